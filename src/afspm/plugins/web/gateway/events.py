"""The events of an experiment, numbered by their times, so that a reconnected client can continue."""

from __future__ import annotations

import json
import logging
import threading
from bisect import bisect_right
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from google.protobuf.message import Message

from afspm import open_run, wire
from afspm.basics import AfspmError, WireError, iso_utc
from afspm.components import to_plain
from afspm.model import (
    ControlResponse,
    ControlState,
    JournalEntries,
    JournalEntry,
    ProblemNames,
    ProcessState,
    ProcessStates,
    Scan,
    ScopeStatus,
    Spectrum,
)
from afspm.record import JOURNAL_FILE
from afspm.storage import log_folder, logged_packets

_log = logging.getLogger("afspm.plugins.web.gateway")

# both bounds: notes and log lines may be long
MOST_EVENTS, MOST_BYTES = 20_000, 16 << 20


class Event(NamedTuple):
    """An event in its transmitted form; `time_ns` is its id."""

    time_ns: int
    kind: str
    text: str


@dataclass(frozen=True)
class EventBatch:
    """A batch of events to send.

    Attributes:
        newest_ns: the time after which to continue.
        missed_until_ns: events up to this time are no longer stored; None: nothing was missed.
    """

    events: tuple[Event, ...]
    newest_ns: int
    missed_until_ns: int | None = None


class EventHistory:
    """The newest events, bounded in number and bytes. Thread-safe.

    Args:
        complete_since_ns: events before this time may be incomplete.
    """

    def __init__(self, problems: ProblemNames, complete_since_ns: int = -1) -> None:
        self._problems = problems
        self._lock = threading.Lock()
        self._events: list[Event] = []
        self._processes: dict[str, tuple[ProcessState, ...]] = {}
        self._bytes = 0
        self._complete_since_ns = complete_since_ns

    @property
    def newest_ns(self) -> int | None:
        """The id of the newest event; None before the first."""
        with self._lock:
            return self._events[-1].time_ns if self._events else None

    def incomplete_before(self, time_ns: int) -> None:
        """Record that events before this time may be incomplete."""
        with self._lock:
            self._complete_since_ns = max(self._complete_since_ns, time_ns)

    def take(self, message: str, thing: object, time_ns: int) -> None:
        """Add a published message; replayed messages (not newer) and unchanged process states are ignored."""
        kind = wire.declaration(message).event
        with self._lock:
            if not kind or (self._events and time_ns <= self._events[-1].time_ns):
                return
            if isinstance(thing, ProcessStates) and not self._has_changed(thing):
                return
            # encoded once for all streams
            data = {"time": iso_utc(time_ns), "data": _data(thing, time_ns, self._problems)}
            event = Event(time_ns, kind, json.dumps(data, allow_nan=False))
            self._events.append(event)
            self._bytes += len(event.text)
            if len(self._events) > MOST_EVENTS or self._bytes > MOST_BYTES:
                self._drop_oldest()

    def after(self, time_ns: int, kinds: Collection[str], most: int) -> EventBatch:
        """Return the events of the given kinds among the first `most` stored events after a time."""
        with self._lock:
            start = bisect_right(self._events, time_ns, key=lambda event: event.time_ns)
            found = self._events[start : start + most]
            missed = self._complete_since_ns if time_ns < self._complete_since_ns else None
        newest_ns = max(time_ns, found[-1].time_ns if found else missed or time_ns)
        return EventBatch(tuple(one for one in found if one.kind in kinds), newest_ns, missed)

    def _has_changed(self, states: ProcessStates) -> bool:
        # a supervisor publishes all its processes every 2 s: as events they took most of a night's memory
        now = tuple(replace(one, step_age_s=0.0) for one in states.processes)
        before, self._processes[states.supervisor] = self._processes.get(states.supervisor), now
        return now != before

    def _drop_oldest(self) -> None:
        count = max(1, len(self._events) // 8)
        self._complete_since_ns = max(self._complete_since_ns, self._events[count - 1].time_ns)
        self._bytes -= sum(len(one.text) for one in self._events[:count])
        del self._events[:count]


def fill(history: EventHistory, run_dir: Path, state_dir: Path | None, now_ns: int) -> None:
    """Add the run's events on disk: the journal, then later events from the packet log.

    Without both files on this computer, past events come from the replay of the scheduler's cache only.
    """
    oldest_ns = None
    for message, thing, time_ns in _recorded(run_dir, state_dir):
        oldest_ns = time_ns if oldest_ns is None else oldest_ns
        history.take(message, thing, time_ns)
    if not (run_dir / JOURNAL_FILE).is_file():
        history.incomplete_before(now_ns if oldest_ns is None else oldest_ns - 1)


def _recorded(run_dir: Path, state_dir: Path | None) -> Iterator[tuple[str, object, int]]:
    newest_ns = -1
    if (run_dir / JOURNAL_FILE).is_file():
        try:
            with open_run(run_dir) as run:
                for packet, message, thing in run.messages([one.name for one in wire.declared() if one.event]):
                    newest_ns = packet.time_ns or newest_ns
                    yield message, thing, newest_ns
        except AfspmError as error:  # the recorder is just creating the file, or it is damaged
            _log.warning("older events are not served: %s; the packet log is read instead", error)
    for entry in () if state_dir is None else logged_packets(log_folder(state_dir)):
        packet = entry.packet
        try:
            message = wire.message_of(packet.envelope)
            if packet.time_ns is not None and packet.time_ns > newest_ns and wire.declaration(message).event:
                yield message, wire.decode(message, packet.payload), packet.time_ns
        except WireError:
            continue


def _data(thing: object, time_ns: int, problems: ProblemNames) -> dict[str, object]:
    # without the values of scans and spectra
    match thing:
        case ControlState():
            return {
                "mode": thing.mode.name,
                "holder": thing.holder,
                "problems": [problems.name(number) for number in thing.problems],
            }
        case ScopeStatus():
            return {"state": thing.state.name, "paused": thing.paused}
        case Scan():
            return {
                "channel": thing.channel,
                "id": str(thing.time_ns or time_ns),
                "unit": thing.unit,
                "center_m": thing.region.center_m,
                "size_m": thing.region.size_m,
                "angle_rad": thing.region.angle_rad,
                "shape": thing.shape,
            }
        case Spectrum():
            return {
                "id": str(thing.time_ns or time_ns),
                "kind": thing.kind,
                "position_m": thing.position_m,
                "names": thing.names,
                "units": thing.units,
                "roles": thing.roles.roles_of(thing.names),
            }
        case JournalEntries():
            return {"entries": [_entry(one, problems) for one in thing.entries]}
        case Message():
            content = wire.as_plain(thing)
            return content if isinstance(content, dict) else {"value": content}
    plain: dict[str, object] = _without_large_numbers(to_plain(thing, lists=True))
    return plain


def _entry(entry: JournalEntry, problems: ProblemNames) -> dict[str, object]:
    is_known = entry.response in ControlResponse._value2member_map_
    return {
        "who": entry.who,
        "what": entry.what,
        "event": entry.event.name,
        "response": ControlResponse(entry.response).name if is_known and entry.response is not None else None,
        "refused": entry.refused,
        "reason": entry.reason,
        "problem": problems.name(entry.problem) if entry.problem else None,
        "key": entry.key,
    }


def _without_large_numbers(value: object) -> Any:
    # JSON has no exact integers of 64 bits in every language, and no NaN
    if isinstance(value, dict):
        return {key: _without_large_numbers(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_without_large_numbers(one) for one in value]
    if isinstance(value, float) and not abs(value) < float("inf"):
        return None
    return str(value) if isinstance(value, int) and abs(value) >= 2**53 else value
