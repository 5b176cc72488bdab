"""Registration of single rows against an earlier scan of the same place. Pure.

The rows of a scan arrive one by one, while the sample drifts. A single row determines the shift badly (a flat terrace,
one particle), so the cost of every shift in a window is summed over rows, with less weight for older rows. The subpixel
part of the shift is fitted together with offset and tilt of the row: to first order it adds the template's two slopes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from afspm.components import SD_PER_MAD, Array

Shift = tuple[float, float]
"""(rows, columns) from the running scan to the same feature in the template."""

Cause = Callable[[Array], Array]
"""A cause of another image: functions of a template's row to be fitted too, [pixel, function]."""

FORGET = 0.85  # weight of the older rows in the cost of a shift
LEAST_OVERLAP = 0.4  # share of a row that the template must cover
PRIOR_PX = 0.7  # standard deviation of the remainder of a shift
MOST_MOVED_PX = 1.5
ROUNDS = (1, 3)  # of each fit; the second fit takes the template's slopes where the first one has moved the row
PULL = 0.02  # cost of each squared pixel from the predicted shift, on ground too flat to show a shift
STEADY = 0.75  # share of the cost that a shift elsewhere must stay below: on a lattice many shifts are nearly as good
HALF_PX = 0.35  # standard deviation of a shift rounded to whole pixels, both directions combined
CANDIDATES = 6  # of a search: on a lattice many shifts are nearly as good
CLIP_SIGMAS = 4.0  # limit of a slope in the cost of a shift, and of a pixel in a residual


@dataclass(frozen=True, eq=False)
class RowTemplate:
    """An earlier scan, prepared for comparison with rows.

    Attributes:
        heights: in m, [y, x], rows levelled, without holes.
        slopes: differences of neighbouring pixels along the rows, [y, x - 1], in m.
        row_slopes, column_slopes: the gradient, in m per pixel.
        spline: cubic spline coefficients of the heights; linear interpolation would blur sharp features between pixels.
        spread: standard deviation of the slopes, in m per pixel.
        trusted: by row; False for a row with a defect such as a scar, which other scans do not show.
    """

    heights: Array
    slopes: Array
    row_slopes: Array
    column_slopes: Array
    spline: Array
    spread: float
    trusted: NDArray[np.bool_]

    @classmethod
    def of(cls, heights: Array, doubtful: Collection[int] = ()) -> RowTemplate:
        """Prepare a scan; doubtful rows and rows with few values are interpolated from their neighbours.

        Args:
            doubtful: rows to exclude from all comparisons.
        """
        level = levelled(heights)
        rows = np.arange(len(level))
        trusted = np.isfinite(level).all(axis=1) & ~np.isin(rows, list(doubtful))
        if not trusted.all() and trusted.any():
            # the spline of the rows beside a hole reaches into it: a copied row would bend them
            after = np.searchsorted(rows[trusted], rows).clip(max=trusted.sum() - 1)
            low, high = rows[trusted][np.maximum(after - 1, 0)], rows[trusted][after]
            share = ((rows - low) / np.maximum(high - low, 1)).clip(0.0, 1.0)[:, None]
            level = np.where(trusted[:, None], level, (1.0 - share) * level[low] + share * level[high])
        slopes = np.diff(level, axis=1)
        row_slopes, column_slopes = (np.asarray(np.gradient(level, axis=axis)) for axis in (0, 1))
        spline = np.asarray(ndimage.spline_filter(level, order=3))
        # the spread is not robust: on particles most of the ground is flat, and only flanks show a shift
        return cls(level, slopes, row_slopes, column_slopes, spline, float(np.std(slopes)) or 1e-15, trusted)


@dataclass(frozen=True)
class RowFit:
    """The difference between a row and its template.

    Attributes:
        residual: in m, NaN where not comparable.
        steepness: slope of the template at each pixel, in m per pixel.
        expected: height of the template at each pixel, in m.
    """

    residual: Array
    steepness: Array
    expected: Array


class RowRegistration:
    """Tracker of the shift between the running scan and its template.

    Args:
        template: the earlier scan.
        expected: predicted shift.
        reach: largest deviation from `expected` that is searched, (rows, columns).
        steady: see `STEADY`; 1: take the best shift anywhere in the window, without `PULL`.
    """

    def __init__(self, template: RowTemplate, expected: Shift, reach: tuple[int, int], steady: float = STEADY) -> None:
        self._template = template
        self._reach, self._steady = reach, steady
        self._middle = (round(expected[0]), round(expected[1]))
        rows, columns = (
            np.arange(-far, far + 1) + m - e for far, m, e in zip(reach, self._middle, expected, strict=True)
        )
        self._away = PULL * (rows[:, None] ** 2 + columns[None, :] ** 2) * float(steady < 1.0)
        self._cost: Array | None = None
        self.shift: Shift = expected

    def follow(self, number: int, row: Array) -> None:
        """Update the shift with a levelled row and its index in the scan, unless the row lies outside the template."""
        cost = self._costs(number, np.diff(row))
        if cost is None:
            return
        self._cost = cost if self._cost is None else FORGET * self._cost + cost
        self.shift = self._best(self._cost)

    def fit(
        self,
        number: int,
        row: Array,
        template: RowTemplate | None = None,
        cause: Cause | None = None,
    ) -> RowFit | None:
        """Fit a levelled row to the template, and return the residual.

        Offset, tilt and the rest of the shift are fitted. None if the template covers too little of the row, or if a
        template row needed for the comparison is not trusted.

        Args:
            number: index of the row in the scan.
            template: another channel of the template's scan, for a row of that channel; None: the tracked template.
            cause: see `Cause`; None: the image is as in the template.
        """
        template, (down, along) = template or self._template, self.shift
        ny, nx = template.heights.shape
        columns = np.arange(nx, dtype=np.float64)
        moved = np.zeros(2)
        for rounds in ROUNDS:
            at, beside = number + down + moved[0], columns + along + moved[1]
            inside = (beside >= 0) & (beside <= nx - 1) & np.isfinite(row)
            if not 0.0 <= at <= ny - 1 or not template.trusted[math.floor(at) : math.ceil(at) + 1].all():
                return None
            if inside.mean() < LEAST_OVERLAP:
                return None
            expected = _row_at(template.spline, at, beside, order=3)
            down_slope, along_slope = (
                _row_at(picture, at, beside, order=1) for picture in (template.row_slopes, template.column_slopes)
            )
            basis = np.stack([np.ones(nx), np.linspace(-1.0, 1.0, nx), down_slope, along_slope], axis=1)
            if cause is not None:
                basis = np.concatenate([basis, cause(expected)], axis=1)
            difference = np.where(inside, row - expected, 0.0)
            residual, more = _unexplained(difference, basis, inside, moved, rounds)
            moved = np.clip(moved + more, -MOST_MOVED_PX, MOST_MOVED_PX)
        return RowFit(residual, np.hypot(down_slope, along_slope), expected)

    def _costs(self, number: int, slopes: Array) -> Array | None:
        template, (rows, columns) = self._template, self._reach
        ny, nx = template.slopes.shape
        first_row, first_column = number + self._middle[0] - rows, self._middle[1] - columns
        if first_row + 2 * rows < 0 or first_row >= ny:
            return None
        part = _cut(template.slopes, first_row, first_column, 2 * rows + 1, nx + 2 * columns)
        windows = np.lib.stride_tricks.sliding_window_view(part, nx, axis=1)
        off = np.minimum(np.abs(windows - slopes), CLIP_SIGMAS * template.spread)
        counted = np.isfinite(off)
        share = counted.mean(axis=-1)
        total = np.where(counted, off * off, 0.0).sum(axis=-1)
        # a shift that leaves the template is as bad as a row that has nothing to do with it
        usual = template.spread**2 * nx
        return np.asarray(np.where(share >= LEAST_OVERLAP, total / np.maximum(share, LEAST_OVERLAP), 4.0 * usual))

    def _best(self, cost: Array) -> Shift:
        cost = cost + float(np.median(cost)) * self._away
        origin = (self._middle[0] - self._reach[0], self._middle[1] - self._reach[1])
        near = [round(at) - first for at, first in zip(self.shift, origin, strict=True)]
        rows, columns = (
            slice(max(0, at - 1), at + 2) if 0 <= at < size else slice(0, size)
            for at, size in zip(near, cost.shape, strict=True)
        )
        local = cost[rows, columns]
        row, column = (int(one) for one in np.unravel_index(int(local.argmin()), local.shape))
        row, column = row + rows.start, column + columns.start
        if cost.min() < self._steady * cost[row, column]:
            row, column = (int(one) for one in np.unravel_index(int(cost.argmin()), cost.shape))
        return origin[0] + row + _vertex(cost[:, column], row), origin[1] + column + _vertex(cost[row, :], column)


def likely_shifts(
    template: RowTemplate,
    lines: Sequence[tuple[int, Array]],
    about: Shift,
    reach: tuple[int, int],
    flat_m: float,
) -> list[Shift]:
    """Return the six shifts in whole pixels with the best fit of some lines, best first.

    Unlike `RowRegistration`, this search compares heights: the flat ground beside a step shows shifts that its edge
    does not.

    Args:
        lines: (index in the scan, levelled row) of each line.
        about: centre of the search.
        reach: largest deviation from `about` that is searched, (rows, columns).
        flat_m: usual difference on flat pixels, in m.
    """
    (down, along), (ny, nx) = (round(at) for at in about), template.heights.shape
    rows, columns = np.arange(-reach[0], reach[0] + 1) + down, np.arange(nx + 2 * reach[1]) + along - reach[1]
    beside = (columns >= 0) & (columns < nx)
    steepness = np.hypot(template.row_slopes, template.column_slopes)
    ends = np.linspace(-2.0, 2.0, nx)  # the middles of the halves are at -1 and 1
    cost = np.zeros((len(rows), 2 * reach[1] + 1))
    for number, line in lines:
        at = np.clip(number + rows, 0, ny - 1)
        inside = (at == number + rows)[:, None] & beside & template.trusted[at][:, None]
        places = np.ix_(at, np.clip(columns, 0, nx - 1))
        heights, slopes, counted = (
            np.lib.stride_tricks.sliding_window_view(one, nx, axis=1)
            for one in (template.heights[places], steepness[places], inside)
        )
        off = line - heights
        # the tilt of a single noisy line is known badly, so the tilt of the difference is taken, by the halves' medians
        left, right = (np.median(half, axis=-1) for half in (off[..., : nx // 2], off[..., -(nx // 2) :]))
        off -= ((left + right) / 2.0)[..., None] + ((right - left) / 2.0)[..., None] * ends
        # between whole pixels a flank differs by half a pixel of slope at most
        square = np.minimum(off * off / (flat_m**2 + (HALF_PX * slopes) ** 2), CLIP_SIGMAS**2)
        share = counted.mean(axis=-1)
        total = np.where(counted, square, 0.0).mean(axis=-1) / np.maximum(share, LEAST_OVERLAP)
        # a line that the template does not cover is evidence neither for a shift nor against it
        cost += np.where(share >= LEAST_OVERLAP, total, 2.0)
    found: list[Shift] = []
    for _ in range(CANDIDATES):
        row, column = (int(one) for one in np.unravel_index(int(cost.argmin()), cost.shape))
        found.append((float(rows[row]), float(columns[0] + column)))
        cost[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2] = np.inf
    return found


def levelled(rows: Array) -> Array:
    """Return rows without the offset of each row and the common tilt (z drift, mounting of the sample).

    Holes are interpolated along the row. A row with at most half of its values becomes NaN, and so does a row of one
    value: some controllers fill lost rows with zeros.
    """
    rows = np.array(rows, dtype=np.float64, ndmin=2)
    there = np.isfinite(rows)
    for row, good in zip(rows, there, strict=True):
        if good.mean() <= 0.5 or np.ptp(row[good]) == 0.0:
            row[:] = np.nan
        elif not good.all():
            x = np.arange(len(row))
            row[~good] = np.interp(x[~good], x[good], row[good])
    if not np.isfinite(rows).any():
        return rows
    with np.errstate(invalid="ignore"):
        tilt = np.nanmedian(np.diff(rows, axis=1))
        level = rows - tilt * np.arange(rows.shape[1])
        return np.asarray(level - np.median(level, axis=1, keepdims=True))


def residual_spread(values: Array) -> float:
    """Return the standard deviation, estimated from the median absolute value; never zero."""
    there = values[np.isfinite(values)]
    half = there.size // 2
    # the upper of the two middle values: a tenth of the time that numpy's median takes on a row
    spread = SD_PER_MAD * float(np.partition(np.abs(there), half)[half]) if there.size else 0.0
    return spread or float(there.std() if there.size else 0.0) or 1e-15


def _cut(picture: Array, row: int, column: int, rows: int, columns: int) -> Array:
    # NaN outside
    part = np.full((rows, columns), np.nan)
    ny, nx = picture.shape
    top, left = max(row, 0), max(column, 0)
    bottom, right = min(row + rows, ny), min(column + columns, nx)
    if top < bottom and left < right:
        part[top - row : bottom - row, left - column : right - column] = picture[top:bottom, left:right]
    return part


def _row_at(picture: Array, at: float, columns: Array, order: Literal[1, 3]) -> Array:
    places = [np.full(columns.shape, at), columns]
    return np.asarray(ndimage.map_coordinates(picture, places, order=order, mode="nearest", prefilter=False))


def _vertex(cost: Array, at: int) -> float:
    # of the parabola through the minimum and its neighbours
    if not 0 < at < len(cost) - 1:
        return 0.0
    below, here, above = cost[at - 1 : at + 2]
    bend = below - 2.0 * here + above
    return float(np.clip(0.5 * (below - above) / bend, -0.5, 0.5)) if bend > 0 else 0.0


def _unexplained(
    difference: Array, basis: Array, inside: NDArray[np.bool_], moved: Array, rounds: int
) -> tuple[Array, Array]:
    # several times, with less weight for outliers: pixels that a scar moved must not move the fit
    weights, residual, found = inside.astype(np.float64), difference, np.zeros(basis.shape[1])
    prior, pulled = np.zeros((2, basis.shape[1]))
    prior[4:] = 1.0  # some functions vanish in a row
    prior[2:4] = 1.0 / PRIOR_PX**2
    pulled[2:4] = prior[2:4] * moved
    for _ in range(rounds):
        unit = residual_spread(residual[inside])
        weighted = basis * (weights / unit**2)[:, None]
        matrix = weighted.T @ basis
        matrix += np.diag(prior)
        moment = weighted.T @ difference - pulled
        size = np.sqrt(matrix.diagonal())
        found = np.linalg.solve(matrix / np.outer(size, size), moment / size) / size
        residual = difference - basis @ found
        weights = np.where(inside, 1.0 / np.maximum(1.0, np.abs(residual) / (2.0 * unit)), 0.0)
    return np.where(inside, residual, np.nan), found[2:4]
