"""The state between measurements: tip, marks, random numbers, and the saved state."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from afspm.basics.errors import ConfigError, ConfigErrors, InvalidValue
from afspm.model import Feedback, Region
from afspm.simulation import World
from afspm.simulation.measuring import Adjustment
from afspm.simulation.tip import Chances, TipChangeSettings, crash_times, pulse_times

REGION = Region((0.0, 0.0), (1e-6, 1e-6))
SHAPE = (48, 48)


def world(seed: int = 3, **settings: Any) -> World:
    return World.from_settings({"surface": "particles", **settings}, seed=seed, start_s=0.0)


def truth(w: World, t_s: float) -> dict[str, Any]:
    return w.truth(t_s)


def scan_height(w: World, start_s: float, region: Region = REGION) -> np.ndarray:
    return w.scan(region, SHAPE, 1.0, start_s).channels()["Height"][1]


def test_same_seed_and_calls_give_the_same_night() -> None:
    def night(seed: int) -> list[np.ndarray]:
        w = world(seed, tip_changes={"per_hour": 60.0}, drift={"walk_m_per_sqrt_hour": 100e-9})
        seen = [scan_height(w, 0.0), scan_height(w, 60.0)]
        w.pulse(4.0, 0.1, 120.0)
        return [*seen, scan_height(w, 130.0), w.spectrum("IV", (1e-7, 0.0), 200.0)[2]]

    for one, again in zip(night(3), night(3), strict=True):
        np.testing.assert_array_equal(one, again)
    assert not np.array_equal(night(3)[0], night(4)[0])


def test_adjustment_during_a_scan_holds_from_the_next_line_on() -> None:
    late = Adjustment(20.5, Feedback(setpoint=0.95, proportional_gain=0.01, integral_gain=5.0), 0.1)
    whole, changed = (
        world().scan(REGION, SHAPE, 1.0, 0.0, adjusted=adjusted).channels()["Height"][1] for adjusted in ((), (late,))
    )
    np.testing.assert_array_equal(changed[:21], whole[:21])
    assert np.abs(changed[21:] - whole[21:]).max() > 1e-9
    down = [
        world().scan(REGION, SHAPE, 1.0, 0.0, direction="down", adjusted=adjusted).channels()["Height"][1]
        for adjusted in ((), (late,))
    ]
    np.testing.assert_array_equal(down[0][27:], down[1][27:])
    assert not np.array_equal(down[0][:27], down[1][:27])


def test_restored_world_continues_identically() -> None:
    settings: dict[str, Any] = {
        "tip_changes": {"per_hour": 60.0, "schedule": [[70.0, "double"], [150.0, "contaminated"]]}
    }
    w = world(**settings)
    scan_height(w, 0.0)
    w.crash((2e-7, 1e-7), 10e-9, 1e-7, 60.0)
    saved = json.loads(json.dumps(w.state()))
    expected = [scan_height(w, 65.0), scan_height(w, 130.0)]
    again = world(**settings)
    again.restore(saved)
    assert json.loads(json.dumps(again.state())) == saved
    np.testing.assert_array_equal(scan_height(again, 65.0), expected[0])
    np.testing.assert_array_equal(scan_height(again, 130.0), expected[1])
    assert again.truth(200.0) == w.truth(200.0)


def test_state_of_another_world_is_refused_and_nothing_changes() -> None:
    w = world(3)
    before = w.state()
    damaged = {**before, "tips": [{"t_s": 0.0}]}
    for state in (world(4).state(), {}, damaged, {**before, "at_m": None}):
        with pytest.raises(InvalidValue):
            w.restore(state)
    assert w.state() == before


def test_scheduled_change_happens_in_the_middle_of_a_scan() -> None:
    plan = {"schedule": [[24.2, "double"]]}
    w, sharp = world(tip_changes=plan), world()
    changed, usual = scan_height(w, 0.0), scan_height(sharp, 0.0)
    difference = np.abs(changed - usual).max(axis=1)
    assert difference[:24].max() < 1e-9
    assert difference[25:].max() > 10e-9
    assert [truth(w, t_s)["tip"]["flaws"] for t_s in (10.0, 24.0, 25.0)] == [(), (), ("double",)]
    assert [c["cause"] for c in truth(w, 48.0)["tip_changes"]] == ["start", "schedule"]


def test_stopped_scan_revokes_predicted_changes() -> None:
    w = world(tip_changes={"schedule": [[40.0, "blunt"]]})
    scan_height(w, 0.0)
    assert not w.tip.is_sharp
    w.spectrum("force", (0.0, 0.0), 20.0)  # so the scan was stopped before
    assert w.tip.is_sharp
    scan_height(w, 22.0)  # and now it comes
    assert w.tip.flaws == ("blunt",)
    assert len([c for c in truth(w, 80.0)["tip_changes"] if c["cause"] == "schedule"]) == 1


def test_scheduled_change_happens_without_a_scan() -> None:
    w = world(tip_changes={"schedule": [[0.0, "blunt"], [5.0, "sharp"], [10.0, "double"]]})
    assert w.tip.flaws == ("blunt",)
    w.spectrum("IV", (0.0, 0.0), 7.0)
    assert w.tip.is_sharp
    w.spectrum("IV", (0.0, 0.0), 20.0)
    assert w.tip.flaws == ("double",)


def changes_by_chance(scans: int, setpoint: float, **settings: Any) -> int:
    w = world(surface="flat", tip_changes=settings)
    for number in range(scans):
        w.scan(REGION, (60, 8), 60.0, number * 3600.0, Feedback(setpoint=setpoint))
    return sum(c["cause"] == "chance" for c in truth(w, scans * 3600.0)["tip_changes"])


def test_tip_changes_at_the_set_rate_and_more_at_a_hard_setpoint() -> None:
    gentle = changes_by_chance(60, 0.7, per_hour=2.0)
    assert gentle == pytest.approx(120, abs=40)
    hard = changes_by_chance(60, 0.4, per_hour=2.0)
    assert hard == pytest.approx(480, abs=90)
    assert changes_by_chance(60, 1.2, per_hour=2.0) == 0  # never touches
    by_length = changes_by_chance(60, 0.7, per_metre=1e4)  # 120 um a scan
    assert by_length == pytest.approx(72, abs=30)


def test_scanning_wears_the_tip_harder_faster() -> None:
    def radius(setpoint: float) -> float:
        w = world(tip_changes={"wear_m_per_m": 1e-4})
        w.scan(REGION, SHAPE, 1.0, 0.0, Feedback(setpoint=setpoint))
        return w.tip.radius_m - 8e-9

    assert radius(0.7) == pytest.approx(1e-4 * 96e-6, rel=1e-6)
    assert radius(0.4) == pytest.approx(4e-4 * 96e-6, rel=1e-6)


def test_each_flaw_of_the_tip_shows() -> None:
    seen = {c: scan_height(world(tip={"condition": c}), 0.0) for c in ("sharp", "blunt", "double", "contaminated")}
    covered = {c: np.mean(h - np.median(h) > 10e-9) for c, h in seen.items()}
    assert covered["blunt"] > 1.5 * covered["sharp"]
    assert covered["double"] > 1.3 * covered["sharp"]
    roughness = {c: np.median(np.abs(np.diff(np.median(h, axis=1)))) for c, h in seen.items()}
    assert covered["contaminated"] > 1.1 * covered["sharp"]
    assert roughness["sharp"] < 1e-9


def test_crash_leaves_a_crater_in_later_scans_only() -> None:
    w = world(surface="flat", drift={"velocity_m_per_s": [1e-9, 0.0, 0.0]}, tip_changes={"crash_cures": 1.0})
    assert np.ptp(scan_height(w, 0.0)) < 3e-9
    w.crash((1.5e-7, -2e-7), 20e-9, 1e-7, 100.0)
    later = scan_height(w, 200.0)
    row, column = np.unravel_index(later.argmin(), later.shape)
    x, y = REGION.pixels_m(SHAPE)
    moved = 1e-9 * (100.0 + row)  # the crater drifts with the sample
    assert x[row, column] == pytest.approx(1.5e-7 + moved, abs=3e-8)
    assert y[row, column] == pytest.approx(-2e-7, abs=3e-8)
    assert later.min() < -3e-9
    at_crater = w.sample.surface_m(np.array([1.5e-7 - 1e-7]), np.array([-2e-7]))
    assert at_crater[0] < -3e-9
    assert w.sample.surface_m(np.array([5e-8]), np.array([-2e-7]), t_s=50.0)[0] == 0.0


def test_pulses_and_crashes_cure_and_worsen_at_the_set_probability() -> None:
    settings = {"pulse_cures": 0.5, "pulse_worsens": 0.2, "crash_cures": 1.0, "crash_worsens": 0.0}
    outcomes = {"cured": 0, "worsened": 0, "unchanged": 0}
    for seed in range(300):
        w = world(seed, surface="flat", tip={"condition": "double"}, tip_changes=settings)
        outcome = w.pulse(10.0, 0.05, 1.0)
        outcomes[outcome] += 1
        assert w.tip.is_sharp == (outcome == "cured")
    assert outcomes["cured"] == pytest.approx(150, abs=35)
    assert outcomes["worsened"] == pytest.approx(60, abs=25)
    w = world(surface="flat", tip={"condition": "blunt"}, tip_changes=settings)
    assert w.pulse(0.5, 0.05, 1.0) == "unchanged"  # below the threshold
    assert w.crash((0.0, 0.0), 5e-9, 1e-7, 2.0) == "cured"
    assert w.tip.is_sharp
    slow = [world(seed, surface="flat", tip_changes=settings).crash((0.0, 0.0), 5e-9, 5e-9, 1.0) for seed in range(100)]
    assert slow.count("cured") == pytest.approx(10, abs=9)


def test_deeper_crash_leaves_a_deeper_crater_up_to_the_limit_of_the_tip() -> None:
    def crater_m(depth_m: float, condition: str = "sharp") -> float:
        w = world(surface="flat", tip={"condition": condition})
        w.crash((0.0, 0.0), depth_m, 50e-9, 1.0)
        (mark,) = truth(w, 2.0)["marks"]
        assert float(w.sample.surface_m(0.0, 0.0)[()]) < -0.5 * mark["depth_m"]
        return float(mark["depth_m"])

    asked_m = [1e-9, 2e-9, 5e-9, 10e-9, 20e-9, 50e-9, 1e-6]
    craters_m = [crater_m(depth_m) for depth_m in asked_m]
    assert craters_m == sorted(craters_m)
    assert all(0.0 < made_m < wanted_m for made_m, wanted_m in zip(craters_m, asked_m, strict=True))
    assert craters_m[2] > 4 * craters_m[0]  # as long as it is shallow, what was asked for decides
    assert craters_m[-1] < 3 * 8e-9  # and in the end the apex gives way
    assert crater_m(1e-6, "blunt") > craters_m[-1]


def test_chances_grow_with_depth_with_duration_and_with_voltage() -> None:
    s = TipChangeSettings()
    crashes = [Chances(0.6, 0.2).of_times(crash_times(s, depth_m)) for depth_m in (1e-10, 1e-9, 5e-9, 20e-9, 1e-6)]
    pulses = [Chances(0.6, 0.2).of_times(pulse_times(s, duration_s)) for duration_s in (1e-4, 0.01, 0.05, 1.0, 60.0)]
    for grown in (crashes, pulses):
        assert [one.cures for one in grown] == sorted(one.cures for one in grown)
        assert [one.worsens for one in grown] == sorted(one.worsens for one in grown)
        assert (grown[2].cures, grown[2].worsens) == pytest.approx((0.6, 0.2))  # the usual ones, as told
        assert all(one.cures + one.worsens <= 1.0 + 1e-12 for one in grown)
    assert crashes[-1].cures + crashes[-1].worsens == pytest.approx(1.0)
    assert pulses[-1].cures + pulses[-1].worsens < 1.0 - 0.2**2 + 1e-12  # no more than two pulses do
    assert Chances(0.0, 0.0).of_times(3.0) == Chances(0.0, 0.0)
    assert Chances(1.0, 0.5).of_times(3.0) == Chances(1.0, 0.0)


def test_deeper_crashes_and_longer_pulses_cure_more_tips() -> None:
    settings = {"crash_cures": 0.4, "crash_worsens": 0.1, "pulse_cures": 0.3, "pulse_worsens": 0.1}

    def cured(treat: Callable[[World], str]) -> int:
        made = [world(seed, surface="flat", tip={"condition": "blunt"}, tip_changes=settings) for seed in range(200)]
        return [treat(w) for w in made].count("cured")

    def crash(w: World, depth_m: float) -> str:
        return w.crash((0.0, 0.0), depth_m, 50e-9, 1.0)

    def pulse(w: World, voltage_v: float, duration_s: float) -> str:
        return w.pulse(voltage_v, duration_s, 1.0)

    by_depth = [cured(partial(crash, depth_m=d)) for d in (1e-9, 5e-9, 20e-9)]
    assert by_depth[1] == pytest.approx(80, abs=25)
    assert by_depth[0] < 0.5 * by_depth[1] < 0.7 * by_depth[2]
    by_duration = [cured(partial(pulse, voltage_v=8.0, duration_s=t)) for t in (5e-3, 50e-3, 5.0)]
    assert by_duration[0] < by_duration[1] < by_duration[2] < 2.5 * by_duration[1]
    by_voltage = [cured(partial(pulse, voltage_v=v, duration_s=50e-3)) for v in (1.0, 2.2, 8.0)]
    assert by_voltage[0] == 0 < by_voltage[1] < by_voltage[2]


@pytest.mark.parametrize(("depth_m", "speed_m_s"), [(0.0, 1e-7), (-1e-9, 1e-7), (math.nan, 1e-7), (1e-9, 0.0)])
def test_crash_of_no_depth_or_no_speed_is_refused(depth_m: float, speed_m_s: float) -> None:
    with pytest.raises(InvalidValue):
        world().crash((0.0, 0.0), depth_m, speed_m_s, 1.0)


def test_creep_brings_the_tip_to_its_place_slowly() -> None:
    def after(creep: float, wait_s: float) -> np.ndarray:
        w = world(scanner={"creep": creep}, noise={"scar_probability": 0.0})
        w.spectrum("IV", (5e-6, 0.0), 0.0)
        w.spectrum("IV", REGION.center_m, 1.0)
        return scan_height(w, 1.0 + wait_s)

    still = after(0.0, 0.0)
    soon, late = (np.std(after(0.05, wait) - still) for wait in (0.0, 20000.0))
    assert soon > 3 * late


def test_settings_are_refused_with_place_and_nearest_name() -> None:
    cases: list[tuple[dict[str, Any], str]] = [
        ({"drif": {}}, "did you mean 'drift'"),
        ({"noise": {"whit_m": 1.0}}, "did you mean 'white_m'"),
        ({"noise": {"white_m": -1.0}}, "zero or more"),
        ({"noise": {"white_m": "much"}}, "'much' is not a number with a unit"),
        ({"noise": {"white_m": "3 pA"}}, "A can't be converted to m"),
        ({"noise": {"white_m": "3"}}, "'3' has no unit"),
        ({"signals": {"conductance_s": "3 s"}}, "expected float"),
        ({"feedback": {"setpoint": "3 pA"}}, "without a unit"),
        ({"noise": {"white_m": float("nan")}}, "finite"),
        ({"noise": 3}, "expected a table"),
        ({"tip": {"radius_m": 8.0}}, "lengths are in m"),  # faults 18: it was accepted, and took all memory
        ({"tip": {"half_angle_deg": 90.0}}, "below 90"),
        ({"tip": {"condition": "blund"}}, "did you mean 'blunt'"),
        ({"tip_changes": {"schedule": [[1.0, "dubble"]]}}, "did you mean 'double'"),
        ({"tip_changes": {"schedule": [[1.0]]}}, "expected 2 values"),
        ({"drift": {"relaxing": [{"time_s": 0.0}]}}, "above zero"),
        ({"drift": {"velocity_m_per_s": [1.0, 2.0]}}, "expected 3 values"),
        ({"feedback": {"mode": "amplitud"}}, "did you mean 'amplitude'"),
        ({"feedback": {"on": 1}}, "expected bool"),
        ({"surface": {"kind": "step"}}, "did you mean 'steps'"),
    ]
    for settings, message in cases:
        with pytest.raises(ConfigError, match=message):
            World.from_settings(settings, seed=1, start_s=0.0)


def test_all_wrong_settings_are_reported_together() -> None:
    wrong = {
        "drif": {},
        "noise": {"whit_m": 1.0, "scar_m": -1.0, "hum_m": "loud"},
        "drift": {"relaxing": [{"time_s": 0.0}, {"tim_s": 1.0}]},
        "surface": {"kind": "steps", "stepp_m": 1.0},
    }
    with pytest.raises(ConfigErrors) as told:
        World.from_settings(wrong, seed=1, start_s=0.0)
    assert [error.where.removeprefix("simulation.") for error in told.value.errors] == [
        "drif", "noise.whit_m", "noise.hum_m", "noise.scar_m", "drift.relaxing[0].time_s", "drift.relaxing[1].tim_s",
        "surface.stepp_m",
    ]  # fmt: skip


def test_lattice_is_imaged_by_tunnelling_by_default() -> None:
    w = world(surface="lattice")
    region = Region((0.0, 0.0), (3e-9, 3e-9))
    seen = w.scan(region, (64, 64), 1.0, 0.0, bias_v=-0.2).channels()
    assert set(seen) == {"Height", "Height Retrace", "Current"}
    assert np.median(seen["Current"][1]) == pytest.approx(-100e-12, rel=0.1)
    x, y = region.pixels_m((64, 64))
    assert np.corrcoef(seen["Height"][1].ravel(), w.sample.surface_m(x, y).ravel())[0, 1] > 0.8
