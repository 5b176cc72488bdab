//! Received values: at every alignment, in several pieces, one by one, or in a number that does not match the header.

use afspm::{decode_packet, proto, Packet, Result};
use prost::Message;

fn scan(channel: &str, values: &[f64]) -> proto::Scan2d {
    let point = proto::Point2d { x: Some(0.0), y: Some(0.0) };
    let size = proto::Size2d { x: Some(20.0), y: Some(10.0) };
    let roi = proto::RotRect2d { top_left: Some(point), size: Some(size), angle: Some(90.0) };
    let spatial = proto::SpatialAspects { roi: Some(roi), length_units: Some("nm".into()), angular_units: None };
    let shape = proto::Size2u { x: Some(values.len() as u32), y: Some(1) };
    let data = proto::DataAspects { shape: Some(shape), units: Some("m".into()) };
    proto::Scan2d {
        params: Some(proto::ScanParameters2d { spatial: Some(spatial), data: Some(data) }),
        timestamp: None,
        channel: Some(channel.into()),
        values: values.to_vec(),
        filename: Some("after the values".into()),
    }
}

fn decoded(message: &[u8]) -> Result<Packet> {
    decode_packet(&[b"Scan2d_20.0_Height", message])
}

#[test]
fn values_at_every_alignment_are_views() {
    let values: Vec<f64> = (0..100).map(|i| f64::from(i) * 0.1).collect();
    for length in 0..16 {
        let packet = decoded(&scan(&"c".repeat(length), &values).encode_to_vec()).unwrap();
        let scan = packet.scan().unwrap();
        assert_eq!(&scan.values[..], &values[..]);
        assert!(scan.values.is_view());
        assert_eq!(scan.values.as_ptr() as usize % align_of::<f64>(), 0);
        assert_eq!((scan.channel.len(), &*scan.filename), (length, "after the values"));
    }
}

#[test]
fn values_in_pieces_are_put_together() {
    let whole = scan("Height", &[]).encode_to_vec();
    let shaped = scan("Height", &[1.0, 2.0, 3.0]);
    let without = proto::Scan2d { values: Vec::new(), ..shaped.clone() }.encode_to_vec();
    let piece = |values: &[f64]| proto::Scan2d { values: values.to_vec(), ..Default::default() }.encode_to_vec();
    let mut unpacked = without.clone();
    for value in [1.0_f64, 2.0, 3.0] {
        unpacked.push(4 << 3 | 1);
        unpacked.extend(value.to_le_bytes());
    }
    for message in [[without, piece(&[1.0]), piece(&[2.0, 3.0])].concat(), unpacked] {
        let packet = decoded(&message).unwrap();
        let scan = packet.scan().unwrap();
        assert_eq!(&scan.values[..], &[1.0, 2.0, 3.0]);
        assert!(!scan.values.is_view());
    }
    assert!(decoded(&whole).unwrap().values().is_empty());
}

#[test]
fn values_that_do_not_fit_are_refused() {
    let mut message = scan("Height", &[1.0, 2.0, 3.0]);
    message.values.push(4.0);
    assert!(decoded(&message.encode_to_vec()).is_err());
    let mut cut = scan("Height", &[]).encode_to_vec();
    cut.extend([4 << 3 | 2, 7, 0, 0, 0, 0, 0, 0, 0]);
    assert!(decoded(&cut).is_err());
}

#[test]
fn pixels_lie_on_the_border_and_turn_about_the_centre() {
    let packet = decoded(&scan("Height", &[0.0; 3]).encode_to_vec()).unwrap();
    let region = packet.scan().unwrap().region;
    let close = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).abs() < 1e-15 && (a[1] - b[1]).abs() < 1e-15;
    assert!(close(region.center_m, [10e-9, 5e-9]));
    assert!(close(region.pixel_m(0, 0, [2, 3]), [15e-9, -5e-9])); // a quarter turn to the left
    assert!(close(region.pixel_m(1, 2, [2, 3]), [5e-9, 15e-9]));
}
