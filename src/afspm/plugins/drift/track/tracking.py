"""Interface of all trackers, and the data that they exchange."""

from __future__ import annotations

from collections.abc import Mapping as Table
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from afspm.basics import InvalidValue, Plain, PlainMapping
from afspm.components import Array
from afspm.model import RegistrationOutcome
from afspm.plugins.drift.registration import DriftScan, Registration
from afspm.plugins.drift.track.mapping import Mapping

FORECAST_VERSION = 2
"""Version of all forecasts as plain data."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted mapping to sample coordinates at one time, with its uncertainty.

    Attributes:
        time_s: experiment time.
        mapping: mapping from tip to sample coordinates.
        covariance_m2: (2, 2) covariance of the mapping's translation.
        rate_m_s: (2,) velocity of the sample in tip coordinates.
        rate_covariance: (2, 2) covariance of the rate, (m/s)².
    """

    time_s: float
    mapping: Mapping
    covariance_m2: Array
    rate_m_s: Array
    rate_covariance: Array

    @property
    def sd_m(self) -> float:
        """Standard deviation of a position along its most uncertain axis."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance_m2)[-1], 0.0)))


class Forecast(Protocol):
    """A tracker's predictions for any time: small, immutable and convertible to JSON, without the scans."""

    def at(self, time_s: float) -> Prediction:
        """Return the prediction for any time; before the newest scan, by extrapolation backwards."""
        ...

    def to_dict(self) -> Plain:
        """Return plain JSON, for `forecast_from_dict`."""
        ...


@dataclass(frozen=True, eq=False)
class Update:
    """Result of adding one scan to a tracker.

    Attributes:
        key: key of the scan.
        before: prediction for the middle of the scan, without the scan.
        after: estimate for the same time, with the scan.
        matched: whether a registration determines the position of the scan; true for the very first scan. A
            registration that the tracker does not use, such as a doubtful result, does not count.
        reason: reason why the scan did not match, or only coarsely, for people.
        lost: whether the position of the sample is unknown.
        registrations: registrations by key of the reference.
        forecast: forecast after this scan.
    """

    key: str
    before: Prediction
    after: Prediction
    matched: bool
    reason: str
    lost: bool
    registrations: Table[str, Registration]
    forecast: Forecast
    quality: Table[str, float] = field(default_factory=dict)

    @property
    def outcome(self) -> RegistrationOutcome:
        """Outcome for the position of the scan, judged by all its registrations."""
        found = self.registrations.values()
        if self.matched:
            accepted = [one for one in found if one.accepted]
            is_coarse = bool(accepted) and all(one.failure for one in accepted)
            return RegistrationOutcome.COARSE if is_coarse else RegistrationOutcome.REGISTERED
        if not found:
            return RegistrationOutcome.NEW
        is_failed = any(one.failure for one in found)
        return RegistrationOutcome.FAILED if is_failed else RegistrationOutcome.REFUSED


def require_newer(scan: DriftScan, newest_s: float | None) -> None:
    """Raise InvalidValue for a scan with its middle before `newest_s`, the middle of the newest scan; None: no scan."""
    if newest_s is not None and scan.mid_s < newest_s:
        late = f"the middle of scan {scan.key!r} is at {scan.mid_s:g} s, and {newest_s:g} s was reached already"
        raise InvalidValue(late, hint="give a tracker its scans in the order of time")


class Tracker(Protocol):
    """Method to track drift from scan to scan. Deterministic: the same scans give the same numbers."""

    @property
    def forecast(self) -> Forecast:
        """Forecast based on all scans so far."""
        ...

    def add(self, scan: DriftScan) -> Update:
        """Add a scan, in the order of time. Raises InvalidValue for a scan older than the newest."""
        ...

    def state(self) -> Plain:
        """Return the complete state to save: numbers, texts, lists and dicts of JSON, and numpy arrays."""
        ...

    def restore(self, state: PlainMapping) -> None:
        """Restore the result of `state`."""
        ...
