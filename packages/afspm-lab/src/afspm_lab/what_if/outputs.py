"""Conversion of a component's requests and published messages into comparable outputs."""

from __future__ import annotations

from collections.abc import Sequence

from afspm import wire
from afspm.basics import AfspmError, WireError, replace
from afspm.model import CLOCK_REQUEST, RELAY_REQUEST, ControlRequest, ProblemNames, request_name
from afspm.scheduler.control.descriptions import request_text
from afspm_lab.what_if.alignment import Output, PacketName

_PROBLEMS = (ControlRequest.ADD_EXP_PRBLM, ControlRequest.RMV_EXP_PRBLM)
_CREATION_TIMES = {"time_ns", "written_ns"}
_HARMLESS = (CLOCK_REQUEST, RELAY_REQUEST, ControlRequest.ACTION_SUPPORT)


class OutputReader:
    """Converter of the frames of one life of a component into outputs.

    Args:
        life: number of the life, from 1.
    """

    def __init__(self, problems: ProblemNames, life: int) -> None:
        self._problems = problems
        self._life = life

    def request(self, frames: Sequence[bytes], packet: PacketName | None, time_ns: int) -> Output | None:
        """Return a request as an output; None for the clock request that opens each connection."""
        try:
            request = wire.decode_request(frames)
        except WireError as error:
            return Output("unreadable request", "", b"".join(frames), str(error), packet, time_ns, self._life)
        if request.kind == CLOCK_REQUEST:
            return None
        kind, subject = request_name(request.kind), request.subject
        if request.kind == RELAY_REQUEST:
            return self.message(subject.message, bytes(subject.payload), packet, time_ns)
        if request.kind in _PROBLEMS:
            key = self._problems.name(int(subject))
        else:
            key = str(subject) if isinstance(subject, int | str) else getattr(subject, "name", "")
        reads = request.kind == ControlRequest.PARAM and subject.value is None
        reaches = request.kind not in _HARMLESS and not reads
        text = request_text(request, self._problems)
        return Output(
            kind, key, bytes(frames[1]) if len(frames) > 1 else b"", text, packet, time_ns, self._life, reaches
        )

    def message(self, envelope: str, payload: bytes, packet: PacketName | None, time_ns: int) -> Output:
        """Return a published message as an output; the creation time is not part of its value."""
        try:
            message = wire.message_of(envelope)
            thing = wire.decode(message, payload)
            made_at = dict.fromkeys(_CREATION_TIMES & {*getattr(thing, "__dataclass_fields__", ())}, 0)
            if made_at:
                thing = replace(thing, **made_at)
                payload = bytes(wire.encode(thing)[1])
        except AfspmError:  # a message of a package that is not installed here: its bytes are compared
            message, thing = envelope, payload
        text = getattr(thing, "text", None) or " ".join(repr(thing).split())
        key = envelope if envelope != message else ""
        return Output(message, key, payload, text, packet, time_ns, self._life)

    def end(self, how: int | str, packet: PacketName | None, time_ns: int) -> Output:
        """Return the end of a life as an output."""
        text = how if isinstance(how, str) else f"exit code {how}"
        return Output("end", "", str(how), f"ends: {text}", packet, time_ns, self._life)
