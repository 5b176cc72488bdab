//! The model: regions, scans, spectra and states, in metres and radians.

use std::ops::Deref;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::proto::{ControlMode, ScopeState};
use crate::zmq::Frame;

/// A rectangle rotated about its centre. x points right, y up.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Region {
    /// (x, y) in m.
    pub center_m: [f64; 2],
    /// (width, height) in m before the rotation; both above zero.
    pub size_m: [f64; 2],
    /// Counter-clockwise.
    pub angle_rad: f64,
}

impl Region {
    /// Return an unrotated region from its centre (x, y) and size (width, height) in m.
    pub fn new(center_m: [f64; 2], size_m: [f64; 2]) -> Region {
        Region { center_m, size_m, angle_rad: 0.0 }
    }

    /// Return the region rotated counter-clockwise about its centre.
    pub fn turned(self, angle_rad: f64) -> Region {
        Region { angle_rad, ..self }
    }

    /// Return (x, y) in m of the pixel (row, column) of an array of `shape` (rows, columns).
    pub fn pixel_m(&self, row: usize, column: usize, shape: [usize; 2]) -> [f64; 2] {
        let along = |i: usize, n: usize| if n > 1 { i as f64 / (n - 1) as f64 - 0.5 } else { 0.0 };
        let (u, v) = (along(column, shape[1]) * self.size_m[0], along(row, shape[0]) * self.size_m[1]);
        let (sin, cos) = self.angle_rad.sin_cos();
        [self.center_m[0] + cos * u - sin * v, self.center_m[1] + sin * u + cos * v]
    }

    pub(crate) fn checked(self) -> Result<Region> {
        let values = [self.center_m[0], self.center_m[1], self.size_m[0], self.size_m[1], self.angle_rad];
        if values.iter().all(|value| value.is_finite()) && self.size_m[0] > 0.0 && self.size_m[1] > 0.0 {
            return Ok(self);
        }
        let Region { center_m: [x, y], size_m: [width, height], angle_rad } = self;
        Err(Error::Invalid(format!(
            "{width:e} m x {height:e} m at ({x:e}, {y:e}) m, turned by {angle_rad} rad, is no region: sizes are above zero"
        )))
    }

    /// Return whether all corners of two regions differ by less than `tolerance` of their size.
    pub(crate) fn is_near(&self, other: &Region, tolerance: f64) -> bool {
        let distance = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
        let size_m = self.size_m[0].hypot(self.size_m[1]);
        let turned = (self.angle_rad - other.angle_rad).sin().atan2((self.angle_rad - other.angle_rad).cos());
        distance(self.center_m, other.center_m) <= tolerance * size_m
            && distance(self.size_m, other.size_m) <= tolerance * size_m
            && turned.abs() <= tolerance
    }
}

/// Numbers in the buffer that ZeroMQ received, or in a copy if they arrived in several pieces.
pub struct Values(Kept);

enum Kept {
    Received { frame: Frame, offset: usize, count: usize },
    Copied(Vec<f64>),
}

impl Values {
    /// Take `count` numbers at `offset` of a received frame.
    ///
    /// Unaligned numbers are shifted by up to seven bytes within the buffer, over the bytes before them.
    pub(crate) fn received(mut frame: Frame, offset: usize, count: usize) -> Values {
        const { assert!(cfg!(target_endian = "little"), "the numbers of the wire are little-endian") };
        let bytes = frame.bytes_mut();
        let odd = (bytes.as_ptr() as usize + offset) % align_of::<f64>();
        if odd > offset {
            return Values::copied(&bytes[offset..offset + 8 * count]);
        }
        if odd > 0 {
            bytes.copy_within(offset..offset + 8 * count, offset - odd);
        }
        Values(Kept::Received { frame, offset: offset - odd, count })
    }

    /// Copy packed numbers.
    pub(crate) fn copied(bytes: &[u8]) -> Values {
        let numbers = bytes.chunks_exact(8).map(|number| f64::from_le_bytes(number.try_into().expect("eight bytes")));
        Values(Kept::Copied(numbers.collect()))
    }

    /// Return whether the numbers are a view of the buffer that ZeroMQ received.
    pub fn is_view(&self) -> bool {
        matches!(self.0, Kept::Received { .. })
    }
}

impl Deref for Values {
    type Target = [f64];

    fn deref(&self) -> &[f64] {
        match &self.0 {
            // SAFETY: aligned and inside of the frame, see `received`; every bit pattern is a number
            Kept::Received { frame, offset, count } => unsafe {
                std::slice::from_raw_parts(frame.as_ptr().add(*offset).cast(), *count)
            },
            Kept::Copied(numbers) => numbers,
        }
    }
}

impl std::fmt::Debug for Values {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} values", self.len())
    }
}

/// One channel of a scan, or some rows of a running scan.
#[derive(Debug)]
pub struct Scan {
    /// Region of the scan.
    pub region: Region,
    /// Such as "Height Retrace".
    pub channel: String,
    /// Unit of the values; empty if unknown.
    pub unit: String,
    /// [rows, columns].
    pub shape: [usize; 2],
    /// [y][x], row after row, both coordinates ascending; empty for parameters alone.
    pub values: Values,
    /// The end of the scan, in ns since 1970; for rows, its start.
    pub time_ns: Option<i64>,
    /// The controller's own file; empty if there is none.
    pub filename: String,
    /// For rows, the index of the first one within the whole scan.
    pub first_row: usize,
}

impl Scan {
    /// Return the value of the pixel (row, column).
    pub fn at(&self, row: usize, column: usize) -> f64 {
        self.values[row * self.shape[1] + column]
    }
}

/// Curves measured at one position.
#[derive(Debug)]
pub struct Spectrum {
    /// Such as "IV".
    pub kind: String,
    /// (x, y) in m; None if unknown.
    pub position_m: Option<[f64; 2]>,
    /// Of the variables.
    pub names: Vec<String>,
    /// Of the variables.
    pub units: Vec<String>,
    /// [points, variables] of `values`.
    pub shape: [usize; 2],
    /// All variables of the first point, then of the second.
    pub values: Values,
    /// The time of measurement, in ns since 1970.
    pub time_ns: Option<i64>,
    pub filename: String,
}

/// The activity of the microscope.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ScopeStatus {
    pub state: ScopeState,
    pub paused: bool,
}

/// The holder of control, and the problems that withhold it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ControlStatus {
    pub mode: ControlMode,
    /// The name of the component in control; None for none.
    pub holder: Option<String>,
    /// Numbers of the flagged problems, ascending.
    pub problems: Vec<u8>,
}

/// Region and number of pixels of the next scan, as far as given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScanParameters {
    pub region: Option<Region>,
    /// [rows, columns].
    pub shape: Option<[usize; 2]>,
}

/// The value of a parameter as text, in its unit.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Parameter {
    pub name: String,
    pub value: String,
    pub unit: Option<String>,
}

/// The z feedback. None: unknown, or in a request unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Feedback {
    pub on: Option<bool>,
    /// In the controller's own unit.
    pub proportional_gain: Option<f32>,
    /// In the controller's own unit.
    pub integral_gain: Option<f32>,
    /// In the unit of the operating mode: A for a tunnelling current, V, m, Hz or N in force microscopy.
    pub setpoint: Option<f32>,
}

/// A decoded message.
#[derive(Debug)]
pub enum Message {
    Scan(Scan),
    Lines(Scan),
    Spectrum(Spectrum),
    Scope(ScopeStatus),
    Control(ControlStatus),
    ScanParameters(ScanParameters),
    Feedback(Feedback),
    ProbePosition([f64; 2]),
    /// Another message of the wire format or of the experiment file, in bytes.
    Other(Vec<u8>),
}

/// A published message with its envelope and time.
#[derive(Debug)]
pub struct Packet {
    /// Such as "Scan2d_2000.0_Height Retrace".
    pub envelope: String,
    /// The name of the message, such as "Scan2d".
    pub name: String,
    /// The time of its first publication, in ns since 1970.
    pub time_ns: Option<i64>,
    pub message: Message,
}

impl Packet {
    /// Return the scan in this packet, if any.
    pub fn scan(&self) -> Option<&Scan> {
        match &self.message {
            Message::Scan(scan) => Some(scan),
            _ => None,
        }
    }

    /// Return the spectrum in this packet, if any.
    pub fn spectrum(&self) -> Option<&Spectrum> {
        match &self.message {
            Message::Spectrum(spectrum) => Some(spectrum),
            _ => None,
        }
    }

    /// Return the numbers of a scan, rows or a spectrum; none for other messages.
    pub fn values(&self) -> &[f64] {
        match &self.message {
            Message::Scan(scan) | Message::Lines(scan) => &scan.values,
            Message::Spectrum(spectrum) => &spectrum.values,
            _ => &[],
        }
    }

    pub(crate) fn size(&self) -> usize {
        let other = if let Message::Other(bytes) = &self.message { bytes.len() } else { 0 };
        8 * self.values().len() + other + self.envelope.len() + 200
    }
}
