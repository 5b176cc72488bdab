"""Alignment of two images by Gauss-Newton steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.components import Array
from afspm.plugins.drift.pairs.images import Unusable, flatten_rows
from afspm.plugins.drift.pairs.noise import (
    LEAST_NOISE,
    CrossingLines,
    FineFilter,
    denoised,
    noise_metric,
    products,
    seen,
    without_lines,
)
from afspm.plugins.drift.pairs.warp import BEND, COUNT, GAIN, LINEAR, SLOPES, WarpedPair, derivative

Index = NDArray[np.intp]
Both = tuple[Array, Array]

SHIFT: Index = np.array([0, 1, GAIN], dtype=np.intp)  # of theta: the shift and the gain
COARSE: Index = np.array([*range(LINEAR.stop), GAIN, BEND], dtype=np.intp)
ALL: Index = np.arange(COUNT, dtype=np.intp)
ROUNDS = 4
SETTLED_PX = 1e-3
DIGITS = 1e-6  # relative precision of products of 32-bit columns
LEAST_CURVATURE = 0.4
"""The least curvature H'QJ, as a share of H'QH, in any direction. On the worst pairs (one bar in view) the share is a
fifth to two fifths: most of H'QH is noise there, and a fit that took this noise for the surface was up to five times
too certain of stretch. On 60 pairs of bars like real scans, errors of 3.6 times the Cramér-Rao bound (as with 1) became
2.5 times; other surfaces change by 2 %. With 0.2 hard pairs get worse (2.9 for 2.1), since the share itself is then
hardly known. Smoothing the gradient along edges, or more thresholding, loses more of the surface than of the noise."""


@dataclass(frozen=True, eq=False)
class Believed:
    """Prior of the parameters theta: mean (n,) and inverse covariance (n, n)."""

    mean: Array
    precision: Array


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of the iteration: theta and its normal equations by block of rows, divided by the noise variance.

    J is the gradient without noise, H its shrunk estimate (`noise.denoised`).

    Attributes:
        theta: (COUNT,), see `WarpedPair`.
        curvature: (n, COUNT, COUNT), H'QJ, for n blocks of rows.
        spread: (n, COUNT, COUNT), H'QH, the covariance of `slope`.
        slope: (n, COUNT), H'Qr, with the residual r.
    """

    theta: Array
    curvature: Array
    spread: Array
    slope: Array

    def information(self, believed: Believed) -> tuple[Array, Array]:
        """Return the information M' S^-1 M about theta, and its product with the images' estimate of theta.

        M is the curvature and S the covariance of the slope (Godambe, Ann. Math. Stat. 31, 1208, 1960). Where M is less
        than S, M alone would count the noise in H as a surface.
        """
        curvature = self.curvature.sum(axis=0)
        # S alone is singular in small overlaps; a hundredth of the prior matters only where the images know less
        spread = _symmetric(self.spread.sum(axis=0)) + 0.01 * believed.precision
        back = np.linalg.solve(spread, curvature)
        found = _symmetric(curvature.T @ back)
        return found, found @ self.theta + back.T @ believed.precision @ (self.theta - believed.mean)


def least_squares(pair: WarpedPair, theta: Array, believed: Believed, free: Index, steps: int) -> Array:
    """Return theta after at most `steps` Gauss-Newton steps with uniform weights, for the coarse stages."""
    theta = theta.copy()
    for _ in range(steps):
        one, two, known = pair.warped(theta)
        mean = (one + two) / 2
        columns = pair.columns(derivative(mean, 1), derivative(mean, 0), mean, two - one, free)
        columns_q = seen(columns, known.astype(np.float64), None)
        normal = np.tensordot(columns_q, columns, ((0, 2), (0, 2))).astype(np.float64)
        normal *= max(known.sum(), 1) / max(normal[-1, -1], LEAST_NOISE * known.sum(), LEAST_NOISE)
        theta, moved = _stepped(theta, normal[:-1, :-1], normal[:-1, -1], believed, free)
        if moved < 0.01:
            break
    return theta


def generalised_least_squares(pair: WarpedPair, theta: Array, believed: Believed, seen_through: FineFilter) -> Fit:
    """Fit theta by iterated generalised least squares, with a low weight for scars.

    Each of at most `ROUNDS` rounds estimates gradient, noise and weights from the residual of the previous round.

    Raises:
        Unusable: a step leaves the overlap.
    """
    for _ in range(ROUNDS):
        fit = _round(pair, theta, believed, seen_through)
        moved = np.hypot(*(fit.theta - theta)[:2])
        theta = fit.theta
        if moved < SETTLED_PX:
            break
    return fit


def _round(pair: WarpedPair, theta: Array, believed: Believed, seen_through: FineFilter) -> Fit:
    # A Newton step to H'Q r + P (theta - mean) = 0 with H, the gradient J without most of its noise (see `denoised`).
    # Noise moves with theta as the surface does, and so does the noise left in H; both cancel. The slope therefore
    # changes by H'QJ with a J without noise, and the product of both noises is subtracted.
    one, two, known = pair.warped(theta)
    if not known.any():  # in a small overlap almost without features a step may leave it
        raise Unusable("without a displacement that fits")
    mean, residual = (one + two) / 2, two - one
    left = without_lines(residual, known, pair.crossing)
    gradient = derivative(mean, 1), derivative(mean, 0)
    signal, noise_through, noise = _signal(gradient, left / 2, known, pair.crossing)
    weight = known * _row_weights(left, known)[:, None]
    metric = noise_metric(left, known, seen_through)
    columns = pair.columns(*signal, mean, residual)
    columns_q = seen(columns, weight, metric, pair.crossing)
    left_over = float(np.vdot(columns_q[:, -1], residual))
    scale = max(weight.sum(), 1.0) / max(left_over, LEAST_NOISE * weight.sum(), LEAST_NOISE)
    columns_q, columns = scale * columns_q[:, :-1], columns[:, :-1]
    spread = products(columns_q, columns)
    curvature = products(columns_q, pair.columns(*gradient, mean, residual)[:, :-1])
    through_q = seen(pair.slopes(*noise_through), weight, metric, pair.crossing)
    curvature[:, :SLOPES, :SLOPES] -= scale * products(through_q, pair.slopes(*noise))
    curvature = _no_less(curvature, spread, believed.precision)
    slope = products(columns_q, residual[:, None].astype(columns_q.dtype))[:, :, 0]
    after, _ = _stepped(theta, curvature.sum(axis=0), slope.sum(axis=0), believed, ALL)
    return Fit(after, curvature, spread, slope + curvature @ (after - theta))


def _signal(
    gradient: Both, noise: Array, known: NDArray[np.bool_], crossing: CrossingLines | None
) -> tuple[Both, Both, Both]:
    # Rows are flattened first: the step from one row to the next holds the offsets of both, and a patch can't
    # distinguish them from a feature.
    nx, ny = (without_lines(derivative(noise, axis), known, crossing) for axis in (1, 0))
    flat = [
        flatten_rows(each, known) if crossing is None else without_lines(each, known, crossing) for each in gradient
    ]
    x, through_x = denoised(flat[0], nx)
    y, through_y = denoised(flat[1], ny)
    return (x, y), (through_x, through_y), (nx, ny)


def _no_less(curvature: Array, spread: Array, precision: Array) -> Array:
    # H'QJ, but in no direction less than `LEAST_CURVATURE` of H'QH: where a direction is hardly visible, the curvature,
    # a difference, may be noise alone. The precision of the prior is on both sides: in an overlap of some 10 px
    # the nuisances act through one gradient and are nearly dependent, and products of columns of 32 bits are not
    # definite any more. Scaled to a diagonal of 1, values below their digits count as nothing.
    total, whole = (_symmetric(each.sum(axis=0)) for each in (curvature, spread))
    if not (np.isfinite(total).all() and np.isfinite(whole).all()):
        return curvature
    least = whole + precision
    size = 1.0 / np.sqrt(np.diag(least))
    powers, axes = np.linalg.eigh(size[:, None] * least * size)
    white = size[:, None] * axes / np.sqrt(np.maximum(powers, DIGITS))
    values, turned = np.linalg.eigh(white.T @ (total + precision) @ white)
    vectors = white @ turned
    missing = np.maximum(LEAST_CURVATURE - values, 0.0)
    raised: Array = curvature + (spread + precision / len(spread)) @ (vectors * missing) @ vectors.T @ least
    return raised


def _symmetric(matrix: Array) -> Array:
    both: Array = (matrix + matrix.T) / 2
    return both


def _stepped(theta: Array, curvature: Array, slope: Array, believed: Believed, free: Index) -> tuple[Array, float]:
    precision = believed.precision[np.ix_(free, free)]
    pull = (believed.precision @ (theta - believed.mean))[free]
    step = -np.linalg.solve(curvature + precision + 1e-9 * np.eye(free.size), slope + pull)
    theta = theta.copy()
    theta[free] += step
    return theta, float(np.hypot(*step[:2]))


def _row_weights(residual: Array, known: NDArray[np.bool_]) -> Array:
    # 1 / (1 + 4 (e - 1.3)²), e the rms of a row over the median of rows: scars weigh little
    count = known.sum(axis=1)
    rms = np.sqrt((residual**2 * known).sum(axis=1) / np.maximum(count, 1))
    typical = float(np.median(rms[count > 0])) if count.any() else 1.0
    weight: Array = 1.0 / (1.0 + 4.0 * np.maximum(rms / max(typical, 1e-12) - 1.3, 0.0) ** 2)
    return weight
