"""Gauss-Newton on the sum of squares of what is left of the difference of two images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.prepare import flatten_rows
from afspm.drift.estimators.least_squares.rows import LEAST_NOISE, noise_metric, products, seen, without_lines
from afspm.drift.estimators.least_squares.shrink import denoised
from afspm.drift.estimators.least_squares.spectra import FineFilter
from afspm.drift.estimators.least_squares.warp import COUNT, Pair, derivative

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SHIFT: Index = np.array([0, 1, 6], dtype=np.intp)  # of theta: the shift and the gain
ALL: Index = np.arange(COUNT, dtype=np.intp)
ENOUGH_PX = 5e-4  # a step
SETTLED_PX = 2e-3  # a round


@dataclass(frozen=True, eq=False)
class Believed:
    """What is known of theta before: its mean and inverse covariance, (8,) and (8, 8)."""

    mean: Array
    precision: Array


@dataclass(frozen=True, eq=False)
class Fit:
    """Where it has come to, and the equations there, per block of the image and over the variance of the noise.

    Attributes:
        theta: (8,), see `Pair`.
        curvature: (n, 8, 8), H'QJ with J the gradient as it is and H what of it is signal.
        spread: (n, 8, 8), H'QH, the covariance of `slope`.
        slope: (n, 8), H'Qr.
    """

    theta: Array
    curvature: Array
    spread: Array
    slope: Array


def least_squares(pair: Pair, theta: Array, believed: Believed, free: Index, steps: int) -> Array:
    """theta after some steps with plain weights, for the coarse stages."""
    theta = theta.copy()
    for _ in range(steps):
        one, two, known = pair.warped(theta)
        mean = (one + two) / 2
        columns = pair.columns(derivative(mean, 1), derivative(mean, 0), mean, two - one, free)
        columns_q = seen(columns, known.astype(np.float64), None)
        normal = np.tensordot(columns_q, columns, ((0, 2), (0, 2)))
        normal *= max(known.sum(), 1) / max(normal[-1, -1], LEAST_NOISE * known.sum(), LEAST_NOISE)
        theta, moved = _stepped(theta, normal[:-1, :-1], normal[:-1, -1], believed, free)
        if moved < 0.01:
            break
    return theta


def generalised_least_squares(
    pair: Pair, theta: Array, believed: Believed, seen_through: FineFilter, rounds: int = 3, steps: int = 3
) -> Fit:
    """theta by rows (see `rows`), where scars count less. The gradient, the noise and the weights are estimated anew in
    each round, from what the one before has left."""
    fit = _round(pair, theta, believed, seen_through, steps)
    for _ in range(rounds - 1):
        before, fit = fit, _round(pair, fit.theta, believed, seen_through, steps)
        if np.hypot(*(fit.theta - before.theta)[:2]) < SETTLED_PX:
            break
    return fit


def _round(pair: Pair, theta: Array, believed: Believed, seen_through: FineFilter, steps: int) -> Fit:
    """Newton's steps to H'Q r + P (theta - mean) = 0. H is free of most of the noise of the gradient (see `shrink`),
    but it is the gradient with its noise that says how r changes with theta."""
    one, two, known = pair.warped(theta)
    mean, residual = (one + two) / 2, two - one
    gradient = derivative(mean, 1), derivative(mean, 0)
    left = without_lines(residual, known)
    signal = pair.columns(*_signal(gradient, left / 2, known), mean, residual)
    weight = known * _row_weights(left, known)[:, None]
    signal_q = seen(signal, weight, noise_metric(left, known, seen_through))
    left_over = float(np.vdot(signal_q[:, -1], residual))
    signal_q *= max(weight.sum(), 1.0) / max(left_over, LEAST_NOISE * weight.sum(), LEAST_NOISE)
    signal_q, signal = signal_q[:, :-1], signal[:, :-1]
    curvature = products(signal_q, pair.columns(*gradient, mean, residual)[:, :-1])
    slope = products(signal_q, residual[:, None])[:, :, 0]
    for step in range(steps):
        theta, moved = _stepped(theta, curvature.sum(axis=0), slope.sum(axis=0), believed, ALL)
        if moved < ENOUGH_PX or step == steps - 1:
            break
        one, two, _ = pair.warped(theta)
        slope = products(signal_q, (two - one)[:, None])[:, :, 0]
    return Fit(theta, curvature, products(signal_q, signal), slope)


def _signal(gradient: tuple[Array, Array], noise: Array, known: NDArray[np.bool_]) -> tuple[Array, Array]:
    """What of a gradient is signal. Its rows are flattened first: the step from one row to the next holds the offsets
    of both, and a patch can't tell them from a feature."""
    gx, gy = (
        denoised(flatten_rows(slope, known), without_lines(derivative(noise, axis), known))
        for slope, axis in zip(gradient, (1, 0), strict=True)
    )
    return gx, gy


def _stepped(theta: Array, curvature: Array, slope: Array, believed: Believed, free: Index) -> tuple[Array, float]:
    """One step of what is free, and how far the shift moved, px."""
    precision = believed.precision[np.ix_(free, free)]
    pull = (believed.precision @ (theta - believed.mean))[free]
    step = -np.linalg.solve(curvature + precision + 1e-9 * np.eye(free.size), slope + pull)
    theta = theta.copy()
    theta[free] += step
    return theta, float(np.hypot(*step[:2]))


def _row_weights(residual: Array, known: NDArray[np.bool_]) -> Array:
    """1 / (1 + 4 (e - 1.3)²) of rows whose root mean square e, over the median of rows, exceeds 1.3: scars."""
    count = known.sum(axis=1)
    rms = np.sqrt((residual**2 * known).sum(axis=1) / np.maximum(count, 1))
    typical = float(np.median(rms[count > 0])) if count.any() else 1.0
    weight: Array = 1.0 / (1.0 + 4.0 * np.maximum(rms / max(typical, 1e-12) - 1.3, 0.0) ** 2)
    return weight
