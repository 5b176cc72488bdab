"""Conversion of recorded scans into `DriftScan`s."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from afspm.basics import NS_PER_S, InvalidValue
from afspm.driver import FileContent
from afspm.model import Frame, Region, Scan
from afspm.plugins.drift.registration import DriftScan
from afspm.plugins.drift.track.mapping import Mapping

_MOST_REASONS = 3


@dataclass(frozen=True)
class Series:
    """One channel of many scans, in order of time.

    Attributes:
        channel, unit: name and unit of the channel.
        scans: scans in tip coordinates, with their file names as keys.
        left_out: file name and reason, for each scan left out.
    """

    channel: str
    unit: str
    scans: tuple[DriftScan, ...]
    left_out: tuple[str, ...]


def series(contents: Sequence[FileContent], channel: str = "") -> Series:
    """Return the scans of one channel; without a name, the most frequent topography channel.

    Raises:
        InvalidValue: the channel has fewer than two scans, or no channel is given and no file has a topography.
    """
    name = channel or topography(contents)
    found: list[DriftScan] = []
    left_out: list[str] = []
    unit, common = "", _common_place(contents)
    for content in contents:
        for scan in content.scans:
            if scan.channel != name:
                continue
            if (why := _unfit(scan, content, common)) != "":
                left_out.append(f"{scan.filename}: {why}")
                continue
            found.append(drift_scan(scan, content))
            unit = scan.unit
    if len(found) < 2:
        there = ", ".join(sorted({scan.channel for content in contents for scan in content.scans})) or "none"
        reasons = "".join(f"; {why}" for why in left_out[:_MOST_REASONS])
        raise InvalidValue(
            f"drift needs two scans of a channel, not {len(found)} of {name!r}{reasons}", hint=f"in it: {there}"
        )
    found.sort(key=lambda one: one.mid_s)
    return Series(name, unit, tuple(found), tuple(left_out))


def topography(contents: Sequence[FileContent]) -> str:
    """Return the most frequent topography channel of some files.

    Raises:
        InvalidValue: no file has a topography.
    """
    heights = Counter(content.topography.channel for content in contents if content.topography is not None)
    if not heights:
        raise InvalidValue("there is no scan of a topography", hint="name a channel")
    return heights.most_common(1)[0][0]


def drift_scan(scan: Scan, content: FileContent) -> DriftScan:
    """Return one channel of a file as a DriftScan, in tip coordinates.

    A missing start or end time is replaced by the other.

    Raises:
        InvalidValue: the file has neither time, or the scan can't be registered, or its place under the tip is unknown.
    """
    end_ns = content.end_ns if content.end_ns is not None else content.start_ns
    start_ns = content.start_ns if content.start_ns is not None else end_ns
    if start_ns is None or end_ns is None:
        raise InvalidValue("it does not say when it was taken", where=scan.filename)
    start_s, end_s = start_ns / NS_PER_S, end_ns / NS_PER_S
    return DriftScan(
        scan.values, _in_tip_coordinates(scan, content), start_s, end_s, content.upwards, scan.filename, scan.unit
    )


def _common_place(contents: Sequence[FileContent]) -> str | None:
    # places in the words of files can be compared only if they are equal
    places = Counter(content.stated_place for content in contents if content.scans and content.stated_place != "")
    return places.most_common(1)[0][0] if places else None


def _unfit(scan: Scan, content: FileContent, common: str | None) -> str:
    if content.end_ns is None and content.start_ns is None:
        return "it does not say when it was taken"
    if content.stated_place == "":
        return "it does not say where it was taken"
    if content.stated_place != common:
        return f"its place ({content.stated_place or 'in m'}) can't be compared with others' ({common or 'in m'})"
    if scan.region.frame is Frame.SAMPLE and _mapping(content) is None:
        return "it says where it is on the sample, but not where that was under the tip"
    if missing := scan.lines_missing:
        return f"it was broken off: {missing} of {scan.shape[0]} lines are missing"
    return f"{scan.shape[1]} x {scan.shape[0]} pixels" if min(scan.shape) < 2 else ""


def _in_tip_coordinates(scan: Scan, content: FileContent) -> Region:
    # a file of the record has the place on the sample where drift was corrected, and the mapping of its scan
    if scan.region.frame is Frame.TIP:
        return scan.region
    mapping = _mapping(content)
    if mapping is None:
        raise InvalidValue("its place under the tip is unknown", where=scan.filename)
    return mapping.to_tip(scan.region)


def _mapping(content: FileContent) -> Mapping | None:
    drift = content.header.get("drift")
    if not isinstance(drift, dict) or len(drift.get("matrix", ())) != 6:
        return None
    # until correction begins, the place on the sample is the place under the tip
    return Mapping(np.reshape([*drift["matrix"], 0.0, 0.0, 1.0], (3, 3))) if drift["correcting"] else Mapping.identity()
