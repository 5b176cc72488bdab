"""Shear of an image by drift during the scan, and drift velocity from an up frame and a down frame.

Rows are scanned one after the other, so a feature at `p` in the middle of the scan is found at
x = p + v a e.(x - c), with c the centre, e the direction of the slow axis and a the time per length along this axis,
negative when scanning down. Two scans with a_1 and a_2 are then related by 1 + A = (1 - a_2 v e')^-1 (1 - a_1 v e'),
that is A e = v (a_2 - a_1) / (1 - a_2 v.e): an up frame and a down frame differ by a shear and a stretch of 2 v times
duration over height, regardless of the drift in between. The velocity from the shear is free of a lattice's ambiguity;
the velocity from the displacement between their middles is more precise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from afspm.basics import InvalidValue
from afspm.components import Array
from afspm.plugins.drift.registration import DriftScan, Estimator, Prior, Registration
from afspm.scheduler import undistorted

_SAFETY = 2.0  # on the standard deviation of the shear, which is only derived from the displacement
_CONTRADICTION = 16.0  # chi2 of the difference between both routes


@dataclass(frozen=True, eq=False)
class DriftVelocity:
    """Absolute velocity of the sample in tip coordinates.

    Attributes:
        accepted: whether the velocity may be used.
        reason: reason for a refusal, for people.
        velocity_m_s: (2,) velocity; NaN for a refusal.
        covariance: (2, 2) covariance of the velocity, (m/s)².
        time_s: middle of the two scans, for which the velocity holds.
        by_shear_m_s, by_displacement_m_s: (2,) velocity from shear alone and from displacement alone.
        by_shear_covariance: (2, 2) covariance of `by_shear_m_s`.
        registration: the registration used or refused; None if the pair was not registered.
    """

    accepted: bool
    reason: str
    velocity_m_s: Array
    covariance: Array
    time_s: float
    by_shear_m_s: Array
    by_shear_covariance: Array
    by_displacement_m_s: Array
    registration: Registration | None = None

    @classmethod
    def refused(cls, reason: str, time_s: float, registration: Registration | None = None) -> DriftVelocity:
        """Return a refusal without a velocity."""
        nothing, unknown = np.full(2, np.nan), np.full((2, 2), np.nan)
        return cls(
            accepted=False,
            reason=reason,
            velocity_m_s=nothing,
            covariance=unknown,
            time_s=time_s,
            by_shear_m_s=nothing,
            by_shear_covariance=unknown,
            by_displacement_m_s=nothing,
            registration=registration,
        )


def slow_axis(scan: DriftScan) -> Array:
    """Return the (2,) unit vector of the slow scan axis towards ascending y, in tip coordinates."""
    angle = scan.region.angle_rad
    return np.array([-math.sin(angle), math.cos(angle)])


def delay_per_length_s_m(scan: DriftScan) -> float | None:
    """Return the delay per length along the slow axis, in s/m, negative when scanning down; None: unknown direction."""
    if scan.upwards is None:
        return None
    return (1.0 if scan.upwards else -1.0) * scan.duration_s / scan.region.size_m[1]


def row_delay_s(scan: DriftScan, position_m: Array) -> float | None:
    """Return the delay from a scan's middle to its pass over a position (tip coordinates); None: unknown direction."""
    a = delay_per_length_s_m(scan)
    return None if a is None else a * float(slow_axis(scan) @ (position_m - np.array(scan.region.center_m)))


def velocity_by_shear(reference: DriftScan, scan: DriftScan, found: Registration) -> tuple[Array, Array] | None:
    """Return velocity (2,) and covariance from the shear between scans of different directions or speeds.

    Features are assumed to be spread evenly over the image: the uncertainty of the slope over a height h is then
    sqrt(12) / h times the uncertainty of the displacement.

    Returns:
        None if the scans were sheared nearly alike, a direction or the covariance is unknown, the registration is
        coarse, or the sample moved about as fast as the scan.
    """
    first, second = delay_per_length_s_m(reference), delay_per_length_s_m(scan)
    if first is None or second is None or not np.isfinite(found.covariance_m2).all():
        return None
    if found.failure:  # a coarse estimate has no shear
        return None
    difference = second - first
    if abs(difference) < 0.1 * max(abs(first), abs(second)):
        return None
    along = slow_axis(reference)
    slope = found.linear @ along / difference
    shrunk = 1.0 + second * float(along @ slope)
    if shrunk < 0.1:
        return None
    height_m = min(reference.region.size_m[1], scan.region.size_m[1])
    covariance = found.covariance_m2 * (12.0 * (_SAFETY / (height_m * difference)) ** 2)
    velocity = slope / shrunk
    # some controllers count the time of the last row, others do not: durations are known to one row
    rows = min(reference.values.shape[0], scan.values.shape[0])
    return velocity, covariance + float(velocity @ velocity) / rows**2 * np.eye(2)


def velocity_from_up_down(up: DriftScan, down: DriftScan, estimator: Estimator) -> DriftVelocity:
    """Return the velocity from an up frame and a down frame, in either order, of about the same region.

    The frames are first registered without a prior. If this registration is refused, or if displacement and shear
    contradict each other (another site of a lattice, a picture with little shear), the velocity from the shear serves
    as a guess, then the velocity from the displacement. Both scans are corrected for the guessed drift and registered
    again with a prior from the guess; the remaining displacement and shear must agree. If this fails for both guesses,
    the refusal without a prior is returned.
    """
    first, second = sorted((up, down), key=lambda scan: scan.mid_s)
    time_s = (first.mid_s + second.mid_s) / 2
    if first.upwards is None or second.upwards is None or first.upwards == second.upwards:
        return DriftVelocity.refused("the scans must have opposite slow-scan directions", time_s)
    free = estimator.register(first, second)
    result = _combined(first, second, free, np.zeros(2))
    if result.accepted:
        return result
    for guess in _guesses(first, second, free):
        prior = _prior_from(first, second, free, guess)
        found = estimator.register(_freed(first, guess), _freed(second, guess), prior)
        guided = _combined(first, second, found, guess)
        if guided.accepted:
            return guided
    return result


def _guesses(first: DriftScan, second: DriftScan, free: Registration) -> list[Array]:
    sheared = velocity_by_shear(first, second, free)
    if sheared is None:
        return []
    return [sheared[0], free.displacement_m / _between_s(first, second, free)]


def _prior_from(first: DriftScan, second: DriftScan, free: Registration, guess: Array) -> Prior:
    # the prior is as uncertain as the velocity from the shear
    sheared = velocity_by_shear(first, second, free)
    covariance = np.zeros((2, 2)) if sheared is None else sheared[1]
    between_s = second.mid_s - first.mid_s
    one_px_m2 = min(first.pixel_m) ** 2
    return Prior(guess * between_s, covariance * between_s**2 + one_px_m2 * np.eye(2))


def _freed(scan: DriftScan, velocity_m_s: Array) -> DriftScan:
    x, y = (float(v) for v in velocity_m_s)
    try:
        values = undistorted(scan.values, scan.region, (x, y), scan.duration_s, upwards=scan.upwards is not False)
    except InvalidValue:  # the sample moves as fast as the scan
        return scan
    return replace(scan, values=values)


def _combined(first: DriftScan, second: DriftScan, found: Registration, freed_m_s: Array) -> DriftVelocity:
    # Combines both routes of a registration if they agree. `freed_m_s` is the drift already removed from the scans.
    time_s = (first.mid_s + second.mid_s) / 2
    sheared = velocity_by_shear(first, second, found)
    if not found.accepted or sheared is None:
        return DriftVelocity.refused(found.reason or "no shear between the scans can be found", time_s, found)
    by_shear, shear_covariance = sheared[0] + freed_m_s, sheared[1]
    between_s, middles_s = _between_s(first, second, found), second.mid_s - first.mid_s
    # corrected rows show the sample as at the middle of the scan, except for the error of the guess
    by_displacement = (found.displacement_m + freed_m_s * (between_s - middles_s)) / between_s
    covariance = found.covariance_m2 / between_s**2
    difference, both = by_displacement - by_shear, covariance + shear_covariance
    if float(difference @ np.linalg.solve(both, difference)) > _CONTRADICTION:
        return DriftVelocity.refused("the displacement between the scans contradicts their shear", time_s, found)
    share = np.linalg.solve(both, covariance).T  # weight of the velocity from the shear
    together = covariance - share @ covariance
    return DriftVelocity(
        accepted=True,
        reason="",
        velocity_m_s=by_displacement - share @ difference,
        covariance=(together + together.T) / 2,
        time_s=time_s,
        by_shear_m_s=by_shear,
        by_shear_covariance=shear_covariance,
        by_displacement_m_s=by_displacement,
        registration=found,
    )


def _between_s(first: DriftScan, second: DriftScan, found: Registration) -> float:
    # from the rows of the overlap in the first scan to its rows in the second
    there_m = found.center_m + found.displacement_m
    late_s, later_s = row_delay_s(first, found.center_m) or 0.0, row_delay_s(second, there_m) or 0.0
    return second.mid_s + later_s - first.mid_s - late_s
