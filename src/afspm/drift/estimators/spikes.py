"""Spikes: pixels that stand out of their row in one of two scans, and not where the other shows the same place.

A filter would smear them over features, and the fit would take their edges for the sample's. In one image a spike and
the top of a small particle look alike, so both images are asked.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.images import Image
from afspm.drift.estimators.warp import LINEAR, Scene

Array = NDArray[np.float64]
Index = NDArray[np.intp]

LEAST_SD = 6.0  # above both neighbours, or below both, in standard deviations of the steps along the rows
OTHER = 0.5  # how much of that the other scan has, at most


def without_spikes(scene: Scene, theta: Array) -> Scene:
    """Return two images with the mean of its neighbours in the row in place of a spike.

    Args:
        theta: how they are displaced, to a pixel; see `warp.WarpedPair`.
    """
    first, second = scene.first, scene.second
    return Scene(_mended(first, second, theta), _mended(second, first, -theta))


def _mended(image: Image, other: Image, theta: Array) -> Image:
    values = image.values
    before, after = values[:, 1:-1] - values[:, :-2], values[:, 1:-1] - values[:, 2:]
    least = LEAST_SD * 1.4826 * float(np.median(np.abs(before)))
    beyond = np.minimum(np.abs(before), np.abs(after)) * (before * after > 0.0)
    rows, columns = np.nonzero(beyond > least)
    spike = beyond[rows, columns] * OTHER > _most_there(other.values, _there(image, other, theta, rows, columns + 1))
    rows, columns = rows[spike], columns[spike] + 1
    if not rows.size:
        return image
    mended = values.copy()
    mended[rows, columns] = (values[rows, columns - 1] + values[rows, columns + 1]) / 2
    return Image(mended, image.known)


def _there(image: Image, other: Image, theta: Array, rows: Index, columns: Index) -> tuple[Index, Index]:
    """The nearest pixels, (row, column), of the other image, though they may lie outside of it."""
    (ny, nx), (there_ny, there_nx) = image.values.shape, other.values.shape
    x, y = columns - (nx - 1) / 2, rows - (ny - 1) / 2
    dx, dy = theta[:2, None] + theta[LINEAR].reshape(2, 2) @ np.stack([x, y])
    return np.rint(y + dy + (there_ny - 1) / 2).astype(int), np.rint(x + dx + (there_nx - 1) / 2).astype(int)


def _most_there(values: Array, at: tuple[Index, Index]) -> Array:
    """How far an image stands out of its rows at these pixels or beside them; outside of it infinitely far."""
    rows, columns = at
    ny, nx = values.shape
    inside = (rows >= 1) & (rows < ny - 1) & (columns >= 2) & (columns < nx - 2)
    rows, columns = rows[inside], columns[inside]
    most = np.zeros(rows.size)
    for row in (rows - 1, rows, rows + 1):
        for column in (columns - 1, columns, columns + 1):
            bent = values[row, column] - (values[row, column - 1] + values[row, column + 1]) / 2
            most = np.maximum(most, np.abs(bent))
    found = np.full(inside.shape, np.inf)
    found[inside] = most
    return found
