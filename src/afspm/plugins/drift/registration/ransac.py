"""RANSAC with least squares: finds the transform with the most agreeing pairs of points.

Sources: paper, supporting information, "Drift Estimation"; Fischler and Bolles 1981.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.components import Array

Mask = NDArray[np.bool_]

_ENOUGH = 0.9  # share of agreeing pairs at which the search ends


@dataclass(frozen=True, eq=False)
class Transform:
    """An affine transform of points: `x -> linear @ (x - center) + center + shift`, in any unit of length."""

    linear: Array
    shift: Array
    center: Array

    def __call__(self, points: Array) -> Array:
        mapped: Array = (points - self.center) @ self.linear.T + self.center + self.shift
        return mapped

    def shift_at(self, point: Array) -> Array:
        moved: Array = self(point[None])[0] - point
        return moved


@dataclass(frozen=True, eq=False)
class Consensus:
    """A transform, with the mask (n,) of the pairs within `radius` of its prediction."""

    transform: Transform
    inlier: Mask
    radius: float

    @property
    def count(self) -> int:
        return int(self.inlier.sum())


def _translation(a: Array, b: Array) -> Array | None:
    return np.eye(2)


def _euclidean(a: Array, b: Array) -> Array | None:
    # the nearest rotation (Kabsch 1976)
    sine, cosine = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()
    length = math.hypot(sine, cosine)
    if length <= 1e-12 * max((a * a).sum(), 1e-300):
        return None
    linear: Array = np.array([[cosine, -sine], [sine, cosine]]) / length
    return linear


def _similarity(a: Array, b: Array) -> Array | None:
    # the nearest rotation with a scale (Umeyama 1991)
    square = (a * a).sum()
    if square == 0.0:
        return None
    sine, cosine = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()
    linear: Array = np.array([[cosine, -sine], [sine, cosine]]) / square
    return linear


def _affine(a: Array, b: Array) -> Array | None:
    square = a.T @ a
    if np.linalg.det(square) <= 1e-6 * np.trace(square) ** 2:  # (almost) on one line
        return None
    return np.asarray(np.linalg.solve(square, a.T @ b).T, dtype=np.float64)


@dataclass(frozen=True)
class Form:
    """A family of transforms, such as translations.

    Attributes:
        pairs: number of pairs needed to determine a transform.
        linear: function that returns the least-squares 2 x 2 part, from points relative to their means; None if
            undetermined.
    """

    pairs: int
    linear: Callable[[Array, Array], Array | None]


FORMS = {
    "translation": Form(1, _translation),
    "euclidean": Form(2, _euclidean),
    "similarity": Form(2, _similarity),
    "affine": Form(3, _affine),
}


def fitted(a: Array, b: Array, form: Form, bend_max: float) -> Transform | None:
    """Return the least-squares transform from points `a` to `b`, (n, 2) each.

    None if the points don't determine the transform, or if an element of its 2 x 2 part differs from the identity by
    more than `bend_max`.
    """
    if len(a) < form.pairs:
        return None
    middle, shift = a.mean(axis=0), (b - a).mean(axis=0)
    linear = form.linear(a - middle, b - middle - shift)
    if linear is None or np.abs(linear - np.eye(2)).max() > bend_max:
        return None
    return Transform(linear, shift, middle)


@dataclass(frozen=True, eq=False)
class Search:
    """RANSAC with its settings.

    Attributes:
        form: family of the transform.
        iterations: largest number of iterations.
        bend_max: see `fitted`.
        rng: random generator of the samples.
    """

    form: Form
    iterations: int
    bend_max: float
    rng: np.random.Generator

    def among(self, a: Array, b: Array, radius: float) -> Consensus | None:
        """Return the best consensus among pairs of points, by the paper's steps.

        Each step fits a random minimal sample, finds the agreeing pairs (squared error), fits these, and keeps the
        better consensus. The search ends early when almost all pairs agree.

        Args:
            a, b: the pairs, (n, 2) each.
            radius: largest distance of an agreeing pair from the transform.

        Returns:
            The best consensus; None if no transform was found.
        """
        best: Consensus | None = None
        best_error = math.inf
        for _ in range(self.iterations if len(a) >= self.form.pairs else 0):
            some = self.rng.choice(len(a), self.form.pairs, replace=False)
            found = consensus(a, b, fitted(a[some], b[some], self.form, self.bend_max), radius)
            if found is None or found.count < self.form.pairs:
                continue
            again = consensus(a, b, fitted(a[found.inlier], b[found.inlier], self.form, self.bend_max), radius)
            if again is not None and again.count >= found.count:
                found = again
            error = float(_squares(a, b, found.transform)[found.inlier].mean())
            if best is None or (found.count, -error) > (best.count, -best_error):
                best, best_error = found, error
                if best.count >= _ENOUGH * len(a):
                    break
        return best


def consensus(a: Array, b: Array, transform: Transform | None, radius: float) -> Consensus | None:
    """Return the pairs that agree with a transform; None without a transform."""
    if transform is None:
        return None
    return Consensus(transform, _squares(a, b, transform) <= radius**2, radius)


def tightened(
    a: Array, b: Array, start: Consensus, form: Form, *, least: float, most: float, bend_max: float
) -> Consensus:
    """Refit to the nearest inliers, since a wide radius admits mismatches that bias the fit.

    The fit is repeated until the inliers stay the same, at most ten times. The radius is three robust standard
    deviations of the inliers, between `least` and `most`.
    """
    best = start
    for _ in range(10):
        near = np.sqrt(_squares(a, b, best.transform)[best.inlier])
        # the median of a Rayleigh distribution is 1.18 standard deviations
        radius = min(max(3.0 * float(np.median(near)) / 1.18, least), most)
        transform = fitted(a[best.inlier], b[best.inlier], form, bend_max)
        found = consensus(a, b, transform, radius)
        if found is None or found.count < form.pairs:
            return best
        if np.array_equal(found.inlier, best.inlier):
            return found
        best = found
    return best


def log10_false_alarms(pairs: int, inliers: int, sample: int, chance: float) -> float:
    """Return log10 of the expected number of equally large consensuses among unrelated pairs; infinite if k <= s.

    A contrario (Moisan and Stival 2004): (n - s) C(n, k) C(k, s) p^(k - s).

    Args:
        pairs, inliers, sample: n, k and s.
        chance: p, the probability that a wrong pair agrees with a transform.
    """
    if inliers <= sample:
        return math.inf

    def log_choose(n: int, k: int) -> float:
        return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)

    log = math.log(max(pairs - sample, 1)) + log_choose(pairs, inliers) + log_choose(inliers, sample)
    return (log + (inliers - sample) * math.log(min(max(chance, 1e-12), 1.0))) / math.log(10.0)


def jackknife_covariance(a: Array, b: Array, block: NDArray[np.intp], form: Form, at: Array) -> Array | None:
    """Return the covariance (2, 2) of the displacement at a point, by a jackknife over blocks of pairs.

    Pairs in one block have correlated errors, so they are left out together. None for fewer than 3 blocks, or if a fit
    fails.
    """
    blocks = np.unique(block)
    shifts = []
    for left_out in blocks:
        kept = block != left_out
        transform = fitted(a[kept], b[kept], form, math.inf)
        if transform is None:
            return None
        shifts.append(transform.shift_at(at))
    if len(blocks) < 3:
        return None
    deviation = np.array(shifts) - np.mean(shifts, axis=0)
    covariance: Array = deviation.T @ deviation * (len(blocks) - 1) / len(blocks)
    return covariance


def _squares(a: Array, b: Array, transform: Transform) -> Array:
    squares: Array = ((transform(a) - b) ** 2).sum(axis=1)
    return squares
