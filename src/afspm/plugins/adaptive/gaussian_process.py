"""A Gaussian process over the plane that also learns how the sample drifts.

The mean is constant, the covariance Matérn 5/2 with one length. The position of a measurement is corrected by
`velocity * (time - first time)`, so all times give one map of the sample as it lay at the first measurement. Length,
noise and velocity are those of the highest marginal likelihood; mean and amplitude follow in closed form.

A map may be even in most places and rough in a few. The amplitude is therefore scaled locally by the errors with
which measurements are predicted from the others (leave one out).

Curves have no picture to register, but a lattice returns to the neighbourhood of earlier positions, and with a wrong
drift the values contradict each other. A constant velocity is enough for the rest that the correction by scans leaves.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from afspm.components import Array

_MOST_FITTED: Final = 240  # measurements for the likelihood, whose time grows with the cube
_LEAST_NOISE: Final = 1e-4  # variance relative to the squared amplitude; with less the matrix is not solved stably
_NEAREST: Final = 8  # measurements that give the local scale
_LEAST_SCALE: Final = 0.04  # of the local variance: a feature may hide between measurements
# factor on the expected error, which takes the fitted length and velocity for true ones: without it the true error was
# over 1.3 times the expected one on a fifth of simulated maps with drift
_OVERCONFIDENCE: Final = 1.15
# in log likelihood: with less, the drift is taken for zero, since a drift within one lattice looks like a sheared map
_DRIFT_GAIN: Final = 4.0


@dataclass(frozen=True)
class Parameters:
    """Parameters of the process.

    Attributes:
        length_m: length of the Matérn correlation, over which values are related.
        noise: variance of a measurement, relative to the squared amplitude of the map.
        velocity_m_s: velocity (x, y) of the sample under the tip.
    """

    length_m: float
    noise: float
    velocity_m_s: tuple[float, float] = (0.0, 0.0)


class GaussianProcess:
    """The process after some measurements.

    Args:
        xy_m: (n, 2) measured positions in tip coordinates.
        values: (n,) measured values.
        times_s: (n,) times of the measurements; the first is the time of the map.
        parameters: parameters of the process.
    """

    def __init__(self, xy_m: Array, values: Array, times_s: Array, parameters: Parameters) -> None:
        self.parameters = parameters
        self._at_m: Array = xy_m - np.outer(times_s - times_s[0], parameters.velocity_m_s)
        factor = cho_factor(_covariance(self._at_m, parameters), lower=True, overwrite_a=True, check_finite=False)
        solved = cho_solve(factor, np.stack([values, np.ones(len(values))], axis=1), check_finite=False)
        self.mean = float(solved[:, 0].sum() / solved[:, 1].sum())
        self._weights = solved[:, 0] - self.mean * solved[:, 1]
        square = float((values - self.mean) @ self._weights) / len(values)
        self.amplitude = math.sqrt(max(square, 1e-300))

    def predict(self, xy_m: Array) -> Array:
        """Return the expected values (m,) at positions (m, 2) on the sample as it lay at the first time."""
        return np.asarray(self.mean + self._related(xy_m) @ self._weights)

    def variance(self, xy_m: Array) -> Array:
        """Return the expected square error (m,) at positions (m, 2), scaled by the local roughness."""
        related = self._related(xy_m)
        left = 1.0 - ((related @ self._inverse) * related).sum(axis=1)
        expected = _OVERCONFIDENCE * self.amplitude
        return np.asarray(expected**2 * np.maximum(left, 0.0) * self._scale(xy_m))

    @property
    def positions_m(self) -> Array:
        """The measured positions on the sample as it lay at the first time, (n, 2)."""
        return self._at_m

    @cached_property
    def _inverse(self) -> Array:
        return np.asarray(np.linalg.inv(_covariance(self._at_m, self.parameters)))

    @cached_property
    def _surprise(self) -> Array:
        # squares of the leave-one-out errors, each as a part of its variance: Rasmussen and Williams, eq. 5.12
        return np.asarray(self._weights**2 / np.diag(self._inverse) / self.amplitude**2)

    def _related(self, xy_m: Array) -> Array:
        return matern(distances(xy_m, self._at_m), self.parameters.length_m)

    def _scale(self, xy_m: Array) -> Array:
        square = distances(xy_m, self._at_m)
        count = min(_NEAREST, square.shape[1])
        nearest = np.argpartition(square, count - 1, axis=1)[:, :count]
        near = np.take_along_axis(square, nearest, axis=1)
        weights = np.exp(-0.5 * (near / np.maximum(near.mean(axis=1, keepdims=True), 1e-30)) ** 2)
        local = (weights * self._surprise[nearest]).sum(axis=1) / weights.sum(axis=1)
        return np.asarray(np.maximum(local, _LEAST_SCALE))


def fitted(
    xy_m: Array, values: Array, times_s: Array, start: Parameters, shortest_m: float, *, drifts: bool, seed: int = 0
) -> Parameters:
    """Return the parameters of the highest marginal likelihood, searched from `start`.

    Args:
        shortest_m: lower bound of the length; the upper bound is a hundred times as large.
        drifts: whether to search for a velocity, too; otherwise the velocity of `start` is known. The velocity found is
            zero if drift hardly improves the likelihood.
        seed: seed for the choice of 240 measurements, if there are more.
    """
    if len(values) > _MOST_FITTED:
        chosen = np.random.default_rng(seed).choice(len(values), _MOST_FITTED, replace=False)
        xy_m, values, times_s = xy_m[chosen], values[chosen], times_s[chosen]
    since_s = times_s - times_s.min()
    unit_s = max(float(since_s.max()), 1e-9)

    def cost(at: Array) -> float:
        length_m, noise = shortest_m * math.exp(at[0]), math.exp(at[1])
        shift_m = np.outer(since_s / unit_s, at[2:] * shortest_m) if len(at) > 2 else 0.0
        bounds = 50.0 * (max(0.0, -at[0]) ** 2 + max(0.0, at[0] - math.log(100.0)) ** 2)
        bounds += 50.0 * (max(0.0, math.log(_LEAST_NOISE) - at[1]) ** 2 + max(0.0, at[1]) ** 2)
        return float(bounds - _log_likelihood(xy_m - shift_m, values, length_m, noise))

    known_m = np.outer(since_s, start.velocity_m_s)
    if not drifts:
        xy_m = xy_m - known_m
    first = np.array([math.log(start.length_m / shortest_m), math.log(max(start.noise, _LEAST_NOISE))])
    still = _lowest(cost, first, np.array([0.5, 1.0]))
    best, velocity = still, np.zeros(2) if drifts else np.asarray(start.velocity_m_s)
    if drifts:
        before = np.asarray(start.velocity_m_s) * unit_s / shortest_m
        moved = _lowest(cost, np.concatenate([still, before]), np.array([0.3, 0.5, 0.3, 0.3]))
        if cost(still) - cost(moved) > _DRIFT_GAIN:
            best, velocity = moved[:2], moved[2:] * shortest_m / unit_s
    length_m = shortest_m * float(np.exp(np.clip(best[0], 0.0, math.log(100.0))))
    noise = float(np.exp(np.clip(best[1], math.log(_LEAST_NOISE), 0.0)))
    return Parameters(length_m, noise, (float(velocity[0]), float(velocity[1])))


def matern(distance_m: Array, length_m: float) -> Array:
    """Return the Matérn 5/2 correlation over distances."""
    r = distance_m * (math.sqrt(5.0) / length_m)
    return np.asarray((1.0 + r + r * r / 3.0) * np.exp(-r))


def distances(a_m: Array, b_m: Array) -> Array:
    """Return the distances between two sets of points, shape (len(a_m), len(b_m))."""
    return np.hypot(a_m[:, None, 0] - b_m[None, :, 0], a_m[:, None, 1] - b_m[None, :, 1])


def _covariance(at_m: Array, parameters: Parameters) -> Array:
    matrix = matern(distances(at_m, at_m), parameters.length_m)
    matrix[np.diag_indices(len(at_m))] += parameters.noise
    return matrix


def _lowest(cost: Callable[[Array], float], first: Array, steps: Array) -> Array:
    simplex = np.vstack([first, first + np.diag(steps)])
    found = minimize(
        cost,
        first,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 22 * len(first), "xatol": 0.03, "fatol": 0.1},
    )
    return np.asarray(found.x)


def _log_likelihood(at_m: Array, values: Array, length_m: float, noise: float) -> float:
    n = len(values)
    matrix = _covariance(at_m, Parameters(length_m, noise))
    factor = cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
    solved = cho_solve(factor, np.stack([values, np.ones(n)], axis=1), check_finite=False)
    mean = solved[:, 0].sum() / solved[:, 1].sum()
    square = float(values @ solved[:, 0] - mean * solved[:, 0].sum())
    spread = 2.0 * float(np.log(np.diag(factor[0])).sum())
    return float(-0.5 * n * math.log(max(square, 1e-300) / n) - 0.5 * spread)
