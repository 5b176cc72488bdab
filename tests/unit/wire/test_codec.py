"""Arrays as views, envelopes, users' own messages, and bytes without a message."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp
from hypothesis import given
from hypothesis import strategies as st

from afspm import wire
from afspm.basics.errors import InvalidValue, WireError
from afspm.model import (
    LEASE_REQUEST,
    ControlRequest,
    ControlResponse,
    Feedback,
    Parameter,
    PositionChange,
    ProbePosition,
    Region,
    RegionChange,
    Request,
    Response,
    ResponseDetail,
    Scan,
    ScanLines,
    ScanParameters,
    Spectrum,
)
from afspm.model.scan import ShapeChange
from afspm.wire.frames import decode_time, encode_subject, encode_time
from afspm.wire.generated import journal_pb2

SCAN = Scan(
    Region((1e-6, -2e-6), (2e-6, 1e-6), 0.25), "Height", "m", np.arange(12.0).reshape(3, 4), 1_700_000_000_000_000_001
)


LINES = ScanLines(
    SCAN.region, (5, 4), "Height", "m", 2, np.arange(8.0).reshape(2, 4), began_ns=1_700_000_000_000_000_001
)


def test_lines_of_a_scan_survive() -> None:
    name, payload = wire.encode(LINES)
    assert name == wire.message_of("ScanLines") == "ScanLines"
    lines = wire.decode(name, payload)
    np.testing.assert_array_equal(lines.values, LINES.values)
    assert (lines.shape, lines.first_row, lines.channel, lines.unit) == ((5, 4), 2, "Height", "m")
    assert (lines.region, lines.began_ns) == (LINES.region, LINES.began_ns)
    assert wire.header(name, payload).channel == "Height"


@pytest.mark.parametrize(("first_row", "columns"), [(4, 4), (2, 3), (0, 0)])
def test_lines_outside_of_their_scan_are_refused(first_row: int, columns: int) -> None:
    from afspm.wire.generated.lines_pb2 import ScanLines as Message

    message = Message.FromString(wire.encode(LINES)[1])
    message.first_row, message.params.data.shape.x = first_row, columns
    with pytest.raises(WireError):
        wire.decode("ScanLines", message.SerializeToString())


def test_a_picture_is_made_up_of_lines() -> None:
    picture = LINES.into()
    assert np.isnan(picture).all(axis=1).tolist() == [True, True, False, False, True]
    rest = ScanLines(LINES.region, (5, 4), "Height", "m", 0, np.ones((2, 4)))
    assert rest.into(picture) is picture
    assert picture[:4, 0].tolist() == [1, 1, 0, 4]


def test_a_scans_values_are_a_view_of_the_buffer() -> None:
    payload = bytearray(wire.encode(SCAN)[1])
    scan = wire.decode("Scan2d", memoryview(payload))
    at = bytes(payload).index(np.float64(5.0).tobytes())
    payload[at : at + 8] = np.float64(-5.0).tobytes()
    assert scan.values[1, 1] == -5.0


def test_scan_survives_with_any_layout_of_its_array() -> None:
    values = np.arange(24.0).reshape(4, 6)[::-1, ::2]
    scan = Scan(SCAN.region, "Height", "m", values)
    np.testing.assert_array_equal(wire.decode("Scan2d", wire.encode(scan)[1]).values, values)


def test_values_that_a_peer_sends_in_pieces_are_put_together() -> None:
    """Protocol Buffers allow a repeated field in several packed pieces, and unpacked."""
    empty = wire.encode(Scan(SCAN.region, "Height", "m", np.empty((0, 0))))[1]
    from afspm.wire.generated.scan_pb2 import Scan2d

    message = Scan2d.FromString(empty)
    message.params.data.shape.x, message.params.data.shape.y = 3, 1
    one = bytes([4 << 3 | 2, 8]) + np.float64(1.0).tobytes()
    two = bytes([4 << 3 | 1]) + np.float64(2.0).tobytes()
    scan = wire.decode("Scan2d", one + message.SerializeToString() + two + one)
    np.testing.assert_array_equal(scan.values, [[1.0, 2.0, 1.0]])


def test_the_header_of_a_scan_is_read_without_its_values() -> None:
    header = wire.header("Scan2d", wire.encode(SCAN)[1])
    assert (header.channel, header.size_m, header.time_ns) == ("Height", (2e-6, 1e-6), 1_700_000_000_000_000_001)


def test_a_spectrum_survives_a_round_trip() -> None:
    spectrum = Spectrum((1e-9, 2e-9), "IV", ("Bias", "Current"), ("V", "A"), np.arange(6.0).reshape(3, 2), 5, "a.dat")
    again = wire.decode("Spec1d", wire.encode(spectrum)[1])
    np.testing.assert_array_equal(again["Current"], [1.0, 3.0, 5.0])
    assert (again.position_m, again.kind, again.units) == ((1e-9, 2e-9), "IV", ("V", "A"))
    assert wire.header("Spec1d", wire.encode(spectrum)[1]).kind == "IV"


@pytest.mark.parametrize("unit", ["px", "V", "nonsense"])
def test_a_length_in_a_unit_of_another_kind_is_refused_with_the_reason(unit: str) -> None:
    from afspm.wire.generated.spectroscopy_pb2 import ProbePosition as Message

    message = Message(units=unit)
    message.point.x = message.point.y = 1.0
    with pytest.raises(WireError, match=unit) as refused:
        wire.decode_request([bytes([ControlRequest.SET_PROBE_POS]), message.SerializeToString()])
    assert refused.value.response == ControlResponse.PARAM_ERROR


def test_only_the_fields_that_are_present_are_set() -> None:
    payload = encode_subject(ScanParameters(RegionChange(width_m=3e-6)))
    request = wire.decode_request([bytes([ControlRequest.SET_SCAN_PARAMS]), payload])
    current = ScanParameters(SCAN.region, (3, 4), "m")
    changed = request.subject.onto(current)
    assert changed.region.size_m == (3e-6, 1e-6)
    assert changed.region.top_left_m == pytest.approx(SCAN.region.top_left_m)
    assert (changed.region.angle_rad, changed.shape) == (0.25, (3, 4))


def test_single_coordinate_or_number_of_pixels_can_be_requested() -> None:
    from afspm.wire.generated.spectroscopy_pb2 import ProbePosition as Message

    message = Message(units="um")
    message.point.y = 2.0
    request = wire.decode_request([bytes([ControlRequest.SET_PROBE_POS]), message.SerializeToString()])
    assert request.subject == PositionChange(None, 2e-6)
    payload = encode_subject(ScanParameters(shape=ShapeChange(columns=64)))
    request = wire.decode_request([bytes([ControlRequest.SET_SCAN_PARAMS]), payload])
    assert request.subject.shape == ShapeChange(None, 64)
    assert request.subject.onto(ScanParameters(SCAN.region, (3, 4), "m")).shape == (3, 64)


@pytest.mark.parametrize(
    "subject",
    [
        Feedback(setpoint=float("nan")),
        Feedback(integral_gain=float("inf")),
        ProbePosition((float("nan"), 0.0)),
        ScanParameters(RegionChange(width_m=0.0)),
        ScanParameters(RegionChange(left_m=float("inf"))),
    ],
)
def test_invalid_values_are_refused(subject: object) -> None:
    kind = {Feedback: 4, ProbePosition: 5, ScanParameters: 3}[type(subject)]
    with pytest.raises(WireError) as refused:
        wire.decode_request([bytes([kind]), encode_subject(subject)])
    assert refused.value.response == ControlResponse.PARAM_ERROR


def test_empty_region_is_refused_with_its_size_in_a_readable_unit() -> None:
    payload = encode_subject(ScanParameters(RegionChange(height_m=-7.5e-6)))
    with pytest.raises(WireError, match=r"the height of the region is -7\.5 µm"):
        wire.decode_request([bytes([ControlRequest.SET_SCAN_PARAMS]), payload])


def test_an_unknown_request_is_not_supported() -> None:
    with pytest.raises(WireError) as refused:
        wire.decode_request([b"\x63"])
    assert refused.value.response == ControlResponse.CMD_NOT_SUPPORTED


@pytest.mark.parametrize(
    "frames",
    [[], [b""], [b"\x06"], [b"\x06", b"\x01\x02"], [b"\x07", b"x"], [b"\x01", b""], [b"\x01", b"\xff"], [b"ab"]],
)
def test_requests_that_break_off_are_refused(frames: list[bytes]) -> None:
    with pytest.raises(WireError):
        wire.decode_request(frames)


def test_a_response_carries_reason_id_and_detail() -> None:
    response = Response(ControlResponse.NO_RESPONSE, b"", "not sent: why", "a/1/2", ResponseDetail.NOT_SENT)
    assert wire.decode_response(wire.encode_response(response)) == response
    plain = Response(ControlResponse.PARAM_ERROR, b"", "tip-bias-voltage: 12 V is above 10 V", "a/1/2")
    assert wire.decode_response(wire.encode_response(plain)) == plain
    assert len(wire.encode_response(plain)) == 4
    too_soon = replace(plain, again_ns=1_750_000_000_000_000_007)
    assert wire.decode_response(wire.encode_response(too_soon)) == too_soon


def test_frames_appended_by_a_newer_peer_are_ignored() -> None:
    newer = [b"\1", b"", b"why", b"a/1/2", bytes([200]), b"", b"more"]
    assert wire.decode_response(newer) == Response(ControlResponse.FAILURE, b"", "why", "a/1/2")


def test_parameter_without_a_value_is_a_reading() -> None:
    request = wire.decode_request(wire.encode_request(Request(ControlRequest.PARAM, Parameter("scan-speed"), id="1")))
    assert request.subject == Parameter("scan-speed")


@pytest.mark.parametrize(
    ("envelope", "message"),
    [
        ("Scan2d", "Scan2d"),
        ("Scan2d_2000.0_Height Retrace", "Scan2d"),
        ("Scan2d_2000.0_a_channel_with_underscores", "Scan2d"),
        ("ScanParameters2d", "ScanParameters2d"),
    ],
)
def test_message_of_an_envelope_is_found(envelope: str, message: str) -> None:
    assert wire.message_of(envelope) == message


@pytest.mark.parametrize("envelope", ["", "Scan", "Scan2", "Scan2dx", "Nobody_knows", "_", "KILL"])
def test_envelope_without_a_message_is_refused(envelope: str) -> None:
    with pytest.raises(WireError):
        wire.message_of(envelope)


def test_users_may_add_a_message_type() -> None:
    file = descriptor_pb2.FileDescriptorProto(name="crystal_test.proto", package="lab", syntax="proto3")
    message = file.message_type.add(name="CrystalAngle")
    message.field.add(name="angle", number=1, type=1, label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    angle = message_factory.GetMessageClass(pool.FindMessageTypeByName("lab.CrystalAngle"))
    wire.register(angle)
    assert wire.register(angle) is angle
    name, payload = wire.encode(angle(angle=0.5))
    assert wire.decode(wire.message_of(name), payload).angle == 0.5
    assert wire.header(name, payload).message == "CrystalAngle"


def test_object_that_is_no_message_cannot_be_sent() -> None:
    with pytest.raises(InvalidValue, match="dict"):
        wire.encode({})


@given(st.integers(-(10**18), 2**63 - 1))
def test_a_time_is_the_timestamp_that_the_library_makes(time_ns: int) -> None:
    library = Timestamp(seconds=time_ns // 10**9, nanos=time_ns % 10**9).SerializeToString(deterministic=True)
    assert encode_time(time_ns) == library
    assert decode_time(library) == decode_time(memoryview(library)) == time_ns


def test_a_time_that_no_record_could_keep_is_refused() -> None:
    late = Timestamp(seconds=2**40)
    with pytest.raises(WireError, match="1099511627776 s"):
        decode_time(late.SerializeToString())
    line = journal_pb2.LogLines(lines=[{"timestamp": late, "name": "series", "level": "INFO", "text": "?"}])
    with pytest.raises(WireError, match="1099511627776 s"):
        wire.decode("LogLines", line.SerializeToString())


@given(st.binary(max_size=24))
def test_any_bytes_are_the_time_that_the_library_reads_or_a_wire_error(data: bytes) -> None:
    try:
        read = decode_time(data)
    except WireError:
        return
    with contextlib.suppress(DecodeError):
        library = Timestamp.FromString(data)
        assert read == library.seconds * 10**9 + library.nanos


@given(st.binary(max_size=300))
def test_any_bytes_are_a_message_or_a_wire_error(data: bytes) -> None:
    for name in ("Scan2d", "Spec1d", "ScanParameters2d", "ControlState", "ScopeStateMsg", "SpatialROIWithScoreList"):
        for read in (wire.decode, wire.header):
            with contextlib.suppress(WireError):
                read(name, data)


@given(st.integers(0, 10_000), st.integers(0, 255))
def test_a_damaged_scan_is_a_scan_or_a_wire_error(at: int, byte: int) -> None:
    payload = bytearray(wire.encode(SCAN)[1])
    payload[at % len(payload)] = byte
    try:
        scan = wire.decode("Scan2d", bytes(payload))
    except WireError:
        return
    assert scan.values.ndim == 2


@given(st.lists(st.binary(max_size=40), max_size=5))
def test_any_frames_are_understood_or_refused(frames: list[bytes]) -> None:
    for read in (wire.decode_request, wire.decode_response, wire.decode_packet):
        with contextlib.suppress(WireError):
            read(frames)


@pytest.mark.parametrize("lease_s", [1e-9, 0.5, 20.0, 86_400.0])
def test_lease_is_sent_in_seconds(lease_s: float) -> None:
    assert wire.decode_request(wire.encode_request(Request(LEASE_REQUEST, lease_s, id="1"))).subject == lease_s


@pytest.mark.parametrize("lease_s", [0.0, -1.0, 86_400.5])
def test_a_lease_without_an_end_is_refused(lease_s: float) -> None:
    with pytest.raises(WireError, match="a lease of"):
        wire.decode_request(wire.encode_request(Request(LEASE_REQUEST, lease_s, id="1")))
