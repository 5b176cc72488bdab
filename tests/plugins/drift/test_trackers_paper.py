"""The tracker of the paper follows the paper."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.plugins.drift.trackers_lab import INTERVAL_S, SIZE_M, World, follow, scan_at, steady

from afspm.basics import ConfigError, InvalidValue
from afspm.plugins.drift.registration import DriftScan, Prior, Registration
from afspm.plugins.drift.track import PaperTracker, forecast_from_dict, tracker
from afspm.plugins.drift.track.mapping import Mapping

NM = 1e-9


def test_the_worked_example_of_the_paper() -> None:
    """Supporting information, "Drift Correction Example", in nm: M_tot adds x_tot to tip coordinates."""
    total = {0: 0.0, 1: 1.0, 2: 2.0, **{k: float(k) for k in range(3, 13)}, 13: 12.5, 14: 13.0}
    world = World(lambda t: np.array([-np.interp(t, [*total], [*total.values()]) * NM, 0.0]), noise_m=0.0)
    following = PaperTracker(world, queue=20)
    predicted, updated = [], []
    for k in total:
        update = following.add(
            scan_at(float(k), following.forecast.at(k).mapping.inverse.apply((0.0, 0.0)), frame_s=0.0)
        )
        predicted.append(update.before.mapping.translation_m[0] / NM)
        updated.append(update.after.mapping.translation_m[0] / NM)
    assert predicted[:3] == pytest.approx([0.0, 0.0, 2.0])
    assert updated[:3] == pytest.approx([0.0, 1.0, 2.0])
    assert (predicted[12], updated[12]) == pytest.approx((12.0, 12.0))
    assert (predicted[13], updated[13]) == pytest.approx((13.0, 12.5))
    assert (predicted[14], updated[14]) == pytest.approx((13.0, 13.0))


def test_the_prediction_is_the_rate_of_the_last_step_times_the_time() -> None:
    world = World(steady((0.02 * NM, -0.01 * NM)), noise_m=0.0)
    following = PaperTracker(world)
    following.add(scan_at(100.0, frame_s=0.0))
    following.add(scan_at(400.0, frame_s=0.0))
    prediction = following.forecast.at(1000.0)
    assert prediction.mapping.translation_m == pytest.approx([-18.0 * NM, 9.0 * NM])
    assert prediction.rate_m_s == pytest.approx([0.02 * NM, -0.01 * NM])


@pytest.mark.parametrize(("w_update", "believed"), [(1.0, 10.0), (0.25, 2.5), (0.0, 0.0)])
def test_the_estimate_is_averaged_with_the_prediction(w_update: float, believed: float) -> None:
    world = World(steady((0.01 * NM, 0.0)), noise_m=0.0)
    following = PaperTracker(world, w_update=w_update)
    following.add(scan_at(0.0))
    update = following.add(scan_at(1000.0))
    assert update.after.mapping.translation_m == pytest.approx([-believed * NM, 0.0])


def test_the_oldest_scan_for_which_estimation_succeeds_is_taken() -> None:
    world = World(blind={"0"})
    following = PaperTracker(world)
    for k in range(4):
        update = following.add(scan_at(1000.0 * k, key=str(k)))
    assert list(update.registrations) == ["0", "1"]
    assert [one.accepted for one in update.registrations.values()] == [False, True]


def test_the_queue_forgets_the_oldest() -> None:
    world = World()
    following = PaperTracker(world, queue=2)
    for k in range(4):
        update = following.add(scan_at(1000.0 * k, key=str(k)))
    assert list(update.registrations) == ["1"]


def test_pairs_with_too_little_overlap_in_sample_coordinates_are_not_registered() -> None:
    """The same tip coordinates show another part once the sample has drifted away."""
    world = World(steady((0.45 * SIZE_M / 1000.0, 0.0)))
    following = PaperTracker(world, f_min=0.5)
    first, second = following.add(scan_at(0.0)), following.add(scan_at(1000.0))
    third = following.add(scan_at(2000.0, key="far"))
    assert first.matched
    assert second.matched
    assert list(third.registrations) == ["1000"]


@pytest.mark.parametrize(("pixels", "comparable"), [(32, True), (33, False)])
def test_pairs_of_very_different_resolution_are_not_registered(pixels: int, *, comparable: bool) -> None:
    following = PaperTracker(World(), sr_norm_min=0.25)
    following.add(scan_at(0.0, pixels=8))
    assert following.add(scan_at(1000.0, pixels=pixels)).matched == comparable


def test_without_a_match_only_the_prediction_applies() -> None:
    world = World(steady((0.01 * NM, 0.0)), noise_m=0.0, blind={"2"})
    following = PaperTracker(world)
    for k in range(2):
        following.add(scan_at(1000.0 * k, key=str(k)))
    update = following.add(scan_at(2000.0, key="2"))
    assert not update.matched
    assert update.reason == "blind"
    assert update.after.mapping.translation_m == pytest.approx([-20.0 * NM, 0.0])
    assert following.forecast.at(3000.0).mapping.translation_m == pytest.approx([-30.0 * NM, 0.0])


def test_scans_of_unknown_places_are_no_sign_of_being_lost() -> None:
    following = PaperTracker(World(), queue=3, lost_after=3)
    places = [(k * 10e-6, 0.0) for k in range(6)]
    updates = [
        following.add(scan_at(1000.0 * k, key=str(k), center_m=place)) for k, place in enumerate([*places, *places])
    ]
    assert not any(update.lost for update in updates)
    assert [update.matched for update in updates] == [True] + 11 * [False]


def test_the_paper_s_tracker_is_lost_after_some_scans_without_a_match() -> None:
    world = World(blind={"2", "3", "4"})
    following = PaperTracker(world, lost_after=3)
    lost = [following.add(scan_at(1000.0 * k, key=str(k))).lost for k in range(6)]
    assert lost == [False, False, False, False, True, False]


class Turning:
    """An estimator for a sample that rotates about the origin and grows, at constant rates."""

    rad_per_s, growth_per_s = 1e-4, 2e-5

    def matrix(self, seconds: float) -> np.ndarray:
        angle, growth = self.rad_per_s * seconds, math.exp(self.growth_per_s * seconds)
        return growth * np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        linear = self.matrix(scan.mid_s - reference.mid_s)
        center = np.array(reference.region.center_m)
        return Registration(True, "", linear @ center - center, np.eye(2) * 1e-24, linear - np.eye(2), center)


@pytest.mark.parametrize(
    ("transform", "angle_rad", "scale"),
    [("euclidean", 0.03, 1.0), ("similarity", 0.03, math.exp(0.006)), ("affine", 0.03, math.exp(0.006))],
)
def test_rotation_and_scale_are_predicted_through_their_logarithms(
    transform: str, angle_rad: float, scale: float
) -> None:
    following = PaperTracker(Turning(), transform=transform)
    center = (0.3e-6, 0.1e-6)
    following.add(scan_at(0.0, center))
    following.add(scan_at(100.0, center))
    predicted = following.forecast.at(300.0).mapping.inverse
    assert predicted.angle_rad == pytest.approx(angle_rad)
    assert predicted.scale == pytest.approx(scale)
    if transform != "euclidean":
        assert predicted.apply(center) == pytest.approx(Turning().matrix(300.0) @ center)


@pytest.mark.parametrize("stretch_per_interval", [0.02, -0.02])
@pytest.mark.parametrize("hours", [12.0, 1000.0])
def test_after_a_long_pause_only_the_translation_of_the_last_rate_is_predicted(
    stretch_per_interval: float, hours: float
) -> None:
    """An error of two per cent in one interval must not become a scan of thrice the size, or none at all."""

    class Stretching:
        def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
            linear = np.eye(2) * math.expm1(stretch_per_interval)
            return Registration(True, "", np.array([NM, 0.0]), np.eye(2) * 1e-20, linear, np.zeros(2))

    following = PaperTracker(Stretching(), transform="affine")
    following.add(scan_at(0.0))
    following.add(scan_at(INTERVAL_S))
    soon, late = (following.forecast.at(INTERVAL_S + s).mapping for s in (INTERVAL_S, hours * 3600.0))
    assert soon.scale == pytest.approx(math.exp(-2 * stretch_per_interval))
    assert late.scale == pytest.approx(math.exp(-stretch_per_interval))
    assert np.linalg.norm(late.translation_m) == pytest.approx(hours * 4 * NM, rel=0.1)


def test_a_translation_leaves_rotation_out() -> None:
    following = PaperTracker(Turning())
    following.add(scan_at(0.0, (0.3e-6, 0.0)))
    update = following.add(scan_at(100.0, (0.3e-6, 0.0)))
    moved = Turning().matrix(100.0) @ (0.3e-6, 0.0) - (0.3e-6, 0.0)
    assert np.array_equal(update.after.mapping.linear, np.eye(2))
    assert update.after.mapping.translation_m == pytest.approx(-moved)


def test_a_rotated_scan_follows_the_matrices() -> None:
    """M_k x_k = M_j x_j for every feature, with any prediction."""
    following = PaperTracker(Turning(), transform="affine")
    for time_s in (0.0, 100.0, 250.0):
        update = following.add(scan_at(time_s, (0.2e-6, -0.1e-6)))
    feature = np.array([0.5e-6, 0.4e-6])
    found = update.after.mapping.apply(Turning().matrix(250.0) @ feature)
    assert found == pytest.approx(feature)


def test_a_restored_tracker_continues_with_the_same_bits() -> None:
    drift = steady((0.013 * NM, 0.007 * NM))
    whole = follow(PaperTracker(World(drift), w_update=0.7, queue=3), 8)
    for cut in range(8):
        world = World(drift)
        before = PaperTracker(world, w_update=0.7, queue=3)
        follow(before, cut)
        after = PaperTracker(world, w_update=0.7, queue=3)
        after.restore(before.state())
        again = follow(after, 8 - cut, first=cut)
        for update, expected in zip(again, whole[cut:], strict=True):
            assert update.forecast.to_dict() == expected.forecast.to_dict()


def test_a_forecast_survives_json() -> None:
    following = PaperTracker(World(steady((0.01 * NM, 0.0))))
    follow(following, 3)
    forecast = forecast_from_dict(json.loads(json.dumps(following.forecast.to_dict())))
    assert np.array_equal(forecast.at(5000.0).mapping.matrix, following.forecast.at(5000.0).mapping.matrix)
    assert np.array_equal(forecast.at(5000.0).covariance_m2, following.forecast.at(5000.0).covariance_m2)


def test_before_the_first_scan_both_coordinates_are_the_same() -> None:
    prediction = PaperTracker(World()).forecast.at(1e9)
    assert np.array_equal(prediction.mapping.matrix, Mapping.identity().matrix)


def test_an_older_scan_is_refused() -> None:
    following = PaperTracker(World())
    following.add(scan_at(INTERVAL_S))
    with pytest.raises(InvalidValue, match="order of time"):
        following.add(scan_at(0.0))


def test_the_state_of_another_tracker_is_refused() -> None:
    state = tracker("bank", World()).state()
    with pytest.raises(InvalidValue, match="'bank'"):
        PaperTracker(World()).restore(state)


@pytest.mark.parametrize(
    "settings",
    [{"transform": "projective"}, {"w_update": 1.1}, {"f_min": -0.1}, {"queue": 0}, {"lost_after": 0}, {"quue": 3}],
)
def test_meaningless_tracker_settings_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        tracker({"class": "paper", **settings}, World())


def test_a_scan_in_the_other_direction_is_taken_like_any_other() -> None:
    following = PaperTracker(World())
    following.add(scan_at(0.0))
    assert following.add(replace(scan_at(1000.0), upwards=None)).matched
