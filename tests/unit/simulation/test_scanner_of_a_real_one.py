"""The scanner "stm-4k": each statistic of the real instrument is found again in simulated data."""

from __future__ import annotations

import json
import math
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest

from afspm.basics.errors import ConfigError
from afspm.model import Feedback, Region
from afspm.model.arrays import Array
from afspm.simulation import World
from afspm.simulation.instrument import SimulatedInstrument
from afspm.simulation.world import SCANNERS, read_settings

QUIET = {"white_m": 0.0, "one_over_f_m": 0.0, "line_offset_m": 0.0, "scar_probability": 0.0, "current_a": 0.0}
EXACT: dict[str, Any] = {"miscalibration": []}
STILL = {"speed_m_per_s": 0.0, "velocity_m_per_s": [0.0, 0.0, 0.0]}


def world(seed: int = 3, **settings: Any) -> World:
    scanner = {"like": "stm-4k", **settings.pop("scanner", {})}
    return World.from_settings({"noise": QUIET, **settings, "scanner": scanner}, seed=seed, start_s=0.0)


def truth(w: World, t_s: float = 0.0) -> dict[str, Any]:
    return w.truth(t_s)


def height(w: World, region: Region, start_s: float, shape: tuple[int, int] = (64, 64), line_s: float = 1.0) -> Array:
    return w.scan(region, shape, line_s, start_s).channels()["Height"][1]


def shift_px(of: Array, against: Array, most: int = 24) -> float:
    """Return the displacement in x of one image against another, by the least difference of their middles, in px."""
    middle = against[:, most:-most]
    differences = [np.square(np.roll(of, -d, axis=1)[:, most:-most] - middle).sum() for d in range(-most, most + 1)]
    at = int(np.argmin(differences))
    left, here, right = differences[at - 1 : at + 2]
    return float(at - most + 0.5 * (left - right) / (left - 2 * here + right))


def test_scanner_is_exact_unless_it_is_named() -> None:
    surface, by_default = read_settings({})
    assert (surface, by_default.scanner.creep_share, by_default.drift.speed_m_per_s) == ("steps", 0.0, 0.0)
    assert World.from_settings({}, 1, 0.0).truth(0.0).get("scales") is None
    with pytest.raises(ConfigError, match=r"did you mean 'stm-4k'"):
        read_settings({"scanner": "stm-4"})
    _, changed = read_settings({"scanner": {"like": "stm-4k", "creep_share": 0.0}, "drift": {"speed_m_per_s": 0.0}})
    assert (changed.scanner.creep_share, changed.scanner.creep_time_s, changed.drift.speed_m_per_s) == (0.0, 500.0, 0.0)


def test_drift_has_the_same_speed_in_a_direction_of_the_seed() -> None:
    drifts = np.array([world(seed).drift_m(1000.0) for seed in range(1, 6)])
    np.testing.assert_allclose(np.hypot(*drifts[:, :2].T), 15e-9)
    np.testing.assert_allclose(drifts[:, 2], 1e-9)
    assert np.ptp(np.arctan2(drifts[:, 1], drifts[:, 0])) > 1.0


def test_creep_after_a_move_grows_with_the_logarithm() -> None:
    w, way_m, pixel_m = world(scanner=EXACT, drift=STILL, surface="particles"), 1e-6, 4e-9
    region = Region((way_m, 0.0), (256e-9, 256e-9))
    times_s = np.array([5.0, 300.0, 600.0, 1200.0])
    seen = [height(w, region, t_s, line_s=0.25) for t_s in times_s]
    crept_m = np.array([-shift_px(one, seen[0]) for one in seen]) * pixel_m
    at_s = times_s - times_s[0] + 8.0  # the middle of each scan; the scanner moved at the first one
    grown = np.log1p(at_s / 500.0) - math.log1p(at_s[0] / 500.0)
    share = float(crept_m @ grown / (grown @ grown)) / way_m
    assert share == pytest.approx(0.05, rel=0.05)
    np.testing.assert_allclose(crept_m, share * way_m * grown, atol=1.5 * pixel_m)
    assert truth(w, 505.0)["crept_m"] == pytest.approx([0.05 * way_m * math.log(2.0), 0.0])


def test_creep_of_earlier_moves_goes_on_after_a_restart() -> None:
    w = world(surface="particles")
    for number in range(3):
        height(w, Region((number * 200e-9, -50e-9), (100e-9, 100e-9)), 100.0 * number)
    again = world(surface="particles")
    again.restore(json.loads(json.dumps(w.state())))
    region = Region((0.0, 0.0), (100e-9, 100e-9))
    np.testing.assert_array_equal(height(again, region, 400.0), height(w, region, 400.0))
    assert len(truth(w, 400.0)["crept_m"]) == 2


def test_retrace_lags_by_another_part_of_the_line_in_each_third() -> None:
    w = world(scanner=EXACT, drift=STILL, surface="particles")
    channels = w.scan(Region((0.0, 0.0), (1e-6, 0.5e-6)), (128, 768), 4.0, 0.0).channels()
    trace, retrace = channels["Height"][1], channels["Height Retrace"][1]
    middles = [slice(at - 60, at + 60) for at in (128, 384, 640)]  # between them the lag changes evenly
    lag = [shift_px(trace[:, part], retrace[:, part]) / 768 for part in middles]
    np.testing.assert_allclose(lag, (0.0098, 0.0137, 0.0117), atol=0.001)
    assert lag[0] < lag[2] < lag[1]


def test_step_edge_is_more_than_a_pixel_wide() -> None:
    steps = {"kind": "steps", "angle_deg": 0.0, "meander": 0.0, "edge_m": 1e-12, "roughness_rms_m": 0.0}
    w = world(scanner=EXACT, drift=STILL, surface=steps, tip={"radius_m": 1e-11}, feedback={"mode": "current"})
    line = height(w, Region((0.0, 0.0), (160e-9, 2e-9)), 0.0, (8, 160), 10.0).mean(axis=0)
    at = int(np.abs(np.diff(line)).argmax())
    low, high = line[at - 8], line[at + 9]
    before, after = (NormalDist().inv_cdf(float((one - low) / (high - low))) for one in line[at : at + 2])
    assert 2.0 * NormalDist().inv_cdf(0.9) / (after - before) == pytest.approx(1.2, abs=0.1), "from 10 to 90 %"


def test_calibration_is_off_both_ways_and_known_to_the_truth() -> None:
    scales = np.array([truth(world(seed))["scales"] for seed in range(1, 30)])
    off = np.abs(scales - 1.0)
    assert off[:, :2].min() >= 0.07
    assert off[:, :2].max() <= 0.09
    assert off[:, 2].min() >= 0.12
    assert off[:, 2].max() <= 0.125
    assert (np.ptp(scales, axis=0) > 0.14).all(), "both signs"


def test_scan_shows_the_error_of_calibration() -> None:
    quiet: dict[str, Any] = {"drift": STILL, "surface": "particles"}
    off = world(scanner={"creep_share": 0.0}, **quiet)
    exact = world(scanner={"creep_share": 0.0, **EXACT}, **quiet)
    x, y, z = truth(off)["scales"]
    seen = height(off, Region((100e-9, 50e-9), (0.5e-6, 0.5e-6)), 0.0, line_s=1.0)
    true = height(exact, Region((x * 100e-9, y * 50e-9), (x * 0.5e-6, y * 0.5e-6)), 0.0, line_s=1.0)
    fit = np.polyfit(true.ravel(), seen.ravel(), 1)
    assert fit[0] == pytest.approx(z, rel=0.01)
    assert np.corrcoef(true.ravel(), seen.ravel())[0, 1] > 0.999
    assert off.under((100e-9, 50e-9), 0.0) == pytest.approx((x * 100e-9, y * 50e-9))


def test_current_saturates_at_the_range_of_the_preamplifier() -> None:
    w = world(surface="flat", feedback={"mode": "current"})
    height(w, Region((0.0, 0.0), (50e-9, 50e-9)), 0.0)
    w.hold(-1e-9)
    at_rest = w.at_rest((0.0, 0.0), 2.0, Feedback(on=False), random=np.random.default_rng(1))
    assert at_rest["Current"] == 10.004e-9


def test_coarse_steps_show_in_the_current() -> None:
    settings = {"surface": "flat", "feedback": {"mode": "current"}, "noise": QUIET, "scanner": "stm-4k"}
    rig = SimulatedInstrument(settings, 3, 0.0)
    still = rig.signals(0.0)["Current"]
    rig.engage(1.0)
    spikes = [rig.signals(1.0 + i / 100)["Current"] - still for i in range(50)]
    assert 82e-12 <= min(spikes) < 120e-12
    assert 340e-12 < max(spikes) <= 375e-12
    assert rig.signals(3.0)["Current"] == pytest.approx(still)


def test_first_lines_after_a_move_are_bent_until_z_has_settled() -> None:
    # results C38
    def bend_pm(wait_s: float) -> float:
        w, there = world(surface="flat", drift=STILL), Region((220e-9, 0.0), (50e-9, 50e-9))
        w.move_to(there.center_m, 10.0)
        lines = height(w, there, 10.0 + wait_s, line_s=0.5).mean(axis=1)
        return float(1e12 * (lines[0] - lines[-1]) / truth(w)["scales"][2])

    at_once, later = bend_pm(0.0), bend_pm(13.0)
    assert at_once == pytest.approx(94.0, rel=0.1)
    assert later == pytest.approx(26.0, rel=0.1)


def test_every_named_scanner_has_valid_settings() -> None:
    for name in SCANNERS:
        World.from_settings({"scanner": name}, 1, 0.0)
