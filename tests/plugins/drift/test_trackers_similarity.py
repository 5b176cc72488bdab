"""The default tracker with rotation and scale: corners stay in place, no rotation is invented, and no scan is lost."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.plugins.drift.registering import PIXEL_M, Waves
from tests.plugins.drift.trackers_lab import World, follow

from afspm.basics import ConfigError, InvalidValue
from afspm.components import Array
from afspm.model import Frame, Region
from afspm.plugins.drift.estimators.least_squares import LeastSquares
from afspm.plugins.drift.frame.worker_state import WorkerStateFile
from afspm.plugins.drift.registration import DriftScan, Prior, Registration
from afspm.plugins.drift.track import BankTracker, forecast_from_dict
from afspm.plugins.drift.track.mapping import Mapping
from afspm.plugins.drift.track.tracking import Update

pytestmark = pytest.mark.slow

NM = 1e-9
SIZE_M = 0.64e-6
PIXELS = 64
INTERVAL_S, FRAME_S = 900.0, 100.0
CENTER_M = (3e-6, -2e-6)  # of the frame: a turn about anything but the place that is scanned would show
VELOCITY_M_S = np.array([8.0, -5.0]) * NM / INTERVAL_S
SURFACE = Waves(3)
TURN = 1.5e-3j  # in an interval


@dataclass(frozen=True)
class Sample:
    """Drifts, rotates and expands about a pivot outside the frame.

    Attributes:
        rate_per_s: logarithm of the scale, plus i times the angle in rad, in a second.
        pivot_m: the centre of rotation and expansion.
    """

    rate_per_s: complex
    pivot_m: tuple[float, float] = (2.5e-6, -2.4e-6)

    def to_tip(self, time_s: float) -> Mapping:
        factor, pivot = np.exp(self.rate_per_s * time_s), np.array(self.pivot_m)
        linear = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
        return Mapping.of(linear, pivot - linear @ pivot + VELOCITY_M_S * time_s)

    def scanned(self, region: Region, time_s: float, seed: int) -> DriftScan:
        """Return a scan so fast that nothing moves meanwhile."""
        x, y = region.pixels_m((PIXELS, PIXELS))
        at = self.to_tip(time_s).inverse.apply(np.stack([x, y], axis=-1))
        values = SURFACE.at_points(at)
        values = values + 0.05 * values.std() * np.random.default_rng(seed).standard_normal(values.shape)
        return DriftScan(values, region, time_s - FRAME_S / 2, time_s + FRAME_S / 2, upwards=True, key=str(seed))


@dataclass(frozen=True)
class Night:
    """Scans of one place of the sample, each at the tracker's prediction.

    Attributes:
        corners_m: (n,) distance of each scan's furthest corner from its intended place.
        truth: (n,) true logarithm of the scale, plus i times the angle.
    """

    updates: list[Update]
    corners_m: Array
    truth: NDArray[np.complex128]


def followed(sample: Sample, tracker: BankTracker, count: int, first: int = 0) -> Night:
    wanted = Region(CENTER_M, (SIZE_M, SIZE_M), frame=Frame.SAMPLE)
    updates, off_m, truth = [], [], []
    for k in range(first, first + count):
        time_s = k * INTERVAL_S
        region = tracker.forecast.at(time_s).mapping.to_tip(wanted)
        shown = sample.to_tip(time_s).inverse.apply(region.corners_m())
        off_m.append(float(np.linalg.norm(shown - wanted.corners_m(), axis=1).max()))
        updates.append(tracker.add(sample.scanned(region, time_s, k)))
        truth.append(sample.rate_per_s * time_s)
    return Night(updates, np.array(off_m), np.array(truth))


@cache
def night(rate_per_scan: complex, transform: str, count: int, compared: int = 1) -> Night:
    tracker = BankTracker(LeastSquares(), compared=compared, transform=transform)
    return followed(Sample(rate_per_scan / INTERVAL_S), tracker, count)


def estimate(update: Update) -> complex:
    """Return the estimated logarithm of the scale of the sample, plus i times its angle."""
    inverse = update.after.mapping.inverse
    return complex(np.log(inverse.scale), inverse.angle_rad)


@pytest.mark.parametrize("rate", [TURN, -1.1e-3 + 1.1e-3j], ids=["turns", "turns and shrinks"])
def test_corners_stay_in_place_on_a_rotating_or_expanding_sample(rate: complex) -> None:
    """So do places beside the frame, three frames away."""
    plain, corrected = night(rate, "translation", 24), night(rate, "similarity", 24)
    assert all(update.matched for update in corrected.updates)
    assert plain.corners_m[-6:].mean() > 12 * NM
    assert corrected.corners_m[-6:].mean() < 0.25 * plain.corners_m[-6:].mean()
    assert estimate(corrected.updates[-1]) == pytest.approx(corrected.truth[-1], abs=0.15 * abs(corrected.truth[-1]))
    beside_m, truth = np.add(CENTER_M, (3 * SIZE_M, 0.0)), Sample(rate / INTERVAL_S).to_tip(23 * INTERVAL_S)
    off_m = [
        float(np.linalg.norm(one.updates[-1].after.mapping.apply(truth.apply(beside_m)) - beside_m))
        for one in (plain, corrected)
    ]
    assert off_m[1] < 0.2 * off_m[0]


def test_without_a_rotation_none_is_found_and_corners_stay_within_a_twentieth_of_a_pixel() -> None:
    plain, corrected = night(0j, "translation", 14, compared=2), night(0j, "similarity", 14, compared=2)
    chi2 = [abs(estimate(one)) ** 2 / one.quality["linear_sd"] ** 2 for one in corrected.updates[1:]]
    assert max(chi2) < 9.0
    assert 0.2 < np.mean(chi2) / 2 < 2.0
    assert corrected.corners_m[4:].mean() < plain.corners_m[4:].mean() + 0.05 * PIXEL_M


def test_the_default_follows_translations_only() -> None:
    """With the option off, neither the mapping nor the saved and published state contains it."""
    tracker = BankTracker(LeastSquares(), compared=2)
    update = followed(Sample(TURN / INTERVAL_S), tracker, 3).updates[-1]
    assert np.array_equal(update.after.mapping.linear, np.eye(2))
    assert tracker.state()["similarity"] is None
    assert update.forecast.to_dict()["straight"] is None
    assert list(update.quality) == ["references"]


def test_an_estimator_without_a_linear_part_leaves_the_mapping_a_translation() -> None:
    world = World(lambda time_s: VELOCITY_M_S * time_s)
    plain, asked = (follow(BankTracker(world, transform=one), 8) for one in ("translation", "similarity"))
    assert np.array_equal(asked[-1].after.mapping.linear, np.eye(2))
    assert np.linalg.norm(asked[-1].after.mapping.translation_m - plain[-1].after.mapping.translation_m) < 0.1 * NM


def test_a_tracker_restored_from_disk_continues_with_the_same_bits(tmp_path: Path) -> None:
    sample, store = Sample(TURN / INTERVAL_S), WorkerStateFile(tmp_path / "drift")
    whole = night(TURN, "similarity", 6).updates
    for cut in (1, 4):
        before, after = (BankTracker(LeastSquares(), compared=1, transform="similarity") for _ in range(2))
        followed(sample, before, cut)
        store.save(before.state())
        state = store.load()
        assert state is not None
        after.restore(state)
        assert after.forecast.to_dict() == before.forecast.to_dict()
        for update, expected in zip(followed(sample, after, 6 - cut, first=cut).updates, whole[cut:], strict=True):
            assert update.forecast.to_dict() == expected.forecast.to_dict()


def test_a_forecast_with_a_rotation_survives_json() -> None:
    forecast = night(TURN, "similarity", 6).updates[-1].forecast
    again = forecast_from_dict(json.loads(json.dumps(forecast.to_dict(), allow_nan=False)))
    mapping = forecast.at(6 * INTERVAL_S).mapping
    assert mapping.angle_rad < -0.002
    assert np.array_equal(again.at(6 * INTERVAL_S).mapping.matrix, mapping.matrix)


def test_one_wrong_rotation_is_not_believed() -> None:
    estimator = LeastSquares()
    tracker = BankTracker(estimator, compared=1, transform="similarity")
    sample = Sample(0j)
    followed(sample, tracker, 4)
    honest = estimator.register

    def lying(reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        found = honest(reference, scan, prior)
        assert found.linear_seen is not None
        turned = found.linear_seen.linear + np.array([[0.0, -0.05], [0.05, 0.0]])
        return replace(found, linear_seen=replace(found.linear_seen, linear=turned))

    estimator.register = lying  # type: ignore[method-assign]
    doubted = followed(sample, tracker, 1, first=4).updates[-1]
    assert doubted.matched
    assert abs(estimate(doubted)) < 3e-3
    believed = followed(sample, tracker, 1, first=5).updates[-1]
    assert estimate(believed).imag > 0.01


@pytest.mark.parametrize("saved", ["translation", "similarity"])
def test_the_state_of_another_transform_is_refused(saved: str) -> None:
    other = {"translation": "similarity", "similarity": "translation"}[saved]
    tracker = BankTracker(LeastSquares(), transform=saved)
    followed(Sample(0j), tracker, 1)
    with pytest.raises(InvalidValue, match="transform"):
        BankTracker(LeastSquares(), transform=other).restore(tracker.state())


def test_an_unknown_transform_is_refused() -> None:
    with pytest.raises(ConfigError, match="'affine'"):
        BankTracker(LeastSquares(), transform="affine")
