"""Levelling of scans for display; published values stay unchanged."""

from __future__ import annotations

from enum import Enum

import numpy as np

from afspm.model.arrays import SD_PER_MAD, Array, Mask

_OUTLIERS_SD = 4.0
_NO_NOISE = 1e-12
_LINE_LEFT = 0.01
"""Largest line that is left in a row, in parts of the row's spread, if a line was subtracted from it."""
_LEAST_ROWS = 16
_LEAST_BESIDE = 0.1  # of a row, for its line
_FOOT_PIXELS = 4
_FEATURE = 0.2
"""Least height of a feature, in parts of the range of the scan."""
_ROUNDS = 8
_NEVER_NONE = 1e-9


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
    """Return values [y, x] with rows aligned in height and a plane subtracted, for pictures.

    The plane is fitted without outliers: neither a scar nor a high particle tilts its neighbours. Rows from which the
    controller has subtracted a straight line are tilted beside a high feature; their lines are fitted again without it.
    """
    finite = np.isfinite(values)
    if _are_lines_subtracted(values, finite):
        return _without_plane(values - _lines_beside_features(values, finite))
    return _without_plane(levelled(values, Levelling.DIFFERENCES))


def _without_plane(values: Array) -> Array:
    flat = levelled(values, Levelling.PLANE)
    finite = np.isfinite(flat)
    if not finite.any():
        return flat
    # at least half of the values are no outliers, so there is always a plane through them
    return flat - _plane(flat, finite & ~_outliers(flat, finite))


def _outliers(flat: Array, finite: Mask) -> Mask:
    from_middle = np.abs(flat - np.median(flat[finite]))
    with np.errstate(invalid="ignore"):
        return np.asarray(from_middle > _OUTLIERS_SD * SD_PER_MAD * np.median(from_middle[finite]))


def _are_lines_subtracted(values: Array, finite: Mask) -> bool:
    # noise alone gives a row of n pixels a line of 1 / sqrt(n) of its spread: 3 % in a thousand pixels
    whole = values[finite.all(axis=1)] if values.ndim == 2 else values[:0]
    if len(whole) < _LEAST_ROWS or whole.shape[1] < _LEAST_ROWS:
        return False
    line = _lines(whole, np.ones(whole.shape, dtype=bool))
    left = (whole - line).std(axis=1)
    # a row without noise is computed, not measured: it counts as a row with its line
    ratio = np.divide(line.std(axis=1), left, out=np.ones(len(left)), where=left > _NO_NOISE * np.abs(whole).max())
    return bool(np.percentile(ratio, 95.0) < _LINE_LEFT)


def _lines_beside_features(values: Array, finite: Mask) -> Array:
    # from row to row a feature changes little, so the differences give the lines well enough to find the features;
    # their errors add up from row to row, so the lines that count are fitted to the rows beside the features
    lines = np.zeros(values.shape)
    lines[1:] = np.cumsum(
        _robust_lines(np.diff(np.where(finite, values, 0.0), axis=0), finite[1:] & finite[:-1]), axis=0
    )
    known = np.where(finite, values, 0.0)
    for _ in range(2):
        flat = _without_plane(levelled(np.where(finite, values - lines, np.nan), Levelling.DIFFERENCES))
        low, middle, high = np.percentile(flat[finite], (1.0, 50.0, 99.0))
        with np.errstate(invalid="ignore"):
            beside = finite & ~_widened(np.abs(flat - middle) > _FEATURE * (high - low))
        fits = beside.mean(axis=1) >= _LEAST_BESIDE
        lines[fits] = _lines(known[fits], beside[fits].astype(np.float64))
    return lines


def _robust_lines(steps: Array, there: Mask) -> Array:
    # first by least absolute deviations, then by Tukey's biweight with the noise of all rows, which no edge reaches
    lines = _lines(steps, there)
    for _ in range(_ROUNDS):
        left = np.abs(steps - lines)
        usual = np.median(left, axis=1, keepdims=True)
        lines = _lines(steps, there / np.maximum(left, np.where(usual > 0.0, 0.05 * usual, 1.0)))
    reach = _OUTLIERS_SD * SD_PER_MAD * np.median(np.abs(steps - lines)[there]) if there.any() else 0.0
    for _ in range(_ROUNDS if reach > 0.0 else 0):
        part = np.minimum(np.abs(steps - lines) / reach, 1.0)
        lines = _lines(steps, there * ((1.0 - part**2) ** 2 + _NEVER_NONE))
    return lines


def _widened(mask: Mask) -> Mask:
    # the foot of a feature is no outlier, and would still tilt the row
    wide = mask.copy()
    for shift in range(1, _FOOT_PIXELS + 1):
        wide[:, shift:] |= mask[:, :-shift]
        wide[:, :-shift] |= mask[:, shift:]
    return wide


def _plane(values: Array, finite: Mask) -> Array:
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


def _lines(values: Array, finite: Mask | Array) -> Array:
    # `finite` may also hold weights
    weights = finite.astype(np.float64)
    known = weights * np.where(weights > 0.0, values, 0.0)
    count = weights.sum(axis=1)
    count[count == 0.0] = 1.0
    x = np.arange(values.shape[1], dtype=np.float64)
    middle = weights @ x / count
    offset = x[None, :] - middle[:, None]
    spread = (weights * offset**2).sum(axis=1)
    mean = known.sum(axis=1) / count
    slope = (known * offset).sum(axis=1) / np.where(spread > 0.0, spread, 1.0)
    return np.asarray(mean[:, None] + slope[:, None] * offset)


def _medians(values: Array, finite: Mask) -> Array:
    measured = finite.mean(axis=1)
    if not ((measured > 0.0) & (measured < 1.0)).any():
        return _row_medians(values, finite)
    # the median of a tilted row depends on which of its pixels were measured, so the tilt is left out of it
    steps = np.diff(np.where(finite, values, np.nan), axis=1)
    known = steps[np.isfinite(steps)]
    x = np.arange(values.shape[1]) - (values.shape[1] - 1) / 2
    return _row_medians(values - (float(np.median(known)) if known.size else 0.0) * x, finite)


def _row_medians(values: Array, finite: Mask) -> Array:
    medians = np.zeros((len(values), 1))
    # numpy warns of a median over no values
    some = finite.any(axis=1)
    medians[some] = np.nanmedian(np.where(finite, values, np.nan)[some], axis=1, keepdims=True)
    return medians


def _differences(values: Array, finite: Mask) -> Array:
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
