"""Registrations as measurements of the filters' state.

A feature at tip position x of the reference j is found at x + d in the scan k. So d is the displacement of the sample
when scan k passed the feature, minus its displacement when scan j did: d = X_k + t_k v_k - X_j - t_j v_j. X is the
displacement at the middle of a scan, v the velocity in tip coordinates, and t the delay from the middle to the rows of
the overlap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from afspm.components import Array
from afspm.plugins.drift.pairs.overlap import overlap_center_m
from afspm.plugins.drift.registration import DriftScan, Prior, Registration
from afspm.plugins.drift.track.filters import Filters
from afspm.plugins.drift.track.references import ReferenceScan
from afspm.plugins.drift.track.shear import delay_per_length_s_m, row_delay_s, slow_axis
from afspm.plugins.drift.track.similarity import Similarity

AGREEMENT = 25.0  # chi2 of the difference of two references' results
_WEIGHED_OTHERWISE = 0.02
"""Share of the variance by wandering during a scan that is an error of the pair; 0.016 in simulated scans of particles.
Each registration weighs the rows in its own way, depending on their features, the overlap and the other unknowns."""
_ALIKE = 0.05  # largest relative difference in pace at which drift shears two scans alike


@dataclass(frozen=True, eq=False)
class ObservationModel:
    """Observation model: the dependence of d on the state.

    Attributes:
        number: index of the reference.
        scan_delay_s, reference_delay_s: t_k and t_j.
        offset_m: (2,) the part of d independent of the state.
        noise_m2: (2, 2) covariance of the offset.
    """

    number: int
    scan_delay_s: float
    reference_delay_s: float
    offset_m: Array
    noise_m2: Array

    def rows(self, states: int, scan_at: int) -> Array:
        """Return the rows (2, states) whose product with the state is d - offset.

        Args:
            scan_at: index of the scan's position in the state.
        """
        rows, first = np.zeros((2, states)), 4 + 4 * self.number
        for axis in range(2):
            rows[axis, scan_at + axis] = 1.0
            rows[axis, 2 + axis] += self.scan_delay_s
            rows[axis, first + axis] -= 1.0
            rows[axis, first + 2 + axis] -= self.reference_delay_s
        return rows


@dataclass(frozen=True, eq=False)
class NewestScan:
    """The newest scan, with the tracker's state at its time.

    Attributes:
        compensated_m_s: (2,) velocity of tip coordinates, which follow the sample; included in the state's velocity.
        similarity: rotation and scale for straightening the scan; None if only translations are tracked.
    """

    scan: DriftScan
    filters: Filters
    compensated_m_s: Array
    similarity: Similarity | None = None

    def link(self, number: int, reference: ReferenceScan, center_m: Array, displacement_m: Array) -> ObservationModel:
        """Return the observation model for an overlap around a position of the reference."""
        ours_s, theirs_s = row_delay_s(self.scan, center_m + displacement_m), row_delay_s(reference.scan, center_m)
        offset, noise = np.zeros(2), np.zeros((2, 2))
        if ours_s is None:
            noise += self._either_way(self.scan, center_m + displacement_m, None, self.compensated_m_s)
        else:
            offset -= ours_s * self.compensated_m_s
        if theirs_s is None:
            noise += self._either_way(reference.scan, center_m, number, reference.compensated_m_s)
        else:
            offset += theirs_s * reference.compensated_m_s
        if self.similarity is not None:
            noise += self.similarity.lever_m2(number, center_m + displacement_m)
        return ObservationModel(number, ours_s or 0.0, theirs_s or 0.0, offset, noise)

    def _either_way(self, scan: DriftScan, position_m: Array, number: int | None, compensated_m_s: Array) -> Array:
        # covariance (2, 2) of the displacement from a scan's middle to a position, for an unknown scan direction
        delay_s = row_delay_s(replace(scan, upwards=True), position_m) or 0.0  # later or earlier by the same time
        velocity, covariance = self.filters.velocity(number)
        velocity = velocity - compensated_m_s
        return np.asarray(delay_s**2 * (np.outer(velocity, velocity) + covariance))

    def expected(self, number: int, reference: ReferenceScan) -> tuple[Array, Array]:
        """Return the expected displacement d (2,) from a reference, and its covariance (2, 2)."""
        states = self.filters.mean.shape[1]
        middle = ObservationModel(number, 0.0, 0.0, np.zeros(2), np.zeros((2, 2)))
        displacement_m, _ = self.filters.mixed(middle.rows(states, 0))
        center_m = overlap_center_m(reference.scan.region, self.scan.region, displacement_m)
        if center_m is None:
            center_m = np.array(reference.scan.region.center_m)
        link = self.link(number, reference, center_m, displacement_m)
        mean, covariance = self.filters.mixed(link.rows(states, 0))
        return mean + link.offset_m, covariance + link.noise_m2

    def prior(self, number: int, reference: ReferenceScan, widening: float) -> Prior:
        """Return the prior for an estimator, widened by a factor and by half a pixel for the search.

        The prior contains the velocity difference only if drift shears both scans alike.
        """
        mean, covariance = self.expected(number, reference)
        half_px_m = max(*self.scan.pixel_m, *reference.scan.pixel_m) / 2
        covariance = widening * covariance + np.eye(2) * half_px_m**2
        if not _sheared_alike(self.scan, reference.scan):
            return Prior(mean, covariance)
        rows = self.filters.velocity_rows() - self.filters.velocity_rows(number)
        difference, spread = self.filters.mixed(rows)
        difference = difference - self.compensated_m_s + reference.compensated_m_s
        return Prior(mean, covariance, difference, float(np.sqrt(np.linalg.eigvalsh(spread)[-1])))


def _sheared_alike(first: DriftScan, second: DriftScan) -> bool:
    # rows in the same direction, at about the same pace
    one, other = delay_per_length_s_m(first), delay_per_length_s_m(second)
    if one is None or other is None:
        return False
    along, across = one * slow_axis(first), other * slow_axis(second)
    return float(np.linalg.norm(along - across)) <= _ALIKE * abs(one)


@dataclass(frozen=True, eq=False)
class PairMeasurement:
    """A registration as a measurement of the state.

    Attributes:
        pair_noise_m2, scan_noise_m2: (2, 2) error covariance due to the pair, and to the scan's location error.
    """

    link: ObservationModel
    found: Registration
    pair_noise_m2: Array
    scan_noise_m2: Array

    @classmethod
    def of(
        cls, newest: NewestScan, number: int, reference: ReferenceScan, found: Registration, inflation: float
    ) -> PairMeasurement:
        """Return the measurement from a registration.

        The error of an efficient estimator consists of one location error per scan; the inflation is an error of the
        pair. So is a share of the wandering during both scans. Without this share, a large velocity times a short
        delay between rows would explain displacements between three scans that do not add up.
        """
        link = newest.link(number, reference, found.center_m, found.displacement_m)
        pair_noise = (inflation - 1.0) * found.covariance_m2 + link.noise_m2
        wandered_m2 = sum(newest.filters.wandered_m2(one.duration_s) for one in (newest.scan, reference.scan))
        pair_noise = pair_noise + _WEIGHED_OTHERWISE * wandered_m2 * np.eye(2)
        return cls(link, found, pair_noise, found.covariance_m2 / 2)

    @property
    def value_m(self) -> Array:
        """Displacement (2,) without the part that does not depend on the state."""
        value: Array = self.found.displacement_m - self.link.offset_m
        return value


def agreeing(measured: list[PairMeasurement], filters: Filters) -> list[PairMeasurement]:
    """Return the largest consistent group of results; of equally large groups, the group of the best reference."""
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
            if i == j or apart @ np.linalg.solve(noise, apart) <= AGREEMENT:
                group.append(other)
        groups.append(group)
    return max(groups, key=len)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Several results for one scan, combined into one measurement, and the filters to update."""

    measured: list[PairMeasurement]
    filters: Filters

    @property
    def scan_noise_m2(self) -> Array:
        """Covariance (2, 2) of the scan's own location error."""
        return np.asarray(np.mean([one.scan_noise_m2 for one in self.measured], axis=0))

    @cached_property
    def apart_m(self) -> Array:
        """Difference (2,) between the best reference's result and the expectation of all filters."""
        return self._apart[0]

    @cached_property
    def surprise(self) -> float:
        """chi² of `apart_m`, with 2 degrees of freedom."""
        apart, covariance = self._apart
        return float(apart @ np.linalg.solve(covariance, apart))

    @cached_property
    def _apart(self) -> tuple[Array, Array]:
        best = self.measured[0]
        expected, covariance = self.filters.mixed(best.link.rows(self.filters.mean.shape[1], 0))
        return best.value_m - expected, covariance + best.pair_noise_m2 + self.scan_noise_m2

    def rows(self, states: int) -> tuple[Array, Array, Array]:
        """Return rows (m, states), values (m,) and noise (m, m) for an update; the scan is the last in the state."""
        rows = np.concatenate([one.link.rows(states, states - 4) for one in self.measured])
        values = np.concatenate([one.value_m for one in self.measured])
        noise = np.zeros((len(values), len(values)))
        for n, one in enumerate(self.measured):
            noise[2 * n : 2 * n + 2, 2 * n : 2 * n + 2] = one.pair_noise_m2
        return rows, values, noise
