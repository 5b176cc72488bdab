"""A bank of Kalman filters that share their measurements and differ in their models of motion.

The state of each filter is (x, y, v_x, v_y), the displacement of the sample and its velocity, followed by four values
for each stored scan: displacement and velocity of the sample during this scan. These stay correlated with each other
and with the drift, so repeated comparisons with one scan are not counted as independent, and later measurements correct
earlier measurements (as landmarks in simultaneous localisation and mapping: Smith, Self and Cheeseman 1990).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from afspm.components import Array

_SHORT = 1e-2  # share of the fading time: below, differences of exponentials lose digits, and a series is exact enough


@dataclass(frozen=True, eq=False)
class Models:
    """Parameters of n models of motion.

    Attributes:
        density_m2_s3: (n,) q, spectral density of the acceleration.
        fading_per_s: (n,) 1 / tau; 0 for a constant velocity.
        walk_m2_s: (n,) variance per second of a random walk of the position.
    """

    density_m2_s3: Array
    fading_per_s: Array
    walk_m2_s: Array

    def wandered_m2(self, duration_s: float) -> Array:
        """Return the variance (n,) of the mean position over the rows of a scan minus the position in its middle.

        The cause is a random walk of the position and a random acceleration.
        """
        return np.asarray(self.walk_m2_s * duration_s / 12 + self.density_m2_s3 * duration_s**3 / 320)

    def over(self, step_s: float) -> tuple[Array, Array]:
        """Return transition matrix and added covariance, (n, 4, 4) each, of a state (x, y, v_x, v_y) over a time step.

        A negative step goes back in a straight line, and adds the same variances.
        """
        a, q, t = self.fading_per_s, self.density_m2_s3, abs(step_s)
        reach_s = np.full_like(a, step_s)  # distance per initial velocity
        left = np.ones_like(a)  # remaining share of the velocity
        if step_s > 0.0:
            left = np.exp(-a * t)
            reach_s = np.where(a > 0.0, -np.expm1(-a * t) / np.where(a > 0.0, a, 1.0), t)
        position, both, velocity = _gained(a, t)
        transition = np.zeros((len(a), 2, 2))
        transition[:, 0, 0], transition[:, 0, 1], transition[:, 1, 1] = 1.0, reach_s, left
        gained = np.zeros_like(transition)
        gained[:, 0, 0], gained[:, 1, 1] = q * position + self.walk_m2_s * t, q * velocity
        gained[:, 0, 1] = gained[:, 1, 0] = q * both * (1.0 if step_s >= 0.0 else -1.0)
        return _both_axes(transition), _both_axes(gained)


def _gained(a: Array, t: float) -> tuple[Array, Array, Array]:
    # variance of position, covariance with and variance of velocity after a time, for q = 1
    x = a * t
    short = x < _SHORT
    b = np.where(short, 1.0, a)
    fade = np.exp(-np.where(short, 0.0, x))
    position = np.where(
        short, t**3 / 3 * (1 - 3 / 4 * x + 7 / 20 * x**2), (t - 2 * (1 - fade) / b + (1 - fade**2) / (2 * b)) / b**2
    )
    both = np.where(short, t**2 / 2 * (1 - x + 7 / 12 * x**2), (1 - fade) ** 2 / (2 * b**2))
    velocity = np.where(short, t * (1 - x + 2 / 3 * x**2), (1 - fade**2) / (2 * b))
    return position, both, velocity


def _both_axes(one: Array) -> Array:
    both = np.zeros((len(one), 4, 4))
    both[:, 0::2, 0::2] = one
    both[:, 1::2, 1::2] = one
    return both


@dataclass(frozen=True, eq=False)
class Filters:
    """Bank of n filters with s state variables each; immutable.

    Attributes:
        models: model of motion of each filter.
        time_s: time of all states.
        mean: (n, s) state, m and m/s.
        covariance: (n, s, s) covariance of the state.
        log_weight: (n,) logarithm of the filters' probabilities.
    """

    models: Models
    time_s: float
    mean: Array
    covariance: Array
    log_weight: Array

    @classmethod
    def start(
        cls, models: Models, time_s: float, position_sd_m: float, velocity_sd_m_s: float, duration_s: float
    ) -> Filters:
        """Return the filters after the first scan, which is the origin of positions.

        Args:
            position_sd_m: location error of the first scan.
            duration_s: duration of the scan.
        """
        n = len(models.density_m2_s3)
        position = position_sd_m**2 + models.wandered_m2(duration_s)[:, None, None]
        covariance = np.zeros((n, 8, 8))
        covariance[:, :2, :2] = position * np.eye(2)
        for one in (2, 6):  # the velocity now, and during the scan
            for other in (2, 6):
                covariance[:, one : one + 2, other : other + 2] = velocity_sd_m_s**2 * np.eye(2)
        return cls(models, time_s, np.zeros((n, 8)), covariance, np.full(n, -np.log(n)))

    @property
    def weight(self) -> Array:
        """Probabilities of the filters, (n,), with the sum 1."""
        weight = np.exp(self.log_weight - self.log_weight.max())
        return np.asarray(weight / weight.sum())

    def wandered_m2(self, duration_s: float) -> float:
        """Return `Models.wandered_m2`, averaged over the filters."""
        return float(self.weight @ self.models.wandered_m2(duration_s))

    def moved(self, time_s: float, followed_m: Array) -> Filters:
        """Return the filters at a later time, in tip coordinates that have moved by `followed_m` (2,) meanwhile."""
        step_s = time_s - self.time_s
        transition, gained = self.models.over(step_s)
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[:, :4] = (transition @ mean[:, :4, None])[..., 0]
        mean[:, :2] -= followed_m
        covariance[:, :4, :] = transition @ covariance[:, :4, :]
        covariance[:, :, :4] = covariance[:, :, :4] @ transition.transpose(0, 2, 1)
        covariance[:, :4, :4] += gained
        return replace(self, time_s=time_s, mean=mean, covariance=covariance)

    def widened(self, position_sd_m: float, velocity_sd_m_s: float, scans: Sequence[int] = ()) -> Filters:
        """Return the filters with less certain present position and velocity.

        The positions of the given scans become uncertain by the same unknown distance.
        """
        covariance = self.covariance.copy()
        for axis in range(2):
            together = [axis, *(4 + 4 * number + axis for number in scans)]
            for state in together:
                covariance[:, state, together] += position_sd_m**2
            covariance[:, 2 + axis, 2 + axis] += velocity_sd_m_s**2
        return replace(self, covariance=covariance)

    def with_scan(self, noise_m2: Array, duration_s: float) -> Filters:
        """Return the filters with the newest scan added: its location error (2, 2), and the motion during the scan."""
        mean = np.concatenate([self.mean, self.mean[:, :4]], axis=1)
        rows = np.concatenate([self.covariance, self.covariance[:, :4, :]], axis=1)
        covariance = np.concatenate([rows, rows[:, :, :4]], axis=2)
        covariance[:, -4:-2, -4:-2] += noise_m2 + self.models.wandered_m2(duration_s)[:, None, None] * np.eye(2)
        return replace(self, mean=mean, covariance=covariance)

    def without_scan(self, number: int) -> Filters:
        kept = np.delete(np.arange(self.mean.shape[1]), range(4 + 4 * number, 8 + 4 * number))
        return replace(self, mean=self.mean[:, kept], covariance=self.covariance[:, kept][:, :, kept])

    def scan_drifts_m(self) -> Array:
        """Return the displacement in each stored scan, averaged over the filters, (scans, 2)."""
        mean: Array = (self.weight @ self.mean)[4:].reshape(-1, 4)[:, :2]
        return mean

    def velocity(self, number: int | None = None) -> tuple[Array, Array]:
        """Return mean (2,) and covariance (2, 2) of the velocity during a stored scan, or of the present velocity."""
        return self.mixed(self.velocity_rows(number))

    def velocity_rows(self, number: int | None = None) -> Array:
        """Return the rows (2, s) whose product with the state is the velocity during a stored scan, or at present."""
        first = 2 if number is None else 6 + 4 * number
        return np.eye(self.mean.shape[1])[first : first + 2]

    def mixed(self, rows: Array) -> tuple[Array, Array]:
        """Return mean (m,) and covariance (m, m) of the product `rows @ state`, as a mixture over all filters.

        `rows` is (m, s).
        """
        return mixed(self.weight, self.mean @ rows.T, rows @ self.covariance @ rows.T)

    def with_velocity(self, time_s: float, velocity_m_s: Array, covariance: Array, *, rarest: float) -> Filters:
        """Update with a velocity of the sample, measured at about the time of the filters."""
        # between both times the velocity may have changed
        elsewhen = self.models.over(abs(self.time_s - time_s))[1][:, 2:, 2:]
        return self.updated(self.velocity_rows(), velocity_m_s, covariance + elsewhen, forget=1.0, rarest=rarest)

    def updated(self, rows: Array, measured: Array, noise: Array, *, forget: float, rarest: float) -> Filters:
        """Update with the measurement `measured` (m,) = `rows` (m, s) @ state + noise.

        `noise` is a covariance (m, m), or a covariance for each filter (n, m, m).

        Args:
            forget: share of the logarithm of the old weights that is kept.
            rarest: least weight relative to the largest, so that a filter that was wrong for long can recover.
        """
        innovation = measured - self.mean @ rows.T
        crossed = self.covariance @ rows.T
        expected = rows @ crossed + noise
        gain = np.linalg.solve(expected, crossed.transpose(0, 2, 1)).transpose(0, 2, 1)
        mean = self.mean + (gain @ innovation[..., None])[..., 0]
        # Joseph's form keeps the covariance positive definite
        left = np.eye(self.mean.shape[1]) - gain @ rows
        covariance = left @ self.covariance @ left.transpose(0, 2, 1) + gain @ noise @ gain.transpose(0, 2, 1)
        covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
        chi2 = (innovation * np.linalg.solve(expected, innovation[..., None])[..., 0]).sum(axis=1)
        log_weight = forget * self.log_weight - (chi2 + np.linalg.slogdet(expected)[1]) / 2
        log_weight = np.maximum(log_weight - log_weight.max(), np.log(rarest))
        log_weight -= np.log(np.exp(log_weight).sum())
        return replace(self, mean=mean, covariance=covariance, log_weight=log_weight)


def mixed(weight: Array, mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Return mean (m,) and covariance (m, m) of a mixture with weights (n,), means (n, m), covariances (n, m, m)."""
    total = weight @ mean
    apart = mean - total
    spread = np.einsum("n,nij->ij", weight, covariance) + np.einsum("n,ni,nj->ij", weight, apart, apart)
    return total, (spread + spread.T) / 2
