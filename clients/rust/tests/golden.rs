//! The reference bytes of `proto/golden.json`, in both directions, and bytes that are none.

use afspm::{decode_packet, from_json, recoded, to_json, Message};
use serde_json::Value;

fn golden() -> Value {
    serde_json::from_str(include_str!("../../../proto/golden.json")).unwrap()
}

fn bytes(hex: &Value) -> Vec<u8> {
    let text = hex.as_str().unwrap();
    (0..text.len()).step_by(2).map(|i| u8::from_str_radix(&text[i..i + 2], 16).unwrap()).collect()
}

#[test]
fn messages_are_read_and_written_as_the_reference_bytes() {
    for entry in golden()["messages"].as_array().unwrap() {
        let (name, wire) = (entry["type"].as_str().unwrap(), bytes(&entry["hex"]));
        let read: Value = serde_json::from_str(&to_json(name, &wire).unwrap()).unwrap();
        assert_eq!(read, entry["fields"], "{name}");
        assert_eq!(from_json(name, &entry["fields"].to_string()).unwrap(), wire, "{name}");
        assert_eq!(recoded(name, &wire).unwrap(), wire, "{name}");
    }
}

#[test]
fn packets_are_read_in_metres_with_their_values() {
    for entry in golden()["published"].as_array().unwrap() {
        let frames: Vec<Vec<u8>> = entry["frames"].as_array().unwrap().iter().map(bytes).collect();
        let packet = decode_packet(&frames.iter().map(Vec::as_slice).collect::<Vec<_>>()).unwrap();
        assert_eq!(packet.envelope, entry["envelope"].as_str().unwrap());
        assert_eq!(packet.name, packet_name(entry));
        assert_eq!(packet.time_ns, Some(1_767_225_600_123_456_000));
        if let Message::Scan(scan) = &packet.message {
            assert!(scan.values.is_view());
            assert_eq!((scan.shape, scan.values.len(), &*scan.channel), ([2, 3], 6, "Height Retrace"));
            assert!(
                (scan.region.size_m[0] - 2e-6).abs() < 1e-15
                    && (scan.region.angle_rad - 12.5_f64.to_radians()).abs() < 1e-12
            );
            assert_eq!((scan.at(0, 1), scan.at(0, 2)), (1.5, -2.25));
        }
        if let Message::Spectrum(spectrum) = &packet.message {
            assert!(spectrum.values.is_view());
            assert_eq!((spectrum.shape, &spectrum.values[..]), ([3, 2], &[-1.0, -0.2, 0.0, 0.01, 1.0, 0.3][..]));
            assert_eq!(spectrum.names, ["Bias", "Current"]);
        }
    }
}

/// Packets truncated at every byte, and with every byte changed: each returns at most an error.
#[test]
fn malformed_packets_are_refused_or_read_but_never_fatal() {
    for entry in golden()["published"].as_array().unwrap() {
        let frames: Vec<Vec<u8>> = entry["frames"].as_array().unwrap().iter().map(bytes).collect();
        for at in 0..frames[1].len() {
            let mut changed = frames[1].clone();
            changed[at] ^= 0xff;
            for body in [&frames[1][..at], &changed] {
                if let Ok(packet) = decode_packet(&[&frames[0], body, &frames[2]]) {
                    let _ = packet.values().iter().sum::<f64>();
                }
                let _ = to_json(&packet_name(entry), body);
            }
        }
    }
    assert!(decode_packet(&[b"Scan2d"]).is_err());
    assert!(decode_packet(&[b"\xff", b"", b""]).is_err());
    assert!(to_json("NoSuchMessage", b"").is_err());
}

fn packet_name(entry: &Value) -> String {
    entry["type"].as_str().unwrap().to_owned()
}
