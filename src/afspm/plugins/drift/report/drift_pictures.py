"""`DriftTable` and `DriftPictures`: the drift of a night as a table, and as figures."""

from __future__ import annotations

import csv
import importlib
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, overload

import numpy as np

from afspm import Component
from afspm.basics import NS_PER_S, AfspmError, FileError, counted, iso_utc
from afspm.components import LineFile, csv_line
from afspm.model import TOPOGRAPHY, ChannelName, RegistrationOutcome, of_role
from afspm.plugins.drift.track.record import COLUMNS as RECORD
from afspm.record import drift_at

if TYPE_CHECKING:
    from afspm.plugins.drift.registration import DriftScan, Registration
    from afspm.plugins.drift.report.album import RunPart
    from afspm.plugins.drift.track.record import DriftRecord
    from afspm.wire.messages import DriftMapping

COLUMNS = ("datetime", "filename", "offset_x", "offset_y", "rate_x", "rate_y", "units", *RECORD, "lost", "correcting")
_ALBUM = "afspm.plugins.drift.report.album"


class DriftTable(Component):
    """The writer of `drift_correction.csv`: for each scan the offset of the coordinates, and the sample's velocity.

    The offset is x_sample - x_tip. `rate_x` is the velocity of the sample, so it is the negative of the offset's rate;
    `rate_x_m_s` is the same in m/s. The columns from `scan` to `failures` are those of `track.record`, which reads the
    table. `outcome` is the way in which the position of a scan was determined: registered, coarse, or by dead reckoning
    (refused, failed, new); the variances belong to this position. After a kill and restart, header and rows are still
    written only once.

    Args:
        file: name of the table in the run folder.
    """

    file_suffix: ClassVar[str] = ""
    listens: ClassVar = ("DriftMapping",)

    def __init__(self, file: str = "drift_correction.csv") -> None:
        self.file = file

    def on_start(self) -> None:
        self._table = LineFile(Path(self.run_dir) / self.file, ",".join(COLUMNS))
        self._written = {tuple(row[:2]) for row in csv.reader(self._table.lines())}

    def on_drift_mapping(self, message: DriftMapping) -> None:
        row = drift_row(message)
        if tuple(row[:2]) in self._written:
            return  # replayed after a restart
        self._table.append([csv_line(row)])
        self._written.add(tuple(row[:2]))


def drift_row(message: DriftMapping) -> list[str]:
    """Return the row of a DriftMapping, in the order of `COLUMNS`."""
    time_ns = message.timestamp.ToNanoseconds()
    drift_x, drift_y = drift_at(np.array(message.matrix).reshape(2, 3), message.center)
    xx, xy, _, yy = message.covariance or (math.nan,) * 4  # empty before the first registration
    rate = message.rate or (math.nan,) * 2
    outcome = RegistrationOutcome.of(message.outcome, matched=message.matched)
    numbers = (*message.center, drift_x, drift_y, xx, yy, xy, *rate)
    return [
        iso_utc(time_ns),
        message.filename,
        *(_text(value) for value in (-drift_x, -drift_y, *rate)),
        "m; m/s",
        message.filename,
        f"{time_ns * 1e-9:.6f}",
        *(_text(value) for value in numbers),
        *("yes" if message.matched else "no", message.reason, outcome.label, str(message.failures)),
        *("yes" if flag else "no" for flag in (message.lost, message.correcting)),
    ]


def _text(value: float) -> str:
    return f"{value + 0.0:.9g}"  # never -0


@dataclass(frozen=True)
class TabledScan:
    """One row of the table: the scan's file and middle, and whether components used sample coordinates at that time."""

    file: str
    correcting: bool
    middle_s: float


def parts(tabled: Sequence[TabledScan]) -> list[tuple[str, int, int]]:
    """Return name, start and stop index of each part of the night, without and with correction.

    Empty parts are left out. The first scan with correction is in neither part, because it may have been requested
    before correction was switched on. Only a night corrected from its first scan on includes this scan.
    """
    first_on = next((k for k, one in enumerate(tabled) if one.correcting), len(tabled))
    found = [("off", 0, first_on), ("on", first_on + 1 if first_on else 0, len(tabled))]
    return [part for part in found if part[2] > part[1]]


class _SavedScans(Sequence["DriftScan"]):
    # scans are read at each access: a night's worth may not fit into memory

    def __init__(self, tabled: Sequence[TabledScan], read: Callable[[TabledScan], DriftScan]) -> None:
        self._tabled, self._read = tabled, read

    def __len__(self) -> int:
        return len(self._tabled)

    @overload
    def __getitem__(self, which: int) -> DriftScan: ...

    @overload
    def __getitem__(self, which: slice) -> Sequence[DriftScan]: ...

    def __getitem__(self, which: int | slice) -> DriftScan | Sequence[DriftScan]:
        if isinstance(which, slice):
            return _SavedScans(self._tabled[which], self._read)
        return self._read(self._tabled[which])


class DriftPictures(DriftTable):
    """The table of `DriftTable`, and figures of drift drawn in the run folder when the experiment ends.

    During the experiment each scan is compared with the first scan of its part, without and with correction. This
    estimates the remaining drift independently of the scheduler's tracker. For a simulated microscope the true errors
    are drawn, too. Scans are read from the files that the microscope saves.

    Args:
        channel: channel of the compared scans, by role or name; None: the one that the scheduler compares.
        estimator: name of the estimator for the comparison.
        features: an estimator that matches features, for the figure of matches; by default "brief" where
            `afspm[features]` is installed.
        title: title above the figure of the offset.
        file: name of the table in the run folder, as for `DriftTable`.
    """

    longest_step_s: ClassVar[float] = 60.0
    # at the end: the supervisor waits for a minute, and drawing takes most of it on a busy computer
    compared_within_s: ClassVar[float] = 15.0
    period_s = 2.0
    period_time: Literal["experiment", "real"] = "real"

    def __init__(
        self,
        channel: ChannelName | None = None,
        estimator: str = "least-squares",
        features: str | None = None,
        title: str = "",
        file: str = "drift_correction.csv",
    ) -> None:
        super().__init__(file)
        if features is not None:
            from afspm.plugins.drift import estimators

            estimators.estimator(features)  # an unknown name is refused now, not at the end of the night
        self.channel, self.estimator, self.features, self.title = channel, estimator, features, title
        self._pairs: dict[tuple[str, str], Registration] = {}
        self._drawing_is_loaded = self._has_logged = False

    def on_start(self) -> None:
        super().on_start()
        tabled = self._tabled_scans()
        # the table alone is not enough: on a full disk its rows wait
        self._known_scans = {one.file: one for one in tabled}
        self._to_repeat = deque(
            (tabled[start], one) for _, start, stop in parts(tabled) for one in tabled[start + 1 : stop]
        )

    def on_tick(self) -> None:
        if not self._drawing_is_loaded:
            importlib.import_module(_ALBUM)  # loading takes seconds: now, since the end must be quick
        self._drawing_is_loaded = True
        if self._to_repeat:
            # comparisons made before a restart are repeated now, since the end must be quick
            self._compared(*self._to_repeat.popleft())

    def on_drift_mapping(self, message: DriftMapping) -> None:
        super().on_drift_mapping(message)
        if message.channel:
            self.memory["channel"] = message.channel
        middle_s = message.timestamp.ToNanoseconds() / NS_PER_S
        self._known_scans.setdefault(message.filename, TabledScan(message.filename, message.correcting, middle_s))
        tabled, newest = list(self._known_scans.values()), list(self._known_scans).index(message.filename)
        for _, start, stop in parts(tabled):
            if start < newest < stop:
                self._compared(tabled[start], tabled[newest])

    def on_end(self) -> None:
        tabled = self._tabled_scans()
        if len(tabled) < 2:
            self.log.info("drift of %s, no pictures", counted(len(tabled), "scan"))
        else:
            self._draw(tabled)

    def _draw(self, tabled: list[TabledScan]) -> None:
        from afspm.plugins.drift.report import album
        from afspm.plugins.drift.report.simulated_truth import true_drift
        from afspm.plugins.drift.track.record import DriftRecord

        folder = Path(self.run_dir)
        readable = {
            number: scan for number, one in enumerate(tabled) if (scan := self._without_values(one)) is not None
        }
        if len(readable) < 2:
            self.log.error("no pictures: only %d of %d scans can be read", len(readable), len(tabled))
            return
        record = DriftRecord.read(folder / self.file).chosen(list(readable))
        tabled, frames = [tabled[number] for number in readable], list(readable.values())
        scans = _SavedScans(tabled, self._scan)
        run = album.DriftRun(
            scans=scans,
            record=record,
            parts=self._parts(tabled, record, frames),
            matched=self._matched(tabled, scans),
            truth_m=true_drift(folder, frames) if self.simulated else None,
            simulated=self.simulated,
        )
        for path in album.write(run, folder, title=self.title):
            self.log.info("drawn: %s", path)

    def _parts(self, tabled: list[TabledScan], record: DriftRecord, frames: list[DriftScan]) -> list[RunPart]:
        from afspm.plugins.drift.report.album import RunPart
        from afspm.plugins.drift.track.offline import against_first

        made, until_s = [], self.clock.monotonic_s() + self.compared_within_s
        for name, start, stop in parts(tabled):
            pairs = self._compared_until(until_s, tabled[start], tabled[start + 1 : stop])
            complete = len(pairs) == stop - start - 1
            estimates = against_first(record[start:stop], frames[start:stop], pairs) if complete else None
            if not complete:
                self.log.warning(
                    "drift_estimates_%s.png and drift_histogram_%s.png are not drawn: after a restart %d of %d "
                    "comparisons were left at the end; `afspm drift %s` compares all",
                    name, name, stop - start - 1 - len(pairs), stop - start - 1, self.run_dir,
                )  # fmt: skip
            made.append(RunPart(name, f"correction {name}", start, stop, estimates))
        return made

    def _compared_until(self, until_s: float, first: TabledScan, others: Sequence[TabledScan]) -> list[Registration]:
        pairs = []
        for other in others:
            if (first.file, other.file) not in self._pairs and self.clock.monotonic_s() >= until_s:
                break
            pairs.append(self._compared(first, other))
        return pairs

    def _matched(self, tabled: list[TabledScan], scans: Sequence[DriftScan]) -> tuple[int, int, Registration] | None:
        # drift shows best between the first scan and the last one without correction that shares features with it
        from afspm.plugins.drift.estimators import estimator

        try:
            by = estimator(self.features or "brief")
        except AfspmError as error:
            self.log.info("no picture of features: %s", error)
            return None
        without = [k for k, one in enumerate(tabled) if not one.correcting] or list(range(len(tabled)))
        for second in reversed(without[1:]):
            found = by.register(scans[without[0]], scans[second])
            if found.accepted:
                return without[0], second, found
        return None

    def _compared(self, first: TabledScan, other: TabledScan) -> Registration:
        # each pair is registered once: a registration takes too long to repeat at the end
        from afspm.plugins.drift.estimators import estimator
        from afspm.plugins.drift.registration import Registration

        pair = (first.file, other.file)
        if pair not in self._pairs:
            try:
                comparing = estimator(self.estimator, lambda failure: self.log.error("%s", failure))
                self._pairs[pair] = comparing.register(self._scan(first), self._scan(other))
            except FileError as error:
                self._log_once(error)
                self._pairs[pair] = Registration.refused(str(error))
        return self._pairs[pair]

    def _without_values(self, tabled: TabledScan) -> DriftScan | None:
        # place and time without the values: the values of a whole night may not fit into memory
        try:
            scan = self._scan(tabled)
            return replace(scan, values=np.broadcast_to(np.nan, scan.values.shape))
        except (AfspmError, OSError) as error:
            self._log_once(error)
            return None

    def _log_once(self, error: Exception) -> None:
        # once a night: a missing channel would be reported for each scan
        if not self._has_logged:
            self.log.error("a scan is left out of the pictures: %s", error)
        self._has_logged = True

    def _scan(self, tabled: TabledScan) -> DriftScan:
        # as the microscope saved it, in tip coordinates
        from afspm import read
        from afspm.plugins.drift.track.scan_series import drift_scan

        content = read(tabled.file)
        channel = self.channel or self.memory.get("channel", TOPOGRAPHY)
        scan = of_role(map(self.scope.channels.shown, content.scans), channel)
        if scan is None:
            there = ", ".join(one.channel for one in content.scans)
            raise FileError(f"has no channel {channel!r}, but {there}", where=tabled.file)
        found = drift_scan(scan, content)
        # a maker's file may have the start or the end alone
        off_s = tabled.middle_s - found.mid_s
        return replace(found, start_s=found.start_s + off_s, end_s=found.end_s + off_s)

    def _tabled_scans(self) -> list[TabledScan]:
        path = Path(self.run_dir) / self.file
        if not path.exists():
            return []
        with path.open(newline="", encoding="utf-8") as file:
            return [
                TabledScan(row["filename"], row["correcting"] == "yes", float(row["time_s"]))
                for row in csv.DictReader(file)
            ]
