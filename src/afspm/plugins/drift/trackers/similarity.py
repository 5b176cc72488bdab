"""Rotation and scale of the sample since the first scan, as a Kalman filter of two parameters.

Both are one complex number, the logarithm of the scale plus i times the angle in rad: successive changes add up. It is
a random walk from zero, so it stays near zero without evidence. Besides the present, the state holds each stored
reference, as the bank of filters does for positions.
"""

from __future__ import annotations

import cmath
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from afspm.model import Frame
from afspm.plugins.drift.mapping import Mapping
from afspm.plugins.drift.registration import DriftScan, LinearSeen

Array = NDArray[np.float64]

_SHEAR_SD = 0.03  # displacement per length along the slow axis, by unknown drift during the scans
_LEAST_SD = 1e-5  # of a measurement
_DOUBT = 25.0  # chi2 above which a measurement is not believed until the next one confirms it
_OF_SCALE, _OF_ANGLE = np.array([1.0, 0.0, 0.0, 1.0]), np.array([0.0, -1.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class Similarity:
    """Rotation and scale with their uncertainty; immutable.

    Scans are registered straightened, with the known rotation and scale of their time undone. In these coordinates, u =
    straight(x_tip), the sample is only displaced, x_sample = u - drift.

    Attributes:
        straight: from tip coordinates to straightened ones, now.
        pivot_m: (2,) the last place of the sample, straightened: later corrections rotate about this place.
        error: (1 + n,) complex, expected rotation and scale left by `straight` now, and in each reference.
        covariance: (1 + n, 1 + n), of scale and angle alike.
        doubted: the newest measurement was far from its expectation.
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
        """Return a later state, with this variance added to the present."""
        covariance = self.covariance.copy()
        covariance[0, 0] += variance
        return replace(self, covariance=covariance)

    def lever_m2(self, number: int, position_m: Array) -> Array:
        """Return the (2, 2) covariance of a displacement from a reference by the uncertain rotation about the pivot."""
        row = self._row(number)
        far_m = position_m - self.pivot_m
        return np.asarray(np.eye(2) * (row @ self.covariance @ row) * (far_m @ far_m))

    def learned(self, number: int, seen: SimilarityMeasurement) -> Similarity:
        """Update by a registration with a reference."""
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
        """Correct `straight` by the expected rotation and scale error, about a place (2,) that stays fixed."""
        error = self.error.copy()
        undone = _turned_about(position_m, -error[0])
        error[0] = 0.0
        return replace(self, straight=undone @ self.straight, pivot_m=position_m, error=error)

    def with_scan(self) -> Similarity:
        """Add the newest scan, straightened as it was registered."""
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
    """Rotation and scale between two scans.

    Attributes:
        value: logarithm of the scale, plus i times the angle in rad.
        variance: of each of them.
    """

    value: complex
    variance: float

    @classmethod
    def of(cls, seen: LinearSeen, scans: tuple[DriftScan, DriftScan], inflation: float) -> SimilarityMeasurement:
        """Fit rotation and scale to a linear part by generalised least squares, besides a shear by drift.

        A shear by drift during a scan displaces whole rows, so changes along a row carry most of the information.
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
