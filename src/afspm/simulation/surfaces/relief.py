"""The interface of all surfaces, and functions shared by them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from afspm.model.arrays import Array
from afspm.simulation import chance
from afspm.simulation.fields import is_separable, rough_field, smooth_field


@dataclass(frozen=True)
class Relief:
    """A part of the surface: heights in m and material from 0 to 1, in equal shapes.

    The material determines phase and current independently of the height.
    """

    height_m: Array
    material: Array


class Surface(Protocol):
    """An unbounded sample; its relief depends only on the seed and the position."""

    def relief(self, x_m: Array, y_m: Array, resolution_m: float, seed: int) -> Relief:
        """Return height and material at sample coordinates.

        Args:
            x_m, y_m: arrays that broadcast; one row and one column (a grid) are fastest.
            resolution_m: lower limit for the width of edges and roughness; 0 without a limit.
        """
        ...


def smooth_step(t: Array) -> Array:
    """Return a smooth step: 0 for t < 0, 1 for t > 1."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def turned(x_m: Array, y_m: Array, angle_deg: float) -> tuple[Array, Array]:
    """Return coordinates along and across a direction; for an angle of 0 a grid remains a grid."""
    if angle_deg == 0.0:
        return x_m, y_m
    cos, sin = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return x_m * cos + y_m * sin, y_m * cos - x_m * sin


def grain(seed: int, x_m: Array, y_m: Array, rms_m: float, size_m: float, resolution_m: float) -> Array | float:
    """Return fine roughness of this rms, with octaves from `size_m` down to a quarter of it."""
    if rms_m == 0.0:
        return 0.0
    field = rough_field(seed, x_m, y_m, largest_m=size_m, smallest_m=size_m / 4, hurst=0.6, resolution_m=resolution_m)
    return rms_m * field


def patches(seed: int, x_m: Array, y_m: Array, size_m: float) -> Array:
    """Return the material from 0 to 1, in patches of two materials with soft borders."""
    return smooth_step(0.5 + 2.0 * smooth_field(seed, x_m, y_m, size_m))


PositionIndex: TypeAlias = tuple[slice, slice] | NDArray[np.bool_]
"""An index of positions: a rectangle, or a mask."""


def around(
    x_m: Array, y_m: Array, x0_m: float, y0_m: float, reach_m: float
) -> Iterator[tuple[PositionIndex, Array, Array]]:
    """Yield (index, x - x0, y - y0) once for the positions near a point; nothing without positions.

    `index` selects the positions from the broadcast array.
    """
    if is_separable(x_m, y_m):
        columns = slice(*np.searchsorted(x_m[0], (x0_m - reach_m, x0_m + reach_m)))
        rows = slice(*np.searchsorted(y_m[:, 0], (y0_m - reach_m, y0_m + reach_m)))
        if columns.start < columns.stop and rows.start < rows.stop:
            yield (rows, columns), x_m[:, columns] - x0_m, y_m[rows] - y0_m
        return
    dx, dy = np.broadcast_arrays(x_m - x0_m, y_m - y0_m)
    index = (np.abs(dx) < reach_m) & (np.abs(dy) < reach_m)
    if index.any():
        yield index, dx[index], dy[index]


@dataclass(frozen=True)
class Sites:
    """Random points, each with an integer that seeds its properties."""

    x_m: Array
    y_m: Array
    key: Array

    @classmethod
    def within(cls, seed: int, x_m: Array, y_m: Array, margin_m: float, spacing_m: float) -> Sites:
        """Return the points in view: one per cell of `spacing_m` on average (0 to 3), anywhere in the cell."""
        i = np.arange(
            math.floor((x_m.min() - margin_m) / spacing_m), math.floor((x_m.max() + margin_m) / spacing_m) + 1
        )
        j = np.arange(
            math.floor((y_m.min() - margin_m) / spacing_m), math.floor((y_m.max() + margin_m) / spacing_m) + 1
        )
        column, row, copy = (a.ravel() for a in np.meshgrid(i, j, np.arange(3), indexing="ij"))
        # 0, 1, 2, 3 with the probabilities of a Poisson number of mean 1 (larger ones counted as 3)
        count = np.searchsorted([0.3679, 0.7358, 0.9197], chance.uniform(seed, column, row))
        there = copy < count
        column, row, copy = column[there], row[there], copy[there]
        key = chance.hashes(seed + 1, column, row, copy) >> np.uint64(12)
        x = (column + chance.uniform(seed + 2, key)) * spacing_m
        y = (row + chance.uniform(seed + 3, key)) * spacing_m
        return cls(x, y, key.astype(np.float64))
