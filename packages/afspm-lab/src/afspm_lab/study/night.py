"""One simulated night in a single process: scans at a fixed interval, and a tracker that follows the sample."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from afspm.components import Array
from afspm.emulation import World
from afspm.model import Frame, Region
from afspm.plugins.drift.estimators import estimator
from afspm.plugins.drift.pairs.overlap import too_far_off, too_little_shared
from afspm.plugins.drift.registration import DriftScan
from afspm.plugins.drift.track import tracker
from afspm.plugins.drift.track.record import DriftRecord
from afspm.plugins.drift.track.tracking import Tracker, Update
from afspm_lab.study.settings import NightSettings

SETTLED_S = 7200.0  # at the start the rate is unknown; the metrics judge tracking after that
_95_PERCENT = -2.0 * math.log(0.05)  # of the square of a normal error of two components, in standard deviations


@dataclass(frozen=True, eq=False)
class SimulatedNight:
    """Outcome of a simulated night. Misplacement is the distance of a scan from its intended place on the sample.

    Attributes:
        record: drift record of all scans, except the second direction of the first scan.
        truth_m: (n, 2) true drift at the middle of each scan, relative to the first scan.
        rescans: number of rescans.
        lost: whether the tracker lost the sample at any time.
    """

    record: DriftRecord
    truth_m: Array
    rescans: int
    lost: bool

    @property
    def misplaced_m(self) -> Array:
        """Misplacement of each scan, (n,), in m."""
        off: Array = np.hypot(*(self.truth_m - (self.record.center_m - self.record.center_m[:1])).T)
        return off

    @property
    def unknown_m(self) -> Array:
        """Estimated minus true drift after each scan, (n, 2), in m."""
        return self.record.drift_m - self.record.drift_m[:1] - self.truth_m

    def metrics(self) -> dict[str, float]:
        """Return the metrics for comparing nights, by name; lengths in nm, "within 95 %" in per cent of the scans."""
        settled = self.record.time_s - self.record.time_s[0] >= min(SETTLED_S, np.ptp(self.record.time_s) / 4)
        misplaced, unknown = 1e9 * self.misplaced_m, self.unknown_m
        inverse = np.linalg.pinv(self.record.covariance_m2[1:])
        surprise = np.einsum("ni,nij,nj->n", unknown[1:], inverse, unknown[1:])
        return {
            "misplaced rms": float(np.sqrt(np.mean(misplaced[settled] ** 2))),
            "misplaced max": float(misplaced[settled].max()),
            "first jump": float(misplaced[1]),
            "unknown at the end": float(1e9 * np.hypot(*unknown[-1])),
            "within 95 %": 100.0 * float(np.mean(surprise <= _95_PERCENT)),
            "refused": float(np.count_nonzero(~self.record.matched)),
            "rescans": float(self.rescans),
            "lost": float(self.lost),
        }


def night(settings: NightSettings, seed: int) -> SimulatedNight:
    """Simulate a night. Equal seeds give the same sample, drift and noise for all settings.

    Raises:
        ConfigError: a setting is invalid.
    """
    world = World.from_settings(_world(settings, seed), seed, 0.0)
    following = tracker(settings.tracker, estimator(settings.estimator))
    place = Region((0.0, 0.0), (settings.size_m, settings.size_m), frame=Frame.SAMPLE)
    scans: list[DriftScan] = []
    updates: list[Update] = []
    rescans = 0
    for number in range(settings.scans):
        start_s = number * settings.every_s
        scan, update = _taken(world, following, place, settings, start_s)
        scans.append(scan)
        updates.append(update)
        fits = scan.end_s + settings.line_s + scan.duration_s <= start_s + settings.every_s
        if fits and number == 0 and settings.at_start == "up-down":
            _taken(world, following, place, settings, scan.end_s + settings.line_s, upwards=False)
        elif fits and _again(settings, place, scan, update):
            rescans += 1
            scan, update = _taken(world, following, place, settings, scan.end_s + settings.line_s)
            scans.append(scan)
            updates.append(update)
    truth = np.array([world.drift_m(scan.mid_s)[:2] for scan in scans])
    lost = any(update.lost for update in updates)
    return SimulatedNight(DriftRecord.of(scans, updates), truth - truth[0], rescans, lost)


def _taken(
    world: World, following: Tracker, place: Region, settings: NightSettings, start_s: float, *, upwards: bool = True
) -> tuple[DriftScan, Update]:
    middle_s = start_s + settings.pixels * settings.line_s / 2
    region = following.forecast.at(middle_s).mapping.to_tip(place)
    shape, direction = (settings.pixels, settings.pixels), "up" if upwards else "down"
    taken = world.scan(region, shape, settings.line_s, start_s, direction=direction)
    _, values = taken.channels()["Height"]
    scan = DriftScan(values, region, taken.start_s, taken.end_s, upwards=upwards, key=f"{start_s:g} s")
    return scan, following.add(scan)


def _again(settings: NightSettings, place: Region, scan: DriftScan, update: Update) -> str:
    scanned = update.after.mapping.to_sample(scan.region)
    if settings.rescan == "paper":
        return too_little_shared(place, scanned, settings.f_rescan)
    if settings.rescan == "tolerance":
        tolerance_m = settings.size_m / 10 if settings.tolerance_m is None else settings.tolerance_m
        return too_far_off(place, scanned, update.after.sd_m, tolerance_m)
    return ""


def _world(settings: NightSettings, seed: int) -> dict[str, object]:
    # a slow and a fast relaxation, the day, and a random walk
    random = np.random.default_rng([seed, 6])
    slow, fast, day = (settings.drift_m * share for share in (1.0, 0.2, 0.1))
    directions = random.uniform(0.0, 2.0 * np.pi, 3)

    def towards(length_m: float, angle: float) -> tuple[float, float, float]:
        return (length_m * math.cos(angle), length_m * math.sin(angle), 0.0)

    drift = {
        "relaxing": [
            {"total_m": towards(slow, directions[0]), "time_s": 3 * 3600.0},
            {"total_m": towards(fast, directions[1]), "time_s": 1800.0},
        ],
        "daily_m": towards(day, directions[2]),
        "walk_m_per_sqrt_hour": 4e-9,
    }
    return {"surface": {"kind": settings.surface}, "scanner": {"flatten": "line"}, "drift": drift}
