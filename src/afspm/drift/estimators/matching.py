"""Which keypoint of one picture is which of the other: brute force with cross-check, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Descriptors = NDArray[np.float32]
Allowed = Callable[[slice], NDArray[np.bool_]]

_CELLS = 1 << 20  # of the table of distances that exist at one time: 4 MB


def matched(first: Descriptors, second: Descriptors, allowed: Allowed | None = None) -> NDArray[np.intp]:
    """Pairs of rows each of which is the other's nearest (Euclidean; of two as near the earlier one).

    Args:
        first, second: (n, d) and (m, d).
        allowed: for a slice of the first, which pairs may be at all, (rows, m).

    Returns:
        Row numbers (k, 2), in the order of the first.
    """
    if not len(first) or not len(second):
        return np.empty((0, 2), dtype=np.intp)
    lengths = (second**2).sum(axis=1)
    nearest = np.empty(len(first), dtype=np.intp)
    back = np.zeros(len(second), dtype=np.intp)
    back_distance = np.full(len(second), np.inf, dtype=np.float32)
    possible = np.empty(len(first), dtype=np.bool_)
    step = max(_CELLS // len(second), 1)
    for start in range(0, len(first), step):
        rows = slice(start, min(start + step, len(first)))
        distance = (first[rows] ** 2).sum(axis=1)[:, None] + lengths - 2.0 * first[rows] @ second.T
        if allowed is not None:
            distance[~allowed(rows)] = np.inf
        nearest[rows] = distance.argmin(axis=1)
        possible[rows] = np.isfinite(distance.min(axis=1))
        column = distance.argmin(axis=0)
        least = distance[column, np.arange(len(second))]
        better = least < back_distance
        back[better], back_distance[better] = column[better] + start, least[better]
    mutual = (back[nearest] == np.arange(len(first))) & possible
    found = np.flatnonzero(mutual)
    return np.stack([found, nearest[found]], axis=1)
