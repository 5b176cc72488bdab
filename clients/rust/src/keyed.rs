//! Keyed measurements happen once: the intent is on disk before the request, the result after it.

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::cycle::Target;
use crate::error::{Error, Result};
use crate::launch::Launch;
use crate::measure::Measured;
use crate::model::Packet;
use crate::wire;
use crate::zmq::Frame;

/// The intent: a measurement about to be requested.
#[derive(Serialize, Deserialize)]
pub struct Intent {
    pub key: String,
    pub target: Target,
    pub attempt: u64,
    pub since_ns: Option<i64>,
    pub interruptions: Vec<String>,
}

/// The first line of a result; the messages follow it.
#[derive(Serialize, Deserialize)]
struct Head {
    key: String,
    target: Target,
    interruptions: Vec<String>,
    packets: Vec<Kept>,
}

#[derive(Serialize, Deserialize)]
struct Kept {
    envelope: String,
    name: String,
    time_ns: Option<i64>,
    bytes: usize,
}

fn folder(launch: &Launch) -> Option<PathBuf> {
    let folder = launch.state_dir.join(format!("{}.results", launch.name.replace(['/', '\\', ':'], "_")));
    (!launch.state_dir.as_os_str().is_empty()).then_some(folder)
}

/// Return a file name that is readable, safe on every file system, and unique for each key.
fn path(launch: &Launch, key: &str) -> Option<PathBuf> {
    let plain: String = key
        .chars()
        .take(60)
        .map(|c| if c.is_ascii_alphanumeric() || c == '-' { c.to_ascii_lowercase() } else { '_' })
        .collect();
    let hash = key.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3) // FNV-1a
    });
    Some(folder(launch)?.join(format!("{plain}-{hash:016x}")))
}

pub fn checked(key: &str) -> Result<&str> {
    if key.is_empty() || key.len() > 100 || key.contains('/') || key.chars().any(char::is_control) {
        return Err(Error::Invalid(format!("{key:?} can't be a key: 1 to 100 printable characters without '/'")));
    }
    Ok(key)
}

/// Return the stored intent without a result.
pub fn pending(launch: &Launch) -> Result<Option<Intent>> {
    let Some(file) = folder(launch).map(|folder| folder.join("pending.json")) else { return Ok(None) };
    read(&file)?.map(|bytes| parse(&file, &bytes)).transpose()
}

/// Store the intent before its request.
pub fn intend(launch: &Launch, intent: &Intent) -> Result<()> {
    let Some(folder) = folder(launch) else { return Ok(()) };
    write(&folder.join("pending.json"), &[&serde_json::to_vec(intent).expect("plain values")])
}

/// Return the stored result of this key.
pub fn find(launch: &Launch, key: &str, target: &Target) -> Result<Option<Measured>> {
    let Some(file) = path(launch, key) else { return Ok(None) };
    let Some(bytes) = read(&file)? else { return Ok(None) };
    let broken = || Error::File(format!("{}: not all of it is there; remove it to measure anew", file.display()));
    let end = bytes.iter().position(|byte| *byte == b'\n').ok_or_else(broken)?;
    let head: Head = parse(&file, &bytes[..end])?;
    if head.key != key || head.target != *target {
        return Err(Error::Invalid(format!("the key {key:?} was used for another measurement: {:?}", head.target)));
    }
    let mut at = end + 1;
    let mut packets = Vec::new();
    for Kept { envelope, name, time_ns, bytes: length } in head.packets {
        let body = bytes.get(at..at + length).ok_or_else(broken)?;
        at += length;
        let message = wire::decode(&name, Frame::copy_of(body))?;
        packets.push(Arc::new(Packet { envelope, name, time_ns, message }));
    }
    Ok(Some(Measured { packets, interruptions: head.interruptions }))
}

/// Store the result, and remove the intent.
pub fn fulfil(launch: &Launch, key: &str, target: &Target, measured: &Measured) -> Result<()> {
    let (Some(file), Some(folder)) = (path(launch, key), folder(launch)) else { return Ok(()) };
    let bodies: Vec<Vec<u8>> = measured.packets.iter().map(|packet| wire::measurement(packet)).collect();
    let kept = |(packet, body): (&Arc<Packet>, &Vec<u8>)| Kept {
        envelope: packet.envelope.clone(),
        name: packet.name.clone(),
        time_ns: packet.time_ns,
        bytes: body.len(),
    };
    let head = Head {
        key: key.to_owned(),
        target: target.clone(),
        interruptions: measured.interruptions.clone(),
        packets: measured.packets.iter().zip(&bodies).map(kept).collect(),
    };
    let mut line = serde_json::to_vec(&head).expect("plain values");
    line.push(b'\n');
    let parts: Vec<&[u8]> = std::iter::once(&*line).chain(bodies.iter().map(Vec::as_slice)).collect();
    write(&file, &parts)?;
    remove(&folder.join("pending.json"))
}

pub fn forget(launch: &Launch, key: &str) -> Result<()> {
    path(launch, key).map_or(Ok(()), |file| remove(&file))
}

fn failed(file: &Path, error: &dyn std::fmt::Display) -> Error {
    Error::File(format!("{}: {error}", file.display()))
}

fn parse<T: DeserializeOwned>(file: &Path, bytes: &[u8]) -> Result<T> {
    serde_json::from_slice(bytes).map_err(|error| failed(file, &error))
}

fn read(file: &Path) -> Result<Option<Vec<u8>>> {
    match fs::read(file) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(failed(file, &error)),
    }
}

fn remove(file: &Path) -> Result<()> {
    match fs::remove_file(file) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(failed(file, &error)),
        _ => Ok(()),
    }
}

/// Write a file atomically, and flush it to the disk.
fn write(file: &Path, parts: &[&[u8]]) -> Result<()> {
    let partial = file.with_extension("partial");
    let written = (|| {
        fs::create_dir_all(file.parent().unwrap_or(Path::new(".")))?;
        let mut out = File::create(&partial)?;
        for part in parts {
            out.write_all(part)?;
        }
        out.sync_all()?;
        fs::rename(&partial, file)
    })();
    written.map_err(|error| failed(file, &error))
}
