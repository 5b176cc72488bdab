"""Values of a scan along a line."""

from __future__ import annotations

import math

import numpy as np

from afspm.drawing.levelling import Array

MOST_POINTS = 1024
Pixel = tuple[float, float]


def profile(values: Array, size_m: tuple[float, float], begin: Pixel, end: Pixel) -> tuple[Array, Array]:
    """Return (distances in m, values) along a line in the scan, linear between pixels, about one point a pixel.

    Args:
        values: [y, x], y ascending; NaN where nothing was measured.
        size_m: of the scan.
        begin, end: (column, row), fractions of pixels allowed; what lies outside is moved to the border.
    """
    ny, nx = values.shape
    (x0, y0), (x1, y1) = ((min(max(x, 0.0), nx - 1.0), min(max(y, 0.0), ny - 1.0)) for x, y in (begin, end))
    count = min(MOST_POINTS, max(2, round(math.hypot(x1 - x0, y1 - y0)) + 1))
    column_m, row_m = size_m[0] / max(nx - 1, 1), size_m[1] / max(ny - 1, 1)
    length_m = math.hypot((x1 - x0) * column_m, (y1 - y0) * row_m)
    found = _interpolated(values, np.linspace(x0, x1, count), np.linspace(y0, y1, count))
    return np.linspace(0.0, length_m, count), found


def _interpolated(values: Array, x: Array, y: Array) -> Array:
    ny, nx = values.shape
    left = np.clip(np.floor(x).astype(int), 0, max(nx - 2, 0))
    low = np.clip(np.floor(y).astype(int), 0, max(ny - 2, 0))
    right, high = np.minimum(left + 1, nx - 1), np.minimum(low + 1, ny - 1)
    u, v = x - left, y - low
    total = np.zeros(x.shape)
    # a neighbour of no weight must not spoil it with its NaN
    for rows, columns, weights in (
        (low, left, (1 - u) * (1 - v)),
        (low, right, u * (1 - v)),
        (high, left, (1 - u) * v),
        (high, right, u * v),
    ):
        total += np.where(weights > 0.0, values[rows, columns] * weights, 0.0)
    return total
