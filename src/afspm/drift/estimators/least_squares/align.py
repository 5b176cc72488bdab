"""Gauss-Newton on the sum of squares of what is left of the difference of two images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.rows import Normal, noise_metric, normal_equations, projected
from afspm.drift.estimators.least_squares.warp import Pair

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SHIFT: Index = np.array([0, 1, 2], dtype=np.intp)  # of theta: the shift and the gain
ALL: Index = np.arange(7, dtype=np.intp)
ENOUGH_PX = 5e-4


@dataclass(frozen=True, eq=False)
class Believed:
    """What is known of theta before: its mean and inverse covariance, (7,) and (7, 7)."""

    mean: Array
    precision: Array


@dataclass(frozen=True, eq=False)
class Fit:
    """Where it has come to.

    Attributes:
        theta: (7,), see `Pair`.
        normal: the equations there, per block, scaled by the variance of the residual.
    """

    theta: Array
    normal: Normal
    weight: Array
    metric: Array | None
    steps: int


def least_squares(pair: Pair, theta: Array, believed: Believed, free: Index, steps: int) -> Array:
    """theta after some steps with plain weights, for the coarse stages."""
    theta = theta.copy()
    for _ in range(steps):
        columns, known = pair.linearised(theta)
        normal = normal_equations(columns, known.astype(np.float64), None)
        theta, moved = _stepped(theta, normal, normal.power / max(known.sum(), 1), believed, free)
        if moved < 0.01:
            break
    return theta


def generalised_least_squares(pair: Pair, theta: Array, believed: Believed, steps: int = 6) -> Fit:
    """theta by rows (see `rows`), with weights that trust outliers and scars less; twice, as the noise is estimated
    from what the first round has left."""
    fit: Fit | None = None
    for _ in range(2):
        fit = _round(pair, theta, believed, steps)
        theta = fit.theta
    assert fit is not None
    return fit


def _round(pair: Pair, theta: Array, believed: Believed, steps: int) -> Fit:
    columns, known = pair.linearised(theta)
    mask = known.astype(np.float64)
    residual = projected(columns[:, 7:], mask, None)[0][:, 0]
    metric = noise_metric(residual, known)
    weight = mask * _row_weights(residual, known)[:, None]
    step = 0
    for step in range(1, steps + 1):
        if step > 1:
            columns, known = pair.linearised(theta)
            residual = projected(columns[:, 7:], known.astype(np.float64), None)[0][:, 0]
            weight = known * _row_weights(residual, known)[:, None] * _pixel_weights(residual, known)
        normal = normal_equations(columns, weight, metric)
        normal = Normal(normal.blocks * (max(weight.sum(), 1.0) / max(normal.power, 1e-300)))
        theta, moved = _stepped(theta, normal, 1.0, believed, ALL)
        if moved < ENOUGH_PX:
            break
    return Fit(theta, normal, weight, metric, step)


def _stepped(theta: Array, normal: Normal, variance: float, believed: Believed, free: Index) -> tuple[Array, float]:
    """One step of what is free, and how far the shift moved, px."""
    sub = np.ix_(free, free)
    matrix = normal.matrix[sub] / variance + believed.precision[sub]
    vector = normal.vector[free] / variance + (believed.precision @ (theta - believed.mean))[free]
    step = -np.linalg.solve(matrix + 1e-12 * np.trace(matrix) / free.size * np.eye(free.size), vector)
    theta = theta.copy()
    theta[free] += step
    return theta, float(np.hypot(*step[:2]))


def _pixel_weights(residual: Array, known: NDArray[np.bool_]) -> Array:
    """Cauchy's, 1 / (1 + (r / 3 s)²)."""
    scale = 1.4826 * float(np.median(np.abs(residual[known])))
    weight: Array = 1.0 / (1.0 + (residual / max(3.0 * scale, 1e-12)) ** 2)
    return weight


def _row_weights(residual: Array, known: NDArray[np.bool_]) -> Array:
    """1 / (1 + 4 (e - 1.3)²) of rows whose root mean square e, over the median of rows, exceeds 1.3: scars."""
    count = known.sum(axis=1)
    rms = np.sqrt((residual**2 * known).sum(axis=1) / np.maximum(count, 1))
    typical = float(np.median(rms[count > 0])) if count.any() else 1.0
    weight: Array = 1.0 / (1.0 + 4.0 * np.maximum(rms / max(typical, 1e-12) - 1.3, 0.0) ** 2)
    return weight
