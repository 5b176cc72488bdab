"""How much one scan may be sheared against the other, averaged over what the data leave open."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.warp import LINEAR

Array = NDArray[np.float64]

DRIFTS = (2e-4, 0.001, 0.002, 0.004, 0.008, 0.016, 0.03)  # displacement per length along y
TURNS_RAD = (2e-4, 0.002, 0.01)
ANYTHING = (2e-4, 0.003, 0.01)  # of each element: creep, calibration


def of_drift(sd: float) -> Array:
    """Covariance of (axx, axy, ayx, ayy) when drift during the scans shears them: each row is displaced against the one
    before, so what depends on y varies alone."""
    return sd**2 * np.diag([0.0, 1.0, 0.0, 1.0])


def of_turn(sd_rad: float) -> Array:
    """The same of a small rotation."""
    turn = np.array([0.0, 1.0, -1.0, 0.0])
    return sd_rad**2 * np.outer(turn, turn)


def models(drift: float | None, aspect: float) -> list[Array]:
    """What the linear map of pixel coordinates may be: covariances of it.

    Args:
        drift: displacement per length along y; None: not known, so all are tried.
        aspect: height of a pixel over its width.
    """
    to_px = np.diag([1.0, aspect, 1.0 / aspect, 1.0])
    besides = [of_turn(t) + ANYTHING[0] ** 2 * np.eye(4) for t in TURNS_RAD] + [a**2 * np.eye(4) for a in ANYTHING[1:]]
    drifts = DRIFTS if drift is None else (drift,)
    return [to_px @ (of_drift(d) + more) @ to_px for d, more in itertools.product(drifts, besides)]


def averaged(theta: Array, covariance: Array, covariances: Iterable[Array], mean: Array) -> tuple[Array, Array]:
    """Bayesian model averaging over what the linear map may be (Hoeting, Stat. Sci. 14, 382, 1999).

    Where features are few, shift and shear are nearly the same thing, and what shear is plausible decides the shift.
    Each model says that the map is normal about `mean` with its covariance; it conditions the shift on that, and weighs
    by how likely the map found is in it.

    Returns:
        theta and its covariance, the moments of the mixture.
    """
    weights, thetas, totals = [], [], []
    off = theta[LINEAR] - mean
    for model in covariances:
        spread = covariance[LINEAR, LINEAR] + model
        gain = covariance[:, LINEAR] @ np.linalg.inv(spread)
        weights.append(-0.5 * off @ np.linalg.solve(spread, off) - 0.5 * np.linalg.slogdet(spread)[1])
        thetas.append(theta - gain @ off)
        totals.append(covariance - gain @ covariance[LINEAR])
    weight = np.exp(np.array(weights) - max(weights))
    weight /= weight.sum()
    best: Array = weight @ np.array(thetas)
    apart = np.array(thetas) - best
    total: Array = np.tensordot(weight, np.array(totals), 1) + np.einsum("k,ki,kj->ij", weight, apart, apart)
    return best, total
