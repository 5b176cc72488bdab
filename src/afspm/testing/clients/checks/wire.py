"""Checks that a client reads and writes the reference bytes of `proto/golden.json`."""

from __future__ import annotations

import base64
import binascii

from google.protobuf import json_format

from afspm.basics.plain_data import Plain
from afspm.model import ControlRequest, ControlResponse, Packet, ScopeState
from afspm.testing.clients.bench import ClientBench, ScriptedRun
from afspm.testing.clients.client_suite import client_check
from afspm.testing.clients.facts import compare
from afspm.testing.clients.golden import frames_of, golden
from afspm.testing.clients.program import Answer
from afspm.testing.clients.scripted import success
from afspm.testing.conformance import Failed, expect
from afspm.wire import declaration, decode_packet, encode_time, message_type

_PACKET_S = 10.0
_FIRST_NS = 1_767_225_600_123_456_000


def in_base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def bytes_in(answer: Answer, name: str) -> bytes:
    """Return the decoded bytes in a field of an answer.

    Raises:
        Failed: no valid base64 in the field.
    """
    try:
        return base64.b64decode(answer.get(name) or "", validate=True)
    except (binascii.Error, TypeError, ValueError) as error:
        raise Failed(f"{name} in base64", f"{answer} ({error})") from None


@client_check(
    "wire/decode",
    "Every message of `proto/golden.json` is decoded to the right fields.",
    "Compile `proto/` again. Keep presence: a zero that is set is not one that is missing.",
)
def decode(bench: ClientBench) -> None:
    with bench.scripted() as run:
        for entry in golden()["messages"]:
            payload = bytes.fromhex(entry["hex"])
            answer = run.client.succeed("decode", message=entry["type"], bytes=in_base64(payload))
            _require_fields(entry, answer)
            again = bytes_in(answer, "bytes")
            expect(again == payload, f"{entry['name']} encoded again as {payload.hex()}", again.hex())


def _require_fields(entry: Plain, answer: Answer) -> None:
    kind = message_type(entry["type"])
    right = kind.FromString(bytes.fromhex(entry["hex"]))
    try:
        decoded = json_format.ParseDict(answer["fields"], kind())
    except (json_format.ParseError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise Failed(f"the fields of {entry['name']} ({entry['type']})", f"{answer} ({error})") from None
    # as dictionaries: the JSON of some languages has no negative zero; the comparison of bytes finds that
    same = json_format.MessageToDict(decoded) == json_format.MessageToDict(right)
    expect(same, f"{entry['name']} with the fields {entry['fields']}", str(answer.get("fields")))


@client_check(
    "wire/encode",
    "Every message is encoded to the reference bytes.",
    "Write fields in the order of their numbers, repeated numbers packed, and only present fields.",
)
def encode(bench: ClientBench) -> None:
    with bench.scripted() as run:
        for entry in golden()["messages"]:
            answer = run.client.succeed("encode", message=entry["type"], fields=entry["fields"])
            came = bytes_in(answer, "bytes").hex()
            expect(came == entry["hex"], f"{entry['name']} as {entry['hex']}", came)


@client_check(
    "wire/requests",
    "Every request goes out as in `proto/golden.json`, with an id as third frame.",
    "Send number, object, id; the object's frame is there, empty, if there is no object.",
)
def requests(bench: ClientBench) -> None:
    with bench.scripted() as run:
        ids: set[bytes] = set()
        for entry in golden()["requests"]:
            number, payload = (*frames_of(entry), b"")[:2]
            ask(run, number[0], payload)
            frames = run.scheduler.requests[-1].frames
            right = f"{entry['name']} as {number.hex()}, {payload.hex() or 'an empty frame'}, and an id"
            expect(frames[:2] == (number, payload), right, ", ".join(frame.hex() for frame in frames))
            id_ = run.scheduler.requests[-1].id
            _is_id(id_, run)
            expect(id_ not in ids, "an id of its own for each request", id_.decode())
            ids.add(id_)


def ask(run: ScriptedRun, number: int, payload: bytes = b"") -> Answer:
    """Make the client send a request, and return its answer."""
    given = {"object": in_base64(payload)} if payload else {}
    return run.client.do("request", number=number, **given)


def _is_id(id_: bytes, run: ScriptedRun) -> None:
    launch = run.client.launch
    begin = f"{launch.name}/{launch.run}-".encode()
    life, _, number = id_.removeprefix(begin).partition(b"/")
    proper = id_.startswith(begin) and life and number.isdigit() and b"/" not in life and len(id_) <= 200
    expect(proper, f"an id {begin.decode()}<life>/<number> as third frame", repr(id_) if id_ else "no id")


@client_check(
    "wire/responses",
    "Every response is understood, with object, reason and detail; frames beyond the fifth are not looked at.",
    "Read the frames number, object, reason, id, detail, each only if it is there. "
    "An empty message from the scheduler is no answer.",
)
def responses(bench: ClientBench) -> None:
    with bench.scripted() as run:
        for entry in golden()["responses"]:
            code, payload = (*frames_of(entry), b"")[:2]
            reason = "" if code[0] == ControlResponse.SUCCESS else "because µ"
            _answered(run, code[0], payload, reason, 0)
        for detail in (1, 2):
            _answered(run, ControlResponse.NO_RESPONSE, b"", "why?", detail)
        _answered(run, 150, b"", "of a later version", 0)


def _answered(run: ScriptedRun, code: int, payload: bytes, reason: str, detail: int) -> None:
    run.scheduler.reply = lambda request: [
        [],
        [*request.answered(code, payload, reason, detail or 0), *([b"later"] if detail else [])],
    ]
    answer = ask(run, ControlRequest.PARAM, b"\n\x01x")
    run.scheduler.reply = success
    name = response_name(code)
    expect(str(answer.get("response")) == str(name), f"the response {name}", str(answer))
    expect(answer.ok == (code == 0), f"ok = {str(code == 0).lower()} with {name}", str(answer))
    expect(bytes_in(answer, "object") == payload, f"the object {in_base64(payload)!r} with {name}", str(answer))
    if code:
        reply = (answer.get("reason"), answer.get("detail"))
        expect(reply == (reason, detail), f"the reason {reason!r} and the detail {detail} with {name}", str(answer))


def response_name(code: int) -> str | int:
    """Return the name of a response code, as in the client's answers; an unknown code is returned unchanged."""
    known = code in ControlResponse._value2member_map_
    return f"REP_{ControlResponse(code).name}" if known else code


@client_check(
    "wire/packets",
    "Every packet of `proto/golden.json` arrives, with time, region in metres and degrees, and values in their order.",
    "Look at `length_units` and `angular_units`; the message's name is the envelope's up to the first underscore.",
)
def packets(bench: ClientBench) -> None:
    with bench.scripted() as run:
        sent: dict[str, list[bytes]] = {entry["envelope"]: frames_of(entry) for entry in golden()["published"]}
        for entry in golden()["messages"]:
            envelope = f"{entry['type']}_{entry['name'].replace(' ', '-')}"
            if declaration(entry["type"]).has_values:
                sent[envelope] = [envelope.encode(), bytes.fromhex(entry["hex"]), b""]
        for i, frames in enumerate(sent.values()):
            frames[2] = encode_time(_FIRST_NS + i * 1_000_000)
            run.scheduler.publish(*frames)
        for envelope, frames in reversed(sent.items()):
            answer = run.client.succeed("wait", prefix=envelope, timeout_s=_PACKET_S)
            if answer.get("envelope") != envelope:  # ZeroMQ's prefix match also delivers longer envelopes
                answer = run.client.succeed("wait", prefix=envelope, timeout_s=_PACKET_S)
            compare(answer, decode_packet(frames))


@client_check(
    "wire/bad-packets",
    "Packets that can't be read are dropped, and the next good one arrives.",
    "Catch what decoding throws, log it, and go on.",
)
def bad_packets(bench: ClientBench) -> None:
    scan = next(entry for entry in golden()["messages"] if entry["name"] == "scan 3x2")
    payload, time = bytes.fromhex(scan["hex"]), encode_time(_FIRST_NS)
    few = message_type("Scan2d").FromString(payload)
    few.values.append(1.0)  # type: ignore[attr-defined]
    state = message_type("ScopeStateMsg")(scope_state=int(ScopeState.SPEC))
    bad = [
        [b"Scan2d_truncated", payload[:-3], time],
        [b"Scan2d_garbage", b"\xff\xff\xff\xff", time],
        [b"Scan2d_\xff\xfe", payload, time],
        [b"Scan2d_values", few.SerializeToString(), time],
        [b"Scan2d_alone"],
        [b"Scan2d_time", payload, b"\xff\xff"],
        [b"Scan2d_frames", payload, time, b"", b""],
        [b"ScopeStateMsg", b"\xff\xff\xff\xff", time],
        [b"ControlState", b"\x12\xff", time],
        [b"NeverHeardOf_this", b"x", time],
        [b"ScopeStateMsg", state.SerializeToString(), encode_time(_FIRST_NS + 1_000_000)],
    ]
    good = [b"Scan2d_good", payload, encode_time(_FIRST_NS + 2_000_000)]
    with bench.scripted() as run:
        for frames in [*bad, good]:
            run.scheduler.publish(*frames)
        compare(run.client.succeed("wait", prefix="Scan2d_good", timeout_s=_PACKET_S), Packet(
            "Scan2d_good", payload, _FIRST_NS + 2_000_000
        ))  # fmt: skip
        scope_state = run.client.succeed("state").get("scope_state")
        expect(scope_state == "SS_SPEC", "the scope state SS_SPEC, which came after bad ones", str(scope_state))
