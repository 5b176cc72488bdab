"""Drift of scans that were taken long ago: followed by a tracker, and each compared with the first on its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from afspm.drift.record import DriftRecord
from afspm.drift.registration import DriftScan, Registration
from afspm.drift.shear import row_delay_s
from afspm.drift.tracking import Tracker, Update
from afspm.errors import InvalidValue
from afspm.model import Scan

Array = NDArray[np.float64]

NS_PER_S = 1_000_000_000
TOPOGRAPHY = ("height", "topo", "z", "zsensor")


@dataclass(frozen=True)
class Chosen:
    """One channel of many scans, in the order of time.

    Attributes:
        channel, unit: of the values.
        scans: of that channel, with the times of those below.
        left_out: what can't be followed, and why.
    """

    channel: str
    unit: str
    scans: tuple[DriftScan, ...]
    left_out: tuple[str, ...]


def chosen(scans: Sequence[Scan], channel: str = "") -> Chosen:
    """The scans of a channel that can be followed; without one named, of the topography.

    Args:
        scans: all channels of all files.

    Raises:
        InvalidValue: there is no such channel, or no two scans of it.
    """
    name = channel or topography([scan.channel for scan in scans])
    found: list[DriftScan] = []
    left_out: list[str] = []
    units = []
    for scan in scans:
        if scan.channel != name:
            continue
        told = scan.filename or "a scan"
        if scan.time_ns is None:
            left_out.append(f"{told}: it does not say when it was taken")
        elif min(scan.shape) < 2:
            left_out.append(f"{told}: {scan.shape[1]} x {scan.shape[0]} pixels")
        else:
            found.append(timed(scan))
            units.append(scan.unit)
    found.sort(key=lambda one: one.mid_s)
    if len(found) < 2:
        there = ", ".join(sorted({scan.channel for scan in scans})) or "none"
        raise InvalidValue(
            f"drift needs two scans of the channel {name!r} at least, not {len(found)}", hint=f"channels: {there}"
        )
    return Chosen(name, units[0], tuple(found), tuple(left_out))


def topography(channels: Sequence[str]) -> str:
    """The channel that most likely is the topography: by its name, the forward one, as most files call it.

    Raises:
        InvalidValue: there are no channels.
    """
    names = list(dict.fromkeys(channels))
    if not names:
        raise InvalidValue("there are no scans")

    def rank(name: str) -> tuple[int, int, int]:
        lower = name.lower()
        words = next((k for k, word in enumerate(TOPOGRAPHY) if lower.startswith(word)), len(TOPOGRAPHY))
        backwards = any(word in lower for word in ("retrace", "backward", "bwd"))
        return words, int(backwards), names.index(name)

    return min(names, key=rank)


def timed(scan: Scan) -> DriftScan:
    """As drift sees it. Where a scan does not say how long it took, it counts as taken when it was finished."""
    end_s = (scan.time_ns or 0) / NS_PER_S
    return DriftScan(scan.values, scan.region, end_s, end_s, key=scan.filename)


def followed(scans: Sequence[DriftScan], tracker: Tracker) -> Iterator[Update]:
    """What the tracker says of each scan, in the order of time."""
    for scan in scans:
        yield tracker.add(scan)


def against_first(record: DriftRecord, scans: Sequence[DriftScan], pairs: Sequence[Registration]) -> DriftRecord:
    """The displacements from the first scan to each later one, each by itself, as a record.

    A registration speaks of the middle of what two scans share, which was not taken in the middle of either: the way
    that the sample went in between is taken off, with the rates of the tracker.

    Args:
        record: of the tracker.
        pairs: of the first scan with each of the others.
    """
    drift, covariance = [np.zeros(2)], [np.zeros((2, 2))]
    for k, (scan, pair) in enumerate(zip(scans[1:], pairs, strict=True), start=1):
        early = record.rate_m_s[0] * (row_delay_s(scans[0], pair.center_m) or 0.0)
        late = record.rate_m_s[k] * (row_delay_s(scan, pair.center_m + pair.displacement_m) or 0.0)
        drift.append(pair.displacement_m - (late - early))
        covariance.append(pair.covariance_m2)
    return replace(
        record,
        drift_m=np.array(drift),
        covariance_m2=np.array(covariance),
        matched=np.array([True, *(pair.accepted for pair in pairs)]),
        reasons=("", *(pair.reason for pair in pairs)),
    )


def spread_pairs(record: DriftRecord, apart_s: float, count: int) -> list[tuple[int, int]]:
    """Indices of matched scans that are about so far apart in time, spread over the run, for the eye."""
    good = np.flatnonzero(record.matched)
    pairs: list[tuple[int, int]] = []
    for first in good:
        later = good[good > first]
        if not len(later):
            break
        second = later[np.argmin(np.abs(record.time_s[later] - record.time_s[first] - apart_s))]
        pairs.append((int(first), int(second)))
    if not pairs:
        return []
    even = np.linspace(0, len(pairs) - 1, count).round().astype(int)
    return [pairs[k] for k in dict.fromkeys(even.tolist())]
