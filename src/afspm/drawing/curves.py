"""Curves: thinning that keeps peaks, round ticks, and the profile of a scan along a line."""

from __future__ import annotations

import itertools
import math

import numpy as np

from afspm.model.arrays import Array

MOST_POINTS = 600
MOST_PROFILE_POINTS = 1024
Pixel = tuple[float, float]


def thinned(x: Array, y: Array, most: int = MOST_POINTS) -> tuple[Array, Array]:
    """Thin a curve to about `most` points: the minimum and maximum of each interval, so that peaks survive."""
    if len(x) <= most:
        return x, y
    edges = np.linspace(0, len(x), most // 2 + 1).astype(int)
    chosen: list[int] = []
    for begin, end in itertools.pairwise(edges.tolist()):
        part = y[begin:end]
        if not np.isfinite(part).any():
            chosen.append(begin)
            continue
        chosen += sorted({int(begin + np.nanargmin(part)), int(begin + np.nanargmax(part))})
    return x[chosen], y[chosen]


def round_ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Return about `about` round ticks in [low, high], at least two where possible."""
    if not high > low:
        return [low]
    power = 10.0 ** math.floor(math.log10((high - low) / about))
    found: list[float] = []
    for factor in (0.5, 1, 2, 5, 10):  # the first step with few enough ticks; a wider one must leave two
        before, found = found, _multiples(power * factor, low, high)
        if len(found) < 2 <= len(before):
            return before
        if (high - low) / (power * factor) <= about:
            break
    return found


def _multiples(step: float, low: float, high: float) -> list[float]:
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(i * step, 14 - math.floor(math.log10(abs(i * step) or 1.0))) for i in range(first, last + 1)]


def profile(values: Array, size_m: tuple[float, float], begin: Pixel, end: Pixel) -> tuple[Array, Array]:
    """Return the profile along a line in a scan: (distances in m, interpolated values), about one point per pixel.

    Args:
        values: [y, x], y ascending; NaN where nothing was measured.
        size_m: (width, height) of the scan in m.
        begin, end: (column, row), fractions of pixels allowed; positions outside are moved to the border.
    """
    ny, nx = values.shape
    (x0, y0), (x1, y1) = ((min(max(x, 0.0), nx - 1.0), min(max(y, 0.0), ny - 1.0)) for x, y in (begin, end))
    count = min(MOST_PROFILE_POINTS, max(2, round(math.hypot(x1 - x0, y1 - y0)) + 1))
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
    # 0 * NaN is NaN: a neighbour without weight must not count
    for rows, columns, weights in (
        (low, left, (1 - u) * (1 - v)),
        (low, right, u * (1 - v)),
        (high, left, (1 - u) * v),
        (high, right, u * v),
    ):
        total += np.where(weights > 0.0, values[rows, columns] * weights, 0.0)
    return total
