"""How much one scan may be sheared against the other, averaged over what the data leave open."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.warp import LINEAR

Array = NDArray[np.float64]

DRIFTS = (2e-4, 0.001, 0.002, 0.004, 0.008, 0.016, 0.03)  # displacement per length along y
BESIDES = (2e-4, 0.01)  # of each element: next to nothing; or creep, a sample that turns, another calibration


def of_drift(sd: float) -> Array:
    """Covariance of (axx, axy, ayx, ayy) when drift during the scans shears them: each row is displaced against the one
    before, so what depends on y varies alone."""
    return sd**2 * np.diag([0.0, 1.0, 0.0, 1.0])


def models(drift: float | None, aspect: float) -> list[Array]:
    """What the linear map of pixel coordinates may be: covariances of it.

    Args:
        drift: displacement per length along y; None: not known, so all are tried.
        aspect: height of a pixel over its width.
    """
    to_px = np.diag([1.0, aspect, 1.0 / aspect, 1.0])
    drifts = DRIFTS if drift is None else (drift,)
    return [to_px @ (of_drift(d) + b**2 * np.eye(4)) @ to_px for d, b in itertools.product(drifts, BESIDES)]


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
