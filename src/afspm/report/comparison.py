"""The comparison of recorded runs: their facts, differing settings, and scans of the same regions."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC
from typing import Final

import numpy as np

from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import AfspmError, InvalidValue
from afspm.basics.formatting import duration_text, period_text
from afspm.model import Region, Scan
from afspm.model.arrays import Array
from afspm.model.line_levelling import flattened
from afspm.night.run import Run
from afspm.night.tables import ScanRow
from afspm.report import story
from afspm.report.pictures import topography
from afspm.report.story import RunStory

Aligner = Callable[[Array, Region, Array, Region], tuple[Array, str]]
"""A function that moves the levelled values of a second scan onto the first, and describes the alignment."""

_ALIKE = 0.01  # of a size; regions that differ less are the same
_CENTRES = 0.05  # of the longer side: drift between two nights moves no region out of the scanner's frame of reference
_ANGLE_RAD = 0.01
ABSENT: Final = "–"


@dataclass(frozen=True)
class Roughness:
    """Roughness of a levelled scan, in the unit of its values (ISO 25178).

    Attributes:
        sq: root mean square deviation from the mean.
        sa: mean absolute deviation from the mean.
    """

    sq: float
    sa: float


@dataclass(frozen=True, eq=False)
class RegionScan:
    """The scan of a region in one run.

    Attributes:
        values: [y, x], levelled.
        roughness: None if nothing was measured.
    """

    row: ScanRow
    scan: Scan
    values: Array
    roughness: Roughness | None


@dataclass(frozen=True, eq=False)
class ScanDifference:
    """A later scan minus the first of the same region.

    Attributes:
        aligned: the later scan moved onto the first, [y, x]; None if there is no difference.
        values: the difference minus its median, [y, x]; None if the scans can't be subtracted.
        words: the alignment, or the reason why there is no difference.
    """

    words: str
    aligned: Array | None = None
    values: Array | None = None


@dataclass(frozen=True, eq=False)
class ComparedRegion:
    """A region that was scanned in at least two runs.

    Attributes:
        scans: a scan for each run, in the order of runs; None for a run without a readable scan of the region.
        differences: the differences from the first run with a scan, by the index of the run.
    """

    name: str
    scans: Sequence[RegionScan | None]
    differences: Mapping[int, ScanDifference]


@dataclass(frozen=True, eq=False)
class RunComparison:
    """The comparison of several runs.

    Attributes:
        names: the names of the runs' folders.
        simulated: whether the microscope of each run was simulated.
        facts: a text for each run, by heading.
        settings: keys of the experiment file whose values differ, with a text for each run.
        unread: reasons why settings or scans are missing.
        left_out: the number of common regions beyond the limit of `compare`.
    """

    names: Sequence[str]
    simulated: Sequence[bool]
    facts: Mapping[str, Sequence[str]]
    settings: Mapping[str, Sequence[str]]
    regions: Sequence[ComparedRegion]
    unread: Sequence[str]
    left_out: int = 0


def compare(runs: Sequence[Run], align: Aligner, most_regions: int = 24) -> RunComparison:
    """Compare runs and their last complete scans of the same regions.

    The reference of a region is the scan in the first run with a readable scan there.

    Args:
        most_regions: the largest number of compared regions; other common regions are counted in `left_out`.

    Raises:
        InvalidValue: fewer than two runs, or one run given twice.
    """
    if len(runs) < 2:
        raise InvalidValue("a comparison needs at least two runs")
    folders = [run.folder.resolve() for run in runs]
    if twice := [folder for folder, count in Counter(folders).items() if count > 1]:
        raise InvalidValue(f"the run {twice[0].name} is given twice", hint="name different runs")
    stories = [story.read(run) for run in runs]
    unread: list[str] = []
    places = _common_places([story.scans for story in stories])
    regions = [region for place in places[:most_regions] if (region := _region(runs, place, align, unread)) is not None]
    return RunComparison(
        names=[run.folder.name for run in runs],
        simulated=[run.simulated for run in runs],
        facts={head: [text(story) for story in stories] for head, text in _FACTS.items()},
        settings=_differing(runs, unread),
        regions=regions,
        unread=unread,
        left_out=max(0, len(places) - most_regions),
    )


def roughness(values: Array) -> Roughness | None:
    """Return the roughness of levelled values, about their mean; None if nothing was measured."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return None
    deviation = finite - finite.mean()
    return Roughness(float(np.sqrt(np.mean(deviation**2))), float(np.mean(np.abs(deviation))))


def flat_settings(table: Mapping[str, object]) -> dict[str, str]:
    """Return all values of an experiment file as JSON, by dotted key."""
    found: dict[str, str] = {}
    for key, value in table.items():
        if isinstance(value, Mapping):
            found |= {f"{key}.{below}": text for below, text in flat_settings(value).items()}
        else:
            found[key] = json.dumps(value, ensure_ascii=False, default=str)
    return found


def differences(settings: Sequence[Mapping[str, str]]) -> dict[str, list[str]]:
    """Return the keys with different values, and the value of each run; ABSENT where a run has no such key."""
    keys = sorted({key for one in settings for key in one})
    rows = {key: [one.get(key, ABSENT) for one in settings] for key in keys}
    return {key: values for key, values in rows.items() if len(set(values)) > 1}


def same_region(first: ScanRow, second: ScanRow) -> bool:
    """Return whether two scans have the same key or, without keys, nearly the same region."""
    if first.key or second.key:
        return first.key == second.key
    one, other = first.region, second.region
    if one is None or other is None or one.frame is not other.frame:
        return False
    by, apart_m = one.compared(other), math.dist(one.center_m, other.center_m)
    return by.size <= _ALIKE and apart_m <= _CENTRES * max(one.size_m) and abs(by.turned_rad) <= _ANGLE_RAD


def _common_places(scans: Sequence[Sequence[ScanRow]]) -> list[list[ScanRow | None]]:
    # the last whole scan of each place in each run
    places: list[list[ScanRow | None]] = []
    for k, rows in enumerate(scans):
        for row in rows:
            if row.interrupted or not row.file:
                continue
            place = next((one for one in places if any(seen and same_region(seen, row) for seen in one)), None)
            if place is None:
                place = [None] * len(scans)
                places.append(place)
            place[k] = row
    return [place for place in places if sum(row is not None for row in place) > 1]


def _region(
    runs: Sequence[Run], place: Sequence[ScanRow | None], align: Aligner, unread: list[str]
) -> ComparedRegion | None:
    scans = [None if row is None else _read(run, row, unread) for run, row in zip(runs, place, strict=True)]
    read = [k for k, scan in enumerate(scans) if scan is not None]
    if len(read) < 2:
        return None
    first = scans[read[0]]
    assert first is not None
    changes = {k: _difference(first, later, align) for k in read[1:] if (later := scans[k]) is not None}
    return ComparedRegion(first.row.key or f"scan {first.row.number}", scans, changes)


def _read(run: Run, row: ScanRow, unread: list[str]) -> RegionScan | None:
    try:
        scans = run.scan(row)
    except AfspmError as error:
        unread.append(f"scan {row.number} of {run.folder.name}: {error}")
        return None
    scan = scans[topography(scans)]
    values = flattened(scan.values)
    return RegionScan(row, scan, values, roughness(values))


def _difference(first: RegionScan, later: RegionScan, align: Aligner) -> ScanDifference:
    if (reason := _obstacle(first.scan, later.scan)) != "":
        return ScanDifference(f"no difference: {reason}")
    aligned, words = align(first.values, first.scan.region, later.values, later.scan.region)
    values = aligned - first.values
    if np.isfinite(values).any():
        values = values - np.nanmedian(values)
    return ScanDifference(words, aligned, values)


def _obstacle(first: Scan, later: Scan) -> str:
    if first.channel != later.channel:
        return f"the channels are {first.channel} and {later.channel}"
    if first.unit != later.unit:
        return f"the units are {first.unit or '1'} and {later.unit or '1'}"
    if first.shape != later.shape:
        (rows, columns), (others, along) = first.shape, later.shape
        return f"{columns} × {rows} and {along} × {others} pixels"
    return "" if first.region.has_size_of(later.region, _ALIKE) else "the sizes differ"


def _differing(runs: Sequence[Run], unread: list[str]) -> dict[str, list[str]]:
    try:
        return differences([flat_settings(run.experiment) for run in runs])
    except AfspmError as error:
        unread.append(f"the settings: {error}")
        return {}


def _named_counts(names: Iterator[str]) -> str:
    return ", ".join(f"{count} × {name}" for name, count in sorted(Counter(names).items())) or "none"


def _scan_count(story: RunStory) -> str:
    whole = str(len(story.scans) - story.interrupted)
    return f"{whole} and {story.interrupted} interrupted" if story.interrupted else whole


_FACTS: Final[Mapping[str, Callable[[RunStory], str]]] = {
    "microscope": lambda story: "SIMULATED" if story.simulated else "real",
    "sample": lambda story: story.metadata.get("sample", ABSENT),
    "probe": lambda story: story.metadata.get("probe", ABSENT),
    "time": lambda story: period_text(story.start_ns, story.end_ns, UTC),
    "lasted": lambda story: duration_text(story.lasted_ns / NS_PER_S),
    "scans": _scan_count,
    "spectra": lambda story: str(story.spectra),
    "problems": lambda story: _named_counts(span.label for span in story.problems),
    "repairs": lambda story: _named_counts(entry.what for entry in story.actions),
    "refusals": lambda story: str(sum(one.count for one in story.refusals)),
    "restarts": lambda story: str(len(story.restarts)),
}
