"""Forecast of a bank of filters: the data for predictions, without the scans."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from afspm.basics import Plain
from afspm.components import Array, snapshot
from afspm.plugins.drift.track.filters import Filters, Models, mixed
from afspm.plugins.drift.track.mapping import Mapping
from afspm.plugins.drift.track.tracking import FORECAST_VERSION, Prediction


@dataclass(frozen=True)
class Compensation:
    """Velocity of the controller's drift compensation over time: a step function, zero at the start.

    Attributes:
        changes: (start in s, v_x, v_y in m/s), in order of time.
    """

    changes: tuple[tuple[float, float, float], ...] = ()

    def velocity_m_s(self, time_s: float) -> Array:
        velocity = (0.0, 0.0)
        for since_s, x, y in self.changes:
            if since_s <= time_s:
                velocity = (x, y)
        return np.array(velocity)

    def followed_m(self, from_s: float, to_s: float) -> Array:
        """Return the movement (2,) of tip coordinates from one time to another in m; the second time may be earlier."""
        start_s, end_s = min(from_s, to_s), max(from_s, to_s)
        edges = [start_s, *(since_s for since_s, _, _ in self.changes if start_s < since_s < end_s), end_s]
        parts = [self.velocity_m_s(a) * (b - a) for a, b in itertools.pairwise(edges)]
        followed: Array = np.sum(parts, axis=0) * (1.0 if to_s >= from_s else -1.0)
        return followed

    def changed(self, since_s: float, velocity_m_s: Array, *, needed_s: float) -> Compensation:
        """Return a copy with another velocity from a time on, without steps that ended before `needed_s`."""
        before = [change for change in self.changes if change[0] < since_s]
        while len(before) > 1 and before[1][0] <= needed_s:
            del before[0]
        return Compensation((*before, (float(since_s), float(velocity_m_s[0]), float(velocity_m_s[1]))))


_LEAST_WEIGHT = 1e-4  # filters that are less likely are left out


@dataclass(frozen=True, eq=False)
class BankForecast:
    """Forecast from the n likely filters of a bank.

    Attributes:
        time_s: time of the states.
        models: models of motion.
        weight: (n,) probabilities of the filters.
        mean: (n, 4) displacement and velocity of the sample.
        covariance: (n, 4, 4) covariance of displacement and velocity.
        compensation: velocity of tip coordinates, which follow the sample.
        straight: mapping from tip coordinates to coordinates without rotation and scale of the sample; None: identity.
    """

    KIND: ClassVar = "bank forecast"

    time_s: float
    models: Models
    weight: Array
    mean: Array
    covariance: Array
    compensation: Compensation
    straight: Mapping | None = None

    @classmethod
    def at_start(cls) -> BankForecast:
        """Return the forecast before the first scan, which is the origin of positions."""
        nothing = Models(np.zeros(1), np.zeros(1), np.zeros(1))
        return cls(0.0, nothing, np.ones(1), np.zeros((1, 4)), np.zeros((1, 4, 4)), Compensation())

    @classmethod
    def of(cls, filters: Filters, compensation: Compensation, straight: Mapping | None = None) -> BankForecast:
        """Return the forecast of a bank of filters."""
        likely = filters.weight >= _LEAST_WEIGHT
        models = filters.models
        return cls(
            filters.time_s,
            Models(models.density_m2_s3[likely], models.fading_per_s[likely], models.walk_m2_s[likely]),
            filters.weight[likely] / filters.weight[likely].sum(),
            filters.mean[likely, :4],
            filters.covariance[likely, :4, :4],
            compensation,
            straight,
        )

    def at(self, time_s: float) -> Prediction:
        step_s = time_s - self.time_s
        transition, gained = self.models.over(step_s)
        means = (transition @ self.mean[..., None])[..., 0]
        means[:, :2] -= self.compensation.followed_m(self.time_s, time_s)
        means[:, 2:] -= self.compensation.velocity_m_s(time_s)
        covariances = transition @ self.covariance @ transition.transpose(0, 2, 1) + gained
        mean, covariance = mixed(self.weight, means, covariances)
        mapping = Mapping.of_drift(mean[:2])
        if self.straight is not None:
            mapping = mapping @ self.straight
        return Prediction(time_s, mapping, covariance[:2, :2], mean[2:], covariance[2:, 2:])

    def to_dict(self) -> Plain:
        return snapshot(self, self.KIND, FORECAST_VERSION, lists=True)
