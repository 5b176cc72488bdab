"""Recorded lives of a component, and the port and clock that offer them again."""

from __future__ import annotations

import threading
from base64 import b64decode
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from afspm import wire
from afspm.basics import FileError, NeverLate, PlainList, WireError
from afspm.client.port_log import LifeFacts
from afspm.model import CLOCK_REQUEST, LEASE_REQUEST, RELAY_REQUEST, ControlRequest, ControlResponse, Packet, Response
from afspm.model.requests import RETURN_REQUEST
from afspm.storage.line_log import read_lines
from afspm.transport import ParentGone
from afspm.transport.port import (
    CaughtUp,
    ControlConnected,
    ControlDisconnected,
    Incoming,
    Killed,
    PacketReceived,
    ReplyReceived,
)
from afspm_lab.what_if.alignment import Output, PacketName
from afspm_lab.what_if.outputs import OutputReader

PacketOf = Callable[[int, str], Packet]
"""A function that returns the recorded packet of a time and an envelope."""

_SIGNALS = {one.__name__: one for one in (Killed, ParentGone, ControlConnected, ControlDisconnected)}
_ANSWERABLE = {
    ControlRequest.REQUEST_CTRL, ControlRequest.RELEASE_CTRL, ControlRequest.ADD_EXP_PRBLM,
    ControlRequest.RMV_EXP_PRBLM, ControlRequest.ACTION_SUPPORT, CLOCK_REQUEST, RELAY_REQUEST, LEASE_REQUEST,
    RETURN_REQUEST,
}  # fmt: skip
_DONE = "answered"
_MOST_POLLS = 100_000  # without any progress
_MOST_READINGS = 1_000  # a loop may sleep between two


class LifeOver(BaseException):
    """Raised in the component at the end of its recorded life; a BaseException, so that no error handler catches it."""


@dataclass(slots=True)
class Poll:
    """A recorded return of `poll`, with its events as in the log.

    Attributes:
        readings: the clock readings before the return, as kind and value in turn.
    """

    timeout_s: float | None
    monotonic_s: float
    now_ns: int
    events: PlainList
    readings: PlainList


@dataclass(slots=True)
class Sent:
    """A recorded request, or a message published by the component.

    Attributes:
        frames: frames of the request; for a message (envelope, payload).
        handled: the packet that the component was handling; None if unknown.
        readings: the clock readings before the sending, as kind and value in turn.
    """

    frames: tuple[bytes, ...]
    handled: PacketName | None
    readings: PlainList
    is_request: bool = True


Line = Poll | Sent


@dataclass
class Life:
    """One recorded life of a process, from its start to its end.

    Attributes:
        facts: content of the log line "life".
        end: the exit code, or the type of the error; None if the process was killed.
    """

    facts: LifeFacts
    lines: list[Line] = field(default_factory=list)
    end: int | str | None = None


def read_lives(path: Path) -> list[Life]:
    """Return the recorded lives in a port log.

    Raises:
        FileError: the file can't be read, or is not a port log.
    """
    lives: list[Life] = []
    try:
        for kind, *rest in read_lines(path):
            if kind == "life":
                lives.append(Life(rest[0]))
            elif kind == "poll":
                lives[-1].lines.append(Poll(*rest))
            elif kind == "send":
                frames, handled, readings = rest
                lives[-1].lines.append(Sent(tuple(map(b64decode, frames)), _name(handled), readings))
            elif kind == "publish":
                envelope, payload, handled, readings = rest
                frames = (envelope.encode(), b64decode(payload))
                lives[-1].lines.append(Sent(frames, _name(handled), readings, is_request=False))
            elif kind == "end":
                lives[-1].end = rest[0]
    except (IndexError, TypeError, ValueError) as error:
        raise FileError(f"is not a port log: {error}", where=str(path)) from error
    return lives


def _name(handled: PlainList | None) -> PacketName | None:
    return None if handled is None else PacketName(handled[0] or 0, handled[1])


class ReplayClock(NeverLate):
    """Clock that shows the recorded readings in order; without a reading, the time of the last recorded event.

    As in the record, only readings by the component's own thread count. No time passes between events, so a loop that
    waits for a time, instead of an event, ends the replay.

    Attributes:
        stuck: reason why the clock ended the replay; empty otherwise.
    """

    def __init__(self, monotonic_s: float, now_ns: int, speed: float) -> None:
        self._speed = speed or 1.0
        self._shown: dict[str, float] = {"m": monotonic_s, "n": now_ns, "s": now_ns / 1e9}
        self._coming: dict[str, deque[float]] = defaultdict(deque)
        self._thread = threading.get_ident()
        self._unrecorded = 0  # readings since the last event
        self.stuck = ""

    def monotonic_s(self) -> float:
        return float(self._read("m"))

    def now_ns(self) -> int:
        return int(self._read("n"))

    def now_s(self) -> float:
        return float(self._read("s"))

    def real_s(self, experiment_s: float) -> float:
        coming = self._coming["r"] if threading.get_ident() == self._thread else None
        return float(coming.popleft()) if coming else experiment_s / self._speed

    @property
    def shown_s(self) -> float:
        """The last shown monotonic time."""
        return float(self._shown["m"])

    @property
    def shown_ns(self) -> int:
        """The last shown experiment time."""
        return int(self._shown["n"])

    def expect(self, readings: PlainList) -> None:
        """Take the readings up to the next recorded line; drop earlier readings that were not shown."""
        self._coming.clear()
        for kind, value in zip(readings[::2], readings[1::2], strict=True):
            self._coming[kind].append(value)

    def move(self, monotonic_s: float, now_ns: int) -> None:
        """Advance to the time of an event; the clock never goes back."""
        self._unrecorded = 0
        self._shown["m"] = max(self._shown["m"], monotonic_s)
        if now_ns > self._shown["n"]:
            self._shown["n"], self._shown["s"] = now_ns, now_ns / 1e9

    def pass_by(self, seconds: float) -> None:
        """Advance the clock by real seconds without events."""
        self.move(self._shown["m"] + seconds, self.shown_ns + round(seconds * self._speed * 1e9))

    def _read(self, kind: str) -> float:
        if threading.get_ident() != self._thread:
            return self._shown[kind]
        if coming := self._coming[kind]:
            self._shown[kind] = coming.popleft()
        else:
            self._unrecorded += 1
            if self._unrecorded > _MOST_READINGS:
                self.stuck = "it reads the clock without end, and no time passes"
                raise LifeOver
        return self._shown[kind]


class RecordedLines:
    """The lines of a recorded life in order, with the clock that shows their readings.

    Attributes:
        line: the next line; None after the last.
    """

    def __init__(self, life: Life) -> None:
        facts = life.facts
        self._lines = iter(life.lines)
        self.clock = ReplayClock(facts["monotonic_s"], facts["now_ns"], facts["speed"])
        self.line: Line | None = None
        self.advance()

    def advance(self) -> None:
        self.line = next(self._lines, None)
        self.clock.expect([] if self.line is None else self.line.readings)


class RecordedAnswers:
    """The recorded answers to a component's requests, for requests that may have other ids or another order."""

    def __init__(self, life: Life) -> None:
        self._answers = _answers(life)
        self._asked: Counter[bytes] = Counter()
        self._ids: dict[str, str] = {}  # the id to answer with, by recorded id

    def asked(self, frames: Sequence[bytes]) -> None:
        self._asked[_content(frames)] += 1

    def rename(self, recorded_id: str, request_id: str) -> None:
        """Give the coming recorded answer to a request numbered in another way."""
        if recorded_id != request_id:
            self._ids[recorded_id] = request_id

    def renamed(self, response: Response) -> Response:
        """Return a recorded answer with the id that the component knows."""
        response.id = self._ids.get(response.id, response.id)
        return response

    def to_latest(self, frames: Sequence[bytes], request_id: str) -> Response | None:
        """Return the answer to the n-th recorded request of this content, if asked n times; None if not recorded."""
        recorded, number = self._answers.get(_content(frames), []), self._asked[_content(frames)] - 1
        if number >= len(recorded):
            return None
        recorded_id, response = recorded[number]
        self._ids[recorded_id] = _DONE  # its recorded answer may still come
        return Response(response.code, response.payload, response.reason, request_id, response.detail)

    def last_value(self, name: str, request_id: str) -> Response:
        """Return the last recorded value of a parameter as an answer; a failure if the record has none."""
        for answers in self._answers.values():
            for _, response in reversed(answers):
                if response.ok and response.payload and _parameter_name(response.payload) == name:
                    return Response(response.code, response.payload, "", request_id)
        reason = f"the value of {name} is not in the record"
        return Response(int(ControlResponse.FAILURE), b"", reason, request_id)


class OutputTrace:
    """The outputs of one life, recorded or replayed; repetitions of a request are left out.

    Args:
        now_ns: time of the start of the life.

    Attributes:
        newest: the newest received packet; None before any.
        woken_ns: time of the last wake-up.
    """

    def __init__(self, reader: OutputReader, now_ns: int) -> None:
        self._reader = reader
        self._sent: set[str] = set()
        self.outputs: list[Output] = []
        self.newest: PacketName | None = None
        self.woken_ns = now_ns

    def request(self, frames: Sequence[bytes], handled: PacketName | None) -> None:
        output, request_id = self._reader.request(frames, *self._place(handled)), wire.id_of(frames)
        if output is not None and (not request_id or request_id not in self._sent):
            self.outputs.append(output)
        self._sent.add(request_id)

    def message(self, envelope: str, payload: bytes, handled: PacketName | None) -> None:
        self.outputs.append(self._reader.message(envelope, payload, *self._place(handled)))

    def end(self, how: int | str, handled: PacketName | None) -> None:
        self.outputs.append(self._reader.end(how, *self._place(handled)))

    def _place(self, handled: PacketName | None) -> tuple[PacketName | None, int]:
        # the handled packet and its time; between packets the newest packet and the time of the last wake-up
        if handled is not None:
            return handled, handled.time_ns or self.woken_ns
        return self.newest, self.woken_ns


class ReplayPort:
    """Port that offers a recorded life to a component. See `afspm.transport.port.Port`.

    While the component sends the recorded outputs, every event comes as recorded. After the first difference, a request
    is answered at once, as the n-th recorded request of the same content. Without a recorded answer, a parameter is
    read as its last recorded value (or the read fails), other harmless requests succeed, and a command to the
    microscope ends the replay.

    Attributes:
        differs: whether an output differs from the recorded life.
        unanswered: the command, or the endless polling, that ended the replay early; empty otherwise.
        missing: the error that ended the replay early, because the record lacks a packet; None otherwise.
        handled: returns the packet that the component is handling.
    """

    def __init__(self, life: Life, outputs: OutputReader, packet_of: PacketOf) -> None:
        self._was_killed = life.end is None
        self._recorded = RecordedLines(life)
        self._answers = RecordedAnswers(life)
        self._trace = OutputTrace(outputs, life.facts["now_ns"])
        self._packet_of = packet_of
        self._pending: list[Incoming] = []
        self._polls = 0
        self.differs = False
        self.unanswered = ""
        self.missing: FileError | None = None
        self.handled: Callable[[], Packet | None] = lambda: None

    @property
    def clock(self) -> ReplayClock:
        return self._recorded.clock

    @property
    def outputs(self) -> Sequence[Output]:
        """All outputs of the component so far."""
        return self._trace.outputs

    @property
    def is_over(self) -> bool:
        """Whether all recorded events are delivered and all recorded outputs are passed."""
        return self._recorded.line is None and not self._pending

    def request_since(self, since_ns: int) -> None:
        """Do nothing: the record has what came."""

    def wake_up(self, incoming: Incoming | None = None) -> None:
        if incoming is not None:
            self._pending.append(incoming)

    def wakeup_fileno(self) -> int:
        return -1

    def close(self) -> None:
        """Do nothing: there is nothing to close."""

    # --- outputs of the component ---

    def send(self, frames: Sequence[bytes]) -> None:
        self._end_if_killed()
        there = tuple(map(bytes, frames))
        self._trace.request(there, self._handled())
        self._answers.asked(there)
        if not self._follows(there, is_request=True):
            self._pending.append(ReplyReceived(self._answer(there)))

    def publish(self, envelope: str, payload: bytes) -> None:
        self._end_if_killed()
        self._trace.message(envelope, bytes(payload), self._handled())
        self._follows((envelope.encode(), bytes(payload)), is_request=False)

    def ended(self, how: int | str) -> None:
        """Note the end of the component as its last output."""
        self._trace.end(how, self._handled())

    def _follows(self, frames: tuple[bytes, ...], *, is_request: bool) -> bool:
        line = self._recorded.line
        if self.differs or not isinstance(line, Sent) or (line.frames[:2], line.is_request) != (frames[:2], is_request):
            self.differs = True
            return False
        if is_request:
            self._answers.rename(wire.id_of(line.frames), wire.id_of(frames))
        self._recorded.advance()
        return True

    def _answer(self, frames: tuple[bytes, ...]) -> Response:
        request_id = wire.id_of(frames)
        if (recorded := self._answers.to_latest(frames, request_id)) is not None:
            return recorded
        try:
            request = wire.decode_request(frames)
        except WireError as error:
            return Response(int(error.response), reason=str(error), id=request_id)
        if request.kind == ControlRequest.PARAM and request.subject.value is None:
            return self._answers.last_value(request.subject.name, request_id)
        if request.kind not in _ANSWERABLE:
            self.unanswered = self.unanswered or self.outputs[-1].text
            raise LifeOver
        return Response(int(ControlResponse.SUCCESS), b"", "", request_id)

    def _handled(self) -> PacketName | None:
        packet = self.handled()
        return None if packet is None else PacketName(packet.time_ns or 0, packet.envelope)

    # --- inputs of the component ---

    def poll(self, timeout_s: float | None) -> list[Incoming]:
        if self._pending:
            pending, self._pending = self._pending, []
            return pending
        self._skip_sent()
        self._end_if_over()
        self._polls += 1
        if self._polls > _MOST_POLLS:
            self.unanswered = "it polls without end, and no time passes"
            raise LifeOver
        until_s = None if timeout_s is None else self.clock.shown_s + timeout_s
        while isinstance(line := self._recorded.line, Poll):
            is_due = until_s is None or line.monotonic_s <= until_s
            if line.timeout_s != timeout_s and not is_due:
                break
            self._polls = 0
            self.clock.move(line.monotonic_s, line.now_ns)
            self._trace.woken_ns = line.now_ns
            self._recorded.advance()
            if line.events or line.timeout_s == timeout_s:
                return self._incoming(line.events)
            self._skip_sent()
        self._end_if_over()
        self.clock.pass_by(timeout_s or 0.0)
        self._trace.woken_ns = self.clock.shown_ns
        return []

    def _skip_sent(self) -> None:
        while isinstance(self._recorded.line, Sent):
            self.differs = True
            self._recorded.advance()

    def _incoming(self, written: PlainList) -> list[Incoming]:
        came: list[Incoming] = []
        for kind, *rest in written:
            if kind == "packet":
                envelope, time_ns, source, payload = rest
                came.append(PacketReceived(self._packet(envelope, time_ns, payload), source))
                self._trace.newest = PacketName(time_ns or 0, envelope)
            elif kind == "reply":
                response = wire.decode_response([*map(b64decode, rest)])
                came.append(ReplyReceived(self._answers.renamed(response)))
            else:
                came.append(CaughtUp(rest[0]) if kind == "caught up" else _SIGNALS[kind]())
        return came

    def _packet(self, envelope: str, time_ns: int | None, payload: str | None) -> Packet:
        if payload is not None:
            return Packet(envelope, b64decode(payload), time_ns)
        try:
            return self._packet_of(time_ns or 0, envelope)
        except FileError as error:  # a handler of the component might take it for an error of its own
            self.missing = error
            raise LifeOver from error

    def _end_if_over(self) -> None:
        if self.is_over:
            raise LifeOver

    def _end_if_killed(self) -> None:
        # the next output of a killed process is unknown; a process that ended by itself had no further output
        if self._was_killed:
            self._end_if_over()


def recorded_outputs(life: Life, outputs: OutputReader) -> list[Output]:
    """Return all outputs of a recorded life, and its end if recorded."""
    trace = OutputTrace(outputs, life.facts["now_ns"])
    for line in life.lines:
        if isinstance(line, Poll):
            trace.woken_ns = line.now_ns
            for kind, *rest in line.events:
                if kind == "packet":
                    trace.newest = PacketName(rest[1] or 0, rest[0])
        elif line.is_request:
            trace.request(line.frames, line.handled)
        else:
            trace.message(line.frames[0].decode(), line.frames[1], line.handled)
    if life.end is not None:
        trace.end(life.end, None)
    return trace.outputs


def _answers(life: Life) -> dict[bytes, list[tuple[str, Response]]]:
    # the answers to all requests of one content, in the order in which these were sent
    answered: dict[str, Response] = {}
    for line in life.lines:
        for kind, *rest in line.events if isinstance(line, Poll) else ():
            if kind == "reply":
                response = wire.decode_response([*map(b64decode, rest)])
                answered.setdefault(response.id, response)
    found: dict[bytes, list[tuple[str, Response]]] = defaultdict(list)
    for line in life.lines:
        if isinstance(line, Sent) and line.is_request and (request_id := wire.id_of(line.frames)) in answered:
            found[_content(line.frames)].append((request_id, answered[request_id]))
    return found


def _content(frames: Sequence[bytes]) -> bytes:
    # without the id of the request
    return b"\0".join(frames[:2])


def _parameter_name(payload: bytes) -> str | None:
    try:
        return wire.decode_parameter(payload).name
    except WireError:  # the answer to a request of another kind
        return None
