"""A laboratory for trackers: a sample with a given drift, a microscope that follows it, and an ideal estimator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.pairs.overlap import intersection_ratio, overlap_center_m
from afspm.plugins.drift.registration import DriftScan, Prior, Registration
from afspm.plugins.drift.track.shear import row_delay_s
from afspm.plugins.drift.track.tracking import Tracker, Update

Drift = Callable[[Any], Array]
"""Returns the displacement (x, y) at a time, or at an array of times: shape of the times + (2,)."""

SIZE_M = 2e-6
INTERVAL_S = 900.0
FRAME_S = 256.0


def still(times_s: Any) -> Array:
    return np.zeros((*np.shape(times_s), 2))


def steady(velocity_m_s: tuple[float, float]) -> Drift:
    return lambda times_s: np.multiply.outer(times_s, np.array(velocity_m_s))


def walked(times_s: Any, known_s: Array, walk_m: Array) -> Array:
    """Return positions (x, y) of a walk with known positions [time, 2] at some times."""
    return np.stack([np.interp(times_s, known_s, walk_m[:, axis]) for axis in range(2)], axis=-1)


@dataclass
class World:
    """The place of the sample, x_tip = x_sample + drift(t), and an ideal estimator for it.

    Attributes:
        noise_m: standard deviation of each scan's location error.
        blind: keys of scans with which nothing can be registered.
        wrong: by the key of a scan, an error added to each displacement in it.
        asked: (key of the reference, key of the scan, prior) of every registration.
    """

    drift_m: Drift = still
    noise_m: float = 0.2e-9
    seed: int = 0
    blind: set[str] = field(default_factory=set)
    wrong: dict[str, Array] = field(default_factory=dict)
    asked: list[tuple[str, str, Prior | None]] = field(default_factory=list)
    location_errors: dict[str, Array] = field(default_factory=dict)

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        """Return the displacement at the middle of the overlap, at the times of its rows."""
        self.asked.append((reference.key, scan.key, prior))
        if {reference.key, scan.key} & self.blind:
            return Registration.refused("blind")
        displacement = self.drift_m(scan.mid_s) - self.drift_m(reference.mid_s)
        there = scan.region.moved_to(tuple(np.array(scan.region.center_m) - displacement))
        if intersection_ratio(reference.region, there) < 0.2:
            return Registration.refused("they show different parts")
        center = overlap_center_m(reference.region, scan.region, displacement)
        assert center is not None
        found = self._seen(scan, center + displacement) - self._seen(reference, center)
        found = found + self.wrong.get(scan.key, np.zeros(2))
        if prior is not None:
            off = found - prior.mean_m
            if off @ np.linalg.solve(prior.covariance_m2, off) > 25.0:
                return Registration.refused("not where it was expected")
        covariance = np.eye(2) * 2 * max(self.noise_m, 1e-13) ** 2
        return Registration(True, "", found, covariance, np.zeros((2, 2)), center)

    def _seen(self, scan: DriftScan, position_m: Array) -> Array:
        if scan.key not in self.location_errors:
            random = np.random.default_rng([self.seed, len(self.location_errors)])
            self.location_errors[scan.key] = self.noise_m * random.standard_normal(2)
        delay_s = row_delay_s(replace(scan, upwards=scan.upwards is not False), position_m)
        assert delay_s is not None
        return self.drift_m(scan.mid_s + delay_s) + self.location_errors[scan.key]


def scan_at(
    time_s: float,
    center_m: tuple[float, float] | Array = (0.0, 0.0),
    *,
    size_m: float = SIZE_M,
    pixels: int = 8,
    upwards: bool | None = True,
    key: str = "",
    frame_s: float = FRAME_S,
) -> DriftScan:
    """Return a scan with its middle at a time."""
    x, y = center_m
    region = Region((float(x), float(y)), (size_m, size_m))
    half_s = frame_s / 2
    return DriftScan(
        np.zeros((pixels, pixels)), region, time_s - half_s, time_s + half_s, upwards, key or f"{time_s:g}"
    )


def follow(tracker: Tracker, count: int, *, first: int = 0, sample_m: tuple[float, float] = (0.0, 0.0)) -> list[Update]:
    """Take scans of one place of the sample, each at the tracker's prediction."""
    updates = []
    for k in range(first, first + count):
        time_s = FRAME_S + k * INTERVAL_S
        tip = tracker.forecast.at(time_s).mapping.inverse.apply(sample_m)
        updates.append(tracker.add(scan_at(time_s, tip, key=f"scan {k}")))
    return updates
