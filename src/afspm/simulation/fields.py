"""Smooth random fields on the whole plane, used for meandering, roughness and patches.

A field is a cubic B-spline. Its coefficients, one for each lattice point, are hashed from the point's indices. So the
field is defined everywhere, never repeats, and does not depend on the sampling.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from afspm.model.arrays import Array
from afspm.simulation import chance

_MATMUL_LATTICE = 48  # up to this size a dense product is faster than gathering
# The rms of a B-spline field of unit coefficients, averaged over positions: (sum of w^2)^(1/2) each axis.
_SPLINE_RMS = 151.0 / 315.0


def is_separable(x_m: Array, y_m: Array) -> bool:
    """Return whether x is one row and y one column: a grid along the axes, faster to compute."""
    return x_m.ndim == 2 and y_m.ndim == 2 and x_m.shape[0] == 1 and y_m.shape[1] == 1


def bspline_weights(fraction: Array) -> tuple[Array, Array, Array, Array]:
    """Return weights of the lattice points -1, 0, 1, 2 for a position at `fraction` in [0, 1) after point 0."""
    rest = 1.0 - fraction
    square, rest_square = fraction * fraction, rest * rest
    return (
        rest_square * rest / 6.0,
        (4.0 - 6.0 * square + 3.0 * square * fraction) / 6.0,
        (4.0 - 6.0 * rest_square + 3.0 * rest_square * rest) / 6.0,
        square * fraction / 6.0,
    )


def smooth_field(seed: int, x_m: Array, y_m: Array, spacing_m: float) -> Array:
    """Return a random field of zero mean and unit rms with features about two spacings wide.

    Args:
        x_m, y_m: positions, broadcast against each other; one row and one column are fastest.
        spacing_m: spacing of the lattice.
    """
    # A random shift, so that the lattices of the octaves don't align at the origin.
    shift = chance.uniform(seed, np.arange(2)) * 64.0
    u, v = x_m / spacing_m + shift[0], y_m / spacing_m + shift[1]
    field = _on_grid(seed, u[0], v[:, 0]) if is_separable(x_m, y_m) else _at_points(seed, u, v)
    return field * (1.0 / _SPLINE_RMS)


def rough_field(
    seed: int, x_m: Array, y_m: Array, *, largest_m: float, smallest_m: float, hurst: float, resolution_m: float
) -> Array:
    """Return a self-affine field of unit rms: octaves from `largest_m` down, amplitudes as wavelength**hurst.

    Octaves finer than `resolution_m` fade out, since they cannot be resolved.
    """
    octaves = max(1, 1 + math.floor(math.log2(largest_m / smallest_m)))
    amplitudes = [2.0 ** (-hurst * octave) for octave in range(octaves)]
    total = math.sqrt(sum(a * a for a in amplitudes))
    field = np.zeros(np.broadcast_shapes(x_m.shape, y_m.shape))
    for octave, amplitude in enumerate(amplitudes):
        spacing_m = largest_m / 2.0**octave
        visible = min(1.0, 2.0 * spacing_m / resolution_m - 1.0) if resolution_m else 1.0
        if visible <= 0.0:
            break
        field += (amplitude * visible / total) * smooth_field(seed + 7919 * octave, x_m, y_m, spacing_m)
    return field


def _coefficients(seed: int, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Array:
    return (chance.uniform(seed, rows, columns) - 0.5) * math.sqrt(12.0)


def _at_points(seed: int, u: Array, v: Array) -> Array:
    u, v = np.broadcast_arrays(u, v)
    column, row = np.floor(u), np.floor(v)
    u_weights, v_weights = bspline_weights(u - column), bspline_weights(v - row)
    field = np.zeros(u.shape)
    for i, v_weight in enumerate(v_weights):
        for j, u_weight in enumerate(u_weights):
            field += v_weight * u_weight * _coefficients(seed, row + (i - 1), column + (j - 1))
    return field


def _on_grid(seed: int, u: Array, v: Array) -> Array:
    # v gives the rows and u the columns; one axis after the other
    (row, v_weights), (column, u_weights) = _axis(v), _axis(u)
    rows = np.arange(row.min() - 1, row.max() + 3)
    columns = np.arange(column.min() - 1, column.max() + 3)
    lattice = _coefficients(seed, rows[:, None], columns[None, :])
    along_x = _spline_axis(lattice.T, column - columns[0] - 1, u_weights)
    return _spline_axis(np.ascontiguousarray(along_x.T), row - rows[0] - 1, v_weights)


def _axis(positions: Array) -> tuple[NDArray[np.int64], tuple[Array, Array, Array, Array]]:
    whole = np.floor(positions)
    return whole.astype(np.int64), bspline_weights(positions - whole)


def _spline_axis(lattice: Array, first: NDArray[np.int64], weights: tuple[Array, ...]) -> Array:
    # sample i is a weighted sum of the lattice rows first[i] to first[i] + 3
    if lattice.shape[0] <= _MATMUL_LATTICE:
        matrix = np.zeros((len(first), lattice.shape[0]))
        for k, weight in enumerate(weights):
            matrix[np.arange(len(first)), first + k] = weight
        product: Array = matrix @ lattice
        return product
    result = lattice[first] * weights[0][:, None]
    for k, weight in enumerate(weights[1:], start=1):
        result += lattice[first + k] * weight[:, None]
    return result
