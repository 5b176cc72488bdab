"""`PaperTracker`, the tracker of the paper: first-order prediction, corrected by the oldest scan that fits.

Sullivan, Valdés, Bevan and Grutter, Beilstein J. Nanotechnol. 2026, 17, 653, "Overarching Workflow" and supporting
information, "Drift Correction Algorithm".
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from afspm.basics import ConfigError, Plain, PlainMapping
from afspm.components import Array, restored, snapshot
from afspm.plugins.drift.doubt.plausibility import unlike_drift
from afspm.plugins.drift.pairs.overlap import intersection_ratio, sr_norm
from afspm.plugins.drift.registration import DriftScan, Estimator, Registration
from afspm.plugins.drift.track.mapping import Mapping
from afspm.plugins.drift.track.tracking import FORECAST_VERSION, Forecast, Prediction, Update, require_newer

TRANSFORMS = ("translation", "euclidean", "similarity", "affine")


def transform_between(found: Registration, form: str) -> Mapping:
    """Return the transform from tip coordinates of the reference to tip coordinates of the scan.

    The result is the transform of the given form that is nearest to the registration.
    """
    linear = _of_form(np.eye(2) + found.linear, form)
    center = found.center_m if form != "translation" else np.zeros(2)
    return Mapping.of(linear, center + found.displacement_m - linear @ center)


def _of_form(linear: Array, form: str) -> Array:
    # the nearest 2 x 2 matrix of a form, by least squares of its elements
    if form == "translation":
        return np.eye(2)
    if form == "affine":
        return linear
    (a, b), (c, d) = linear
    cos, sin = (a + d) / 2, (c - b) / 2
    if form == "euclidean":
        length = math.hypot(cos, sin)
        cos, sin = cos / length, sin / length
    return np.array([[cos, -sin], [sin, cos]])


def logarithm(matrix: Array) -> Array:
    """Return the real matrix X (3 x 3) with exp X = matrix; exact for a translation."""
    if np.array_equal(matrix[:2, :2], np.eye(2)):
        return np.asarray(matrix - np.eye(3))
    from scipy.linalg import logm

    return np.asarray(logm(matrix)).real


def exponential(matrix: Array) -> Array:
    """Return exp X with the last row 0 0 1, 3 x 3; exact for a translation."""
    if not matrix[:2, :2].any():
        return np.asarray(np.eye(3) + matrix)
    from scipy.linalg import expm

    made = np.asarray(expm(matrix))
    made[2] = (0.0, 0.0, 1.0)  # rounding
    return made


VERSION = 2
_MEMORY = 0.7  # weight of the previous mean square of the residuals


@dataclass(frozen=True, eq=False)
class PaperForecast:
    """Forecast from M_tot of the newest scan and the rate of the last step.

    Attributes:
        time_s: middle of the newest scan.
        matrix: (3, 3) M_k.
        rate: (3, 3) logarithm of the last step over its duration, 1/s.
        covariance_m2: (2, 2) covariance of the newest scan's position.
        rate_covariance: (2, 2) covariance of the translation rate, (m/s)².
    """

    KIND: ClassVar = "paper forecast"

    time_s: float
    matrix: Array
    rate: Array
    covariance_m2: Array
    rate_covariance: Array

    def at(self, time_s: float) -> Prediction:
        """Return the prediction for a time: M_k times the step at the last rate.

        If this step would stretch the sample implausibly, only its translation is used.
        """
        since_s = time_s - self.time_s
        step = exponential(self.rate * since_s)
        if not np.isfinite(step).all() or unlike_drift(step[:2, :2]):
            step = np.eye(3)
            step[:2, 2] = self.rate[:2, 2] * since_s
        mapping = Mapping(self.matrix @ step)
        # x_S = M x_T stays while M moves, so in tip coordinates the sample moves by minus the rate.
        velocity = -self.rate[:2, 2]
        covariance = self.covariance_m2 + since_s**2 * self.rate_covariance
        return Prediction(time_s, mapping, covariance, velocity, self.rate_covariance)

    def to_dict(self) -> Plain:
        return snapshot(self, self.KIND, FORECAST_VERSION, lists=True)


@dataclass(frozen=True, eq=False)
class PlacedScan:
    """A scan in the queue C, with its mapping M_j."""

    scan: DriftScan
    mapping: Mapping


@dataclass(eq=False)
class PaperState:
    """Complete saved state of a tracker.

    Attributes:
        forecast: forecast after the newest scan.
        newest_s: middle of the newest scan; None before the first.
        residual_m2: running mean square of the residuals; None before the first comparison.
        unmatched: number of scans in a row that should have matched, but did not.
        queue: the queue C, oldest scan first.
    """

    forecast: PaperForecast = PaperForecast(0.0, np.eye(3), np.zeros((3, 3)), np.zeros((2, 2)), np.zeros((2, 2)))
    newest_s: float | None = None
    residual_m2: float | None = None
    unmatched: int = 0
    queue: deque[PlacedScan] = field(default_factory=deque)


class PaperTracker:
    """Tracker with the unchanged scheme of the paper.

    Each scan is first predicted, M'_k = M_(k-1) dM^_k with dM^_k the rate of the last step times the time since, and
    then corrected by the residual dM~_k against the oldest scan of the queue for which estimation succeeds:
    M_k = M'_k dM~_k. Choices that the paper leaves open: times are the middles of the scans; without a rate the
    predicted step is the identity; an unmatched scan joins the queue at its predicted place. The paper defines no
    uncertainty: here the variance of a prediction is the mean square of the last residuals.

    Args:
        estimator: estimator for registrations, without a prior.
        transform: form of the mapping, "translation", "euclidean", "similarity" or "affine".
        w_update: weight of the estimated residual; 0: prediction alone.
        queue: number l of stored scans.
        f_min: least intersection ratio of a pair of scans, in sample coordinates.
        sr_norm_min: least ratio of the resolutions of a pair.
        lost_after: number of scans in a row that should have matched, but did not, after which the tracker is lost
            (added by afspm; the paper continues).

    Raises:
        ConfigError: a setting is invalid.
    """

    def __init__(
        self,
        estimator: Estimator,
        *,
        transform: str = "translation",
        w_update: float = 1.0,
        queue: int = 5,
        f_min: float = 0.5,
        sr_norm_min: float = 0.25,
        lost_after: int = 3,
    ) -> None:
        if transform not in TRANSFORMS:
            raise ConfigError(f"no transform {transform!r}", where="transform", hint=f"one of {', '.join(TRANSFORMS)}")
        for name, value in (("w_update", w_update), ("f_min", f_min), ("sr_norm_min", sr_norm_min)):
            if not 0.0 <= value <= 1.0:
                raise ConfigError(f"{value} is not between 0 and 1", where=name)
        for name, number in (("queue", queue), ("lost_after", lost_after)):
            if number < 1:
                raise ConfigError(f"{number} is less than one scan", where=name)
        self._estimator = estimator
        self._transform, self._w_update, self._lost_after = transform, w_update, lost_after
        self._f_min, self._sr_norm_min = f_min, sr_norm_min
        self._length = queue
        self._state = PaperState()

    @property
    def forecast(self) -> Forecast:
        return self._state.forecast

    def add(self, scan: DriftScan) -> Update:
        state = self._state
        require_newer(scan, state.newest_s)
        first = state.newest_s is None
        before = state.forecast.at(scan.mid_s)
        placed, tried, reason = (None, {}, "") if first else self._match(scan, before.mapping)
        matched = first or placed is not None
        mapping = before.mapping if placed is None else self._averaged(before.mapping, placed)
        # only a refusal in an overlap counts: an error of the estimator means nothing about the sample
        state.unmatched = 0 if matched else state.unmatched + any(not one.failure for one in tried.values())
        self._step(scan, before, mapping, [one for one in tried.values() if one.accepted])
        state.queue.append(PlacedScan(scan, mapping))
        while len(state.queue) > self._length:
            state.queue.popleft()
        return Update(
            key=scan.key,
            before=before,
            after=state.forecast.at(scan.mid_s),
            matched=matched,
            reason=reason,
            lost=state.unmatched >= self._lost_after,
            registrations=tried,
            forecast=state.forecast,
            quality={"candidates": float(len(tried))},
        )

    def _match(self, scan: DriftScan, predicted: Mapping) -> tuple[Mapping | None, dict[str, Registration], str]:
        # M_k from the oldest scan of D whose estimation succeeds, all tries, and the reason for none
        region = predicted.to_sample(scan.region)
        tried: dict[str, Registration] = {}
        for old in self._state.queue:
            ratio = intersection_ratio(old.mapping.to_sample(old.scan.region), region)
            alike = sr_norm(old.scan.region, old.scan.values.shape, scan.region, scan.values.shape)
            if ratio < self._f_min or alike < self._sr_norm_min:
                continue
            found = self._estimator.register(old.scan, scan)
            tried[old.scan.key] = found
            if found.accepted:
                return old.mapping @ transform_between(found, self._transform).inverse, tried, found.failure
        if tried:
            failed = (one.failure for one in tried.values() if one.failure)
            return None, tried, next(failed, next(reversed(tried.values())).reason)
        return None, tried, "no scan of the queue overlaps enough with it"

    def _averaged(self, predicted: Mapping, estimated: Mapping) -> Mapping:
        # M'_k dM~_k, with dM~_k shortened to the believed share
        if self._w_update == 1.0:
            return estimated
        residual = predicted.inverse @ estimated
        return predicted @ Mapping(exponential(self._w_update * logarithm(residual.matrix)))

    def _step(self, scan: DriftScan, before: Prediction, mapping: Mapping, used: list[Registration]) -> None:
        # dM_k = dM^_k dM~_k makes the next rate
        state = self._state
        since_s = 0.0 if state.newest_s is None else scan.mid_s - state.newest_s
        rate, covariance = state.forecast.rate, before.covariance_m2
        if used:
            covariance = used[-1].covariance_m2
            center = scan.region.center_m
            residual_m2 = float(np.sum((mapping.apply(center) - before.mapping.apply(center)) ** 2) / 2)
            kept = state.residual_m2
            state.residual_m2 = residual_m2 if kept is None else _MEMORY * kept + (1 - _MEMORY) * residual_m2
            if since_s > 0.0:
                step = Mapping(state.forecast.matrix).inverse @ mapping
                rate = logarithm(step.matrix) / since_s
        spread_m2 = state.residual_m2
        if spread_m2 is None:  # nothing has been compared yet
            spread_m2 = (min(scan.region.size_m) / 4) ** 2
        usual_s = since_s if since_s > 0.0 else max(scan.duration_s, 1.0)
        rate_covariance = np.eye(2) * (spread_m2 / usual_s**2)
        state.forecast = PaperForecast(scan.mid_s, mapping.matrix, rate, covariance, rate_covariance)
        state.newest_s = scan.mid_s

    def state(self) -> Plain:
        return snapshot(self._state, "paper", VERSION)

    def restore(self, state: PlainMapping) -> None:
        """Restore the result of `state`. Raises InvalidValue for the state of another tracker."""
        self._state = restored(PaperState, state, "paper", VERSION)
