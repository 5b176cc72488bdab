//! What was published or measured, one packet or several, and any message as JSON.

use std::ffi::{c_char, c_double, c_int};
use std::sync::Arc;

use native::{Message, Packet, Scan, Spectrum};

use crate::texts::{bytes, copy, fit_all, put, required};
use crate::{invalid, plain, Outcome};

/// Packets that belong together: the channels of a scan, a spectrum, or one that was published.
pub struct Packets {
    packets: Vec<Arc<Packet>>,
    interruptions: Vec<String>,
}

impl Packets {
    pub(crate) unsafe fn hand_out(
        packets: Vec<Arc<Packet>>,
        interruptions: Vec<String>,
        out: *mut *mut Packets,
    ) -> Outcome {
        let out = out.as_mut().ok_or_else(|| invalid("there is nowhere to put what came"))?;
        *out = Box::into_raw(Box::new(Packets { packets, interruptions }));
        Ok(())
    }
}

unsafe fn packet<'a>(packets: *const Packets, index: c_int) -> Option<&'a Packet> {
    let packets = &packets.as_ref()?.packets;
    packets.get(usize::try_from(index).ok()?).map(Arc::as_ref)
}

unsafe fn scan<'a>(packets: *const Packets, index: c_int) -> Option<&'a Scan> {
    match &packet(packets, index)?.message {
        Message::Scan(scan) | Message::Lines(scan) => Some(scan),
        _ => None,
    }
}

unsafe fn spectrum<'a>(packets: *const Packets, index: c_int) -> Option<&'a Spectrum> {
    packet(packets, index)?.spectrum()
}

/// Return a fact about a packet; an error if it has none.
unsafe fn fact<T>(out: *mut T, found: Option<T>) -> c_int {
    plain(|| {
        put(out, found.ok_or_else(|| invalid("this packet does not tell that"))?);
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_packets_free(packets: *mut Packets) {
    if !packets.is_null() {
        drop(Box::from_raw(packets));
    }
}

#[no_mangle]
pub unsafe extern "C" fn afspm_count(packets: *const Packets) -> c_int {
    packets.as_ref().map_or(0, |packets| packets.packets.len() as c_int)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_interruptions(packets: *const Packets) -> c_int {
    packets.as_ref().map_or(0, |packets| packets.interruptions.len() as c_int)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_interruption(
    packets: *const Packets,
    index: c_int,
    out: *mut c_char,
    capacity: c_int,
) -> c_int {
    let why = packets.as_ref().and_then(|packets| packets.interruptions.get(usize::try_from(index).ok()?));
    copy(why.map_or("", String::as_str), out, capacity)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_envelope(
    packets: *const Packets,
    index: c_int,
    out: *mut c_char,
    capacity: c_int,
) -> c_int {
    copy(packet(packets, index).map_or("", |packet| &packet.envelope), out, capacity)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_message(
    packets: *const Packets,
    index: c_int,
    out: *mut c_char,
    capacity: c_int,
) -> c_int {
    copy(packet(packets, index).map_or("", |packet| &packet.name), out, capacity)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_time_ns(packets: *const Packets, index: c_int, out: *mut i64) -> c_int {
    fact(out, packet(packets, index).and_then(|packet| packet.time_ns))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_finished_ns(packets: *const Packets, index: c_int, out: *mut i64) -> c_int {
    let of_spectrum = spectrum(packets, index).and_then(|spectrum| spectrum.time_ns);
    fact(out, scan(packets, index).map_or(of_spectrum, |scan| scan.time_ns))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_channel(
    packets: *const Packets,
    index: c_int,
    out: *mut c_char,
    capacity: c_int,
) -> c_int {
    let kind = spectrum(packets, index).map_or("", |spectrum| &spectrum.kind);
    copy(scan(packets, index).map_or(kind, |scan| &scan.channel), out, capacity)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_unit(packets: *const Packets, index: c_int, out: *mut c_char, capacity: c_int) -> c_int {
    copy(scan(packets, index).map_or("", |scan| &scan.unit), out, capacity)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_column_name(
    packets: *const Packets,
    index: c_int,
    column: c_int,
    out: *mut c_char,
    capacity: c_int,
) -> c_int {
    let name = spectrum(packets, index).and_then(|spectrum| spectrum.names.get(usize::try_from(column).ok()?));
    copy(name.map_or("", String::as_str), out, capacity)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_column_unit(
    packets: *const Packets,
    index: c_int,
    column: c_int,
    out: *mut c_char,
    capacity: c_int,
) -> c_int {
    let unit = spectrum(packets, index).and_then(|spectrum| spectrum.units.get(usize::try_from(column).ok()?));
    copy(unit.map_or("", String::as_str), out, capacity)
}

#[no_mangle]
pub unsafe extern "C" fn afspm_shape(
    packets: *const Packets,
    index: c_int,
    rows: *mut c_int,
    columns: *mut c_int,
) -> c_int {
    let of_spectrum = spectrum(packets, index).map(|spectrum| spectrum.shape);
    let found = scan(packets, index).map(|scan| scan.shape).or(of_spectrum);
    put(columns, found.map_or(0, |shape| shape[1] as c_int));
    fact(rows, found.map(|shape| shape[0] as c_int))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_first_row(packets: *const Packets, index: c_int, out: *mut c_int) -> c_int {
    fact(out, scan(packets, index).map(|scan| scan.first_row as c_int))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_values(packets: *const Packets, index: c_int, out: *mut *const c_double) -> i64 {
    let values = packet(packets, index).map_or(&[][..], Packet::values);
    put(out, if values.is_empty() { std::ptr::null() } else { values.as_ptr() });
    values.len() as i64
}

#[no_mangle]
pub unsafe extern "C" fn afspm_copy_values(
    packets: *const Packets,
    index: c_int,
    out: *mut c_double,
    capacity: i64,
) -> c_int {
    plain(|| Ok(fit_all(packet(packets, index).map_or(&[][..], Packet::values), out, capacity)?))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_is_view(packets: *const Packets, index: c_int) -> c_int {
    let of_spectrum = spectrum(packets, index).is_some_and(|spectrum| spectrum.values.is_view());
    c_int::from(scan(packets, index).map_or(of_spectrum, |scan| scan.values.is_view()))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_region(packets: *const Packets, index: c_int, out: *mut c_double) -> c_int {
    plain(|| {
        let region = scan(packets, index).ok_or_else(|| invalid("this packet is no scan"))?.region;
        let [[x, y], [width, height]] = [region.center_m, region.size_m];
        Ok(fit_all(&[x, y, width, height, region.angle_rad], out, 5)?)
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_pixel(
    packets: *const Packets,
    index: c_int,
    row: c_int,
    column: c_int,
    x_m: *mut c_double,
    y_m: *mut c_double,
) -> c_int {
    let place = scan(packets, index).and_then(|scan| {
        let (row, column) = (usize::try_from(row).ok()?, usize::try_from(column).ok()?);
        (row < scan.shape[0] && column < scan.shape[1]).then(|| scan.region.pixel_m(row, column, scan.shape))
    });
    put(y_m, place.map_or(0.0, |place| place[1]));
    fact(x_m, place.map(|place| place[0]))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_position(
    packets: *const Packets,
    index: c_int,
    x_m: *mut c_double,
    y_m: *mut c_double,
) -> c_int {
    let place = spectrum(packets, index).and_then(|spectrum| spectrum.position_m);
    put(y_m, place.map_or(0.0, |place| place[1]));
    fact(x_m, place.map(|place| place[0]))
}

#[no_mangle]
pub unsafe extern "C" fn afspm_bytes(packets: *const Packets, index: c_int, out: *mut *const u8) -> i64 {
    let found = match packet(packets, index).map(|packet| &packet.message) {
        Some(Message::Other(bytes)) => &bytes[..],
        _ => &[],
    };
    put(out, found.as_ptr());
    found.len() as i64
}

#[no_mangle]
pub unsafe extern "C" fn afspm_decode(
    envelope: *const c_char,
    message: *const u8,
    size: i64,
    out: *mut *mut Packets,
) -> c_int {
    plain(|| {
        let packet = native::decode_packet(&[required(envelope)?.as_bytes(), bytes(message, size)?])?;
        Packets::hand_out(vec![Arc::new(packet)], Vec::new(), out)
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_to_json(
    message: *const c_char,
    encoded: *const u8,
    size: i64,
    out: *mut c_char,
    capacity: c_int,
    length: *mut c_int,
) -> c_int {
    plain(|| {
        let json = native::to_json(required(message)?, bytes(encoded, size)?)?;
        put(length, c_int::try_from(json.len()).unwrap_or(c_int::MAX));
        Ok(crate::texts::fit(&json, out, capacity)?)
    })
}

#[no_mangle]
pub unsafe extern "C" fn afspm_from_json(
    message: *const c_char,
    json: *const c_char,
    out: *mut u8,
    capacity: i64,
    size: *mut i64,
) -> c_int {
    plain(|| {
        let encoded = native::from_json(required(message)?, required(json)?)?;
        put(size, encoded.len() as i64);
        Ok(fit_all(&encoded, out, capacity)?)
    })
}
