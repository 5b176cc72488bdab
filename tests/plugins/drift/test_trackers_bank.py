"""The default tracker: near the optimum, robust to wrong pairs, lost and found, at any place and size."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike
from tests.plugins.drift.trackers_lab import (
    FRAME_S,
    INTERVAL_S,
    SIZE_M,
    Drift,
    World,
    follow,
    scan_at,
    steady,
    walked,
)

from afspm.basics import ConfigError, InvalidValue
from afspm.components import Array
from afspm.plugins.drift.registration import DriftScan, Prior, Registration
from afspm.plugins.drift.track import BankTracker, PaperTracker, forecast_from_dict, tracker
from afspm.plugins.drift.track.tracking import Prediction, Update

NM = 1e-9
STEADY = steady((0.05 * NM, -0.03 * NM))
Y = (np.arange(128) + 0.5) / 64 - 1.0  # of the rows, from -1 to 1


def night(seed: int, walk_m: float = NM) -> Drift:
    """Relaxations of hours and of half an hour, a day's wave, and a random walk of this step in 15 minutes."""
    random = np.random.default_rng(seed)
    slow, fast, daily = (v / np.linalg.norm(v) for v in random.standard_normal((3, 2)))
    times_s = np.arange(0.0, 120 * INTERVAL_S, 60.0)
    walk = np.cumsum(random.standard_normal((len(times_s), 2)), axis=0) * walk_m * np.sqrt(60.0 / 900.0)

    def drift(at_s: ArrayLike) -> Array:
        t = np.asarray(at_s)[..., None]
        relaxed = 1500 * NM * slow * (1 - np.exp(-t / 10800)) + 300 * NM * fast * (1 - np.exp(-t / 1800))
        return np.asarray(relaxed + 150 * NM * daily * np.sin(2 * np.pi * t / 86400) + walked(at_s, times_s, walk))

    return drift


def error_m(world: World, prediction: Prediction, start_s: float = FRAME_S) -> Array:
    """Return the estimate minus the truth; positions are counted from the first scan."""
    drift = world.drift_m(prediction.time_s) - world.drift_m(start_s)
    return np.asarray(-prediction.mapping.translation_m - drift)


def rms_m(errors: list[Array]) -> float:
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1))))


@pytest.fixture(scope="module")
def nights() -> list[tuple[World, list[Update]]]:
    """Three nights of forty scans, followed."""
    worlds = [World(night(seed), seed=seed) for seed in range(3)]
    return [(world, follow(BankTracker(world), 40)) for world in worlds]


def test_the_bank_predicts_better_than_the_last_step(nights: list[tuple[World, list[Update]]]) -> None:
    """Late misplacement in the same nights: at most 0.85 of the paper's scheme with the same estimator."""
    late: dict[type, list[Array]] = {BankTracker: [], PaperTracker: []}
    for seed, (world, updates) in enumerate(nights):
        late[BankTracker] += [error_m(world, update.before) for update in updates[8:]]
        again = World(night(seed), seed=seed)
        late[PaperTracker] += [error_m(again, update.before) for update in follow(PaperTracker(again), 40)[8:]]
    assert rms_m(late[BankTracker]) < 3.0 * NM
    assert rms_m(late[BankTracker]) < 0.85 * rms_m(late[PaperTracker])


def test_the_bank_knows_its_own_uncertainty(nights: list[tuple[World, list[Update]]]) -> None:
    """Neither over-confident nor over-cautious, before a scan and after it."""
    before: list[float] = []
    after: list[float] = []
    for world, updates in nights:
        for update in updates[8:]:
            for chi2, known in ((before, update.before), (after, update.after)):
                error = error_m(world, known)
                chi2.append(float(error @ np.linalg.solve(known.covariance_m2, error)) / 2)
    assert 0.1 < np.mean(before) < 1.2
    assert 0.1 < np.mean(after) < 2.5


class WorldByRows(World):
    """A scan shows the sample at the mean of its displacement over the rows."""

    def _seen(self, scan: DriftScan, position_m: Array) -> Array:
        return super()._seen(scan, position_m) + self.shown_m(scan) - self.drift_m(scan.mid_s)

    def shown_m(self, scan: DriftScan) -> Array:
        """Return the mean (2,) of the displacement over the rows."""
        times_s = np.linspace(scan.start_s, scan.end_s, 65)
        return np.asarray(np.mean(self.drift_m(times_s), axis=0))


@pytest.mark.parametrize("walk_m", [1 * NM, 4 * NM])
def test_the_bank_counts_the_wandering_of_the_sample_during_a_scan(walk_m: float) -> None:
    """The estimate is for the middle of a scan, but the scan shows the mean over its rows."""
    chi2 = []
    for seed in range(3):
        world = WorldByRows(night(seed, walk_m), noise_m=0.05 * NM, seed=seed)
        wandered_m = world.shown_m(scan_at(FRAME_S)) - world.drift_m(FRAME_S)  # in the first, all are counted from it
        for update in follow(BankTracker(world), 40)[8:]:
            error = error_m(world, update.after) + wandered_m
            chi2.append(error @ np.linalg.solve(update.after.covariance_m2, error) / 2)
    assert 0.1 < np.mean(chi2) < 2.0


class WorldByFeatures(WorldByRows):
    """Scans in opposite directions are sheared, so they are compared by other rows than scans in one direction."""

    uneven = 0.0

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        self.uneven = 1.0 if reference.upwards != scan.upwards else 0.0
        found = super().register(reference, scan, prior)
        slope = 6.0 / scan.region.size_m[1] * (self._by_row(scan, Y) - self._by_row(reference, Y))
        return replace(found, linear=np.outer(slope, (0.0, 1.0)))

    def shown_m(self, scan: DriftScan) -> Array:
        # neither set of weights mistakes a constant velocity for a shift
        return self._by_row(scan, 1.0 + self.uneven * (3 * Y**2 - 1) / 2)

    def _by_row(self, scan: DriftScan, weights: Array) -> Array:
        times_s = scan.mid_s + (Y if scan.upwards else -Y) * scan.duration_s / 2
        return np.asarray(np.mean(weights[:, None] * self.drift_m(times_s), axis=0))


def walking(seed: int, walk_m: float) -> Drift:
    """A constant velocity, and a random walk of this step in an hour that also distorts scans."""
    times_s = np.arange(0.0, 2000.0, 4.0)
    steps = np.random.default_rng(seed).standard_normal((len(times_s), 2))
    walk = np.cumsum(steps, axis=0) * walk_m * np.sqrt(4.0 / 3600.0)
    return lambda t: STEADY(t) + walked(t, times_s, walk)


def test_distorted_scans_do_not_feign_a_velocity() -> None:
    """Up, down and up again: the displacements do not add up, which a second's delay must not explain."""
    for seed in range(4):
        world = WorldByFeatures(walking(seed, 10 * NM), noise_m=0.03 * NM, seed=seed)
        following, interval_s = BankTracker(world), FRAME_S + 16.0
        for k in range(3):
            time_s = FRAME_S + k * interval_s
            tip = following.forecast.at(time_s).mapping.inverse.apply((0.0, 0.0))
            following.add(scan_at(time_s, tip, size_m=SIZE_M / 2, pixels=128, upwards=k != 1, key=str(k)))
        found = following.forecast.at(time_s)
        assert np.linalg.norm(found.rate_m_s - STEADY(1.0)) < 0.03 * NM
        assert np.linalg.norm(error_m(world, following.forecast.at(time_s + interval_s))) < 10.0 * NM


def test_errors_do_not_accumulate() -> None:
    world = World(night(1), noise_m=0.3 * NM)
    updates = follow(BankTracker(world, compared=2), 70)
    assert rms_m([error_m(world, update.after) for update in updates[-20:]]) < 1.0 * NM


def test_positions_are_counted_from_the_first_scan() -> None:
    update = BankTracker(World(STEADY)).add(scan_at(5000.0))
    assert update.matched
    assert not update.lost
    assert np.array_equal(update.before.mapping.matrix, np.eye(3))
    assert np.array_equal(update.after.mapping.matrix, np.eye(3))
    assert update.after.rate_covariance[0, 0] > 0.0


@pytest.mark.parametrize("upwards", [True, False])
def test_an_overlap_off_the_middle_gives_no_bias(*, upwards: bool) -> None:
    """A fifth of the frame from its middle, a sample that drifts by 26 nm a frame is 5 nm further."""
    world = World(steady((0.0, 0.1 * NM)), noise_m=0.0)
    following = BankTracker(world)
    for k, offset in enumerate((0.0, 0.4, -0.4, 0.3, -0.3)):
        scan = scan_at(FRAME_S + k * INTERVAL_S, (0.0, offset * SIZE_M), pixels=64, upwards=upwards, key=str(k))
        update = following.add(scan)
        assert update.matched
    assert np.linalg.norm(error_m(world, update.after)) < 0.3 * NM
    assert update.after.rate_m_s == pytest.approx((0.0, 0.1 * NM), abs=1e-3 * NM)


def test_an_unknown_direction_gives_uncertainty_and_no_bias() -> None:
    world = World(steady((0.0, 0.1 * NM)), noise_m=0.0)
    errors, deviations = [], []
    following = BankTracker(world)
    for k, offset in enumerate((0.0, 0.4, -0.4, 0.4)):
        update = following.add(scan_at(FRAME_S + k * INTERVAL_S, (0.0, offset * SIZE_M), upwards=None, key=str(k)))
        errors.append(float(np.linalg.norm(error_m(world, update.after))))
        deviations.append(update.after.sd_m)
    assert update.matched
    assert max(errors) > 1.0 * NM
    assert all(error < 3.0 * sd for error, sd in zip(errors[1:], deviations[1:], strict=True))


def test_one_wrong_pair_does_not_throw_it_off() -> None:
    wrong = np.array([40.0, -20.0]) * NM
    world = World(night(2), wrong={"scan 20": wrong})
    updates = follow(BankTracker(world), 25)
    assert not updates[20].matched
    assert "standard deviations" in updates[20].reason
    assert not updates[20].lost
    for update in updates[20:]:
        assert np.linalg.norm(error_m(world, update.after)) < 10.0 * NM
        assert np.linalg.norm(error_m(world, update.before)) < 12.0 * NM


def test_one_wrong_reference_of_several_is_left_out() -> None:
    world = World(night(2))
    following = BankTracker(world)
    follow(following, 20)
    honest = world.register

    def lying(reference, scan, prior=None):  # type: ignore[no-untyped-def]
        found = honest(reference, scan, prior)
        if reference.key == "scan 0":
            found.displacement_m[:] += 15.0 * NM
        return found

    world.register = lying  # type: ignore[method-assign]
    update = follow(following, 1, first=20)[0]
    assert update.matched
    assert update.quality["references"] == len(update.registrations) - 1
    assert np.linalg.norm(error_m(world, update.after)) < 1.5 * NM


def test_a_jump_that_stays_is_believed_the_second_time() -> None:
    calm = night(3)
    world = World(lambda t: calm(t) + (t > 15.5 * INTERVAL_S) * np.array([25.0, 30.0]) * NM)
    updates = follow(BankTracker(world), 24)
    assert not updates[16].matched
    assert updates[17].matched
    assert np.linalg.norm(error_m(world, updates[17].after)) < 2.0 * NM
    assert np.linalg.norm(error_m(world, updates[22].before)) < 15.0 * NM


def test_a_lost_bank_reports_it_and_recovers() -> None:
    jump = np.array([900.0, -500.0]) * NM
    unusable = {f"scan {k}" for k in (11, 12, 13)}
    world = World(lambda t: STEADY(t) + (t > 10.5 * INTERVAL_S) * jump, blind=unusable)
    updates = follow(BankTracker(world), 20)
    lost = [update.lost for update in updates]
    assert lost[:13] == [False] * 13
    assert lost[13]
    assert updates[13].after.sd_m > 500.0 * NM
    assert not any(lost[14:])
    assert updates[14].matched
    assert np.linalg.norm(error_m(world, updates[14].after)) < 5.0 * NM
    assert np.linalg.norm(error_m(world, updates[19].after)) < 2.0 * NM
    searched = [prior for _, scan, prior in world.asked if scan == "scan 14"]
    assert all(prior is None for prior in searched)


def test_scans_without_comparable_references_do_not_make_the_bank_lost_soon() -> None:
    following = BankTracker(World())
    follow(following, 8)
    for k in range(3):
        time_s = FRAME_S + (8 + k) * INTERVAL_S
        update = following.add(scan_at(time_s, ((k + 1) * 3 * SIZE_M, 0.0), key=f"far {k}"))
        assert not update.matched
        assert not update.lost
        assert update.reason == "no earlier scan of this part of the sample is stored"


def test_the_bank_is_lost_when_positions_are_too_uncertain() -> None:
    world = World(night(4))
    following = BankTracker(world)
    follow(following, 3)
    week_s = 7 * 86400.0
    update = following.add(scan_at(week_s, (5 * SIZE_M, 0.0), key="elsewhere"))
    assert update.lost
    assert update.after.sd_m > 0.35 * SIZE_M


def test_a_jump_of_half_a_scan_is_found_at_once_and_believed_the_second_time() -> None:
    jump = np.array([900.0, -500.0]) * NM
    world = World(lambda t: STEADY(t) + (t > 10.5 * INTERVAL_S) * jump)
    updates = follow(BankTracker(world), 20)
    assert [update.matched for update in updates[10:13]] == [True, False, True]
    assert not any(update.lost for update in updates)
    for update in updates[12:]:
        assert np.linalg.norm(error_m(world, update.after)) < 2.0 * NM
    assert np.linalg.norm(error_m(world, updates[14].before)) < 20.0 * NM


def far_jump(distance_m: float) -> World:
    """Return a sample that jumps so far between scans 10 and 11 that later scans share nothing with earlier ones."""
    jump = np.array([distance_m, 0.0])
    return World(lambda t: STEADY(t) + (t > 10.5 * INTERVAL_S) * jump)


@pytest.mark.parametrize("frames", [0.9, 2.0])
def test_scans_that_match_only_each_other_do_not_count_as_found(frames: float) -> None:
    world = far_jump(frames * SIZE_M)
    updates = follow(BankTracker(world), 30)
    assert not any(update.matched for update in updates[11:])
    assert [update.lost for update in updates[10:13]] == [False, False, False]
    assert all(update.lost for update in updates[13:])
    assert updates[12].reason == "it matches only scans that themselves matched no older scan"
    assert updates[12].registrations["scan 11"].accepted
    assert updates[29].after.sd_m > 500.0 * NM
    assert "scan 0" in updates[29].registrations


def test_after_a_far_jump_one_scan_of_an_old_place_corrects_all() -> None:
    world = far_jump(0.9 * SIZE_M)
    following = BankTracker(world)
    follow(following, 20)
    time_s = FRAME_S + 20 * INTERVAL_S
    tip = following.forecast.at(time_s).mapping.inverse.apply((0.0, 0.0))
    wide = following.add(scan_at(time_s, tip, size_m=3 * SIZE_M, pixels=16, key="wide"))
    assert wide.matched
    assert not wide.lost
    assert np.linalg.norm(error_m(world, wide.after)) < 5.0 * NM
    while_lost = [one for one in following.state()["references"] if one["scan"]["key"] in ("scan 18", "scan 19")]
    assert [one["adrift"] for one in while_lost] == [False, False]
    updates = follow(following, 4, first=21)
    assert all(update.matched for update in updates)
    assert np.linalg.norm(error_m(world, updates[-1].after)) < 2.0 * NM


def test_a_place_first_seen_adrift_is_known_once_it_matches_an_older_scan() -> None:
    """The first scan of a place next to the known one matched no older scan; the next ones do."""
    world = World(STEADY)
    following = BankTracker(world)
    follow(following, 8)
    world.blind |= {f"scan {k}" for k in range(8)}
    beside = (0.4 * SIZE_M, 0.0)
    first = follow(following, 1, first=8, sample_m=beside)[0]
    assert not first.matched
    world.blind.clear()
    second = follow(following, 1, first=9, sample_m=beside)[0]
    assert second.matched
    world.blind |= {"scan 9", *(f"scan {k}" for k in range(8))}
    third = follow(following, 1, first=10, sample_m=beside)[0]
    assert third.matched
    assert np.linalg.norm(error_m(world, third.after)) < 2.0 * NM


@pytest.mark.parametrize("unusable", [1, 2, 6])
def test_tracking_begins_with_the_first_two_scans_that_match(unusable: int) -> None:
    world = World(STEADY, blind={f"scan {k}" for k in range(unusable)})
    updates = follow(BankTracker(world), unusable + 8)
    assert [update.matched for update in updates[1:]] == [k > unusable for k in range(1, unusable + 8)]
    assert not any(update.lost for update in updates[unusable + 1 :])
    assert updates[unusable].lost == (unusable > 1)
    last = updates[-1]
    assert np.linalg.norm(error_m(world, last.after)) < 3.0 * NM
    assert last.after.sd_m < 50.0 * NM


def test_the_bank_goes_on_after_any_time_lost() -> None:
    world = World(STEADY)
    following = BankTracker(world)
    follow(following, 5)
    following.restore({**following.state(), "unmatched": 100_000})
    world.blind.add("scan 5")
    assert not follow(following, 1, first=5)[0].matched


def test_a_new_velocity_is_learned_within_three_scans() -> None:
    turn_s = FRAME_S + 15 * INTERVAL_S
    turned = steady((-0.4 * NM, 0.2 * NM))
    world = World(lambda t: STEADY(t) + turned(max(t - turn_s, 0.0)))
    updates = follow(BankTracker(world), 24)
    assert np.linalg.norm(error_m(world, updates[16].before)) > 300.0 * NM
    # while the velocity is not known, neither is what the sample did between the middle and the overlap
    assert np.linalg.norm(error_m(world, updates[17].after)) < 2.0 * updates[17].after.sd_m
    assert all(np.linalg.norm(error_m(world, update.after)) < 2.0 * NM for update in updates[18:])
    assert np.linalg.norm(error_m(world, updates[19].before)) < 20.0 * NM


def test_an_unusable_scan_is_skipped() -> None:
    world = World(night(5), blind={"scan 12", "scan 13"})
    updates = follow(BankTracker(world), 20)
    assert [update.matched for update in updates[11:15]] == [True, False, False, True]
    assert updates[12].reason == "blind"
    assert np.linalg.norm(error_m(world, updates[14].after)) < 2.0 * NM


def test_an_anchor_that_is_no_longer_recognised_is_removed() -> None:
    """The tip has changed: new scans match each other, and no older ones."""
    world = World(night(6))
    following = BankTracker(world)
    follow(following, 10)
    world.blind |= {f"scan {k}" for k in range(9)}
    updates = follow(following, 12, first=10)
    assert all(update.matched for update in updates)
    assert "scan 0" not in updates[-1].registrations
    anchors = {min(int(key.split()[1]) for key in update.registrations) for update in updates[-3:]}
    assert len(anchors) == 1
    assert np.linalg.norm(error_m(world, updates[-1].after)) < 2.0 * NM


def test_the_first_scan_stays_the_anchor_while_it_is_recognised() -> None:
    updates = follow(BankTracker(World(night(7))), 40)
    assert all("scan 0" in update.registrations for update in updates[1:])


def test_other_places_get_anchors_of_their_own() -> None:
    """Two places, scanned in turn: the drift measured at one place holds for the other, with its uncertainty."""
    world = World(night(8), noise_m=0.3 * NM)
    following = BankTracker(world)
    places = [(0.0, 0.0), (3.5 * SIZE_M, 1.0 * SIZE_M)]
    updates = []
    for k in range(40):
        time_s = FRAME_S + k * INTERVAL_S
        tip = following.forecast.at(time_s).mapping.inverse.apply(places[k % 2])
        updates.append(following.add(scan_at(time_s, tip, key=f"{k % 2}-{k}")))
    assert not updates[1].matched
    assert all(update.matched for update in updates[3:])
    assert all("0-0" in update.registrations for update in updates[4::2])
    assert all("1-1" in update.registrations for update in updates[5::2])
    assert rms_m([error_m(world, update.before) for update in updates[20:]]) < 6.0 * NM


def test_zooms_in_an_overview_are_followed() -> None:
    world = World(night(9))
    following = BankTracker(world)
    following.add(scan_at(FRAME_S, size_m=4 * SIZE_M, pixels=16, key="wide"))
    updates = []
    for k in range(1, 16):
        time_s = FRAME_S + k * INTERVAL_S
        place = ((k % 3 - 1) * 1.2 * SIZE_M, 0.5 * SIZE_M)
        tip = following.forecast.at(time_s).mapping.inverse.apply(place)
        updates.append(following.add(scan_at(time_s, tip, size_m=SIZE_M, key=f"narrow {k}")))
    assert all(update.matched for update in updates)
    assert all("wide" in update.registrations for update in updates[:3])
    assert np.linalg.norm(error_m(world, updates[-1].after)) < 2.0 * NM


def test_a_zoom_too_fine_for_the_overview_begins_a_series_of_its_own() -> None:
    """Its distance from the overview stays unknown, and a rescan would not change that."""
    world = World(night(4))
    following = BankTracker(world, sr_norm_min=0.25)
    following.add(scan_at(FRAME_S, pixels=16, key="overview"))
    asked, updates = [], []
    plain = world.register

    def register(reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        asked.append(prior)
        return plain(reference, scan, prior)

    world.register = register  # type: ignore[method-assign]
    for k in range(1, 12):
        time_s = FRAME_S + k * INTERVAL_S
        tip = following.forecast.at(time_s).mapping.inverse.apply((0.0, 0.0))
        updates.append(following.add(scan_at(time_s, tip, size_m=SIZE_M / 10, pixels=16, key=f"zoom {k}")))
    assert updates[0].after.sd_m > 0.35 * SIZE_M / 10, "it is not known better than that"
    assert not any(update.lost for update in updates)
    assert all(update.matched for update in updates[3:])
    assert None not in asked[-5:], "its place among the others is known"


def refusing(world: World) -> list[Prior | None]:
    """Refuse every registration; return the list to which each registration adds its prior."""
    asked: list[Prior | None] = []

    def refuse(reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        asked.append(prior)
        return Registration.refused("ambiguous")

    world.register = refuse  # type: ignore[method-assign]
    return asked


def test_zooms_unclear_in_the_overview_are_not_searched_elsewhere() -> None:
    """In an overview a zoom of a particle fits every particle."""
    world = World(night(4))
    following = BankTracker(world)
    following.add(scan_at(FRAME_S, pixels=64, key="overview"))
    asked = refusing(world)
    places = [(x * SIZE_M / 4, y * SIZE_M / 4) for x in (-1, 0, 1) for y in (-1, 1)]
    updates = [
        following.add(scan_at(FRAME_S + (k + 1) * 20.0, place, size_m=SIZE_M / 8, pixels=64, key=f"zoom {k}"))
        for k, place in enumerate(places)
    ]
    assert len(asked) == len(places)
    assert None not in asked
    assert not any(update.lost for update in updates)


def test_a_zoom_long_after_the_overview_is_not_searched_everywhere_in_it() -> None:
    world = World(night(4))
    following = BankTracker(world)
    following.add(scan_at(FRAME_S, pixels=64, key="overview"))
    asked = refusing(world)
    hours_later_s = FRAME_S + 40 * 3600.0
    following.add(scan_at(hours_later_s, size_m=SIZE_M / 8, pixels=64, key="zoom"))
    following.add(scan_at(hours_later_s + 300.0, pixels=64, key="overview again"))
    assert [one is None for one in asked[:2]] == [False, True], "an overview is looked for everywhere"


def test_without_correction_anchors_follow_each_other() -> None:
    """The region stays in tip coordinates, and the sample drifts out of it."""
    world = World(steady((0.3 * NM, 0.0)))
    following = BankTracker(world)
    for k in range(40):
        update = following.add(scan_at(FRAME_S + k * INTERVAL_S, key=str(k)))
        assert update.matched
    assert world.drift_m(update.after.time_s)[0] > 4 * SIZE_M
    assert np.linalg.norm(error_m(world, update.after)) < 4.0 * NM


def test_memory_is_bounded_in_scans_and_in_bytes() -> None:
    following = BankTracker(World(), anchors=3, recent=2)
    for k in range(30):
        following.add(scan_at(FRAME_S + k * INTERVAL_S, (k * SIZE_M / 4, 0.0), key=str(k)))
        assert len(following.state()["references"]) <= 5
    small = BankTracker(World(), most_bytes=3 * 8 * 8 * 8)
    for k in range(10):
        small.add(scan_at(FRAME_S + k * INTERVAL_S, key=str(k)))
        assert len(small.state()["references"]) <= 3
    assert {one["scan"]["key"] for one in small.state()["references"]} >= {"0", "9"}


def test_a_restored_tracker_continues_with_the_same_bits() -> None:
    def world() -> World:
        return World(night(10), blind={"scan 5"}, wrong={"scan 8": np.array([60.0, 0.0]) * NM})

    whole = follow(BankTracker(world()), 12)
    for cut in range(12):
        same = world()
        before = BankTracker(same)
        follow(before, cut)
        after = BankTracker(same)
        after.restore(before.state())
        assert after.forecast.to_dict() == before.forecast.to_dict()
        for update, expected in zip(follow(after, 12 - cut, first=cut), whole[cut:], strict=True):
            assert update.forecast.to_dict() == expected.forecast.to_dict()
            assert list(update.registrations) == list(expected.registrations)


def test_the_same_scans_give_the_same_numbers() -> None:
    first, second = (follow(BankTracker(World(night(11))), 10) for _ in range(2))
    assert first[-1].forecast.to_dict() == second[-1].forecast.to_dict()


def test_a_forecast_survives_json_and_predicts_any_time() -> None:
    world = World(STEADY, noise_m=0.01 * NM)
    following = BankTracker(world)
    follow(following, 12)
    forecast = forecast_from_dict(json.loads(json.dumps(following.forecast.to_dict(), allow_nan=False)))
    newest_s = FRAME_S + 11 * INTERVAL_S
    for time_s in (newest_s - 3000.0, newest_s, newest_s + 60.0, newest_s + 5000.0):
        ours, theirs = following.forecast.at(time_s), forecast.at(time_s)
        assert np.array_equal(ours.mapping.matrix, theirs.mapping.matrix)
        assert np.array_equal(ours.covariance_m2, theirs.covariance_m2)
        assert np.linalg.norm(error_m(world, ours)) < 2.0 * NM
    deviations = [forecast.at(newest_s + s).sd_m for s in (0.0, 900.0, 3600.0)]
    assert deviations == sorted(deviations)
    assert ours.rate_m_s == pytest.approx(STEADY(1.0), abs=1e-3 * NM)


@pytest.mark.parametrize("table", [{}, {"kind": "other"}, {"kind": "bank", "time_s": 1.0}, {"kind": "paper"}])
def test_a_damaged_forecast_is_refused(table: dict[str, object]) -> None:
    with pytest.raises(InvalidValue, match="forecast"):
        forecast_from_dict(table)


def test_a_measured_velocity_cuts_the_first_jump() -> None:
    jumps = []
    for told in (False, True):
        world = World(STEADY)
        following = BankTracker(world)
        follow(following, 1)
        if told:
            following.set_velocity(FRAME_S, STEADY(1.0), np.eye(2) * (0.002 * NM) ** 2)
        jumps.append(float(np.linalg.norm(error_m(world, following.forecast.at(FRAME_S + INTERVAL_S)))))
    assert jumps[0] > 40.0 * NM
    assert jumps[1] < 5.0 * NM


def test_a_velocity_before_the_first_scan_is_refused() -> None:
    with pytest.raises(InvalidValue, match="first scan"):
        BankTracker(World()).set_velocity(0.0, (0.0, 0.0), np.eye(2))


def compensating(drift: Drift, since_s: float, velocity: Array) -> Drift:
    """Return the remaining drift in tip coordinates when a controller compensates."""
    return lambda t: drift(t) - velocity * max(t - since_s, 0.0)


def test_a_rate_compensated_by_the_controller_is_subtracted() -> None:
    calm = night(12)
    changed_s = FRAME_S + 10.4 * INTERVAL_S
    velocity = (calm(changed_s) - calm(changed_s - 900.0)) / 900.0
    predicted = {}
    for told in (False, True):
        world = World(compensating(calm, changed_s, velocity))
        following = BankTracker(world)
        follow(following, 11)
        if told:
            following.compensated(changed_s, velocity)
            assert following.forecast.at(changed_s + 1.0).rate_m_s == pytest.approx((0.0, 0.0), abs=0.02 * NM)
        updates = follow(following, 8, first=11)
        predicted[told] = [float(np.linalg.norm(error_m(world, update.before))) for update in updates]
    assert predicted[True][0] < 10.0 * NM
    assert predicted[False][0] > 2 * predicted[True][0]
    assert predicted[True][-1] < 10.0 * NM


def test_compensation_may_change_during_a_scan_and_survives_a_kill() -> None:
    """The file of a scan that was half done at that time comes after the change."""
    velocity = np.array([0.05, -0.03]) * NM
    changed_s = FRAME_S + 9 * INTERVAL_S + 30.0
    world = World(compensating(STEADY, changed_s, velocity), noise_m=0.01 * NM)
    following = BankTracker(world)
    follow(following, 9)
    following.compensated(changed_s, velocity)
    again = BankTracker(world)
    again.restore(following.state())
    for update in follow(again, 4, first=9):
        assert update.matched
        assert np.linalg.norm(error_m(world, update.before)) < 1.0 * NM
    assert np.linalg.norm(update.after.rate_m_s) < 0.003 * NM


def test_compensation_reported_too_late_is_refused() -> None:
    following = BankTracker(World())
    follow(following, 2)
    with pytest.raises(InvalidValue, match="before the next scan"):
        following.compensated(0.0, (0.0, 0.0))


def test_an_older_scan_is_refused_and_changes_nothing() -> None:
    following = BankTracker(World(STEADY))
    follow(following, 3)
    before = following.forecast.to_dict()
    with pytest.raises(InvalidValue, match="order of time"):
        following.add(scan_at(0.0))
    assert following.forecast.to_dict() == before


@pytest.mark.parametrize(
    "settings", [{"forgett": 1.0}, {"densities_m2_s3": []}, {"inflation": 1.0}, {"walks_m2_s": [0.0]}, {"forget": "x"}]
)
def test_meaningless_tracker_settings_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        tracker({"class": "bank", **settings}, World())


def test_trackers_have_names() -> None:
    assert isinstance(tracker("bank", World()), BankTracker)
    assert isinstance(tracker("paper", World()), PaperTracker)
    assert isinstance(tracker({"compared": 2}, World()), BankTracker)
    assert isinstance(tracker("afspm.plugins.drift.track.paper.PaperTracker", World()), PaperTracker)
    with pytest.raises(ConfigError, match="did you mean 'paper'"):
        tracker("papper", World())
    with pytest.raises(ConfigError, match="not a tracker"):
        tracker({"class": "collections.OrderedDict"}, [])  # type: ignore[arg-type]
