"""The places of lines published during a scan, found in the scan that is saved at its end."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from afspm.model import Scan, ScanLines

_SAME: Final = 1e-3
"""Largest difference of the same line in memory and file, as a part of the difference between two lines."""


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
