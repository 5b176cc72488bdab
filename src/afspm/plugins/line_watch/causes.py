"""Causes of a changed image that are no changed tip: another contrast, a saturated range, and overshoot. Pure.

A bent or scaled contrast makes the difference a function of the height, and a saturated range gives pixels at one
value. A feedback that overshoots makes the same difference behind all edges: to the right of them in the trace, to the
left in the retrace. A blunt or double tip does none of these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from afspm.components import Array
from afspm.plugins.line_watch.registration import RowFit

MOST_BENT = 0.08  # of the heights: a larger change of the contrast within a scan is the tip's
FEWEST_ENDS = 3  # pixels of a row at the same highest or lowest value
REACH_PX = 12  # behind an edge


def of_height(expected: Array) -> Array:
    """Return functions of the heights to fit: another gain, and a bend. A `Cause`."""
    part = (expected - expected.mean()) / max(float(np.ptp(expected)), 1e-15)
    return np.stack([part, part**2], axis=1)


def without_ends(row: Array, level: Array) -> Array:
    """Return a levelled row, NaN where the row as recorded stays at its lowest or highest value."""
    at_end = np.zeros(row.size, dtype=bool)
    for end in (np.nanmin(row), np.nanmax(row)):
        if (there := row == end).sum() >= FEWEST_ENDS:
            at_end |= there
    return np.where(at_end, np.nan, level)


def is_slight(before: Sequence[Sequence[RowFit]], after: Sequence[Sequence[RowFit]]) -> bool:
    """Return whether the explained part of the differences is at most `MOST_BENT` of the heights."""
    parts = [
        np.nanstd(one.residual - other.residual) / max(float(np.std(one.expected)), 1e-15)
        for line, again in zip(before, after, strict=True)
        for one, other in zip(line, again, strict=False)
    ]
    return bool(parts) and float(np.median(parts)) <= MOST_BENT


def without_overshoot(lines: Sequence[Sequence[RowFit]], *, has_retrace: bool) -> list[list[RowFit]]:
    """Return the fits of some lines without the part of the differences that follows all edges alike.

    Empty if this part lags behind the edges by more than it rises beyond them, as with debris that smears the image:
    in rooms of the half "tried" the sum of its kernel was -0.13 and less, and 0.07 and more with overshoot.

    Args:
        has_retrace: whether the second fit of a line is its retrace, which runs the other way.
    """
    ways = (1, -1 if has_retrace else 1)
    basis = [[_behind(fit.expected[::way])[::way] for fit, way in zip(line, ways, strict=True)] for line in lines]
    wanted = np.concatenate([fit.residual for line in lines for fit in line])
    given = np.concatenate([one for line in basis for one in line])
    there = np.isfinite(wanted)
    found = np.linalg.lstsq(given[there], wanted[there], rcond=None)[0]
    if found.sum() < 0.0:
        return []
    return [
        [replace(fit, residual=fit.residual - one @ found) for fit, one in zip(line, of, strict=True)]
        for line, of in zip(lines, basis, strict=True)
    ]


def _behind(heights: Array) -> Array:
    slopes = np.append(0.0, np.diff(heights))
    padded = np.pad(slopes, (REACH_PX, 0), mode="edge")
    return np.stack([padded[REACH_PX - lag : padded.size - lag] for lag in range(REACH_PX)], axis=1)
