"""A recorded night at a selected time, in the form of a running experiment's page."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from afspm import Run, open_run
from afspm.basics import FileError, NeverLate
from afspm.components import Array
from afspm.model import XY, Note, Scan
from afspm.night import Overview, RecordPlayback
from afspm.plugins.web.frames import FrameStore
from afspm.plugins.web.watch import SpectrumStore, Watch
from afspm.record import bands_allowed

if TYPE_CHECKING:
    from afspm.wire.messages import DriftMapping

_log = logging.getLogger("afspm.plugins.web.dashboard")

SPECTRA = 8
"""Largest number of spectra read for a displayed time."""


@dataclass(frozen=True, slots=True)
class NightEvent:
    """A published message with its time; for a note, the time that the note describes."""

    time_ns: int
    message: str
    thing: Any
    envelope: str


@dataclass(frozen=True, slots=True)
class DriftedScan:
    """The centre of a scan in tip coordinates, and its drift-corrected centre in sample coordinates."""

    tip_m: XY
    sample_m: XY


class Night:
    """The record of a run: all published messages, without the values of scans.

    Args:
        folder: the run folder.

    Raises:
        FileError: the record is missing or damaged.
    """

    def __init__(self, folder: Path) -> None:
        with open_run(folder) as run:
            self.folder = run.folder
            self.title, self.simulated, self.problems = run.name, run.simulated, run.problem_names
            self.speed = float((run.facts.get("clock") or {}).get("speed", 1.0))
        self._unreadable: set[int] = set()
        self.reload()

    def reload(self) -> None:
        """Read the record again, after a note was added."""
        with open_run(self.folder) as run:
            self.scans = [row for row in run.scans if row.file]
            self.events = sorted(_events(run), key=lambda event: event.time_ns)
            self.unread_messages = tuple(run.unread_messages())

    @property
    def begin_ns(self) -> int:
        return self.events[0].time_ns if self.events else 0

    @property
    def end_ns(self) -> int:
        return self.events[-1].time_ns if self.events else 0

    def published_ns(self) -> dict[int, int]:
        """Return the publication time of each scan's last channel, by the scan's end time."""
        return {event.thing.time_ns: event.time_ns for event in self.events if event.message == "Scan2d"}

    def spectra_until(self, time_ns: int) -> SpectrumStore:
        """Return the last `SPECTRA` spectra up to and including a time, without unreadable spectra."""
        store = SpectrumStore()
        with open_run(self.folder) as run:
            for row in [row for row in run.spectra if row.time_ns <= time_ns][-SPECTRA:]:
                try:
                    store.take(run.spectrum(row), row.time_ns)
                except FileError as error:  # missing or damaged; once a spectrum, not at each move of the slider
                    if row.time_ns not in self._unreadable:
                        self._unreadable.add(row.time_ns)
                        _log.warning("a spectrum is not shown: %s", error)
        return store

    def drifted(self) -> dict[int, DriftedScan]:
        """Return the drift-corrected scans by number; empty without drift correction."""
        by_time = {row.time_ns: row for row in self.scans}
        found: dict[int, DriftedScan] = {}
        mapping: DriftMapping | None = None
        for event in self.events:
            if event.message == "DriftMapping":
                mapping = event.thing
            elif event.message == "Scan2d" and mapping is not None and len(mapping.center) == 2:
                row = by_time.get(event.thing.time_ns)
                if row is not None:
                    tip_x, tip_y = mapping.center
                    x, y = _matrix(mapping) @ (tip_x, tip_y, 1.0)
                    found.setdefault(row.number, DriftedScan((tip_x, tip_y), (float(x), float(y))))
        return found


class NightWatch(Watch):
    """The state of a night at one time, for one viewer."""

    def __init__(self, night: Night) -> None:
        self.moment = StoppedClock(night.end_ns, night.speed)
        super().__init__(self.moment, night.problems, bands=bands_allowed(night.folder))
        self._night = night
        self._events: Sequence[NightEvent] = ()
        self._playback: RecordPlayback[NightEvent] = RecordPlayback(())
        self.go(night.end_ns)

    @property
    def moment_ns(self) -> int | None:
        return self.moment.time_ns

    @property
    def is_over(self) -> bool:
        return self.moment.time_ns >= (self.overview.ended_ns or self._night.end_ns)

    @property
    def revision(self) -> int:
        if not self.is_current:
            self.go(self.moment.time_ns)
        return self.changes

    @property
    def is_current(self) -> bool:
        """False if a note was added since the last call of `go`."""
        return self._events is self._night.events

    @contextmanager
    def reading(self) -> Iterator[Overview]:
        with super().reading():
            if not self.is_current:
                self._go(self.moment.time_ns)
            yield self.overview

    def go(self, time_ns: int) -> None:
        """Show the night at a time."""
        with super().reading():
            self._go(time_ns)

    def _go(self, time_ns: int) -> None:
        if time_ns < self.moment.time_ns or not self.is_current:
            self._events = self._night.events
            self._playback = RecordPlayback(self._events)
            self.overview, self.frames = Overview(self.problems, bands=self._bands), ChannelNames()
            self.overview.unread = self._night.unread_messages
            self.tip_to_sample = None
        self.moment.time_ns = time_ns
        for event in self._playback.due(time_ns):
            self.take(event.message, event.thing, event.time_ns, event.envelope)
        self.spectra = self._night.spectra_until(time_ns)
        self.connected = True
        self.changes += 1


class ChannelNames(FrameStore):
    """The channel names of a night, without pictures, which are in the record."""

    def __init__(self) -> None:
        super().__init__()
        self._names: dict[str, None] = {}

    @property
    def channels(self) -> tuple[str, ...]:
        return self.roles.topography_first(self._names)

    def take_scan(self, scan: Scan, time_ns: int) -> None:
        self._names[scan.channel] = None


class StoppedClock(NeverLate):
    """A clock that shows a fixed time."""

    def __init__(self, time_ns: int, speed: float) -> None:
        self.time_ns = time_ns
        self._speed = speed

    def now_ns(self) -> int:
        return self.time_ns

    def now_s(self) -> float:
        return self.time_ns * 1e-9

    def monotonic_s(self) -> float:
        return 0.0

    def real_s(self, experiment_s: float) -> float:
        return experiment_s / self._speed


def _events(run: Run) -> Iterator[NightEvent]:
    for number, (packet, message, thing) in enumerate(run.messages()):
        if isinstance(thing, Note):
            yield NightEvent(thing.time_ns, message, thing, f"{message}_{number}")  # two notes may describe one moment
        else:
            yield NightEvent(packet.time_ns or 0, message, thing, packet.envelope)


def _matrix(mapping: DriftMapping) -> Array:
    return np.array(mapping.matrix, dtype=np.float64).reshape(2, 3)
