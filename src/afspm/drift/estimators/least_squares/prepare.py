"""What is registered of a scan: its rows flattened, what was measured marked, and what holds nothing refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_ROWS = 0.5  # of a scan, measured
LEAST_TOPOGRAPHY = 0.1  # correlation of neighbouring rows; noise and streaks have none
MOST_SATURATED = 0.6  # of the pixels at exactly the lowest or the highest value


class Unusable(Exception):
    """The scan can't be registered with any other; the text says why."""


@dataclass(frozen=True, eq=False)
class Image:
    """A prepared image.

    Attributes:
        values: [y, x], finite everywhere: what was not measured is filled from the nearest row.
        known: [y, x], where something was measured.
    """

    values: Array
    known: Mask


def prepare(values: Array) -> Image:
    """Flatten the rows, cut off what sticks out, scale to a standard deviation of 1.

    Raises:
        Unusable: less than half of the rows measured, constant, saturated, or without topography (a crashed tip).
    """
    known = np.isfinite(values)
    known &= ~_unfinished(np.where(known, values, 0.0))[:, None]
    rows = known.mean(axis=1) > 0.5
    known &= rows[:, None]
    if rows.mean() < LEAST_ROWS:
        raise Unusable(f"only {rows.sum()} of {rows.size} rows hold something")
    measured = values[known]
    lowest, highest = measured.min(), measured.max()
    if highest - lowest <= 1e-12 * max(abs(lowest), abs(highest)):
        raise Unusable("it is constant")
    if max(np.mean(measured == lowest), np.mean(measured == highest)) > MOST_SATURATED:
        raise Unusable("most of it is saturated at one value: has the tip crashed?")
    scaled = (_filled(values, known) - lowest) / (highest - lowest)
    flat = flatten_rows(scaled, known)
    low, high = np.percentile(flat[known], (0.1, 99.9))
    flat = np.clip(flat, low - 0.25 * (high - low), high + 0.25 * (high - low))
    spread = flat[known].std()
    if spread < 1e-9:
        raise Unusable("but for an offset and a tilt of each row it is constant")
    flat /= spread
    if _topography(flat, rows) < LEAST_TOPOGRAPHY:
        raise Unusable("no row looks like its neighbours (noise or streaks alone): has the tip crashed?")
    return Image(flat, known)


def flatten_rows(values: Array, known: Mask) -> Array:
    """Minus a straight line in each row, by two rounds of weighted least squares that trust outliers less."""
    x = np.linspace(-1.0, 1.0, values.shape[1])
    powers = np.stack([np.ones_like(x), x, x * x], axis=1)
    weight = known.astype(np.float64)
    line = np.zeros_like(values)
    for _ in range(3):
        w, wx, wxx = (weight @ powers).T
        b, bx = ((weight * values) @ powers[:, :2]).T
        determinant = w * wxx - wx * wx
        determinant = np.where(determinant > 1e-12, determinant, np.inf)
        offset, slope = (wxx * b - wx * bx) / determinant, (w * bx - wx * b) / determinant
        line = offset[:, None] + slope[:, None] * x
        residual = values - line
        scale = 1.4826 * np.median(np.abs(residual[known]))
        weight = known / (1.0 + (residual / max(2.0 * scale, 1e-12)) ** 2)
    return values - line


def _unfinished(values: Array) -> Mask:
    """Rows at the start or the end of a scan that hold one and the same value: it was stopped before them."""
    same = (values == values[:, :1]).all(axis=1)
    first = np.logical_and.accumulate(same & (values[:, 0] == values[0, 0]))
    last = np.logical_and.accumulate((same & (values[:, 0] == values[-1, 0]))[::-1])[::-1]
    unfinished: Mask = first | last
    return unfinished


def _filled(values: Array, known: Mask) -> Array:
    """With the nearest measured value of the column in place of what is missing."""
    if known.all():
        return np.array(values, dtype=np.float64)
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(~known, sampling=(1.0, 2.0), return_distances=False, return_indices=True)
    filled: Array = values[tuple(nearest)]
    return filled


def _topography(values: Array, rows: Mask) -> float:
    """Greatest correlation of rows up to four apart."""
    measured = values[rows] - values[rows].mean(axis=1, keepdims=True)
    power = float(np.mean(measured**2))
    return max(abs(float(np.mean(measured[lag:] * measured[:-lag]))) / power for lag in (1, 2, 3, 4))
