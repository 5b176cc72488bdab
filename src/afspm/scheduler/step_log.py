"""The step log: every input of the scheduler's decisions, and a fingerprint of every effect, for a later replay.

The decisions are pure, so the same inputs must give the same effects: `afspm what-if` checks that. A line of the file
is a list:

- ["life", launch, saved, cached]: the scheduler starts, with the state and the packets restored from disk; `launch` is
  kept without its keys.
- ["step", event, now_s, now_ns, effects, state]: an input, or null for the start itself; `effects` are the results of
  `facts_of`; `state` has a checksum of each part of the state that the step has changed.

Measured values decide nothing, so large scans, lines and spectra are kept compressed, with zeros in place of values. Of
other large packets only the length is kept. The results of a coordinate frame's worker are inputs, too: a replay gets
the recorded results, and starts no worker.
"""

from __future__ import annotations

import json
import logging
import zlib
from base64 import b64decode, b64encode
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import Enum
from pathlib import Path

from afspm import wire
from afspm.basics import PlainList
from afspm.basics.errors import WireError
from afspm.basics.launch import Launch
from afspm.model import (
    CLOCK_REQUEST,
    ControlResponse,
    LoggedPacket,
    Packet,
    PacketHeader,
    Request,
    Response,
    request_name,
)
from afspm.model.snapshot import from_plain, snapshot, to_plain
from afspm.scheduler import events
from afspm.scheduler.coordinate_frame import TIP_FRAME, CoordinateFrame
from afspm.scheduler.saved_state import KIND, VERSION, SavedState
from afspm.scheduler.scheduler_core import SchedulerCore
from afspm.scheduler.settings import SchedulerSettings
from afspm.scheduler.state import SchedulerState
from afspm.storage.line_log import REQUESTS_FOLDER, LineLog
from afspm.wire import Buffer
from afspm.wire.values import with_zeros

INLINE_BYTES = 4096
"""Packets up to this size are kept as they are."""
SUFFIX = ".steps.jsonl"
_PLAIN = (
    events.Connected, events.Disconnected, events.Greeted, events.TranslatorUp, events.TranslatorDown,
    events.TranslatorCaughtUp, events.ProblemSeen, events.Announced, events.Stopped, events.Tick,
)  # fmt: skip
_BY_NAME: dict[str, type] = {event.__name__: event for event in _PLAIN}


@dataclass(frozen=True)
class Restored:
    """The state and packets that a scheduler restores from disk at its start; None and empty for a new run."""

    saved: SavedState | None = None
    cached: tuple[LoggedPacket, ...] = ()


@dataclass(frozen=True)
class Step:
    """One step: its input (None: the start), times, facts of its effects, and checksums of the changed state."""

    event: events.Input | None
    now_s: float
    now_ns: int
    effects: list[PlainList]
    state: dict[str, int]


Keep = Callable[[Restored | Step], None]


class StateSums:
    """Checksums of the parts of a scheduler's state that a step has changed."""

    def __init__(self) -> None:
        self._parts: dict[str, object] = {}
        self._sums: dict[str, int] = {}

    def changed(self, state: SchedulerState) -> dict[str, int]:
        """Return the checksum of each part that has changed since the last call."""
        before = dict(self._sums)
        for name, part in vars(state).items():
            if part is not self._parts.get(name, self):  # most steps leave most parts as they are
                self._parts[name] = part
                self._sums[name] = zlib.crc32(_canonical(part).encode())
        return {name: total for name, total in self._sums.items() if before.get(name) != total}


class RecordedCore(SchedulerCore):
    """A `SchedulerCore` that records every step.

    Args:
        settings, codec, frame: as for `SchedulerCore`.
        keep: called with the beginning of a life, then after every step.
    """

    def __init__(
        self, settings: SchedulerSettings, codec: events.Codec, frame: CoordinateFrame = TIP_FRAME, *, keep: Keep
    ) -> None:
        super().__init__(settings, codec, frame)
        self._keep = keep
        self._beginning = Restored()
        self._sums = StateSums()

    def restore(self, saved: SavedState) -> None:
        self._beginning = replace(self._beginning, saved=saved)
        super().restore(saved)

    def restore_cache(self, packets: Iterable[LoggedPacket]) -> None:
        self._beginning = replace(self._beginning, cached=tuple(packets))
        super().restore_cache(self._beginning.cached)

    def start(self, now_s: float, now_ns: int) -> list[events.Effect]:
        self._keep(self._beginning)
        effects = super().start(now_s, now_ns)
        self._keep(Step(None, now_s, now_ns, [*map(facts_of, effects)], self._sums.changed(self.state)))
        return effects

    def step(self, event: events.Input, now_s: float, now_ns: int) -> list[events.Effect]:
        effects = super().step(event, now_s, now_ns)
        self._keep(Step(event, now_s, now_ns, [*map(facts_of, effects)], self._sums.changed(self.state)))
        return effects


class StepLog:
    """The writer of a scheduler's step log."""

    def __init__(self, log: LineLog, launch: Launch) -> None:
        self._log = log
        self._launch = launch

    @classmethod
    def of_run(cls, launch: Launch, logger: logging.Logger) -> StepLog:
        """Return the log of a scheduler, in the folder of its run."""
        return cls(LineLog(log_path(Path(launch.run_dir or "."), launch.name), logger), launch)

    def keep(self, recorded: Restored | Step) -> None:
        """Append the beginning of a life, or a step."""
        if isinstance(recorded, Step):
            event = None if recorded.event is None else _plain_event(recorded.event)
            self._log.add(["step", event, recorded.now_s, recorded.now_ns, recorded.effects, recorded.state])
            return
        saved = None if recorded.saved is None else snapshot(recorded.saved, KIND, VERSION, lists=True)
        cached = [[_plain_packet(entry.packet), entry.source_ns, entry.history] for entry in recorded.cached]
        launch = json.loads(replace(self._launch, keys=None, beat_token="").to_json())
        self._log.add(["life", launch, saved, cached])


def log_path(run_dir: Path, name: str) -> Path:
    """Return the path of a scheduler's step log."""
    return run_dir / REQUESTS_FOLDER / f"{name}{SUFFIX}"


def read_cached(plain: PlainList) -> tuple[LoggedPacket, ...]:
    """Return the packets from the field `cached` of a line "life"."""
    return tuple(LoggedPacket(_packet(packet), source_ns, history) for packet, source_ns, history in plain)


def read_event(plain: PlainList | None, reports: Iterable[type] = ()) -> events.Input | None:
    """Return the input from the field `event` of a line "step"; None for the start.

    Args:
        reports: the classes that the scheduler's coordinate frame declares.

    Raises:
        KeyError: the input is unknown, or a report of another coordinate frame.
        WireError: the bytes of a message are damaged.
        TypeError, ValueError, AttributeError: the line is damaged.
    """
    if plain is None:
        return None
    name, *given = plain
    if name == "RequestIn":
        connection, who, frames, user, heard_s = given
        return events.RequestIn(connection, who, wire.decode_request([*map(b64decode, frames)]), user, heard_s)
    if name == "PacketIn":
        packet, header = given
        return events.PacketIn(_packet(packet), from_plain(PacketHeader, header))
    if name == "Unreadable":
        return events.Unreadable(given[0], wire.decode_response([*map(b64decode, given[1])]))
    if name == "TranslatorReply":
        return events.TranslatorReply(given[0], wire.decode_response([*map(b64decode, given[1])]))
    if name == "ReplayRequested":
        return events.ReplayRequested(given[0], tuple(given[1]), given[2])
    if name == "FrameReported":
        return events.FrameReported(from_plain({report.__name__: report for report in reports}[given[0]], given[1]))
    made: events.Input = from_plain(_BY_NAME[name], given[0])
    return made


def facts_of(effect: events.Effect) -> PlainList:
    """Return an effect as a list of facts: kind, key, text for people, and the rest."""
    match effect:
        case events.Reply(_, name, response, asked):
            key = f"{name} {request_name(asked)}" if asked else name
            text = f"{_code(response)} {response.reason}".strip()
            payload = b"" if asked == CLOCK_REQUEST else response.payload  # versions and time, which decide nothing
            return ["Reply", key, text, response.id, zlib.crc32(payload), int(response.detail)]
        case events.Forward(number, request):
            return ["Forward", request_name(request.kind), str(request.subject), request.id, number]
        case events.Publish(packet, source_ns, history):
            text, total = f"{len(packet.payload)} bytes", _packet_sum(packet)
            return ["Publish", packet.envelope, text, packet.time_ns, source_ns, history, total]
        case events.Replay(_, packets):
            order = [(packet.envelope, packet.time_ns) for packet in packets]
            return ["Replay", "", f"{len(packets)} packets", zlib.crc32(repr(order).encode())]
        case events.SaveState(state):
            sums = {part.name: _plain_sum(getattr(state, part.name)) for part in fields(state)}
            return ["SaveState", "", "", sums]
        case events.Log(level, text):
            return ["Log", level, text]
        case events.Kill(tip_is_safe):
            return ["Kill", "", "the tip is safe" if tip_is_safe else "the tip is in danger"]
        case events.Delegate(job):
            return ["Delegate", type(job).__name__, "", _plain_sum(job)]


def _code(response: Response) -> str:
    known = ControlResponse._value2member_map_.get(response.code)
    return str(response.code) if known is None else ControlResponse(response.code).name


def _plain_event(event: events.Input) -> PlainList:
    name = type(event).__name__
    match event:
        case events.RequestIn(connection, who, request, user, heard_s):
            return [name, connection, who, _request(request), user, heard_s]
        case events.PacketIn(packet, header):
            return [name, _plain_packet(packet, header.message), to_plain(header)]
        case events.Unreadable(who, response):
            return [name, who, [*map(_text, wire.encode_response(response))]]
        case events.TranslatorReply(number, response):
            return [name, number, [*map(_text, wire.encode_response(response))]]
        case events.ReplayRequested(_, prefixes, since_ns):
            return [name, 0, list(prefixes), since_ns]
        case events.FrameReported(report):
            return [name, type(report).__name__, to_plain(report, lists=True) if is_dataclass(report) else None]
        case _:
            return [name, to_plain(event)]


def _request(request: Request) -> list[str]:
    return [*map(_text, wire.encode_request(request))]


def _plain_packet(packet: Packet, message: str = "") -> PlainList:
    payload: Buffer = packet.payload
    content: object
    if len(payload) <= INLINE_BYTES:
        content = _text(payload)
    elif (zeros := _with_zeros(message, payload)) is not None:
        content = [_text(zlib.compress(zeros, 1))]
    else:
        content = len(payload)
    return [packet.envelope, packet.time_ns, content]


def _packet(plain: PlainList) -> Packet:
    envelope, time_ns, content = plain
    if isinstance(content, int):
        return Packet(envelope, bytes(content), time_ns)
    return Packet(
        envelope, zlib.decompress(b64decode(content[0])) if isinstance(content, list) else b64decode(content), time_ns
    )


def _packet_sum(packet: Packet) -> int:
    if len(packet.payload) <= INLINE_BYTES:
        return zlib.crc32(packet.payload)
    try:
        message = wire.message_of(packet.envelope)
    except WireError:  # [cache] mapping may give any envelopes
        message = ""
    zeros = _with_zeros(message, packet.payload)
    return len(packet.payload) if zeros is None else zlib.crc32(zeros)


def _with_zeros(message: str, payload: Buffer) -> bytes | None:
    return with_zeros(message, payload) if message and wire.declaration(message).has_values else None


def _plain_sum(value: object) -> int:
    return zlib.crc32(_canonical(value).encode())


def _canonical(value: object) -> str:
    # equal for equal values in all processes: no order of a set, and no address of an object
    if isinstance(value, Enum):
        return repr(value.value)
    if is_dataclass(value) and not isinstance(value, type):
        return f"({','.join(_canonical(getattr(value, part.name)) for part in fields(value))})"
    if isinstance(value, Mapping):
        return f"{{{','.join(sorted(f'{_canonical(key)}:{_canonical(item)}' for key, item in value.items()))}}}"
    if isinstance(value, set | frozenset):
        return f"{{{','.join(sorted(map(_canonical, value)))}}}"
    if isinstance(value, list | tuple | deque):
        return f"[{','.join(map(_canonical, value))}]"
    if isinstance(value, float):
        return float.__repr__(value)  # a float of numpy has another one
    if isinstance(value, bytes | bytearray | memoryview):  # a packet that waits may be large
        return f"{len(value)} bytes, {zlib.crc32(value) if len(value) <= INLINE_BYTES else ''}"
    if value is None or isinstance(value, str | int):
        return repr(value)
    return type(value).__name__


def _text(payload: bytes | memoryview) -> str:
    return b64encode(payload).decode()
