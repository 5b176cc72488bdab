"""Drift of scans that were taken long ago: followed by a tracker, and each compared with the first on its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from afspm.drift.record import DriftRecord
from afspm.drift.registration import DriftScan, Registration
from afspm.drift.shear import row_delay_s
from afspm.drift.tracking import Tracker, Update

Array = NDArray[np.float64]


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
