"""Reader of the run's folder: earlier messages, scans no longer in memory, and settings of the experiment file."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from pathlib import Path

from afspm import open_run, wire
from afspm.basics import AfspmError, Plain, parse_toml, si
from afspm.model import PERSON, ProblemNames, Region, Scan, Spectrum
from afspm.night import Overview
from afspm.plugins.web.frames import ChannelFrame, FrameKey
from afspm.record import EXPERIMENT_FILE, JOURNAL_FILE

KEPT = 6
_AGENT = "Agent"


class Archive:
    """A thread-safe reader of the recorder's files in the run's folder.

    Args:
        folder: the run folder; None if the folder is on another computer.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._log = logging.getLogger("afspm.plugins.web.dashboard")
        self._lock = threading.Lock()
        self._read: OrderedDict[FrameKey, ChannelFrame] = OrderedDict()
        self._unread: set[str] = set()

    def past(self, problems: ProblemNames) -> Overview | None:
        """Return the overview of the run so far, without log lines; None without a readable record."""
        if self._folder is None or not (self._folder / JOURNAL_FILE).is_file():  # a replay has no journal of its own
            return None
        try:
            with open_run(self._folder) as run:
                # of other messages the scheduler's cache is enough
                return run.overview([one.name for one in wire.declared() if one.in_past], problems)
        except (AfspmError, ImportError) as error:
            self._log.debug("the earlier part of the run can't be read: %s", error)
            return None

    def frame(self, time_ns: int, channel: str) -> ChannelFrame | None:
        """Return a finished channel by its time; None if the record does not contain the channel or can't be read."""
        if self._folder is None:
            return None
        key = (time_ns, channel)
        with self._lock:
            if key in self._read:
                self._read.move_to_end(key)
                return self._read[key]
            try:
                frame = _find(self._folder, time_ns, channel)
            except (AfspmError, ImportError, KeyError) as error:
                self._name(f"a scan is not shown: {error}")
                return None
            if frame is not None:
                self._read[key] = frame
                while len(self._read) > KEPT:
                    self._read.popitem(last=False)
            return frame

    def spectrum(self, time_ns: int) -> Spectrum | None:
        """Return a spectrum by its time; None if the record does not contain the spectrum or can't be read."""
        if self._folder is None:
            return None
        try:
            with open_run(self._folder) as run:
                row = next((row for row in reversed(run.spectra) if row.time_ns == time_ns), None)
                return None if row is None else run.spectrum(row)
        except (AfspmError, ImportError) as error:
            self._name(f"a spectrum is not shown: {error}")
            return None

    def _name(self, why: str) -> None:
        # once each: a page asks again and again
        if why not in self._unread:
            self._unread.add(why)
            self._log.warning("%s", why)


def allowed_region(folder: Path) -> Region | None:
    """Return the region of [limits] in the expanded experiment file, in tip coordinates; None if absent or invalid."""
    try:
        box = _section(folder, "limits").get("region")
        return None if box is None else _region(box)
    except (ValueError, KeyError, TypeError, AttributeError, AfspmError):
        return None  # only for the map: the scheduler reads and enforces the limits itself


def adjustable_parameters(folder: Path) -> tuple[str, ...]:
    """Return the list `adjustable` in [control] of the expanded experiment file; the scheduler enforces the list."""
    offered = _section(folder, "control").get("adjustable", ())
    return tuple(map(str, offered)) if isinstance(offered, list) else ()


def agents_in(folder: Path) -> tuple[str, ...]:
    """Return names of agents in the expanded experiment file, as suggestions; the scheduler has the valid list.

    A component without `people` accepts any name: its suggestion ends with the colon.
    """
    found = []
    for name, section in _sections(folder).items():
        if isinstance(section, dict) and str(section.get("class", "")).rpartition(".")[2] == _AGENT:
            people = section.get("people")
            found += [f"{name}{PERSON}{one}" for one in (people if isinstance(people, dict) and people else ("",))]
    return tuple(found)


def _section(folder: Path, name: str) -> Plain:
    section = _sections(folder).get(name)
    return section if isinstance(section, dict) else {}


def _sections(folder: Path) -> Plain:
    try:
        return parse_toml((folder / EXPERIMENT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _region(box: Plain) -> Region:
    if "x" in box:
        (left, right), (low, high) = (tuple(si(v, "m") for v in box[axis]) for axis in "xy")
        return Region(((left + right) / 2, (low + high) / 2), (right - left, high - low))
    center, size = (tuple(si(v, "m") for v in box[key]) for key in ("center", "size"))
    return Region((center[0], center[1]), (size[0], size[1]), si(box.get("angle", 0.0), "rad"))


def _find(folder: Path, time_ns: int, channel: str) -> ChannelFrame | None:
    with open_run(folder) as run:
        row = run.scan_at(time_ns, channel)
        if row is None or not row.file:
            return None
        return _frame(run.scan(row)[channel], time_ns, run.changed_rows().get(time_ns))


def _frame(scan: Scan, time_ns: int, changed_row: int | None) -> ChannelFrame:
    # negative, unlike the numbers of live frames, and always the same for the same scan
    number = -1 - (hash((time_ns, scan.channel)) & (2**52 - 1))
    return ChannelFrame(
        number, scan.channel, scan.unit, scan.region, scan.values, time_ns, None, scan.shape[0], changed_row=changed_row
    )
