"""Packets, requests and responses as frames of a ZeroMQ message, and signals, which have one frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Final

from google.protobuf.duration_pb2 import Duration
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp

from afspm.basics.errors import AfspmError, InvalidValue, WireError
from afspm.model import (
    CLOCK_REQUEST,
    GRANT_REQUEST,
    LEASE_REQUEST,
    RELAY_REQUEST,
    RESTART_REQUEST,
    ControlRequest,
    ControlResponse,
    Packet,
    Parameter,
    Request,
    Response,
    ResponseDetail,
    request_name,
)
from afspm.model.requests import (
    AS_PLANNED_REQUEST,
    COMPARE_REQUEST,
    KEEP_REQUEST,
    LEND_REQUEST,
    LONGEST_LEASE_S,
    RETURN_REQUEST,
)
from afspm.wire import unit_conversion
from afspm.wire.codec import encode
from afspm.wire.generated import control_pb2, scan_pb2, spectroscopy_pb2
from afspm.wire.mapping import FEEDBACK, GRANT, PARAMETER, RELAYED, SETTINGS, known, time_ns, timestamp
from afspm.wire.messages import parse
from afspm.wire.split import Buffer

PROTOCOL_VERSION: Final = 2

KILL: Final = b"KILL"
"""The packet of one frame to all subscribers that announces the end of the experiment."""
CLOSE: Final = bytes([100])
"""The request of one frame that ends a translator, which subscribes to no publisher and so receives no KILL."""
BEAT: Final = b"\x00"
CLOSING: Final = b"\x01"
LONGEST_ID: Final = 200
LONGEST_ENVELOPE: Final = 1000
"""Limit of an envelope, in bytes."""


def encode_time(time_ns: int) -> bytes:
    """Return the third frame of a packet: a serialised google.protobuf.Timestamp."""
    return timestamp(time_ns).SerializeToString()


def decode_time(frame: Buffer) -> int:
    """Return the time in the third frame of a packet, ns since the Unix epoch.

    Raises:
        WireError: the bytes are no Timestamp, or a time out of range.
    """
    try:
        return time_ns(Timestamp.FromString(bytes(frame)))
    except (DecodeError, InvalidValue) as error:
        raise WireError(f"the bytes are no Timestamp: {error}") from None


def encode_packet(packet: Packet) -> list[Buffer]:
    """Return the frames [envelope, message] and, for a packet with a time, [timestamp]."""
    frames: list[Buffer] = [packet.envelope.encode(), packet.payload]
    if packet.time_ns is not None:
        frames.append(encode_time(packet.time_ns))
    return frames


def decode_packet(frames: Sequence[Buffer]) -> Packet:
    """Return a packet of two or three frames, with its message still in bytes.

    Raises:
        WireError: the frames are no packet.
    """
    if not 2 <= len(frames) <= 3:
        raise WireError(f"a packet of {len(frames)} frames instead of two or three")
    if len(frames[0]) > LONGEST_ENVELOPE:
        raise WireError(f"an envelope of {len(frames[0])} bytes")
    try:
        envelope = str(frames[0], "utf-8")
    except UnicodeDecodeError:
        raise WireError("an envelope that is not UTF-8 text") from None
    time_ns = decode_time(frames[2]) if len(frames) == 3 else None
    return Packet(envelope, frames[1], time_ns)


def encode_request(request: Request) -> list[bytes]:
    """Return the frames [number, object, id], without empty frames at the end."""
    frames = [bytes([request.kind]), request.payload or encode_subject(request.subject), request.id.encode()]
    while len(frames) > 1 and not frames[-1]:
        frames.pop()
    return frames


def encode_subject(subject: object) -> bytes:
    """Return the subject of a request in bytes; empty for None.

    A whole number is one byte, a float is a Duration in seconds, text is an ActionMsg, and a model object its message.
    """
    if subject is None:
        return b""
    if isinstance(subject, int):
        return bytes([subject])
    if isinstance(subject, float):
        seconds, nanos = divmod(round(subject * 1e9), 10**9)
        return Duration(seconds=seconds, nanos=nanos).SerializeToString()
    if isinstance(subject, str):
        # long names are not cached, since 256 of them could take much memory
        return _action_message(subject) if len(subject) <= LONGEST_ID else _new_action_message(subject)
    return encode(subject)[1]


def _new_action_message(name: str) -> bytes:
    return control_pb2.ActionMsg(action=name).SerializeToString()


_action_message = lru_cache(256)(_new_action_message)


def decode_request(frames: Sequence[Buffer]) -> Request:
    """Return a request of one to three frames.

    Raises:
        WireError: the frames are no request; with the `response` to send: REP_CMD_NOT_SUPPORTED for an unknown number,
            REP_PARAM_ERROR for an invalid value, else REP_FAILURE.
    """
    if not 1 <= len(frames) <= 3:
        raise WireError(f"a request of {len(frames)} frames instead of one to three")
    if len(frames[0]) != 1:
        raise WireError(f"a request whose first frame has {len(frames[0])} bytes instead of one")
    kind = frames[0][0]
    subject_of = _SUBJECTS.get(kind)
    if subject_of is None:
        raise WireError(f"there is no request {kind}", response=ControlResponse.CMD_NOT_SUPPORTED)
    payload = bytes(frames[1]) if len(frames) > 1 else b""
    request_id = _request_id(frames[2]) if len(frames) == 3 else ""
    try:
        return Request(kind, subject_of(payload), payload, request_id)
    except AfspmError as error:
        response = error.response if isinstance(error, WireError) else ControlResponse.PARAM_ERROR
        raise WireError(f"{request_name(kind)}: {error}", response=response) from error


def id_of(frames: Sequence[Buffer]) -> str:
    """Return the id of a request, even a malformed one, for its refusal; empty without an id of a valid length."""
    return str(frames[2], "utf-8", "replace") if len(frames) == 3 and len(frames[2]) <= LONGEST_ID else ""


def _request_id(frame: Buffer) -> str:
    if len(frame) > LONGEST_ID:
        raise WireError(f"a request id of {len(frame)} bytes", hint=f"at most {LONGEST_ID}")
    try:
        return str(frame, "utf-8")
    except UnicodeDecodeError:
        raise WireError("a request id that is not UTF-8 text") from None


def encode_response(response: Response) -> list[bytes]:
    """Return the frames [number, object, reason, id, detail, again], without empty frames at the end."""
    detail = bytes([response.detail]) if response.detail else b""
    again = b"" if response.again_ns is None else encode_time(response.again_ns)
    frames = [bytes([response.code]), response.payload, response.reason.encode(), response.id.encode(), detail, again]
    while len(frames) > 1 and not frames[-1]:
        frames.pop()
    return frames


def decode_response(frames: Sequence[Buffer]) -> Response:
    """Return a response of one to six frames; frames that a newer peer appends are ignored.

    Raises:
        WireError: the frames are no response.
    """
    count = len(frames)
    if not count or len(frames[0]) != 1:
        raise WireError(f"a response of {count} frames, the first of {len(frames[0]) if frames else 0} bytes")
    payload = bytes(frames[1]) if count > 1 else b""
    # text for people: a wrong byte in it must not hide the answer
    reason = str(frames[2], "utf-8", "replace") if count > 2 and frames[2] else ""
    request_id = str(frames[3], "utf-8", "replace") if count > 3 else ""
    detail = known(ResponseDetail, frames[4][0]) if count > 4 and frames[4] else ResponseDetail.NONE
    again_ns = decode_time(frames[5]) if count > 5 and frames[5] else None
    return Response(frames[0][0], payload, reason, request_id, detail, again_ns)


def decode_parameter(payload: Buffer) -> Parameter:
    """Return the parameter in the answer to REQ_PARAM, with the value in force.

    Raises:
        WireError: the bytes are no parameter.
    """
    try:
        return PARAMETER.decode(payload)
    except AfspmError as error:
        raise WireError(f"the answer holds no parameter: {error}") from error


def _action(payload: bytes) -> str:
    # cached: an experiment repeats the same few actions
    return _known_action(payload) if len(payload) <= LONGEST_ID else _new_action(payload)


def _new_action(payload: bytes) -> str:
    return unit_conversion.action_from_wire(parse(control_pb2.ActionMsg, payload))


_known_action = lru_cache(256)(_new_action)


def _nothing(payload: bytes) -> None:
    if payload:
        raise WireError(f"an object of {len(payload)} bytes where there should be none")


def _number(payload: bytes) -> int:
    if len(payload) != 1:
        raise WireError(f"an object of {len(payload)} bytes instead of one number")
    return payload[0]


def _seconds(payload: bytes) -> float:
    try:
        duration = Duration.FromString(payload)
    except DecodeError as error:
        raise WireError(f"the bytes are no Duration: {error}") from None
    seconds = duration.seconds + duration.nanos * 1e-9
    if not 0.0 < seconds <= LONGEST_LEASE_S:
        raise InvalidValue(f"a lease of {seconds:g} s", hint=f"above 0 and at most {LONGEST_LEASE_S:g} s")
    return seconds


_SUBJECTS: dict[int, Callable[[bytes], object]] = {
    ControlRequest.ACTION: _action,
    ControlRequest.PARAM: PARAMETER.decode,
    ControlRequest.SET_SCAN_PARAMS: lambda p: unit_conversion.scan_parameters_from_wire(
        parse(scan_pb2.ScanParameters2d, p)
    ),
    ControlRequest.SET_ZCTRL_PARAMS: FEEDBACK.decode,
    ControlRequest.SET_PROBE_POS: lambda p: unit_conversion.position_change_from_wire(
        parse(spectroscopy_pb2.ProbePosition, p)
    ),
    ControlRequest.REQUEST_CTRL: _number,
    ControlRequest.RELEASE_CTRL: _nothing,
    ControlRequest.ADD_EXP_PRBLM: _number,
    ControlRequest.RMV_EXP_PRBLM: _number,
    ControlRequest.SET_CONTROL_MODE: _number,
    ControlRequest.END_EXPERIMENT: _nothing,
    CLOCK_REQUEST: lambda p: None,
    RELAY_REQUEST: RELAYED.decode,
    RESTART_REQUEST: _action,
    LEASE_REQUEST: _seconds,
    GRANT_REQUEST: GRANT.decode,
    LEND_REQUEST: SETTINGS.decode,
    RETURN_REQUEST: SETTINGS.decode,
    COMPARE_REQUEST: SETTINGS.decode,
    KEEP_REQUEST: SETTINGS.decode,
    AS_PLANNED_REQUEST: SETTINGS.decode,
    ControlRequest.ACTION_SUPPORT: _action,
}
