"""Curves: fewer points without losing a peak, and round ticks."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
MOST_POINTS = 600


def thinned(x: Array, y: Array, most: int = MOST_POINTS) -> tuple[Array, Array]:
    """Return at most about `most` points: the lowest and highest of each stretch, so that no peak gets lost."""
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
    """Return round numbers between two, about so many, and two at least where there are any."""
    if not high > low:
        return [low]
    power = 10.0 ** math.floor(math.log10((high - low) / about))
    found: list[float] = []
    for factor in (0.5, 1, 2, 5, 10):  # the widest steps that leave two, or the first that are few enough
        before, found = found, _multiples(power * factor, low, high)
        if len(found) < 2 <= len(before):
            return before
        if (high - low) / (power * factor) <= about:
            break
    return found


def _multiples(step: float, low: float, high: float) -> list[float]:
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(i * step, 14 - math.floor(math.log10(abs(i * step) or 1.0))) for i in range(first, last + 1)]
