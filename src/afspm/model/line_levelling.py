"""Levelling of scans for display; published values stay unchanged."""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# standard deviation of a normal distribution, in median absolute deviations
_SD_PER_MAD = 1.4826
_OUTLIERS_SD = 4.0


class Levelling(Enum):
    """The background that is subtracted before a scan is shown."""

    NONE = "none"
    PLANE = "plane"
    """The best-fitting plane (least squares)."""
    LINES = "lines"
    """The best-fitting straight line of each row."""
    MEDIANS = "medians"
    """The median of each row."""
    DIFFERENCES = "differences"
    """The sum of the median differences between neighbouring rows: features longer than half a row do no harm."""


def levelled(values: Array, how: Levelling) -> Array:
    """Return values [y, x] without their background; non-finite values stay and are left out of the fit."""
    if how is Levelling.NONE or not values.size:
        return values
    finite = np.isfinite(values)
    if not finite.any():
        return values
    return values - _BACKGROUNDS[how](values, finite)


def flattened(values: Array) -> Array:
    """Return values [y, x] with rows aligned in height and a plane subtracted, for small pictures.

    The plane is fitted without outliers: neither a scar nor a high particle tilts its neighbours.
    """
    flat = levelled(levelled(values, Levelling.DIFFERENCES), Levelling.PLANE)
    finite = np.isfinite(flat)
    if not finite.any():
        return flat
    from_middle = np.abs(flat - np.median(flat[finite]))
    near = finite & (from_middle <= _OUTLIERS_SD * _SD_PER_MAD * np.median(from_middle[finite]))
    # at least half of the values are within this limit, so there is always a plane through them
    return flat - _plane(flat, near)


def _plane(values: Array, finite: NDArray[np.bool_]) -> Array:
    # normal equations in coordinates about the mean position, which keep the sums small
    weights = finite.astype(np.float64)
    known = np.where(finite, values, 0.0)
    x, y = (np.arange(n, dtype=np.float64) for n in reversed(values.shape))
    count = weights.sum()
    columns, rows = weights.sum(axis=0), weights.sum(axis=1)
    x = x - columns @ x / count
    y = y - rows @ y / count
    mean = known.sum() / count
    xx, yy, xy = columns @ x**2, rows @ y**2, y @ weights @ x
    by_column, by_row = known.sum(axis=0), known.sum(axis=1)
    matrix = np.array([[xx, xy], [xy, yy]])
    # lstsq, not solve: a single row or column leaves one slope undetermined, which then is zero
    slope_x, slope_y = np.linalg.lstsq(matrix, np.array([by_column @ x, by_row @ y]), rcond=1e-12)[0]
    return np.asarray(mean + slope_x * x[None, :] + slope_y * y[:, None])


def _lines(values: Array, finite: NDArray[np.bool_]) -> Array:
    weights = finite.astype(np.float64)
    known = np.where(finite, values, 0.0)
    count = np.maximum(weights.sum(axis=1), 1.0)
    x = np.arange(values.shape[1], dtype=np.float64)
    middle = weights @ x / count
    offset = x[None, :] - middle[:, None]
    spread = (weights * offset**2).sum(axis=1)
    mean = known.sum(axis=1) / count
    slope = (known * offset).sum(axis=1) / np.where(spread > 0.0, spread, 1.0)
    return np.asarray(mean[:, None] + slope[:, None] * offset)


def _medians(values: Array, finite: NDArray[np.bool_]) -> Array:
    measured = finite.mean(axis=1)
    if not ((measured > 0.0) & (measured < 1.0)).any():
        return _row_medians(values, finite)
    # the median of a tilted row depends on which of its pixels were measured, so the tilt is left out of it
    steps = np.diff(np.where(finite, values, np.nan), axis=1)
    known = steps[np.isfinite(steps)]
    x = np.arange(values.shape[1]) - (values.shape[1] - 1) / 2
    return _row_medians(values - (float(np.median(known)) if known.size else 0.0) * x, finite)


def _row_medians(values: Array, finite: NDArray[np.bool_]) -> Array:
    medians = np.zeros((len(values), 1))
    # numpy warns of a median over no values
    some = finite.any(axis=1)
    medians[some] = np.nanmedian(np.where(finite, values, np.nan)[some], axis=1, keepdims=True)
    return medians


def _differences(values: Array, finite: NDArray[np.bool_]) -> Array:
    some = finite.any(axis=1)  # rows without values are skipped: the previous row is the last with values
    known, there = np.where(finite, values, 0.0)[some], finite[some]
    offsets = np.zeros((len(values), 1))
    offsets[some] = np.cumsum([[0.0], *_row_medians(np.diff(known, axis=0), there[1:] & there[:-1])], axis=0)
    return offsets


_BACKGROUNDS = {
    Levelling.PLANE: _plane,
    Levelling.LINES: _lines,
    Levelling.MEDIANS: _medians,
    Levelling.DIFFERENCES: _differences,
}
