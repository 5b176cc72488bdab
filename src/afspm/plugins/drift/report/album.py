"""Writing of all drift figures of a run into a folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from afspm.components import Array
from afspm.plugins.drift.registration import DriftScan, Registration
from afspm.plugins.drift.report import style
from afspm.plugins.drift.report.drawings import (
    ScanPair,
    draw_errors,
    draw_estimates,
    draw_features,
    draw_histogram,
    draw_offsets,
    draw_pairs,
)
from afspm.plugins.drift.track.offline import spread_pairs
from afspm.plugins.drift.track.record import DriftRecord

PAIRS_APART_S = 2 * 3600.0
_PAIRS = 2


@dataclass(frozen=True, eq=False)
class RunPart:
    """Consecutive scans of a run, before or after drift correction was switched on.

    Attributes:
        name: suffix for file names, such as "on".
        title: title in figures, such as "correction on".
        start, stop: range of scan indices; `stop` is excluded.
        estimates: off-line registrations of each scan with the first scan of the part; None without registrations.
    """

    name: str
    title: str
    start: int
    stop: int
    estimates: DriftRecord | None = None


@dataclass(frozen=True, eq=False)
class DriftRun:
    """Data for the figures of a run with n scans.

    Attributes:
        scans: scans in order of time.
        record: drift record of the tracker.
        parts: parts of the run in order of time.
        matched: indices of two scans, and their registration with matched features; None without such a pair.
        truth_m: (n, 2) true drift, if known.
        simulated: whether the microscope was simulated.
    """

    scans: Sequence[DriftScan]
    record: DriftRecord
    parts: Sequence[RunPart]
    matched: tuple[int, int, Registration] | None = None
    truth_m: Array | None = None
    simulated: bool = False

    @property
    def switched_on_s(self) -> float | None:
        """Middle of the first scan after the first part, when correction was on; None with a single part."""
        return float(self.record.time_s[self.parts[0].stop]) if len(self.parts) > 1 else None

    def marked(self, title: str) -> str:
        """Return a title, marked if the microscope was simulated."""
        return f"{title}   {style.SIMULATED}".strip() if self.simulated else title


def write(run: DriftRun, folder: Path, *, title: str = "") -> list[Path]:
    """Write all figures for which there are data, and return their paths."""
    written = []
    for name, made in _figures(run, title):
        path = folder / f"drift_{name}.png"
        style.save(made, path)
        written.append(path)
    return written


def _figures(run: DriftRun, title: str) -> Iterator[tuple[str, Figure]]:
    record, switched = run.record, run.switched_on_s
    yield "offset", draw_offsets(record, truth_m=run.truth_m, switched_on_s=switched, title=run.marked(title))
    if chosen := [pair for part in run.parts for pair in _pairs(run, part)]:
        yield "pairs", draw_pairs(chosen)
    for part in run.parts:
        if part.estimates is None or len(part.estimates) < 2:
            continue
        caption = run.marked(f"{part.title}: first scan against each later one")
        yield _named("estimates", part), draw_estimates(part.estimates, title=caption, truth_m=_left_over(run, part))
        yield _named("histogram", part), draw_histogram(part.estimates, title=caption)
    if run.matched is not None and run.matched[2].matches is not None:
        first, second, found = run.matched
        yield "features", draw_features(run.scans[first], run.scans[second], found.matches)
    if run.truth_m is not None:
        yield "errors", draw_errors(record, run.truth_m, switched_on_s=switched)


def _named(name: str, part: RunPart) -> str:
    return f"{name}_{part.name}" if part.name else name


def _left_over(run: DriftRun, part: RunPart) -> Array | None:
    if run.truth_m is None:
        return None
    truth, centers = (array[part.start : part.stop] for array in (run.truth_m, run.record.center_m))
    left: Array = (truth - truth[0]) - (centers - centers[0])
    return left


def _pairs(run: DriftRun, part: RunPart) -> list[ScanPair]:
    record, scans = run.record[part.start : part.stop], run.scans[part.start : part.stop]
    moved = record.misplacement_m
    return [
        ScanPair(scans[first], scans[second], moved[second] - moved[first], run.marked(part.title))
        for first, second in spread_pairs(record, PAIRS_APART_S, _PAIRS)
    ]
