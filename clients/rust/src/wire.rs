//! Packets, requests and responses as frames. The only module that knows units and corners of the wire format.

use prost::Message as _;
use prost_types::Timestamp;

use crate::error::{Error, Result};
use crate::model::{
    ControlStatus, Feedback, Message, Packet, Parameter, Region, Scan, ScanParameters, ScopeStatus, Spectrum, Values,
};
use crate::proto;
use crate::zmq::Frame;

pub const KILL: &[u8] = b"KILL";
pub const CLOCK: u8 = 101;
pub const RELAY: u8 = 102;
pub const OTHER_RUN: u8 = 100;
const LONGEST_ENVELOPE: usize = 1000;

/// The position of a message's numbers, and its other fields.
struct Split {
    rest: Vec<u8>,
    chunks: Vec<(usize, usize)>,
}

fn varint(bytes: &[u8], at: &mut usize) -> Result<u64> {
    let mut value = 0;
    for shift in (0..64).step_by(7) {
        let byte = *bytes.get(*at).ok_or_else(broken)?;
        *at += 1;
        value |= u64::from(byte & 0x7f) << shift;
        if byte < 0x80 {
            return Ok(value);
        }
    }
    Err(broken())
}

fn broken() -> Error {
    Error::Wire("the message breaks off".into())
}

/// Extract the field at `path` (numbers of nested fields) from a message, so that its numbers never become a list.
fn split(bytes: &[u8], start: usize, path: &[u64]) -> Result<Split> {
    let mut found = Split { rest: Vec::new(), chunks: Vec::new() };
    let mut at = 0;
    while at < bytes.len() {
        let begin = at;
        let tag = varint(bytes, &mut at)?;
        let length = match tag & 7 {
            0 => {
                let mut end = at;
                varint(bytes, &mut end)?;
                end - at
            }
            1 => 8,
            2 => usize::try_from(varint(bytes, &mut at)?).map_err(|_| broken())?,
            5 => 4,
            kind => return Err(Error::Wire(format!("byte {begin} begins a field of the unknown kind {kind}"))),
        };
        let end = at.checked_add(length).filter(|end| *end <= bytes.len()).ok_or_else(broken)?;
        let is_ours = tag >> 3 == path[0];
        if is_ours && path.len() > 1 && tag & 7 == 2 {
            let inner = split(&bytes[at..end], start + at, &path[1..])?;
            prost::encoding::encode_varint(tag, &mut found.rest);
            prost::encoding::encode_varint(inner.rest.len() as u64, &mut found.rest);
            found.rest.extend(inner.rest);
            found.chunks.extend(inner.chunks);
        } else if is_ours && path.len() == 1 && matches!(tag & 7, 1 | 2) {
            found.chunks.push((start + at, length));
        } else {
            found.rest.extend(&bytes[begin..end]);
        }
        at = end;
    }
    Ok(found)
}

fn parse<T: prost::Message + Default>(bytes: &[u8]) -> Result<T> {
    T::decode(bytes).map_err(|error| Error::Wire(error.to_string()))
}

/// Decode a message with its numbers at `path`.
fn parse_with_values<T: prost::Message + Default>(frame: Frame, path: &[u64]) -> Result<(T, Values)> {
    let Split { rest, chunks } = split(&frame, 0, path)?;
    if chunks.iter().any(|(_, length)| length % 8 != 0) {
        return Err(Error::Wire("values that are no float64 numbers".into()));
    }
    let values = match chunks[..] {
        [(offset, length)] => Values::received(frame, offset, length / 8),
        _ => Values::copied(
            &chunks.iter().flat_map(|(at, length)| &frame[*at..at + length]).copied().collect::<Vec<_>>(),
        ),
    };
    Ok((parse(&rest)?, values))
}

pub fn time_ns(stamp: &Timestamp) -> Option<i64> {
    stamp.seconds.checked_mul(1_000_000_000)?.checked_add(i64::from(stamp.nanos))
}

pub fn timestamp(time_ns: i64) -> Timestamp {
    Timestamp { seconds: time_ns.div_euclid(1_000_000_000), nanos: time_ns.rem_euclid(1_000_000_000) as i32 }
}

/// Return a length or angle in SI.
fn in_si(value: f64, unit: &str) -> Result<f64> {
    let factor = match unit {
        "m" | "rad" | "metre" | "meter" => 1.0,
        "mm" | "mrad" => 1e-3,
        "um" | "µm" | "μm" | "micron" | "urad" => 1e-6,
        "nm" => 1e-9,
        "pm" => 1e-12,
        "\u{c5}" | "\u{212b}" | "A" | "angstrom" => 1e-10,
        "cm" => 1e-2,
        "km" => 1e3,
        "deg" | "degree" | "degrees" | "°" => std::f64::consts::PI / 180.0,
        _ => return Err(Error::Wire(format!("the unit {unit:?} is not known"))),
    };
    Some(value * factor).filter(|value| value.is_finite()).ok_or_else(|| Error::Wire(format!("{value} {unit}")))
}

fn or<'a>(unit: &'a Option<String>, default: &'a str) -> &'a str {
    unit.as_deref().filter(|unit| !unit.is_empty()).unwrap_or(default)
}

fn region(spatial: Option<&proto::SpatialAspects>) -> Result<Option<Region>> {
    let Some((spatial, roi)) = spatial.and_then(|spatial| Some((spatial, spatial.roi.as_ref()?))) else {
        return Ok(None);
    };
    let (Some(corner), Some(size)) = (&roi.top_left, &roi.size) else { return Ok(None) };
    let (Some(x), Some(y), Some(width), Some(height)) = (corner.x, corner.y, size.x, size.y) else { return Ok(None) };
    let unit = or(&spatial.length_units, "m");
    let (x, y, width, height) = (in_si(x, unit)?, in_si(y, unit)?, in_si(width, unit)?, in_si(height, unit)?);
    let angle_rad = in_si(roi.angle.unwrap_or(0.0), or(&spatial.angular_units, "deg"))?;
    let region = Region { center_m: [x + width / 2.0, y + height / 2.0], size_m: [width, height], angle_rad };
    region.checked().map(Some).map_err(|error| Error::Wire(error.to_string()))
}

fn point(point: Option<&proto::Point2d>, unit: &Option<String>) -> Result<Option<[f64; 2]>> {
    let Some((x, y)) = point.and_then(|point| Some((point.x?, point.y?))) else { return Ok(None) };
    let unit = or(unit, "m");
    Ok(Some([in_si(x, unit)?, in_si(y, unit)?]))
}

fn pixels(data: Option<&proto::DataAspects>) -> Option<[usize; 2]> {
    let shape = data?.shape.as_ref()?;
    Some([shape.y? as usize, shape.x? as usize])
}

fn scan_of(
    params: Option<&proto::ScanParameters2d>,
    values: Values,
    channel: Option<String>,
    stamp: Option<&Timestamp>,
) -> Result<Scan> {
    let data = params.and_then(|params| params.data.as_ref());
    let region = region(params.and_then(|params| params.spatial.as_ref()))?;
    Ok(Scan {
        region: region.ok_or_else(|| Error::Wire("a scan without a region".into()))?,
        channel: channel.unwrap_or_default(),
        unit: data.and_then(|data| data.units.clone()).unwrap_or_default(),
        shape: pixels(data).unwrap_or([0, 0]),
        values,
        time_ns: stamp.and_then(time_ns),
        filename: String::new(),
        first_row: 0,
    })
}

fn scan(frame: Frame) -> Result<Scan> {
    let (message, values): (proto::Scan2d, _) = parse_with_values(frame, &[4])?;
    let scan = scan_of(message.params.as_ref(), values, message.channel, message.timestamp.as_ref())?;
    let [rows, columns] = scan.shape;
    if !scan.values.is_empty() && rows.checked_mul(columns) != Some(scan.values.len()) {
        return Err(Error::Wire(format!("{} values of {rows} x {columns} pixels", scan.values.len())));
    }
    Ok(Scan { filename: message.filename.unwrap_or_default(), ..scan })
}

fn lines(frame: Frame) -> Result<Scan> {
    let (message, values): (proto::ScanLines, _) = parse_with_values(frame, &[4])?;
    let scan = scan_of(message.params.as_ref(), values, message.channel, message.timestamp.as_ref())?;
    let columns = scan.shape[1];
    if columns == 0 || scan.values.len() % columns != 0 {
        return Err(Error::Wire(format!("{} values in rows of {columns}", scan.values.len())));
    }
    let rows = scan.values.len() / columns;
    Ok(Scan { first_row: message.first_row.unwrap_or(0) as usize, shape: [rows, columns], ..scan })
}

fn spectrum(frame: Frame) -> Result<Spectrum> {
    let (message, values): (proto::Spec1d, _) = parse_with_values(frame, &[4, 5])?;
    let data = message.data.unwrap_or_default();
    let shape = [data.data_per_variable.unwrap_or(0) as usize, data.num_variables.unwrap_or(0) as usize];
    if shape[0].checked_mul(shape[1]) != Some(values.len()) {
        return Err(Error::Wire(format!("{} values of {} points of {} variables", values.len(), shape[0], shape[1])));
    }
    let position = message.position.unwrap_or_default();
    Ok(Spectrum {
        kind: message.r#type.unwrap_or_default(),
        position_m: point(position.point.as_ref(), &position.units)?,
        names: data.names,
        units: data.units,
        shape,
        values,
        time_ns: message.timestamp.as_ref().and_then(time_ns),
        filename: message.filename.unwrap_or_default(),
    })
}

fn control(bytes: &[u8]) -> Result<ControlStatus> {
    let message: proto::ControlState = parse(bytes)?;
    let mut problems: Vec<u8> = message.problems_set.iter().filter_map(|number| u8::try_from(*number).ok()).collect();
    problems.sort_unstable();
    problems.dedup();
    let mode = message.control_mode();
    Ok(ControlStatus { mode, holder: message.client_in_control_id.filter(|name| !name.is_empty()), problems })
}

/// Decode a message by its name.
pub fn decode(name: &str, frame: Frame) -> Result<Message> {
    Ok(match name {
        "Scan2d" => Message::Scan(scan(frame)?),
        "ScanLines" => Message::Lines(lines(frame)?),
        "Spec1d" => Message::Spectrum(spectrum(frame)?),
        "ScopeStateMsg" => {
            let message: proto::ScopeStateMsg = parse(&frame)?;
            Message::Scope(ScopeStatus { state: message.scope_state(), paused: message.scan_paused() })
        }
        "ControlState" => Message::Control(control(&frame)?),
        "ScanParameters2d" => {
            let message: proto::ScanParameters2d = parse(&frame)?;
            Message::ScanParameters(ScanParameters {
                region: region(message.spatial.as_ref())?,
                shape: pixels(message.data.as_ref()),
            })
        }
        "ZCtrlParameters" => {
            let message: proto::ZCtrlParameters = parse(&frame)?;
            Message::Feedback(Feedback {
                on: message.feedback_on,
                proportional_gain: message.proportional_gain,
                integral_gain: message.integral_gain,
                setpoint: message.set_point,
            })
        }
        "ProbePosition" => {
            let message: proto::ProbePosition = parse(&frame)?;
            let place = point(message.point.as_ref(), &message.units)?;
            Message::ProbePosition(place.ok_or_else(|| Error::Wire("a position without x and y".into()))?)
        }
        _ => Message::Other(frame.to_vec()),
    })
}

/// Return a packet of two or three frames: envelope, message, timestamp.
pub fn packet(mut frames: Vec<Frame>) -> Result<Packet> {
    if !(2..=3).contains(&frames.len()) {
        return Err(Error::Wire(format!("a packet of {} frames instead of two or three", frames.len())));
    }
    let stamp = if frames.len() == 3 { frames.pop() } else { None };
    let (Some(body), Some(envelope)) = (frames.pop(), frames.pop()) else { return Err(broken()) };
    if envelope.len() > LONGEST_ENVELOPE {
        return Err(Error::Wire(format!("an envelope of {} bytes", envelope.len())));
    }
    let text = std::str::from_utf8(&envelope).map_err(|_| Error::Wire("an envelope that is not UTF-8".into()))?;
    let name = text.split('_').next().unwrap_or(text).to_owned();
    let time_ns = match stamp.as_deref() {
        None | Some([]) => None,
        Some(bytes) => {
            let stamp: Timestamp = parse(bytes)?;
            Some(time_ns(&stamp).ok_or_else(|| Error::Wire(format!("a time {} s from 1970", stamp.seconds)))?)
        }
    };
    Ok(Packet { envelope: text.to_owned(), message: decode(&name, body)?, name, time_ns })
}

// --- requests ---

/// The answer to a request, also a refusal.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Response {
    /// The number of a `ControlResponse`.
    pub response: u8,
    /// In bytes; empty for most responses.
    pub object: Vec<u8>,
    /// The reason of a failure, for a person.
    pub reason: String,
    /// 1: not sent; 2: it may or may not have been carried out; 3: the experiment has ended; 0 for none.
    pub detail: u8,
    pub(crate) id: String,
}

impl Response {
    pub fn is_success(&self) -> bool {
        self.response == 0
    }
}

pub fn request(number: u8, object: &[u8], id: &str) -> Vec<Vec<u8>> {
    vec![vec![number], object.to_vec(), id.as_bytes().to_vec()]
}

/// Return a response of one to five frames; frames appended by a newer peer are ignored.
pub fn response(frames: &[Frame]) -> Result<Response> {
    let [number] = frames.first().map_or(&[][..], |frame| frame)[..] else {
        return Err(Error::Wire("a response without its number".into()));
    };
    let text = |i: usize| frames.get(i).map_or(String::new(), |frame| String::from_utf8_lossy(frame).into_owned());
    Ok(Response {
        response: number,
        object: frames.get(1).map_or(Vec::new(), |frame| frame.to_vec()),
        reason: text(2),
        id: text(3),
        detail: frames.get(4).and_then(|frame| frame.first().copied()).unwrap_or(0),
    })
}

pub fn action(name: &str) -> Vec<u8> {
    proto::ActionMsg { action: Some(name.to_owned()) }.encode_to_vec()
}

pub fn parameter(name: &str, value: Option<&str>, unit: Option<&str>) -> Vec<u8> {
    let text = |text: Option<&str>| text.map(str::to_owned);
    proto::ParameterMsg { parameter: text(Some(name)), value: text(value), units: text(unit) }.encode_to_vec()
}

pub fn parameter_from(bytes: &[u8]) -> Result<Parameter> {
    let message: proto::ParameterMsg = parse(bytes)?;
    let unit = message.units.filter(|unit| !unit.is_empty());
    Ok(Parameter { name: message.parameter.unwrap_or_default(), value: message.value.unwrap_or_default(), unit })
}

pub fn position(xy_m: [f64; 2]) -> Vec<u8> {
    let point = proto::Point2d { x: Some(xy_m[0]), y: Some(xy_m[1]) };
    proto::ProbePosition { point: Some(point), units: Some("m".into()) }.encode_to_vec()
}

pub fn feedback(feedback: &Feedback) -> Vec<u8> {
    proto::ZCtrlParameters {
        feedback_on: feedback.on,
        proportional_gain: feedback.proportional_gain,
        integral_gain: feedback.integral_gain,
        set_point: feedback.setpoint,
    }
    .encode_to_vec()
}

pub fn scan_parameters(wanted: &ScanParameters) -> Vec<u8> {
    let spatial = wanted.region.map(|region| proto::SpatialAspects {
        roi: Some(proto::RotRect2d {
            top_left: Some(proto::Point2d {
                x: Some(region.center_m[0] - region.size_m[0] / 2.0),
                y: Some(region.center_m[1] - region.size_m[1] / 2.0),
            }),
            size: Some(proto::Size2d { x: Some(region.size_m[0]), y: Some(region.size_m[1]) }),
            angle: Some(region.angle_rad.to_degrees()),
        }),
        length_units: Some("m".into()),
        angular_units: Some("deg".into()),
    });
    let data = wanted.shape.map(|[rows, columns]| proto::DataAspects {
        shape: Some(proto::Size2u { x: Some(columns as u32), y: Some(rows as u32) }),
        units: None,
    });
    proto::ScanParameters2d { spatial, data }.encode_to_vec()
}

/// Return the object of the request by which the scheduler publishes a message.
pub fn told<T: prost::Message>(name: &str, message: &T) -> Vec<u8> {
    proto::Told { message: Some(name.into()), payload: Some(message.encode_to_vec()) }.encode_to_vec()
}

/// Return a scan or spectrum as the bytes of its message.
pub fn measurement(packet: &Packet) -> Vec<u8> {
    match &packet.message {
        Message::Scan(scan) => {
            let params = ScanParameters { region: Some(scan.region), shape: Some(scan.shape) };
            let mut params = parse::<proto::ScanParameters2d>(&scan_parameters(&params)).unwrap_or_default();
            params.data.get_or_insert_default().units = Some(scan.unit.clone());
            proto::Scan2d {
                params: Some(params),
                timestamp: scan.time_ns.map(timestamp),
                channel: Some(scan.channel.clone()),
                values: scan.values.to_vec(),
                filename: Some(scan.filename.clone()),
            }
            .encode_to_vec()
        }
        Message::Spectrum(spectrum) => proto::Spec1d {
            position: spectrum.position_m.and_then(|xy_m| parse(&position(xy_m)).ok()),
            filename: Some(spectrum.filename.clone()),
            timestamp: spectrum.time_ns.map(timestamp),
            data: Some(proto::SpecData {
                num_variables: Some(spectrum.shape[1] as u32),
                data_per_variable: Some(spectrum.shape[0] as u32),
                names: spectrum.names.clone(),
                units: spectrum.units.clone(),
                values: spectrum.values.to_vec(),
            }),
            r#type: Some(spectrum.kind.clone()),
        }
        .encode_to_vec(),
        Message::Other(bytes) => bytes.clone(),
        _ => Vec::new(),
    }
}
