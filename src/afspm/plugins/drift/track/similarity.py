"""Kalman filter for rotation and scale of the sample since the first scan.

Both form one complex number, the logarithm of the scale plus i times the angle in rad, so that successive changes add
up. The model of this number is a random walk from zero, so the estimate stays near zero without evidence. The state
contains the present value and a value for each stored reference, like the positions in the bank of filters.
"""

from __future__ import annotations

import cmath
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from afspm.components import Array
from afspm.model import Frame
from afspm.plugins.drift.registration import DriftScan, LinearSeen
from afspm.plugins.drift.track.mapping import Mapping

_SHEAR_SD = 0.03  # displacement per length along the slow axis, by unknown drift during the scans
_LEAST_SD = 1e-5  # of a measurement
_DOUBT = 25.0  # chi2 above which a measurement is ignored until the next measurement confirms it
_OF_SCALE, _OF_ANGLE = np.array([1.0, 0.0, 0.0, 1.0]), np.array([0.0, -1.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class Similarity:
    """Rotation and scale with their uncertainty; immutable.

    Scans are straightened before registration: their known rotation and scale are undone. In straightened coordinates u
    = straight(x_tip), the sample is only displaced: x_sample = u - drift.

    Attributes:
        straight: present mapping from tip coordinates to straightened coordinates.
        pivot_m: (2,) last place of the sample, straightened; later corrections rotate about this place.
        error: (1 + n,) complex, rotation and scale expected to remain after straightening, at present and in each
            reference.
        covariance: (1 + n, 1 + n) covariance of `error`, the same for scale and angle.
        doubted: whether the newest measurement was far from its expected value.
    """

    straight: Mapping
    pivot_m: Array
    error: NDArray[np.complex128]
    covariance: Array
    doubted: bool = False

    @classmethod
    def at_start(cls, scan: DriftScan) -> Similarity:
        """Return the state after the first scan, which by definition has no rotation and scale 1."""
        return cls(Mapping.identity(), np.array(scan.region.center_m), np.zeros(2, complex), np.zeros((2, 2)))

    @property
    def sd(self) -> float:
        """Standard deviation of the logarithm of the scale, and of the angle in rad."""
        return float(np.sqrt(self.covariance[0, 0]))

    def straightened(self, scan: DriftScan) -> DriftScan:
        """Return the scan with its region in straightened coordinates."""
        return replace(scan, region=replace(self.straight.to_sample(scan.region), frame=Frame.TIP))

    def moved(self, variance: float) -> Similarity:
        """Return the state at a later time, with a variance added to the present."""
        covariance = self.covariance.copy()
        covariance[0, 0] += variance
        return replace(self, covariance=covariance)

    def lever_m2(self, number: int, position_m: Array) -> Array:
        """Return the covariance (2, 2) of a displacement by uncertain rotation and scale about the pivot."""
        row = self._row(number)
        far_m = position_m - self.pivot_m
        return np.asarray(np.eye(2) * (row @ self.covariance @ row) * (far_m @ far_m))

    def learned(self, number: int, seen: SimilarityMeasurement) -> Similarity:
        """Update with the measurement from a registration with a reference.

        A measurement far from its expected value is ignored, unless the measurement before was also far.
        """
        row = self._row(number)
        crossed = self.covariance @ row
        expected = float(row @ crossed) + seen.variance
        innovation = seen.value - row @ self.error
        if abs(innovation) ** 2 > _DOUBT * expected and not self.doubted:
            return replace(self, doubted=True)
        gain = crossed / expected
        left = np.eye(len(row)) - np.outer(gain, row)
        covariance = left @ self.covariance @ left.T + seen.variance * np.outer(gain, gain)  # Joseph's form
        error = self.error + gain * innovation
        return replace(self, error=error, covariance=(covariance + covariance.T) / 2, doubted=False)

    def straight_about(self, position_m: Array) -> Similarity:
        """Correct `straight` for the expected error of rotation and scale, about a fixed place (2,)."""
        error = self.error.copy()
        undone = _turned_about(position_m, -error[0])
        error[0] = 0.0
        return replace(self, straight=undone @ self.straight, pivot_m=position_m, error=error)

    def with_scan(self) -> Similarity:
        """Return the state with the newest scan added, straightened as for its registration."""
        now = [*range(len(self.error)), 0]
        return replace(self, error=self.error[now], covariance=self.covariance[np.ix_(now, now)])

    def without_scan(self, number: int) -> Similarity:
        kept = np.delete(np.arange(len(self.error)), 1 + number)
        return replace(self, error=self.error[kept], covariance=self.covariance[np.ix_(kept, kept)])

    def _row(self, number: int) -> Array:
        # (1 + n,) whose product with the state is the value in a registration with a reference
        row = np.zeros(len(self.error))
        row[0], row[1 + number] = 1.0, -1.0
        return row


@dataclass(frozen=True)
class SimilarityMeasurement:
    """Measured rotation and scale between two scans.

    Attributes:
        value: logarithm of the scale, plus i times the angle in rad.
        variance: variance of the logarithm of the scale, and of the angle.
    """

    value: complex
    variance: float

    @classmethod
    def of(cls, seen: LinearSeen, scans: tuple[DriftScan, DriftScan], inflation: float) -> SimilarityMeasurement:
        """Fit rotation and scale to a linear part by generalised least squares, allowing for a shear by drift.

        Drift during a scan displaces whole rows, so changes along a row carry most of the information.
        """
        covariance = seen.covariance + _LEAST_SD**2 * np.eye(4)
        for scan in scans:
            angle = scan.region.angle_rad
            slow = np.array([-np.sin(angle), np.cos(angle)])
            covariance = covariance + _SHEAR_SD**2 * np.kron(np.eye(2), np.outer(slow, slow))
        columns = np.stack([_OF_SCALE, _OF_ANGLE], axis=1)
        weighted = np.linalg.solve(covariance, columns)
        of_both = np.linalg.inv(columns.T @ weighted)
        scale, angle = of_both @ weighted.T @ seen.linear.ravel()
        return cls(cmath.log(1.0 + complex(scale, angle)), inflation * float(np.linalg.eigvalsh(of_both)[-1]))


def _turned_about(center_m: Array, logarithm: complex) -> Mapping:
    factor = cmath.exp(logarithm)
    linear = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
    return Mapping.of(linear, center_m - linear @ center_m)
