"""What is known before the scans are looked at, in pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.grid import Grid
from afspm.drift.registration import DriftScan, Prior

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Expected:
    """Expected shift, px, and its covariance, px²."""

    mean: Array
    covariance: Array

    @classmethod
    def of(cls, prior: Prior, grid: Grid) -> Expected:
        inverse = np.linalg.inv(grid.to_m)
        return cls(grid.shift_px(prior.mean_m), inverse @ prior.covariance_m2 @ inverse.T)

    def chi2(self, shift_px: Array) -> Array:
        """Of shifts, shape (..., 2)."""
        off = shift_px - self.mean
        chi2: Array = np.einsum("...i,ij,...j", off, np.linalg.inv(self.covariance), off)
        return chi2

    def surprise(self, shift_px: Array, covariance: Array) -> float:
        """chi² of an estimate, which has a covariance too."""
        off = shift_px - self.mean
        return float(off @ np.linalg.solve(self.covariance + covariance, off))

    def on_smaller(self, factor: int, offset_px: Array) -> Expected:
        """On images of which each pixel is `factor` pixels, with their centres moved apart by `offset_px`."""
        mean: Array = (self.mean - offset_px) / factor
        return Expected(mean, self.covariance / factor**2 + 0.3 * np.eye(2))


def shear_by_drift(prior: Prior | None, reference: DriftScan, scan: DriftScan) -> tuple[Array, float | None]:
    """By how much each row of the scan is displaced against that of the reference, and the standard deviation of it, in
    metres per metre along the slow axis.

    What drift does while a scan is taken is v t, and t runs along its slow axis. Nothing can be said (zero, None)
    unless both scans have been taken alike: the prior knows the difference of two velocities, and that alone.
    """
    nothing = np.zeros(2), None
    if prior is None or prior.velocity_sd_m_s is None or reference.upwards is None:
        return nothing
    slow = [scan.duration_s / scan.region.size_m[1] for scan in (reference, scan)]
    turned = math.remainder(scan.region.angle_rad - reference.region.angle_rad, 2.0 * math.pi)
    if reference.upwards != scan.upwards or abs(turned) > 0.1 or not max(slow) <= 1.1 * min(slow):
        return nothing
    pace_s_m = (slow[0] + slow[1]) / 2 * (1.0 if scan.upwards else -1.0)
    return prior.velocity_difference_m_s * pace_s_m, prior.velocity_sd_m_s * abs(pace_s_m)
