"""What drift does to an image while it is taken, and the velocity that two opposite frames tell.

Rows are taken one after the other, so a feature at `p` when half of the scan is done is found at
x = p + v a e.(x - c), with c the centre, e the direction of the slow axis and a the time per length along it, negative
when scanning down. Two scans with a_1 and a_2 are then related by 1 + A = (1 - a_2 v e')^-1 (1 - a_1 v e'), that is
A e = v (a_2 - a_1) / (1 - a_2 v.e): an up frame and a down frame differ by a shear and a stretch of 2 v for each height
per duration, whatever lies in between. That is a velocity without a lattice's ambiguity; the displacement between
their middles is another, more precise one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.drift.registration import DriftScan, Estimator, Prior, Registration

Array = NDArray[np.float64]

_SAFETY = 2.0  # of the standard deviation of the shear, which is derived from that of the displacement
_CONTRADICTION = 16.0  # chi2 of both routes' difference


@dataclass(frozen=True, eq=False)
class DriftVelocity:
    """The absolute velocity of the sample in tip coordinates.

    Attributes:
        accepted: whether it may be used.
        reason: why not, for a person.
        velocity_m_s: (2,); NaN where nothing could be found.
        covariance: (2, 2) of it, (m/s)².
        time_s: the middle of the two scans, for which it holds.
        by_shear_m_s, by_displacement_m_s: (2,) what each route says by itself.
        registrations: what it rests on, the last one used.
    """

    accepted: bool
    reason: str
    velocity_m_s: Array
    covariance: Array
    time_s: float
    by_shear_m_s: Array
    by_displacement_m_s: Array
    registrations: tuple[Registration, ...] = ()

    @classmethod
    def refused(cls, reason: str, time_s: float, registrations: tuple[Registration, ...] = ()) -> DriftVelocity:
        """Nothing that may be used."""
        unknown = np.full(2, np.nan)
        return cls(
            accepted=False,
            reason=reason,
            velocity_m_s=unknown,
            covariance=np.full((2, 2), np.nan),
            time_s=time_s,
            by_shear_m_s=unknown,
            by_displacement_m_s=unknown,
            registrations=registrations,
        )


def slow_axis(scan: DriftScan) -> Array:
    """(2,) unit vector along which rows follow each other with ascending y, in tip coordinates."""
    angle = scan.region.angle_rad
    return np.array([-math.sin(angle), math.cos(angle)])


def delay_per_length_s_m(scan: DriftScan) -> float | None:
    """a: how much later a position that lies further along the slow axis is taken; None where the direction is not
    known."""
    if scan.upwards is None:
        return None
    return (1.0 if scan.upwards else -1.0) * scan.duration_s / scan.region.size_m[1]


def row_delay_s(scan: DriftScan, position_m: Array) -> float | None:
    """How long after its middle a scan passes a position of tip coordinates; None where its direction is not known."""
    a = delay_per_length_s_m(scan)
    return None if a is None else a * float(slow_axis(scan) @ (position_m - np.array(scan.region.center_m)))


def velocity_by_shear(reference: DriftScan, scan: DriftScan, found: Registration) -> tuple[Array, Array] | None:
    """Velocity (2,) and its covariance from the shear between scans of different directions or speeds.

    Its covariance takes what is in the image as spread evenly over it: a slope over a height h is then known to
    sqrt(12) / h of what the displacement is known to.

    Returns:
        None where both were sheared alike, a direction is not known, or nothing was found.
    """
    first, second = delay_per_length_s_m(reference), delay_per_length_s_m(scan)
    if first is None or second is None or not np.isfinite(found.covariance_m2).all():
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
    return slope / shrunk, covariance


def velocity_from_up_down(up: DriftScan, down: DriftScan, estimator: Estimator) -> DriftVelocity:
    """The velocity from an up frame and the down frame after it (or the other way round), of about the same region.

    Registers them freely; where that is refused or contradicts the shear (another site of a lattice), once more with
    what the shear says as prior.
    """
    first, second = sorted((up, down), key=lambda scan: scan.mid_s)
    time_s = (first.mid_s + second.mid_s) / 2
    if first.upwards is None or second.upwards is None or first.upwards == second.upwards:
        return DriftVelocity.refused("they need to be scanned in opposite directions", time_s)
    free = estimator.register(first, second)
    result = _combined(first, second, (free,))
    sheared = velocity_by_shear(first, second, free)
    if result.accepted or sheared is None:
        return result
    guided = estimator.register(first, second, _prior_from(first, second, sheared))
    return _combined(first, second, (free, guided))


def _prior_from(first: DriftScan, second: DriftScan, sheared: tuple[Array, Array]) -> Prior:
    """The displacement of the second scan that a velocity lets expect."""
    velocity, covariance = sheared
    between_s = second.mid_s - first.mid_s
    half_px = 0.25 * min(first.pixel_m) ** 2
    return Prior(velocity * between_s, covariance * between_s**2 + half_px * np.eye(2))


def _combined(first: DriftScan, second: DriftScan, tried: tuple[Registration, ...]) -> DriftVelocity:
    """Both routes of the last registration, put together if they agree."""
    found, time_s = tried[-1], (first.mid_s + second.mid_s) / 2
    sheared = velocity_by_shear(first, second, found)
    if not found.accepted or sheared is None:
        reason = found.reason or "there is no shear to be found between them"
        return DriftVelocity.refused(reason, time_s, tried)
    by_shear, shear_covariance = sheared
    there_m = found.center_m + found.displacement_m
    between_s = second.mid_s + _delay_s(second, there_m) - first.mid_s - _delay_s(first, found.center_m)
    by_displacement, covariance = found.displacement_m / between_s, found.covariance_m2 / between_s**2
    difference, both = by_displacement - by_shear, covariance + shear_covariance
    if float(difference @ np.linalg.solve(both, difference)) > _CONTRADICTION:
        return DriftVelocity.refused("the displacement between them contradicts their shear", time_s, tried)
    share = np.linalg.solve(both, covariance).T  # of the shear
    together = covariance - share @ covariance
    return DriftVelocity(
        accepted=True,
        reason="",
        velocity_m_s=by_displacement - share @ difference,
        covariance=(together + together.T) / 2,
        time_s=time_s,
        by_shear_m_s=by_shear,
        by_displacement_m_s=by_displacement,
        registrations=tried,
    )


def _delay_s(scan: DriftScan, position_m: Array) -> float:
    return row_delay_s(scan, position_m) or 0.0
