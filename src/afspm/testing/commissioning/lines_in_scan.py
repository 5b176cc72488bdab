"""The places of lines published during a scan, found in the scan that is saved at its end."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from afspm.model import Scan, ScanLines
from afspm.model.arrays import Array
from afspm.model.line_levelling import Levelling, levelled
from afspm.model.variables import RETRACE

_SAME: Final = 1e-3
"""Largest difference of the same line in memory and file, as a part of the difference between two lines."""

_LIKE: Final = 0.5
"""Least correlation of trace and retrace, in the order that is right."""
_APART: Final = 0.2
"""Least difference of the correlations in both orders."""


@dataclass(frozen=True)
class LinePlace:
    """Where a published line is in the saved scan.

    Attributes:
        is_row: True if it is in the row that was published.
        is_mirrored: True if it is there from right to left.
        is_retrace: True for a line of a retrace, by the role of its channel.
    """

    is_row: bool
    is_mirrored: bool
    is_retrace: bool


def places(scan: Scan, lines: Iterable[ScanLines]) -> Iterator[LinePlace]:
    """Yield the places of the lines of one channel. A line is left out if no row is like it, or another one as much."""
    rows = np.concatenate([scan.values, scan.values[:, ::-1]])
    retrace = any(role.endswith("retrace") for role in scan.roles)
    for part in lines:
        if part.channel != scan.channel or part.shape != scan.shape:
            continue
        for index, line in enumerate(part.values, part.first_row):
            distances = np.abs(rows - line).max(axis=1)
            nearest, next_one = np.argsort(distances)[:2]
            # NaN sorts last, and compares as False
            if distances[nearest] < _SAME * distances[next_one]:
                yield LinePlace(nearest % scan.shape[0] == index, bool(nearest >= scan.shape[0]), retrace)


def retrace_runs_as_trace(scans: Sequence[Scan]) -> bool | None:
    """Return whether the lines of a retrace run as those of its trace do; None if no pair of scans shows it."""
    by_role = {role: scan for scan in scans for role in scan.roles}
    for role, trace in by_role.items():
        retrace = by_role.get(role + RETRACE)
        if retrace is None or retrace.shape != trace.shape:
            continue
        a = levelled(trace.values, Levelling.LINES)
        same, mirrored = (
            _likeness(a, levelled(one, Levelling.LINES)) for one in (retrace.values, retrace.values[:, ::-1])
        )
        if max(same, mirrored) > _LIKE and abs(same - mirrored) > _APART:
            return same > mirrored
    return None


def _likeness(a: Array, b: Array) -> float:
    both = np.isfinite(a) & np.isfinite(b)
    if not both.any() or min(np.ptp(a[both]), np.ptp(b[both])) == 0.0:
        return 0.0
    return float(np.corrcoef(a[both], b[both])[0, 1])
