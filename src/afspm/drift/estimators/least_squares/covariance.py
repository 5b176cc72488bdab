"""How far the estimate may be off, from how much it depends on each part of the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.align import Believed, Fit

Array = NDArray[np.float64]

FLOOR_PX = 1e-3


def covariance(fit: Fit, believed: Believed) -> Array:
    """(8, 8) of theta: (M + P)^-1 (H'QH + P) (M + P)^-T with the curvature M = H'QJ (White, Econometrica 50, 1, 1982),
    scaled by what the shift really varies with the blocks of the image left out.

    The variation is that of the cluster jackknife (CV3; MacKinnon, Nielsen and Webb, J. Appl. Econom. 38, 671, 2023),
    which allows for noise that is correlated within a block. Of 8 x 8 numbers it would know little, as few blocks hold
    most of the features: only its size is taken, and only where it is larger.
    """
    used = np.abs(fit.curvature).max(axis=(1, 2)) > 0.0
    n = int(used.sum())
    whole = fit.curvature.sum(axis=0) + believed.precision
    inverse = np.linalg.inv(whole)
    model = inverse @ (fit.spread.sum(axis=0) + believed.precision) @ inverse.T
    change = np.linalg.solve(whole - fit.curvature[used], fit.slope[used][:, :, None])[:, :, 0]
    varied = change.T @ change * (n - 1) / n + inverse @ believed.precision @ inverse.T
    size = float(np.trace(np.linalg.solve(model[:2, :2], varied[:2, :2]))) / 2
    total: Array = max(size, 1.0) * (model + model.T) / 2
    total[:2, :2] += FLOOR_PX**2 * np.eye(2)
    return total
