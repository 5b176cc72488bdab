"""How far the estimate may be off, from how much it depends on each part of the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.align import Believed, Fit

Array = NDArray[np.float64]

INFLATION = 1.5  # few blocks hold most features: the jackknife's own scatter
FLOOR_PX = 1e-3


def covariance(fit: Fit, believed: Believed) -> Array:
    """(7, 7) of theta: cluster jackknife over blocks of the image (CV3; MacKinnon, Nielsen and Webb, J. Appl. Econom.
    38, 671, 2023), which allows for noise that is correlated within a block, and the part that the prior stands for."""
    blocks = fit.normal.blocks
    blocks = blocks[np.abs(blocks[:, :7, :7]).max(axis=(1, 2)) > 0.0]
    n = len(blocks)
    whole = fit.normal.matrix + believed.precision
    without = whole - blocks[:, :7, :7]
    change = np.linalg.solve(without, blocks[:, :7, 7:])[:, :, 0]
    inverse = np.linalg.inv(whole)
    total: Array = change.T @ change * (n - 1) / n + inverse @ believed.precision @ inverse
    total *= INFLATION
    total[:2, :2] += FLOOR_PX**2 * np.eye(2)
    return total
