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
    rate_m_s = record.rate_then_m_s
    for k, (scan, pair) in enumerate(zip(scans[1:], pairs, strict=True), start=1):
        early = rate_m_s[0] * (row_delay_s(scans[0], pair.center_m) or 0.0)
        late = rate_m_s[k] * (row_delay_s(scan, pair.center_m + pair.displacement_m) or 0.0)
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
    """Indices of matched scans that are about so far apart in time, spread over the run, for the eye. Of a run that is
    too short, its ends."""
    good = np.flatnonzero(record.matched)
    if len(good) < 2:
        return []
    time_s = record.time_s[good]
    apart_s = min(apart_s, float(time_s[-1] - time_s[0]))
    starts = np.flatnonzero(time_s <= time_s[-1] - 0.95 * apart_s)
    chosen = dict.fromkeys(np.linspace(0, len(starts) - 1, count).round().astype(int).tolist())
    ends = [int(np.argmin(np.abs(time_s - time_s[start] - apart_s))) for start in starts[list(chosen)]]
    return [(int(good[start]), int(good[end])) for start, end in zip(starts[list(chosen)], ends, strict=True)]
