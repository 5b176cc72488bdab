"""Files saved by a controller, assigned to the running measurement, the last ended measurement, and the results.

This state is saved and survives a restart of the translator.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from afspm.basics.errors import FileError
from afspm.basics.plain_data import Plain
from afspm.model import Region, Scan, Spectrum
from afspm.storage.formats import FileContent, read
from afspm.translator.judge import Stated
from afspm.translator.setting_groups import as_list, as_region
from afspm.translator.trace import TRACE

SCAN: Final = "scan"
"""The kind of a scan; a spectrum has the name of its own kind."""
_NEW_FRAME: Final = "its frame was changed at the panel while it ran"
_LISTED: Final = 16
_OF_A_RESULT: Final = ("what", "frame", "position", "end_ns", "new_frame")
_MOST_STARTS: Final = 500

Content = Sequence[Scan | Spectrum]
Entry = Plain
"""A measurement in JSON: its kind ("what"), its set "frame" or "position", "end_ns", keys of the driver."""


class ResultFiles(ABC):
    """The measurements of one controller and their files.

    Args:
        kept: a JSON dict on disk: "running" and "ended" are an `Entry` or None; "results" is a list of entries, each
            with the name of the result as "result"; "started" has start and end of the newest results, the start in the
            clock of the files.

    Attributes:
        broken_off: True if the ended measurement was interrupted at the controller; until the next `results`.
        missing: what the last interrupted measurement lacks, in words; empty: nothing, or that is not known.
        precision: precision of the numbers in the files.
    """

    precision: FilePrecision

    def __init__(self, kept: Entry, log: logging.Logger) -> None:
        self._kept = kept
        self._log = log
        self._content: dict[str, Content] = {}
        self.broken_off, self.missing = False, ""
        for key, empty in (("running", None), ("ended", None), ("results", []), ("started", [])):
            kept.setdefault(key, empty)

    @abstractmethod
    def read(self, entry: Entry) -> Content:
        """Return the content of a result, with the settings of the measurement.

        Raises:
            FileError
        """

    @property
    def what(self) -> str:
        """The running measurement: `SCAN`, the kind of a spectrum, or empty."""
        running = self._kept["running"]
        return running["what"] if running else ""

    def next_begins(self) -> bool:
        """Register that a measurement begins at the panel; return True if a scan before it still awaits its file."""
        return False

    @property
    def frame(self) -> list[float] | None:
        """The frame of the running scan (`as_list`); None without a scan."""
        running = self._kept["running"]
        return None if running is None else running.get("frame")

    def see_frame(self, region: Region) -> None:
        """Register the frame in force during a scan, for a controller that may move the running scan to a new frame.

        A scan during which the frame was changed ("new_frame") is not complete.
        """
        running = self._kept["running"]
        if running is None or running["what"] != SCAN:
            return
        if not self.precision.same(as_region(running.setdefault("under_way", as_list(region))), region):
            running["new_frame"] = True

    def forget(self) -> None:
        """Discard the running or ended measurement after an interruption."""
        self._kept["running"] = self._kept["ended"] = None

    def load(self, result: str) -> Content:
        """Read a result by its name.

        Raises:
            FileError: the result is not among the last results, or its file is gone.
        """
        entry = next((one for one in self._kept["results"] if one["result"] == result), None)
        if entry is None:
            raise FileError("is not among the last results", where=result)
        if result not in self._content:
            self._content = {result: self.read(entry)}
        return self._content[result]

    def newest_ns(self, folder: Path | None, files: Iterable[Path], what: str = "") -> int:
        """Return, and store, the modification time in ns of the newest file in a folder; only newer files are results.

        A folder may be missing or empty while its network drive is away: the newest file seen before counts then.

        Args:
            files: the files in the folder now.
            what: the kind of measurement, if each kind has its own files.
        """
        place = f"{folder} {'scans' if what == SCAN else 'spectra' if what else ''}".strip()
        seen = self._kept.setdefault("newest", {})
        before_ns = seen.pop(place, 0)
        seen[place] = newest(files)[0] or before_ns
        for oldest in list(seen)[:-_LISTED]:
            del seen[oldest]
        return int(seen[place])

    def _begins(self, what: str, facts: Mapping[str, object]) -> None:
        self._kept["running"], self._kept["ended"] = {"what": what, **facts}, None
        self.missing = ""

    def _ends(self, facts: Mapping[str, object]) -> None:
        self._kept["running"], self._kept["ended"] = None, {**self._kept["running"], **facts}

    def stated(self, result: str) -> Stated:
        """Return what the files of a result say of their measurement; nothing of one that is not among the last."""
        nothing: Entry = {}
        entry = next((one for one in self._kept["results"] if one["result"] == result), nothing)
        began_ns, ended_ns = entry.get("stated", ((), ()))
        earlier = {start_ns: end_ns for start_ns, end_ns, of in self._kept["started"] if of != result}
        unproved, most_ns = tuple(entry.get("unproved", ())), entry.get("at_most_ns")
        frame = as_region(entry["region"]) if "region" in entry else None
        shape = tuple(entry["pixels"]) if "pixels" in entry else None
        times = tuple(began_ns), tuple(ended_ns), earlier
        disturbed = _NEW_FRAME if entry.get("new_frame") else ""
        return Stated(*times, frame, shape, disturbed, entry.get("pictures", 1), most_ns, unproved)

    def _add(
        self,
        result: str,
        measured: Entry,
        facts: Mapping[str, object],
        content: Content,
        files: Iterable[FileContent] = (),
    ) -> None:
        # `facts` may have "pictures", "at_most_ns" and "unproved", see `Stated`
        files = tuple(files)
        began_ns = [one.start_ns for one in files if one.start_ns is not None]
        stated = [began_ns, [one.end_ns for one in files if one.end_ns is not None]]
        taken: Entry = {key: measured[key] for key in _OF_A_RESULT if key in measured}
        entry: Entry = {"result": result} | taken | dict(facts) | {"stated": stated}
        if scan := next((one for one in content if isinstance(one, Scan)), None):
            entry |= {"region": as_list(scan.region), "pixels": list(scan.shape)}
        self._kept["results"] = [*self._kept["results"], entry][-_LISTED:]
        started = [[start_ns, measured["end_ns"], result] for start_ns in {*began_ns}]
        self._kept["started"] = [*self._kept["started"], *started][-_MOST_STARTS:]
        self._content = {result: content}

    def _listed(self) -> list[str]:
        return [entry["result"] for entry in self._kept["results"]]


@dataclass(frozen=True)
class FilePrecision:
    """The precision of a controller's files: the difference between set numbers and numbers in a file.

    Attributes:
        part: the rounding of a length, relative to the largest length.
        angle_rad: the rounding of the angle.
        positions: True if a spectrum's file has a reliable position, which replaces a different set position.
    """

    part: float
    angle_rad: float
    positions: bool = False

    def same(self, a: Region, b: Region) -> bool:
        """Return whether two frames are equal within the precision."""
        lengths_m = [*a.center_m, *a.size_m]
        scale_m = self.part * max(*map(abs, a.center_m), *a.size_m)
        close = np.allclose(lengths_m, [*b.center_m, *b.size_m], rtol=0.0, atol=scale_m)
        return bool(close) and abs(math.remainder(a.angle_rad - b.angle_rad, math.tau)) <= self.angle_rad

    def as_set(self, one: Scan | Spectrum, measured: Entry) -> Scan | Spectrum:
        """Return a scan or spectrum with its set frame or position, and with afspm's time.

        The frame in the file stays if it differs by more than the precision; so does the position if `positions`.
        """
        time_ns = measured["end_ns"]
        if isinstance(one, Scan):
            wanted = as_region(measured["frame"])
            return replace(one, region=wanted if self.same(wanted, one.region) else one.region, time_ns=time_ns)
        position_m = self._position_m(one.position_m, measured["position"])
        return replace(one, kind=measured["what"], position_m=position_m, time_ns=time_ns)

    def _position_m(
        self, reported: tuple[float, float] | None, place: Sequence[float] | None
    ) -> tuple[float, float] | None:
        if place is None:
            return reported
        x, y = place
        slack_m = 10 * self.part * max(abs(x), abs(y)) + 1e-12
        elsewhere = self.positions and reported is not None and math.dist(reported, (x, y)) > slack_m
        return reported if elsewhere else (x, y)


def read_result(path: Path | str) -> FileContent:
    """Read a file of the controller, and add it to the trace.

    Raises:
        FileError
    """
    content = read(path)
    TRACE.file(Path(path))
    return content


def lines_missing(content: Iterable[Scan | Spectrum]) -> int:
    """Return the largest number of lines without any value in a scan: lines missing from an interrupted scan."""
    return max((one.lines_missing for one in content if isinstance(one, Scan)), default=0)


def missing_text(content: Sequence[Scan | Spectrum]) -> str:
    """Return how many lines an interrupted scan lacks, in words; empty for a complete scan."""
    missing = lines_missing(content)
    return f"{missing} of its {content[0].values.shape[0]} lines were not scanned" if missing else ""


def modified_ns(path: Path) -> int:
    """Return the modification time of a file in ns; 0 if the file does not exist."""
    # the controller may delete or rename a file at any time
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def newest(files: Iterable[Path], after_ns: int = 0) -> tuple[int, Path | None]:
    """Return (modification time in ns, file) of the newest file after `after_ns`; (0, None) without one."""
    times = [(modified_ns(file), file) for file in files]
    return max((one for one in times if one[0] > after_ns), default=(0, None))
