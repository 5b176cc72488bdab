"""What the driver refuses by itself, with a controller that takes every value as it is sent."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tests.plugins.nanonis.nanonis_bench import Bench
from tests.plugins.vendor_bench import SHAPE, Peer, ready

from afspm.model import (
    ControlRequest,
    ControlResponse,
    Feedback,
    ProbePosition,
    Region,
    ScanParameters,
    ScopeState,
    names,
)
from afspm.plugins.nanonis.preamplifier import range_a

Make = Callable[..., Bench]


def lenient(make: Make, emulator: dict[str, Any] | None = None, **settings: Any) -> tuple[Bench, Peer]:
    """Return a bench whose controller refuses, rounds and clips nothing, and its peer."""
    made = make(**(emulator or {}))
    peer = made.start(**settings)
    ready(peer)
    made.strike("takes-all", duration_s=1e9)
    return made, peer


@pytest.mark.parametrize(
    ("name", "value", "unit", "what"),
    [
        (names.ZCTRL_PGAIN, "3", None, "3 m is outside 0 m to 0.001 m"),
        (names.ZCTRL_PGAIN, "3", "mm", "0.003 m is outside"),
        (names.ZCTRL_IGAIN, "50", None, "50 m/s is outside 0 m/s to 1 m/s"),
        (names.ZCTRL_SETPOINT, "1.5", "A", "1.5 A is outside -0.001 A to 0.001 A"),
        (names.TIP_BIAS_VOLTAGE, "1000", None, "outside -10 V to 10 V"),
        (names.SCAN_SPEED, "10", None, "outside"),
        (names.MOVE_SPEED, "1", None, "outside"),
        (names.SAMPLE_SLOPE_X, "1.5", None, "outside -1 to 1"),
        (names.SCAN_RESOLUTION_X, "100", None, "no multiple of 16"),
        (names.SCAN_SIZE_X, "0.1", "pm", "outside"),
        (names.PULSE_VOLTAGE, "11", None, "outside -10 V to 10 V"),
        (names.CRASH_DEPTH, "1", "um", "outside"),
    ],
)
def test_impossible_value_is_refused_without_limits(
    bench: Make, name: str, value: str, unit: str | None, what: str
) -> None:
    _, peer = lenient(bench)
    before = peer.get(name)
    response = peer.set(name, value, unit)
    assert response.code == ControlResponse.PARAM_ERROR
    assert what in response.reason
    assert peer.get(name) == before


def test_gains_are_metres_as_plain_numbers_and_with_units(bench: Make) -> None:
    made, peer = lenient(bench)
    assert peer.set(names.ZCTRL_PGAIN, 5e-12).ok
    assert peer.set(names.ZCTRL_IGAIN, "50", "nm/s").ok
    assert (float(peer.get(names.ZCTRL_PGAIN)), float(peer.get(names.ZCTRL_IGAIN))) == (5e-12, 5e-8)
    assert made.emulator.rig.setup.feedback.integral_gain == pytest.approx(500.0)
    assert peer.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(integral_gain=6e-8)).ok
    assert float(peer.get(names.ZCTRL_IGAIN)) == 6e-8
    assert "m" in peer.set(names.ZCTRL_PGAIN, "3", "V").reason


def test_gains_of_another_controller_have_its_units(bench: Make) -> None:
    of_frequency = {
        names.ZCTRL_SETPOINT: {"unit": "Hz"},
        names.ZCTRL_PGAIN: {"unit": "pm/Hz", "range": [0, 100]},
    }
    feedback = {"mode": "frequency-shift", "setpoint": -20.0}
    _, peer = lenient(bench, {"feedback": feedback}, parameters=of_frequency)
    assert peer.set(names.ZCTRL_SETPOINT, -25.0).ok, "a range in A says nothing of Hz"
    assert peer.set(names.ZCTRL_PGAIN, "5", "pm/Hz").ok
    assert "101 pm/Hz is outside 0 pm/Hz to 100 pm/Hz" in peer.set(names.ZCTRL_PGAIN, "101", "pm/Hz").reason


# --- the preamplifier ---


@pytest.mark.parametrize(
    ("label", "most_a"),
    [
        ("LN 10^9", 1e-8),
        ("HI 10^11", 1e-10),
        ("10^8 V/A", 1e-7),
        ("1E+9", 1e-8),
        ("1.0e9V/A", 1e-8),
        ("x10", None),
        ("LN 9", None),
        ("2e9 V/A", None),
        ("10^9 A/V", None),
        ("", None),
    ],
)
def test_range_of_a_preamplifier_is_read_from_a_label_that_states_it(label: str, most_a: float | None) -> None:
    assert range_a(label) == (None if most_a is None else pytest.approx(most_a))


def test_setpoint_beyond_the_preamplifier_is_refused(bench: Make) -> None:
    made, peer = lenient(bench)
    assert peer.set(names.ZCTRL_SETPOINT, "9", "nA").ok
    as_parameter = peer.set(names.ZCTRL_SETPOINT, "11", "nA")
    as_feedback = peer.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(setpoint=-1.1e-8))
    for response in (as_parameter, as_feedback):
        assert response.code == ControlResponse.PARAM_ERROR
        assert "11 nA is not below the preamplifier's range, 10 nA by its gain 'LN 10^9'" in response.reason
    made.at_panel(lambda emulator: emulator.software.core.registers.put("Current.Gain", 8))
    assert "100 pA by its gain 'LN 10^11'" in peer.set(names.ZCTRL_SETPOINT, "200", "pA").reason
    assert made.emulator.rig.setup.feedback.setpoint == pytest.approx(9e-9)


def test_feedback_is_not_switched_on_beyond_the_reach_of_another_gain(bench: Make) -> None:
    made, peer = lenient(bench)
    assert peer.set(names.ZCTRL_SETPOINT, "9", "nA").ok
    assert peer.ask(ControlRequest.ACTION, names.RETRACT).ok
    made.at_panel(lambda emulator: emulator.software.core.registers.put("Current.Gain", 8))
    for response in (
        *(peer.ask(ControlRequest.ACTION, one) for one in (names.ENGAGE, names.APPROACH)),
        peer.set(names.FEEDBACK_ON, "true"),
    ):
        assert "9 nA is not below the preamplifier's range, 100 pA by its gain 'LN 10^11'" in response.reason
    assert not made.emulator.rig.engaged


def test_unknown_preamplifier_is_named_and_can_be_given(bench: Make) -> None:
    made = bench()
    made.at_panel(lambda emulator: emulator.software.core.registers.put("Current.Gain", 99))
    peer = made.start()
    ready(peer)
    made.until_logged("the preamplifier's range is unknown")
    assert peer.set(names.ZCTRL_SETPOINT, "90", "nA").ok
    made.kill()
    peer = made.start(preamplifier_range=50e-9)
    ready(peer)
    assert "not below the preamplifier's range, 50 nA by preamplifier_range" in (
        peer.set(names.ZCTRL_SETPOINT, "60", "nA").reason
    )


# --- the scanner ---


def test_frame_beyond_the_voltage_limits_is_refused(bench: Make) -> None:
    made, peer = lenient(bench, {"range_m": 1e-6})
    frame = ScanParameters(Region((0.0, 0.0), (600e-9, 300e-9)), SHAPE, "")
    assert peer.ask(ControlRequest.SET_SCAN_PARAMS, frame).ok
    limits_v = (1, -4.0, 5.0, -10.0, 10.0, -10.0, 10.0)
    made.at_panel(lambda emulator: emulator.software.core.registers.put("Piezo.XYZLimits", *limits_v))
    response = peer.ask(ControlRequest.SET_SCAN_PARAMS, frame)
    assert response.code == ControlResponse.PARAM_ERROR
    assert "-200 to 250 nm (set in Nanonis, Piezo: calibration and voltage limits)" in response.reason
    assert "-200 to 250 nm" in peer.ask(ControlRequest.SET_PROBE_POS, ProbePosition((-240e-9, 0.0))).reason
    assert peer.ask(ControlRequest.SET_PROBE_POS, ProbePosition((240e-9, 0.0))).ok


@pytest.mark.parametrize("is_missing", [True, False], ids=["missing", "unreadable"])
def test_unknown_voltages_of_the_scanner_are_named_and_its_range_counts(bench: Make, is_missing: bool) -> None:
    asked = ["Piezo.CalibrGet", "Current.GainsGet", "TipShaper.PropsGet"]
    made = bench(range_m=1e-6, other_layout=[] if is_missing else asked)
    if is_missing:
        made.at_panel(lambda emulator: emulator.software.functions.remove(*asked))
    peer = made.start()
    ready(peer)
    made.until_logged("the scanner's calibration and voltage limits are unknown, so only its range counts")
    made.until_logged("the preamplifier's range is unknown")
    wide = ScanParameters(Region((0.0, 0.0), (1.2e-6, 300e-9)), SHAPE, "")
    assert "-500 to 500 nm" in peer.ask(ControlRequest.SET_SCAN_PARAMS, wide).reason
    assert peer.set(names.ZCTRL_SETPOINT, "200", "nA").ok
    assert "open it at Nanonis" in peer.act(names.CRASH).reason


def test_frame_that_is_scanned_at_another_speed_is_refused(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    made, peer = lenient(bench)
    scans = made.emulator.software.scans
    plain = scans._adapt_speed

    def keeps_time(*speed: Any) -> None:
        plain(*speed[:2], *scans.speed[2:4], 1, speed[5])  # also if another speed is set

    monkeypatch.setattr(scans, "_adapt_speed", keeps_time)
    response = peer.set(names.SCAN_SIZE_X, "600", "nm")
    assert response.code == ControlResponse.PARAM_ERROR
    assert "would scan this frame at 4 µm/s instead of 2 µm/s" in response.reason


# --- the tip shaper ---


def test_dip_of_a_qplus_sensor_at_a_high_bias_is_refused(bench: Make) -> None:
    made, peer = lenient(bench, sensor="qplus")
    assert peer.set(names.TIP_BIAS_VOLTAGE, 0.5).ok
    response = peer.act(names.CRASH)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "a dip at a bias of 500 mV, above 50 mV (qplus_bias) makes the fork" in response.reason
    assert not made.emulator.rig.world.truth(made.clock.now_s())["marks"]
    assert peer.set(names.TIP_BIAS_VOLTAGE, 0.04).ok
    assert peer.act(names.CRASH).ok


def test_dip_at_a_high_bias_names_a_sensor_that_may_be_a_qplus_once(bench: Make) -> None:
    made, peer = lenient(bench, {"speed": 5.0})
    for _ in range(2):
        assert peer.act_once_free(names.CRASH).ok
    made.kill()
    assert made.log_text().count('set sensor to "qplus" or "other"') == 1


def test_dip_is_refused_while_the_tip_shaper_is_closed(bench: Make) -> None:
    made, peer = lenient(bench)
    made.at_panel(lambda emulator: emulator.software.functions.remove("TipShaper."))
    response = peer.act(names.CRASH)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "the Tip Shaper does not answer, so nothing was sent: open it at Nanonis" in response.reason


def test_dip_is_refused_if_other_values_are_in_force(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    made, peer = lenient(bench)
    registers = made.emulator.software.core.registers
    plain = registers.set
    deeper = {"TipShaper.PropsSet": lambda values: [*values[:3], 10 * values[3], *values[4:]]}
    monkeypatch.setattr(registers, "set", lambda name, values: plain(name, deeper.get(name, list)(values)))
    response = peer.act(names.CRASH)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "the Tip Shaper has other values than those set" in response.reason
    assert not made.emulator.rig.world.truth(made.clock.now_s())["marks"]


# --- the coarse motor ---


def test_step_of_the_coarse_motor_needs_a_withdrawn_tip(bench: Make) -> None:
    # results 30: an action with Motor.StartMove had no guard
    step = {"command": "Motor.StartMove 4 10 0 1"}
    made, peer = lenient(bench, actions={"x-step": step})
    response = peer.act("x-step")
    assert response.code == ControlResponse.ACTION_ERROR
    assert "the tip is at the sample: withdraw it first (x-retract)" in response.reason
    assert made.emulator.rig.doing(made.clock.now_s()) == ""
    assert peer.ask(ControlRequest.ACTION, names.RETRACT).ok
    peer.until(ScopeState.FREE)
    assert peer.act("x-step").ok
