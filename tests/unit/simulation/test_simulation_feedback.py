"""The z feedback: effects of gains and setpoint."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from afspm.basics.errors import ConfigError, InvalidValue
from afspm.model import Feedback, Region
from afspm.simulation import World
from afspm.simulation.feedback import MODES, FeedbackSettings, Loop, SensorSettings

REGION = Region((0.0, 0.0), (1e-6, 1e-6))
DT = 1e-4


def loop(**said: Any) -> Loop:
    return Loop.of(FeedbackSettings(), Feedback(**said))


def step(height_m: float, steps: int = 400) -> np.ndarray:
    path = np.full((steps, 1), height_m)
    path[:10] = 0.0
    return path


def channels(**said: Any) -> dict[str, np.ndarray]:
    world = World.from_settings({"surface": "particles"}, seed=3, start_s=0.0)
    scan = world.scan(REGION, (64, 96), 1.0, 0.0, Feedback(**said))
    return {name: values for name, (_, values) in scan.channels().items()}


def asymmetry(said: dict[str, Any]) -> float:
    seen = channels(**said)
    return float(np.std(seen["Height"] - seen["Height Retrace"]) / np.std(seen["Height"]))


def test_loop_settles_on_the_surface_without_error() -> None:
    z = loop(integral_gain=1500.0).follow(step(5e-9), DT, np.zeros(1))
    assert z[-1, 0] == pytest.approx(5e-9, rel=1e-3)
    assert z.max() < 5.5e-9


def test_one_long_step_is_as_good_as_many_short_ones() -> None:
    ramp = np.linspace(0.0, 1e-9, 11)[:, None]
    fine = np.interp(np.linspace(0, 10, 101), np.arange(11), ramp[:, 0])[:, None]
    a = loop(integral_gain=800.0).follow(ramp, 1e-3, np.zeros(1))
    b = loop(integral_gain=800.0).follow(fine, 1e-4, np.zeros(1))
    np.testing.assert_allclose(a[:, 0], b[::10, 0], atol=1e-15)


def test_lower_gains_are_slower_and_higher_ones_overshoot() -> None:
    at = {
        gain: loop(integral_gain=gain).follow(step(5e-9, 1500), DT, np.zeros(1))[:, 0]
        for gain in (50.0, 1500.0, 8000.0)
    }
    settled = {gain: int(np.argmax(z > 4.5e-9)) for gain, z in at.items()}
    assert settled[50.0] > 10 * (settled[1500.0] - 10) > 0
    assert at[8000.0].max() > 6e-9
    assert at[50.0].max() <= 5e-9


def test_gains_beyond_the_limit_oscillate() -> None:
    unstable = loop(integral_gain=12000.0)
    assert unstable.oscillates
    assert not loop(integral_gain=1500.0).oscillates
    z = unstable.follow(step(0.0, 3000), DT, np.array([1e-6]))[-1000:, 0]
    assert z.max() > 5e-9
    assert z.min() < -5e-9
    assert np.abs(z).max() < 200e-9


def test_tip_parachutes_down_a_cliff_more_the_softer_the_setpoint() -> None:
    def time_down(setpoint: float) -> int:
        z = loop(setpoint=setpoint, integral_gain=300.0).follow(step(-100e-9, 2000), DT, np.zeros(1))[:, 0]
        return int(np.argmax(z < -90e-9))

    def time_up(setpoint: float) -> int:
        z = loop(setpoint=setpoint, integral_gain=300.0).follow(step(100e-9, 2000), DT, np.zeros(1))[:, 0]
        return int(np.argmax(z > 90e-9))

    assert time_down(0.95) > 2 * time_down(0.7) > 2 * time_up(0.7)


def test_low_gains_smear_trace_and_retrace_apart() -> None:
    good, slow = asymmetry({"integral_gain": 1500.0}), asymmetry({"integral_gain": 60.0, "proportional_gain": 0.0})
    assert good < 0.1
    assert slow > 3 * good


def test_unstable_gains_are_seen_in_height_and_amplitude() -> None:
    good, bad = channels(integral_gain=1500.0), channels(integral_gain=12000.0)
    assert bad["Amplitude"].std() > 5 * good["Amplitude"].std()
    assert np.median(np.abs(np.diff(bad["Height"], axis=1))) > 5 * np.median(np.abs(np.diff(good["Height"], axis=1)))


def test_without_feedback_the_height_is_constant_and_the_amplitude_shows_the_sample() -> None:
    world = World.from_settings({"surface": "particles", "noise": {"scar_probability": 0.0}}, seed=3, start_s=0.0)
    on = world.scan(REGION, (64, 96), 1.0, 0.0).channels()["Height"][1]
    off = world.scan(REGION, (64, 96), 1.0, 100.0, Feedback(on=False)).channels()
    assert off["Height"][1].std() < 0.05 * on.std()
    high = on > np.percentile(on, 97)
    assert off["Amplitude"][1][high].mean() < off["Amplitude"][1][~high].mean() - 0.3


def test_setpoint_above_the_free_amplitude_never_touches() -> None:
    seen = channels(setpoint=1.2)
    assert seen["Height"].std() < 1e-9
    assert seen["Height"].mean() > 1e-6
    assert np.allclose(seen["Amplitude"], 1.0, atol=0.02)
    assert np.abs(seen["Current"]).max() < 10e-12


def test_amplitude_phase_and_current_answer_to_the_setpoint() -> None:
    soft, hard = channels(setpoint=0.8), channels(setpoint=0.4)
    assert np.median(soft["Amplitude"]) == pytest.approx(0.8, abs=0.01)
    assert np.median(hard["Amplitude"]) == pytest.approx(0.4, abs=0.01)
    assert np.median(hard["Phase"]) < np.median(soft["Phase"]) < 90.0
    assert np.median(hard["Current"]) > 2 * np.median(soft["Current"])


@pytest.mark.parametrize("said", [{"integral_gain": -1.0}, {"proportional_gain": float("nan")}, {"setpoint": 0.0}])
def test_invalid_feedback_is_refused(said: dict[str, float]) -> None:
    with pytest.raises(InvalidValue):
        loop(**said)


@pytest.mark.parametrize("gain", [9_500.0, 20_000.0, 100_000.0, 500_000.0])
@pytest.mark.parametrize("line_s", [0.5, 4.0])
def test_beyond_stability_the_signal_swings_from_pixel_to_pixel_however_high_the_gain(
    gain: float, line_s: float
) -> None:
    world = World.from_settings({"surface": "flat"}, seed=3, start_s=0.0)
    scan = world.scan(REGION, (16, 64), line_s, 0.0, Feedback(integral_gain=gain)).channels()
    amplitude = scan["Amplitude"][1]
    assert amplitude.std(axis=1).min() > 0.1  # in every line, and not only from line to line


# --- without contact: the frequency shift of a sensor ---


def test_with_a_small_amplitude_the_shift_is_the_gradient_of_the_force() -> None:
    sensor = SensorSettings(oscillation_m=1e-13)
    distances_m = np.array([1e-9, 2e-9, 5e-9])
    gradients = sensor.hamaker_j * sensor.radius_m / (3.0 * distances_m**3)
    expected_hz = -sensor.resonance_hz / (2.0 * sensor.spring_n_per_m) * gradients
    np.testing.assert_allclose(sensor.shift_hz(distances_m), expected_hz, rtol=1e-3)


def test_distance_shift_and_slope_of_a_sensor_belong_together() -> None:
    sensor = SensorSettings()
    for shift_hz in (-100.0, -20.0, -0.1):
        distance_m = sensor.distance_m(shift_hz)
        assert sensor.shift_hz(np.array(distance_m)) == pytest.approx(shift_hz)
        near = sensor.shift_hz(np.array([distance_m - 1e-12, distance_m + 1e-12]))
        assert sensor.slope_hz_per_m(distance_m) == pytest.approx(np.diff(near)[0] / 2e-12, rel=1e-4)


@pytest.mark.parametrize("setpoint_hz", [0.0, 20.0, -1e4, float("nan"), float("-inf")])
def test_impossible_frequency_shift_is_refused_as_setpoint(setpoint_hz: float) -> None:
    settings = FeedbackSettings(mode="frequency-shift", setpoint=-20.0)
    with pytest.raises(InvalidValue, match="between -18"):
        Loop.of(settings, Feedback(setpoint=setpoint_hz))
    with pytest.raises(ConfigError, match="between -18"):
        FeedbackSettings(mode="frequency-shift", setpoint=setpoint_hz)


@pytest.mark.parametrize("mode", MODES)
def test_each_mode_alone_has_a_setpoint_that_reaches_the_surface(mode: str) -> None:
    first = Loop.of(FeedbackSettings(mode=mode), None)
    assert first.settings.refusal_of(first.setpoint) == ""
    assert first.engages


def test_feedback_error_is_seen_in_the_frequency_shift() -> None:
    settings = {"surface": "particles", "feedback": {"mode": "frequency-shift", "setpoint": -20.0}}
    spreads = []
    for gain in (1500.0, 150.0):
        scan = World.from_settings(settings, 3, 0.0).scan(REGION, (32, 96), 2.0, 0.0, Feedback(integral_gain=gain))
        shift_hz = scan.channels()["Frequency Shift"][1]
        assert np.median(shift_hz) == pytest.approx(-20.0, abs=2.0)
        spreads.append(float(np.std(shift_hz)))
    assert spreads[1] > 2.0 * spreads[0]


@pytest.mark.parametrize("direction", ["up", "down"])
def test_tip_that_becomes_blunt_in_a_scan_is_attracted_more_from_then_on(direction: str) -> None:
    feedback = {"mode": "current", "setpoint": 100e-12, "qplus": True, "sensor": {"oscillation_m": 100e-12}}
    changes = {"schedule": [[20.0, "blunt"]]}
    settings = {"surface": "lattice", "feedback": feedback, "tip_changes": changes}
    region = Region((0.0, 0.0), (5e-9, 5e-9))
    scan = World.from_settings(settings, 3, 0.0).scan(region, (32, 16), 1.0, 0.0, direction=direction)
    rows = np.median(scan.channels()["Frequency Shift"][1], axis=1)
    before, after = np.split(rows if direction == "up" else rows[::-1], [21])
    assert before[1:-1] == pytest.approx(before[0], rel=0.1)
    assert max(after) < 3.0 * before[0] < 0.0
