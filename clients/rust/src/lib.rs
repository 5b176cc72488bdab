//! Components for afspm experiments, which automate scanning probe microscopes.
//!
//! A component is a process with one purpose. It receives measurements, and requests from the Microscope Scheduler control,
//! scans, spectra and settings. Lengths are in metres, angles in radians, times in nanoseconds since 1970.
//!
//! ```no_run
//! use afspm::{Client, Region};
//!
//! fn main() -> std::process::ExitCode {
//!     afspm::run(|client: &Client| {
//!         let scan = client.scan(Some(Region::new([0.0, 0.0], [1e-6, 1e-6])), Some([64, 64]), Some("first"), None)?;
//!         for channel in scan.scans() {
//!             client.log("INFO", &format!("{}: {} values in {}", channel.channel, channel.values.len(), channel.unit));
//!         }
//!         client.end_experiment()
//!     })
//! }
//! ```

mod client;
mod control;
mod cycle;
mod error;
mod heartbeat;
mod json;
mod keyed;
mod launch;
mod measure;
mod model;
mod parent;
mod shared;
mod sockets;
mod wire;
mod zmq;

/// The messages of the wire format, generated from `proto/*.proto`.
pub mod proto {
    #![allow(missing_docs, clippy::all)]
    include!(concat!(env!("OUT_DIR"), "/afspm.rs"));
}

pub use client::{Client, Snapshot};
pub use control::Control;
pub use error::{response_name, Error, Refusal, Result};
pub use json::{from_json, recoded, to_json};
pub use launch::{Clock, Keys, Launch, Sockets};
pub use measure::Measured;
pub use model::{
    ControlStatus, Feedback, Message, Packet, Parameter, Region, Scan, ScanParameters, ScopeStatus, Spectrum, Values,
};
pub use proto::{ControlMode, ControlRequest, ControlResponse, ScopeState};
pub use wire::Response;

/// Decode a packet of two or three frames: envelope, message and timestamp.
pub fn decode_packet(frames: &[&[u8]]) -> Result<Packet> {
    wire::packet(frames.iter().map(|frame| zmq::Frame::copy_of(frame)).collect())
}

/// Run a component that `afspm run` started, and return its exit code.
pub fn run(component: impl FnOnce(&Client) -> Result<()>) -> std::process::ExitCode {
    let ended = Client::launched().and_then(|client| {
        let result = component(&client);
        client.close();
        result
    });
    let Err(error) = ended else { return 0.into() };
    if !matches!(error, Error::Ended | Error::Stopped) {
        eprintln!("ERROR {error}");
    }
    error.exit_code().into()
}
