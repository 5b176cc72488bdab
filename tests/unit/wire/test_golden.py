"""The reference bytes of the wire format, in both directions."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import json_format

from afspm import model, wire
from afspm.model import ControlRequest, ControlResponse, requests
from afspm.wire.messages import MessageKind, declared, message_type

GOLDEN = json.loads((Path(__file__).parents[3] / "proto" / "golden.json").read_text(encoding="utf-8"))
AS_MODEL = {
    "Scan2d",
    "Spec1d",
    "ScanParameters2d",
    "ZCtrlParameters",
    "ProbePosition",
    "ScopeStateMsg",
    "ControlState",
    "ScanLines",
    "JournalEntries",
    "ProcessStates",
    "LogLines",
    "Progress",
    "Note",
    "MeasurementSettings",
    "InstrumentReadings",
    "Grant",
    "Approvals",
    "Loans",
    "Proposal",
    "TipStatus",
    "ZCtrlUnits",
    "ChannelRoles",
    "ActByHand",
    "MeasurementConditions",
}


def each(kind: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("entry", GOLDEN[kind], ids=lambda entry: entry.get("name") or entry["envelope"])


def parsed(name: str, payload: bytes) -> Any:
    return message_type(name).FromString(payload)


def test_every_declared_message_has_reference_bytes() -> None:
    own = {one.name for one in declared() if one.kind is not MessageKind.PART}
    assert own - {entry["type"] for entry in GOLDEN["messages"]} == set()


def test_every_own_request_has_reference_bytes() -> None:
    numbers = {value for name, value in vars(requests).items() if name.endswith("_REQUEST")}
    assert {entry["request"] for entry in GOLDEN["our_requests"]} == numbers


@each("messages")
def test_bytes_of_a_peer_are_decoded_as_specified(entry: Any) -> None:
    expected = json_format.ParseDict(entry["fields"], message_type(entry["type"])(), ignore_unknown_fields=False)
    assert parsed(entry["type"], bytes.fromhex(entry["hex"])) == expected


@each("messages")
def test_encoded_messages_equal_the_reference_bytes(entry: Any) -> None:
    message = json_format.ParseDict(entry["fields"], message_type(entry["type"])())
    assert message.SerializeToString(deterministic=True).hex() == entry["hex"]


@pytest.mark.parametrize(
    "entry", [e for e in GOLDEN["messages"] if e["type"] in AS_MODEL], ids=lambda entry: entry["name"]
)
def test_model_objects_survive_a_round_trip(entry: Any) -> None:
    """A peer's message, decoded and sent on, has the same content in SI units and the same fields."""
    received = wire.decode(entry["type"], bytes.fromhex(entry["hex"]))
    name, sent = wire.encode(received)
    assert name == entry["type"]
    original, ours = parsed(name, bytes.fromhex(entry["hex"])), parsed(name, sent)
    assert _presence(ours) == _presence(original)
    _same(wire.decode(name, sent), received)


def _presence(message: Any) -> Any:
    # the present fields at every level
    return {
        field.name: _presence(value) if field.message_type and not field.is_repeated else None
        for field, value in message.ListFields()
    }


def _same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    for name in (field.name for field in fields(a)):
        value, other = getattr(a, name), getattr(b, name)
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, other)
        elif isinstance(value, model.Region):
            np.testing.assert_allclose(value.corners_m(), other.corners_m(), rtol=1e-14)
        else:
            assert value == other


def test_the_reference_scan_in_si_units() -> None:
    entry = next(e for e in GOLDEN["messages"] if e["name"] == "scan 3x2")
    scan = wire.decode("Scan2d", bytes.fromhex(entry["hex"]))
    assert scan.region.top_left_m == pytest.approx((-250.5e-9, 125.25e-9))
    assert scan.region.center_m == pytest.approx((749.5e-9, 875.25e-9))
    assert scan.region.size_m == (2e-6, 1.5e-6)
    assert scan.region.angle_rad == pytest.approx(np.radians(12.5))
    assert (scan.channel, scan.unit, scan.filename) == ("Height Retrace", "nm", "C:\\data\\scan0001.ibw")
    assert scan.time_ns == 1_767_225_600_123_456_000
    np.testing.assert_array_equal(scan.values, [[0.0, 1.5, -2.25], [1e-09, 3e300, -0.0]])


def test_the_reference_scan_without_values_has_its_shape() -> None:
    entry = next(e for e in GOLDEN["messages"] if e["name"] == "scan without values")
    scan = wire.decode("Scan2d", bytes.fromhex(entry["hex"]))
    assert (scan.shape, scan.values.size) == ((2, 3), 0)
    assert (scan.parameters.region, scan.parameters.shape, scan.parameters.unit) == (scan.region, (2, 3), "nm")


@each("requests")
def test_requests(entry: Any) -> None:
    frames = [bytes.fromhex(frame) for frame in entry["frames"]]
    request = wire.decode_request(frames)
    assert request.kind == ControlRequest[entry["request"].removeprefix("REQ_")]
    if isinstance(entry["object"], int):
        assert request.subject == entry["object"]
    assert wire.encode_request(request) == frames
    again = wire.decode_request(wire.encode_request(model.Request(request.kind, request.subject, id="exp/1/7")))
    assert (again.kind, again.id) == (request.kind, "exp/1/7")
    assert str(again.subject) == str(request.subject)


@each("our_requests")
def test_requests_that_version_1_does_not_know(entry: Any) -> None:
    frames = [bytes.fromhex(frame) for frame in entry["frames"]]
    request = wire.decode_request(frames)
    assert (request.kind, request.id) == (entry["request"], "exp/1/7")
    if isinstance(request.subject, model.RelayedMessage):
        assert [request.subject.message, bytes(request.subject.payload).hex()] == entry["object"]
    elif isinstance(request.subject, model.Grant | requests.Settings):
        name, payload = wire.encode(request.subject)
        assert [name, payload.hex()] == entry["object"]
    else:
        assert request.subject == entry["object"]
    assert wire.encode_request(model.Request(request.kind, request.subject, id=request.id)) == frames


@each("responses")
def test_responses(entry: Any) -> None:
    frames = [bytes.fromhex(frame) for frame in entry["frames"]]
    response = wire.decode_response(frames)
    assert response.code == entry["response"]
    assert wire.encode_response(response) == frames
    if "object" in entry:
        assert wire.decode_parameter(response.payload) == model.Parameter("scan-speed", "1500.0", "nm/s")


@each("our_responses")
def test_responses_with_what_version_1_does_not_know(entry: Any) -> None:
    frames = [bytes.fromhex(frame) for frame in entry["frames"]]
    response = wire.decode_response(frames)
    assert response == model.Response(3, b"", "why?", "exp/1/7", model.ResponseDetail.NOT_SENT)
    assert wire.encode_response(response) == frames


@each("published")
def test_packets(entry: Any) -> None:
    frames = [bytes.fromhex(frame) for frame in entry["frames"]]
    packet = wire.decode_packet(frames)
    assert packet.envelope == entry["envelope"]
    assert wire.message_of(packet.envelope) == entry["type"]
    assert [bytes(frame) for frame in wire.encode_packet(packet)] == frames


def test_signals_and_heartbeats() -> None:
    assert wire.KILL.hex() == GOLDEN["signals"][0]["frames"][0]
    assert [wire.BEAT.hex(), wire.CLOSING.hex()] == [beat["frames"][0] for beat in GOLDEN["heartbeats"]]


def test_enumerations_have_the_numbers_of_the_contract() -> None:
    from afspm.wire.generated import control_pb2

    for ours, theirs, prefix in (
        (model.ScopeState, control_pb2.ScopeState, "SS_"),
        (model.ControlMode, control_pb2.ControlMode, "CM_"),
        (model.Problem, control_pb2.ExperimentProblem, "EP_"),
        (ControlRequest, control_pb2.ControlRequest, "REQ_"),
        (ControlResponse, control_pb2.ControlResponse, "REP_"),
    ):
        assert {prefix + member.name: int(member) for member in ours} == dict(theirs.items())
