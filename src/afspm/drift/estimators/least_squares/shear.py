"""How much one scan may be sheared against the other, averaged over what the data leave open."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SCALES = (2e-4, 0.001, 0.002, 0.004, 0.008, 0.016, 0.03)


def averaged(theta: Array, covariance: Array, scales: tuple[float, ...], mean: Array) -> tuple[Array, Array]:
    """Bayesian model averaging over the standard deviation of the linear map (Hoeting, Stat. Sci. 14, 382, 1999).

    Each scale is a model in which the elements of the map are normal about `mean` with that deviation: it conditions
    the shift on what the map may be, and weighs by how likely the map found is in it.

    Returns:
        theta and its covariance, the moments of the mixture.
    """
    weights, thetas, covariances = [], [], []
    for scale in scales:
        spread = covariance[3:, 3:] + scale**2 * np.eye(4)
        off = theta[3:] - mean
        gain = covariance[:, 3:] @ np.linalg.inv(spread)
        weights.append(-0.5 * off @ np.linalg.solve(spread, off) - 0.5 * np.linalg.slogdet(spread)[1])
        thetas.append(theta - gain @ off)
        covariances.append(covariance - gain @ covariance[3:])
    w = np.exp(np.array(weights) - max(weights))
    w /= w.sum()
    all_thetas = np.array(thetas)
    best: Array = w @ all_thetas
    off = all_thetas - best
    total: Array = np.einsum("k,kij->ij", w, np.array(covariances)) + np.einsum("k,ki,kj->ij", w, off, off)
    return best, total
