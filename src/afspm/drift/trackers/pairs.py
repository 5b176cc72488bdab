"""A registration as a measurement of the filters' state.

A feature at tip position x of the reference j is found at x + d in the scan k, so d is the displacement of the sample
when k passed it, less that when j did: d = X_k + t_k v_k - X_j - t_j v_j, with X where a scan shows the sample at its
middle, and t how much later than that its rows passed the overlap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from afspm.drift.overlap import overlap_center_m
from afspm.drift.registration import DriftScan, Prior, Registration
from afspm.drift.shear import delay_per_length_s_m, row_delay_s, slow_axis
from afspm.drift.trackers.filters import Filters
from afspm.drift.trackers.references import Reference

Array = NDArray[np.float64]

_AGREEMENT = 25.0  # chi2 of the difference of two references' results
_ALIKE = 0.05  # by which part the courses of two scans may differ if drift is to shear them alike


@dataclass(frozen=True, eq=False)
class Link:
    """How d depends on the state.

    Attributes:
        number: of the reference.
        scan_delay_s: t_k.
        offset_m: (2,) what is known of d besides the state.
        noise_m2: (2, 2) of that.
    """

    number: int
    scan_delay_s: float
    offset_m: Array
    noise_m2: Array

    def rows(self, states: int, scan_at: int) -> Array:
        """(2, states) whose product with the state is d - offset; the scan's own position is at `scan_at`."""
        rows = np.zeros((2, states))
        for axis in range(2):
            rows[axis, scan_at + axis] = 1.0
            rows[axis, 2 + axis] += self.scan_delay_s
            rows[axis, 4 + 2 * self.number + axis] -= 1.0
        return rows


@dataclass(frozen=True, eq=False)
class Newest:
    """The scan that is being compared.

    Attributes:
        velocity_m_s, velocity_covariance: (2,), (2, 2) of the sample in tip coordinates.
        compensated_m_s: (2,) velocity with which tip coordinates follow the sample; the state's is more by that.
    """

    scan: DriftScan
    velocity_m_s: Array
    velocity_covariance: Array
    compensated_m_s: Array

    def link(self, number: int, reference: Reference, center_m: Array, displacement_m: Array) -> Link:
        """For an overlap about a position of the reference."""
        ours_s, our_noise = _delay(self.scan, center_m + displacement_m, self.velocity_m_s)
        theirs_s, their_noise = _delay(reference.scan, center_m, reference.velocity_m_s)
        offset = -ours_s * self.compensated_m_s - theirs_s * reference.velocity_m_s
        return Link(number, ours_s, offset, our_noise + their_noise + theirs_s**2 * reference.velocity_covariance)

    def expected(self, number: int, reference: Reference, filters: Filters) -> tuple[Link, Array, Array]:
        """The link to a reference, d (2,) as it is expected, and its covariance (2, 2)."""
        states = filters.mean.shape[1]
        displacement_m, _ = filters.mixed(Link(number, 0.0, np.zeros(2), np.zeros((2, 2))).rows(states, 0))
        center_m = overlap_center_m(reference.scan.region, self.scan.region, displacement_m)
        if center_m is None:
            center_m = np.array(reference.scan.region.center_m)
        link = self.link(number, reference, center_m, displacement_m)
        mean, covariance = filters.mixed(link.rows(states, 0))
        return link, mean + link.offset_m, covariance + link.noise_m2

    def prior(self, number: int, reference: Reference, filters: Filters, widening: float) -> Prior:
        """What an estimator is told to expect: half a pixel wider, so that it looks around."""
        _, mean, covariance = self.expected(number, reference, filters)
        half_px_m = max(*self.scan.pixel_m, *reference.scan.pixel_m) / 2
        covariance = widening * covariance + np.eye(2) * half_px_m**2
        if not _sheared_alike(self.scan, reference.scan):
            return Prior(mean, covariance)
        both = self.velocity_covariance + reference.velocity_covariance
        velocity_sd_m_s = float(np.sqrt(np.linalg.eigvalsh(both)[-1]))
        return Prior(mean, covariance, self.velocity_m_s - reference.velocity_m_s, velocity_sd_m_s)


def _delay(scan: DriftScan, position_m: Array, velocity_m_s: Array) -> tuple[float, Array]:
    """When a scan passes a position after its middle; what is uncertain of the displacement then, (2, 2)."""
    delay_s = row_delay_s(scan, position_m)
    if delay_s is not None:
        return delay_s, np.zeros((2, 2))
    either_s = row_delay_s(replace(scan, upwards=True), position_m) or 0.0  # as much later as earlier
    return 0.0, np.outer(velocity_m_s, velocity_m_s) * either_s**2


def _sheared_alike(first: DriftScan, second: DriftScan) -> bool:
    """Whether the same drift shears both alike: rows in the same direction, at about the same pace."""
    one, other = delay_per_length_s_m(first), delay_per_length_s_m(second)
    if one is None or other is None:
        return False
    along, across = one * slow_axis(first), other * slow_axis(second)
    return float(np.linalg.norm(along - across)) <= _ALIKE * abs(one)


@dataclass(frozen=True, eq=False)
class Measured:
    """What an estimator found.

    Attributes:
        pair_noise_m2, scan_noise_m2: (2, 2) what of its error is the pair's, and what the location error of the scan.
    """

    link: Link
    found: Registration
    pair_noise_m2: Array
    scan_noise_m2: Array

    @classmethod
    def of(cls, newest: Newest, number: int, reference: Reference, found: Registration, inflation: float) -> Measured:
        """An efficient estimator's error is one location error for each of the scans; inflation is the pair's."""
        link = newest.link(number, reference, found.center_m, found.displacement_m)
        pair_noise = (inflation - 1.0) * found.covariance_m2 + link.noise_m2
        return cls(link, found, pair_noise, found.covariance_m2 / 2)

    @property
    def value_m(self) -> Array:
        """(2,) what the state tells of the displacement."""
        value: Array = self.found.displacement_m - self.link.offset_m
        return value


def agreeing(measured: list[Measured], filters: Filters) -> list[Measured]:
    """The largest group of results that fit together; of equally large ones that with the best reference."""
    if len(measured) < 2:
        return measured
    states = filters.mean.shape[1]
    rows = [one.link.rows(states, 0) for one in measured]
    groups = []
    for i, one in enumerate(measured):
        group = []
        for j, other in enumerate(measured):
            expected, covariance = filters.mixed(rows[j] - rows[i])
            apart = other.value_m - one.value_m - expected
            # both have the scan's own error in common
            noise = covariance + one.pair_noise_m2 + other.pair_noise_m2
            if i == j or apart @ np.linalg.solve(noise, apart) <= _AGREEMENT:
                group.append(other)
        groups.append(group)
    return max(groups, key=len)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Several results for one scan as one measurement."""

    measured: list[Measured]

    @property
    def scan_noise_m2(self) -> Array:
        """(2, 2) of the scan's own location error."""
        return np.asarray(np.mean([one.scan_noise_m2 for one in self.measured], axis=0))

    def surprise(self, filters: Filters) -> float:
        """chi2 (2 degrees of freedom) of the best reference's result, against all filters together."""
        best = self.measured[0]
        expected, covariance = filters.mixed(best.link.rows(filters.mean.shape[1], 0))
        apart = best.value_m - expected
        return float(apart @ np.linalg.solve(covariance + best.pair_noise_m2 + self.scan_noise_m2, apart))

    def rows(self, states: int) -> tuple[Array, Array, Array]:
        """Rows (m, states), values (m,) and noise (m, m); the scan is the last one in the state."""
        rows = np.concatenate([one.link.rows(states, states - 2) for one in self.measured])
        values = np.concatenate([one.value_m for one in self.measured])
        noise = np.zeros((len(values), len(values)))
        for n, one in enumerate(self.measured):
            noise[2 * n : 2 * n + 2, 2 * n : 2 * n + 2] = one.pair_noise_m2
        return rows, values, noise
