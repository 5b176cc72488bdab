"""A Gaussian process over the plane that also learns how the sample drifts.

The mean is constant, the covariance Matérn 5/2 with one length. The position of a measurement is corrected by
`velocity * (time - first time)`, so all times give one map of the sample as it lay at the first measurement. Length,
noise and velocity are those of the highest marginal likelihood; mean and amplitude follow in closed form.

A map may be even in most places and rough in a few. The amplitude is therefore scaled locally by the errors with
which measurements are predicted from the others (leave one out).

Curves have no picture to register, but a lattice returns to the neighbourhood of earlier positions, and with a wrong
drift the values contradict each other. A constant velocity is enough for the rest that the correction by scans leaves.
It is zero unless many values gain by it: edges and spots are no Gaussian process, and a few of their values may gain
much by a false drift.

Between two fits the parameters stay, and a measurement adds one row to the inverse of the covariance.
`PredictedPlaces` follows these rows, so that another choice among m candidates costs n (n + m) for n measurements, and
not n² (n + m).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize

from afspm.components import Array

Counts = npt.NDArray[np.intp]

_MOST_FITTED: Final = 240  # measurements for the likelihood, whose time grows with the cube
_LEAST_NOISE: Final = 1e-4  # variance relative to the squared amplitude; with less the matrix is not solved stably
_NEAREST: Final = 8  # measurements that give the local scale
_LEAST_SCALE: Final = 0.04  # of the local variance: a feature may hide between measurements
# factor on the expected error, which takes the fitted length and velocity for true ones: without it the true error was
# over 1.3 times the expected one on a fifth of simulated maps with drift
_OVERCONFIDENCE: Final = 1.15
# in log likelihood: with less, the drift is taken for zero, since a drift within one lattice looks like a sheared map
_DRIFT_GAIN: Final = 4.0
# in standard errors of the gain: at edges and spots, few values may give a large gain to a false drift. On 90 maps and
# grids of still samples it was at most 2.5; with 15 and -10 pm/s it was above 3 once they had moved by 10 to 30 nm
_CLEAR_GAIN: Final = 3.0


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
    """The process after some measurements, which takes further ones.

    Args:
        xy_m: (n, 2) measured positions in tip coordinates.
        values: (n,) measured values.
        times_s: (n,) times of the measurements; the first is the time of the map.
        parameters: parameters of the process.

    Attributes:
        positions_m: the measured positions on the sample as it lay at the first time, (n, 2).
        inverse: inverse of the covariance of the values, (n, n), relative to the squared amplitude.
        mean, amplitude: of the map.
    """

    def __init__(self, xy_m: Array, values: Array, times_s: Array, parameters: Parameters) -> None:
        self.parameters = parameters
        self._first_s = float(times_s[0])
        self.positions_m = self.on_sample(xy_m, times_s)
        self._values = values
        self.inverse = np.asarray(np.linalg.inv(self._covariance(self.positions_m)), dtype=np.float64)
        self._weigh()

    def add(self, xy_m: Array, values: Array, times_s: Array) -> None:
        """Take further measurements: each adds a row to the inverse, in place of another inversion."""
        at_m = self.on_sample(xy_m, times_s)
        related = self._related(at_m)
        solved = related @ self.inverse
        corner = np.linalg.inv(self._covariance(at_m) - solved @ related.T)
        beside = -corner @ solved
        self.inverse = np.block([[self.inverse - solved.T @ beside, beside.T], [beside, corner]])
        self.positions_m = np.concatenate([self.positions_m, at_m])
        self._values = np.concatenate([self._values, values])
        self._weigh()

    def on_sample(self, xy_m: Array, times_s: Array) -> Array:
        """Return positions (n, 2) in tip coordinates on the sample as it lay at the first time."""
        return np.asarray(xy_m - np.outer(times_s - self._first_s, self.parameters.velocity_m_s))

    def predict(self, xy_m: Array) -> Array:
        """Return the expected values (m,) at positions (m, 2) on the sample as it lay at the first time."""
        return np.asarray(self.mean + self._related(xy_m) @ self._weights)

    def variance(self, xy_m: Array) -> Array:
        """Return the expected square error (m,) at positions (m, 2), scaled by the local roughness."""
        return PredictedPlaces(self, xy_m).variance()

    @property
    def noise_variance(self) -> float:
        """The variance of a measurement at one position."""
        return self.parameters.noise * self.amplitude**2

    @property
    def surprises(self) -> Array:
        """The squares of the leave-one-out errors (n,), each as a part of its variance."""
        # Rasmussen and Williams, eq. 5.12
        return np.asarray(self._weights**2 / np.diag(self.inverse) / self.amplitude**2)

    def _weigh(self) -> None:
        solved = self.inverse @ np.stack([self._values, np.ones(len(self._values))], axis=1)
        self.mean = float(solved[:, 0].sum() / solved[:, 1].sum())
        self._weights = solved[:, 0] - self.mean * solved[:, 1]
        square = float((self._values - self.mean) @ self._weights) / len(self._values)
        self.amplitude = math.sqrt(max(square, 1e-300))

    def _covariance(self, at_m: Array) -> Array:
        return _covariance(distances(at_m, at_m), self.parameters.length_m, self.parameters.noise)

    def _related(self, xy_m: Array) -> Array:
        return matern(distances(xy_m, self.positions_m), self.parameters.length_m)


class PredictedPlaces:
    """PredictedPlaces whose expected square errors follow the measurements that a process takes, one column for each.

    Args:
        model: process of the measurements.
        xy_m: (m, 2) positions on the sample as it lay at the first time.

    Attributes:
        model: the process.
        xy_m: the positions, (m, 2).
        nearest_m: distances to the nearest measurements, (m, at most 8).
    """

    def __init__(self, model: GaussianProcess, xy_m: Array) -> None:
        self.model, self.xy_m = model, xy_m
        self._measured = len(model.positions_m)
        self._related, self._left, self.nearest_m, self._nearest = self._described(xy_m)

    def add(self, xy_m: Array) -> None:
        """Add positions (k, 2)."""
        self._follow()
        count = len(self.xy_m)
        related, left, nearest_m, nearest = self._described(xy_m)
        self._related = _with_room(self._related, count + len(xy_m), self._measured)
        self._related[count : count + len(xy_m), : self._measured] = related
        self.xy_m = np.concatenate([self.xy_m, xy_m])
        self._left = np.concatenate([self._left, left])
        self.nearest_m = np.concatenate([self.nearest_m, nearest_m])
        self._nearest = np.concatenate([self._nearest, nearest])

    def variance(self) -> Array:
        """Return the expected square error (m,) of each place, scaled by the local roughness."""
        self._follow()
        near_m = self.nearest_m
        weights = np.exp(-0.5 * (near_m / np.maximum(near_m.mean(axis=1, keepdims=True), 1e-30)) ** 2)
        local = (weights * self.model.surprises[self._nearest]).sum(axis=1) / weights.sum(axis=1)
        expected = _OVERCONFIDENCE * self.model.amplitude
        return np.asarray(expected**2 * np.maximum(self._left, 0.0) * np.maximum(local, _LEAST_SCALE))

    def _described(self, xy_m: Array) -> tuple[Array, Array, Array, Counts]:
        apart_m = distances(xy_m, self.model.positions_m)
        related = matern(apart_m, self.model.parameters.length_m)
        left = 1.0 - ((related @ self.model.inverse) * related).sum(axis=1)
        numbers = np.broadcast_to(np.arange(apart_m.shape[1]), apart_m.shape)
        return related, left, *_nearest(apart_m, numbers)

    def _follow(self) -> None:
        before, after = self._measured, len(self.model.positions_m)
        if after == before:
            return
        count = len(self.xy_m)
        apart_m = distances(self.xy_m, self.model.positions_m[before:])
        self._related = _with_room(self._related, count, after)
        self._related[:count, before:after] = matern(apart_m, self.model.parameters.length_m)
        # the new columns of the inverse, weighted by the inverse of its corner, are the gain of the new measurements
        gain = self._related[:count, :after] @ self.model.inverse[:, before:]
        corner = self.model.inverse[before:, before:]
        self._left -= (gain * np.linalg.solve(corner, gain.T).T).sum(axis=1)
        self._measured = after
        numbers = np.broadcast_to(np.arange(before, after), apart_m.shape)
        if before < _NEAREST:
            near_m = np.concatenate([self.nearest_m, apart_m], axis=1)
            self.nearest_m, self._nearest = _nearest(near_m, np.concatenate([self._nearest, numbers], axis=1))
            return
        near = np.flatnonzero(apart_m.min(axis=1) < self.nearest_m.max(axis=1))
        near_m = np.concatenate([self.nearest_m[near], apart_m[near]], axis=1)
        numbers = np.concatenate([self._nearest[near], numbers[near]], axis=1)
        self.nearest_m[near], self._nearest[near] = _nearest(near_m, numbers)


def fitted(
    xy_m: Array, values: Array, times_s: Array, start: Parameters, shortest_m: float, *, drifts: bool, seed: int = 0
) -> Parameters:
    """Return the parameters of the highest marginal likelihood, searched from `start`.

    Args:
        shortest_m: lower bound of the length; the upper bound is a hundred times as large.
        drifts: whether to search for a velocity, too; otherwise the velocity of `start` is known. The velocity found is
            zero unless the values are clearly more likely with a drift, by many of them (test of Vuong, 1989).
        seed: seed for the choice of 240 measurements, if there are more.
    """
    if len(values) > _MOST_FITTED:
        chosen = np.sort(np.random.default_rng(seed).choice(len(values), _MOST_FITTED, replace=False))
        xy_m, values, times_s = xy_m[chosen], values[chosen], times_s[chosen]
    since_s = times_s - times_s.min()
    unit_s = max(float(since_s.max()), 1e-9)

    def densities(at: Array) -> Array:
        apart_m = still_m
        if len(at) > 2:
            moved_m = xy_m - np.outer(since_s / unit_s, at[2:] * shortest_m)
            apart_m = distances(moved_m, moved_m)
        return _log_densities(apart_m, values, shortest_m * math.exp(at[0]), math.exp(at[1]))

    def cost(at: Array) -> float:
        bounds = 50.0 * (max(0.0, -at[0]) ** 2 + max(0.0, at[0] - math.log(100.0)) ** 2)
        bounds += 50.0 * (max(0.0, math.log(_LEAST_NOISE) - at[1]) ** 2 + max(0.0, at[1]) ** 2)
        return float(bounds - densities(at).sum())

    if not drifts:
        xy_m = xy_m - np.outer(since_s, start.velocity_m_s)
    still_m = distances(xy_m, xy_m)
    first = np.array([math.log(start.length_m / shortest_m), math.log(max(start.noise, _LEAST_NOISE))])
    still = _lowest(cost, first, np.array([0.5, 1.0]))
    best, velocity = still, np.zeros(2) if drifts else np.asarray(start.velocity_m_s)
    if drifts:
        before = np.asarray(start.velocity_m_s) * unit_s / shortest_m
        moved = _lowest(cost, np.concatenate([still, before]), np.array([0.3, 0.5, 0.3, 0.3]))
        gains = densities(moved) - densities(still)
        if gains.sum() > max(_DRIFT_GAIN, _CLEAR_GAIN * math.sqrt(len(gains)) * float(gains.std())):
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
    x, y = a_m[:, None, 0] - b_m[None, :, 0], a_m[:, None, 1] - b_m[None, :, 1]
    return np.asarray(np.sqrt(x * x + y * y))  # a fifth of the time of hypot, half of a fit's


def _nearest(apart_m: Array, numbers: Counts) -> tuple[Array, Counts]:
    count = min(_NEAREST, apart_m.shape[1])
    chosen = np.argpartition(apart_m, count - 1, axis=1)[:, :count]
    return np.take_along_axis(apart_m, chosen, axis=1), np.take_along_axis(numbers, chosen, axis=1)


def _with_room(matrix: Array, rows: int, columns: int) -> Array:
    # with a reserve: to copy the matrix for each row costs more than the row
    if rows <= matrix.shape[0] and columns <= matrix.shape[1]:
        return matrix
    larger = np.empty((rows + rows // 4, columns + columns // 4))
    larger[: matrix.shape[0], : matrix.shape[1]] = matrix
    return larger


def _covariance(apart_m: Array, length_m: float, noise: float) -> Array:
    matrix = matern(apart_m, length_m)
    matrix[np.diag_indices(len(matrix))] += noise
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


def _log_densities(apart_m: Array, values: Array, length_m: float, noise: float) -> Array:
    # of each value after those before; their sum is the likelihood, but for a constant
    lower = cholesky(_covariance(apart_m, length_m, noise), lower=True, overwrite_a=True, check_finite=False)
    both = np.stack([values, np.ones(len(values))], axis=1)
    solved: Array = solve_triangular(lower, both, lower=True, check_finite=False)
    seen, ones = solved[:, 0], solved[:, 1]
    left = seen - (ones @ seen) / (ones @ ones) * ones
    square = max(float((left**2).mean()), 1e-300)
    return np.asarray(-0.5 * (math.log(square) + left**2 / square) - np.log(np.diag(lower)))
