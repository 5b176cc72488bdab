"""The Nanonis translator with the emulated controller: every request of a peer, and its effects."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.plugins.nanonis.nanonis_bench import Bench, Emulated
from tests.plugins.vendor_bench import FLAT, SHAPE, TURNED, left_in_danger, moved, ready, scanned, scans, states

from afspm import read
from afspm.basics import ExitCode
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Feedback,
    ProbePosition,
    Region,
    Scan,
    ScanLines,
    ScanParameters,
    ScopeState,
    Spectrum,
    names,
)
from afspm.plugins.adaptive.quantities import kelvin_parabola
from afspm.plugins.nanonis.emulator.scans import ScanProperties
from afspm.plugins.nanonis.emulator.signals import CHANNELS
from afspm.plugins.nanonis.z_controller import unit_of
from afspm.translator.trace import FILE, TracedExchange, read_trace

Make = Callable[..., Bench]

FREE = ScopeState.FREE


# --- scans ---


def test_scan_has_exactly_the_frame_that_was_set(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    scans = scanned(peer)
    assert {"Z Forward", "Z Backward", "Current Forward", "Current Backward"} <= scans.keys()
    for scan in scans.values():
        assert scan.region == TURNED
        assert scan.shape == SHAPE
        assert scan.filename == str(made.data / "unnamed001.sxm")
        assert scan.time_ns is not None
        assert abs(scan.time_ns / 1e9 - made.clock.now_s()) < 600.0


@pytest.mark.parametrize("direction", ["up", "down"])
@pytest.mark.parametrize("fetch", [False, True])
def test_rows_and_columns_match_the_sample(bench: Make, direction: str, fetch: bool) -> None:
    # Compared with the heights of the simulated sample at each pixel: an offset by half a pixel or a mirrored axis
    # shows.
    seen = 20.0 if fetch else 100.0  # a scan without a file must be seen running
    made = bench(seen, surface="steps", tip={"radius_m": 0.1e-9}, scanner={"band_limit_px": 0.0}, **FLAT)
    settings: dict[str, Any] = {"session_dir": str(made.folder / "not there")} if fetch else {}
    peer = made.start(**settings)
    region = Region((40e-9, -25e-9), (60e-9, 300e-9), math.radians(30))
    ready(peer, region, (48, 32))
    assert peer.set(names.SCAN_DIRECTION, direction).ok
    scans = scanned(peer)
    x, y = region.pixels_m((48, 32))
    truth = made.emulator.rig.world.sample.surface_m(x, y)

    def likeness(values: np.ndarray) -> float:
        return float(np.corrcoef(values.ravel(), truth.ravel())[0, 1])

    for channel in ("Z Forward", "Z Backward"):
        values = scans[channel].values
        assert likeness(values) > 0.98
        for mirrored in (values[::-1], values[:, ::-1], values[::-1, ::-1]):
            assert likeness(mirrored) < likeness(values) - 0.1
    file = scans["Z Forward"].filename
    assert file.endswith(".nc" if fetch else ".sxm")
    if not fetch:
        assert read(file).upwards is (direction == "up")


def test_lines_are_published_during_a_scan(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = made.start(live_lines_s=1.0)
    ready(peer, shape=(40, 32))
    assert peer.set(names.SCAN_DIRECTION, "down").ok
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    lines = [one for one in received if isinstance(one, ScanLines) and one.channel == "Z Forward"]
    whole = next(one for one in received if isinstance(one, Scan) and one.channel == "Z Forward")
    assert len(lines) >= 2
    assert lines[0].first_row + len(lines[0].values) == 40, "the highest first"
    picture = None
    for one in lines:
        picture = one.into(picture)
    assert picture is not None
    there = np.isfinite(picture)
    assert there.any()
    np.testing.assert_allclose(picture[there], whole.values[there], rtol=1e-6)


def test_lines_lie_in_the_frame_of_their_scan_though_a_person_has_set_another(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = made.start(live_lines_s=1.0)
    ready(peer, shape=(40, 32))
    assert peer.act(names.START_SCAN).ok
    received = peer.until(lambda one: isinstance(one, ScanLines))
    made.at_panel(lambda emulator: emulator.software.scans.set_frame(0.0, 0.0, 500e-9, 500e-9, 0.0))
    received += peer.until(FREE)
    lines = [one for one in received if isinstance(one, ScanLines)]
    assert len({one.first_row for one in lines}) > 2
    assert {one.region for one in lines} == {TURNED}


def test_pixels_that_nanonis_would_round_are_refused(bench: Make) -> None:
    peer = bench().start()
    ready(peer)
    response = peer.set(names.SCAN_RESOLUTION_X, 100)
    assert response.code == ControlResponse.PARAM_ERROR
    assert "100 is no multiple of 16: set 96 or 112" in response.reason
    assert peer.get(names.SCAN_RESOLUTION_X) == "32"


def test_missing_module_piezo_is_named_at_the_start_and_refuses_positions(bench: Make) -> None:
    made = bench()
    made.at_panel(lambda emulator: emulator.software.functions.remove("Piezo."))
    peer = made.start()
    ready(peer)
    made.until_logged("(module Piezo), so positions of the probe will be refused")
    response = peer.ask(ControlRequest.SET_PROBE_POS, ProbePosition((1e-9, 0.0)))
    assert response.code == ControlResponse.PARAM_ERROR
    assert "does not report the scanner's range" in response.reason
    made.kill()
    assert "Traceback" not in made.log_text()


SIGNALS = ["Current (A)", "Bias (V)", "Z (m)", "OC M1 Freq. Shift (Hz)", "Amplitude (V)", "OC M1 Amplitude (m)", "X"]


@pytest.mark.parametrize(
    ("controller", "unit"),
    [
        ("log Current", "A"),
        ("Current", "A"),
        ("neg. Freq. Shift", "Hz"),
        ("OC M1 Freq. Shift", "Hz"),
        ("Amplitude", "V"),
        ("OC M1 Amplitude", "m"),
        ("Force", ""),
        ("OC M1", ""),
        ("log", ""),
        ("X", ""),
    ],
)
def test_z_controller_has_the_unit_of_the_signal_in_its_name(controller: str, unit: str) -> None:
    assert unit_of(controller, SIGNALS) == unit


@pytest.mark.parametrize(
    ("mode", "setpoint", "rows", "logged"),
    [
        ("current", 1e-10, {}, "the active z controller is 'log Current', in A"),
        ("frequency-shift", -20.0, {}, "'OC M1 Freq. Shift' holds a value in Hz, but zctrl-setpoint is in A"),
        ("frequency-shift", -20.0, {"unit": "Hz"}, "the active z controller is 'OC M1 Freq. Shift', in Hz"),
        ("current", 1e-10, {"unit": "pA"}, "'log Current' holds a value in A, but zctrl-setpoint is in pA"),
    ],
)
def test_active_z_controller_is_compared_with_the_unit_of_the_setpoint(
    bench: Make, mode: str, setpoint: float, rows: dict[str, str], logged: str
) -> None:
    made = bench(feedback={"mode": mode, "setpoint": setpoint})
    peer = made.start(parameters={names.ZCTRL_SETPOINT: rows} if rows else {})
    peer.until(FREE)
    made.until_logged(logged)


def test_z_controller_of_unknown_unit_is_named(bench: Make) -> None:
    made = bench()
    made.at_panel(lambda emulator: emulator.software.functions.remove("ZCtrl.CtrlListGet"))
    peer = made.start()
    peer.until(FREE)
    made.until_logged("the active z controller is unknown")


@pytest.mark.parametrize(
    ("frame", "what"),
    [
        (Region((0.45e-6, 0.0), (300e-9, 100e-9)), "its corners are at 300 to 600 nm in x"),
        (
            Region((0.0, 0.0), (900e-9, 900e-9), math.radians(45)),
            "make it smaller, or turn it: they are 272.79 nm too far",
        ),
    ],
    ids=["beside", "turned"],
)
def test_a_frame_beyond_the_scanner_is_refused_and_the_old_one_stays(bench: Make, frame: Region, what: str) -> None:
    # results T2: the controller takes such a frame, and returns it as set
    peer = bench(range_m=1e-6).start()
    ready(peer)
    response = peer.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(frame, SHAPE, ""))
    assert response.code == ControlResponse.PARAM_ERROR
    assert what in response.reason
    assert "beyond the scanner's -500 to 500 nm (set in Nanonis, module Piezo)" in response.reason
    assert float(peer.get(names.SCAN_TOP_LEFT_X)) == pytest.approx(TURNED.top_left_m[0], rel=1e-13)


def test_range_of_the_scanner_is_the_present_one_or_a_narrower_one_of_the_file(bench: Make) -> None:
    made = bench(range_m=1e-6)
    narrow = {"range": ["-300 nm", "300 nm"]}
    peer = made.start(parameters={names.PROBE_POS_X: narrow})
    ready(peer)
    wide = ScanParameters(Region((0.0, 0.0), (500e-9, 500e-9)), SHAPE, "")
    assert peer.ask(ControlRequest.SET_SCAN_PARAMS, wide).ok
    wider = ScanParameters(Region((0.0, 0.0), (700e-9, 500e-9)), SHAPE, "")
    assert "-300 to 300 nm (set in the experiment file" in peer.ask(ControlRequest.SET_SCAN_PARAMS, wider).reason
    made.at_panel(lambda emulator: setattr(emulator.software.core, "range_m", (400e-9, 400e-9, 1e-6)))
    assert "-200 to 200 nm" in peer.ask(ControlRequest.SET_SCAN_PARAMS, wide).reason
    assert "beyond the scanner's -200 to 200 nm" in peer.set(names.PROBE_POS_X, 250e-9).reason


def test_settings_are_reported_to_the_last_digit_despite_float32(bench: Make) -> None:
    peer = bench().start()
    peer.until(FREE)
    for name, value in {
        names.TIP_BIAS_VOLTAGE: 0.123456789,
        names.SCAN_SPEED: 1.23456789e-6,
        names.MOVE_SPEED: 2.3456789e-6,
        names.ZCTRL_PGAIN: 1.23456789e-12,
        names.ZCTRL_IGAIN: 1.23456789e-8,
        names.ZCTRL_SETPOINT: 0.66666666666e-9,
        names.SCAN_TOP_LEFT_X: 1.23456789012e-8,
        names.SCAN_SIZE_Y: 3.33333333333e-7,
        names.SCAN_ANGLE: -12.3456789012,
        names.SAMPLE_SLOPE_X: 0.0123456789,
        "x-drift-rate-x": 1.23456789e-12,
        names.PULSE_VOLTAGE: 3.21,
    }.items():
        response = peer.set(name, value)
        assert response.ok, (name, response.reason)
        assert float(peer.get(name)) == pytest.approx(value, rel=1e-13), name


def test_setting_the_resolution_keeps_the_frame(bench: Make) -> None:
    # Nanonis' range goes from edge to edge of its pixels: for the same pixel centres it depends on their number.
    made = bench()
    peer = made.start()
    ready(peer)
    assert peer.set(names.SCAN_RESOLUTION_X, 64).ok
    assert float(peer.get(names.SCAN_SIZE_X)) == pytest.approx(TURNED.size_m[0], rel=1e-13)
    assert made.emulator.software.scans.frame[2] == pytest.approx(TURNED.size_m[0] * 64 / 63, rel=1e-6)
    assert made.emulator.software.scans.frame[4] == pytest.approx(-30.0), "clockwise"


# --- feedback, probe, spectra ---


def test_feedback_is_set_switched_off_and_on(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    assert peer.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=False, proportional_gain=2.5e-11, setpoint=5e-10)).ok
    received = peer.until(lambda one: isinstance(one, Feedback))
    assert (received[-1].on, received[-1].proportional_gain, received[-1].setpoint) == (False, 2.5e-11, 5e-10)
    assert made.emulator.rig.setup.feedback.on is False
    assert made.emulator.rig.setup.feedback.integral_gain == pytest.approx(1500.0), "P alone changes T, and I stays"
    assert peer.set("x-feedback-on", True).ok
    assert made.emulator.rig.setup.feedback.on is True
    response = peer.set(names.ZCTRL_PGAIN, 0)
    assert response.code == ControlResponse.PARAM_ERROR
    assert "T = P / I" in response.reason


def test_feedback_is_switched_on_after_its_other_settings(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    software, switched_with = made.emulator.software, []
    plain = software.z_controller.switch

    def switch(now_s: float, *, on: bool, **settings: float) -> None:
        switched_with.append((on, software.core.rig.setup.feedback.setpoint))
        plain(now_s, on=on, **settings)

    assert peer.set(names.ZCTRL_SETPOINT, 2.5e-10).ok
    monkeypatch.setattr(software.z_controller, "switch", switch)
    assert peer.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=False, setpoint=5e-10)).ok
    assert peer.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=True, setpoint=7.5e-10)).ok
    assert switched_with == [(False, pytest.approx(2.5e-10)), (True, pytest.approx(7.5e-10))]


def test_wider_frame_is_not_scanned_faster(bench: Make) -> None:
    made = bench()

    def keep_time(emulator: Emulated) -> None:
        emulator.software.scans.speed = (2e-6, 2e-6, 0.5, 0.5, 1, 1.0)

    made.at_panel(keep_time)
    peer = made.start()
    ready(peer)
    assert peer.set(names.SCAN_SIZE_X, 50e-9).ok
    assert float(peer.get(names.SCAN_SPEED)) == pytest.approx(2e-6)
    assert peer.set(names.SCAN_SIZE_X, 1e-6).ok
    assert float(peer.get(names.SCAN_SPEED)) == pytest.approx(2e-6)


def test_probe_moves_at_its_speed_and_keeps_its_position_during_a_scan(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = made.start()
    ready(peer)
    assert peer.set(names.MOVE_SPEED, "100", "nm/s").ok
    moved(peer, 200e-9, -50e-9)
    assert float(peer.get(names.PROBE_POS_X)) == 200e-9
    assert made.emulator.rig.probe_m == (200e-9, -50e-9)
    assert peer.act(names.START_SCAN).ok
    assert not any(isinstance(one, ProbePosition) for one in peer.until(FREE))


@pytest.mark.parametrize(("kind", "first"), [("IV", "Bias calc"), ("force", "Z rel")])
@pytest.mark.parametrize("fetch", [False, True])
def test_spectrum_has_its_position(bench: Make, kind: str, first: str, fetch: bool) -> None:
    made = bench(speed=20.0)
    settings: dict[str, Any] = {"session_dir": str(made.folder / "not there")} if fetch else {}
    peer = made.start(**settings)
    ready(peer)
    moved(peer, 12.3456789e-9, -50e-9)
    assert peer.set(names.SPEC_KIND, kind).ok
    assert peer.act(names.START_SPEC).ok
    received = peer.until(FREE)
    assert states(received) == ["SPEC", "FREE"]
    (spectrum,) = (one for one in received if isinstance(one, Spectrum))
    assert spectrum.position_m == (12.3456789e-9, -50e-9)
    assert spectrum.kind == kind
    assert spectrum.names[0] == first
    assert len(spectrum.values) > 100
    assert spectrum.filename.endswith(".nc" if fetch else ".dat")
    true = made.emulator.rig.spectrum
    assert true is not None
    np.testing.assert_allclose(spectrum.values, true.values, rtol=1e-4, atol=1e-18)


def curve_of(peer: Any, kind: str) -> Spectrum:
    assert peer.set(names.SPEC_KIND, kind).ok
    assert peer.act(names.START_SPEC).ok
    (spectrum,) = (one for one in peer.until(FREE) if isinstance(one, Spectrum))
    return spectrum


# results 5, F12: no kind of spectrum had the frequency shift
def test_bias_spectrum_of_a_sensor_is_a_kelvin_parabola(bench: Make) -> None:
    made = bench(speed=20.0, property_map={"kind": "smooth", "quantity": "contact_potential"})
    peer = made.start()
    ready(peer)
    spectrum = curve_of(peer, "IV")
    assert spectrum.names[4:] == ("OC M1 Freq. Shift", "OC M1 Freq. Shift [bwd]")
    assert spectrum.units[4:] == ("Hz", "Hz")
    fit, rig = kelvin_parabola(spectrum), made.emulator.rig
    true: Any = rig.world.property_truth(rig.probe_m, made.clock.now_s())["property"]
    assert fit.error_v < 0.01
    assert abs(fit.vertex_v - true["value"]) < 5.0 * fit.error_v


def test_z_spectrum_of_current_and_frequency_shift_stays_near_the_setpoint(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = made.start()
    ready(peer)
    channels = list(CHANNELS.values())
    made.at_panel(
        lambda emulator: setattr(emulator.software.spectra.sweeps["ZSpectr"], "channels", [channels[0], channels[-1]])
    )
    spectrum = curve_of(peer, "force")
    assert spectrum.names == ("Z rel", "Current", "Current [bwd]", "OC M1 Freq. Shift", "OC M1 Freq. Shift [bwd]")
    z, current, shift = (spectrum.of(role) for role in ("height", "current", "frequency shift"))
    near = z < 0.0
    assert np.polyfit(z[near], np.log(current[near]), 1)[0] == pytest.approx(-1.0 / 50e-12, rel=0.05)
    assert shift[0] < shift[-1] < 0.5


# results F1: it was the setpoint at any bias, and Δf followed the bias
def test_current_at_a_held_z_is_proportional_to_the_bias(bench: Make) -> None:
    made = bench(speed=20.0, noise={"current_a": 1e-15, "frequency_hz": 1e-3, "white_m": 0.0})
    peer = made.start()
    ready(peer)
    assert peer.set(names.FEEDBACK_ON, "false").ok
    shown = {}
    for bias in ("100", "10", "0", "-100"):
        assert peer.set(names.TIP_BIAS_VOLTAGE, bias, "mV").ok
        shown[bias] = made.emulator.rig.signals(made.clock.now_s())
    currents = {bias: signals["Current"] for bias, signals in shown.items()}
    assert currents["10"] / currents["100"] == pytest.approx(0.1, rel=0.05)
    assert currents["-100"] / currents["100"] == pytest.approx(-1.0, rel=0.05)
    assert abs(currents["0"]) < 1e-4 * currents["100"]


OF_THE_STATE = (
    *("Scan.StatusGet", "BiasSpectr.StatusGet", "ZSpectr.StatusGet", "ZCtrl.StatusGet"),
    "AutoApproach.OnOffGet",
)


@pytest.mark.parametrize(
    ("action", "start", "most"), [(names.START_SPEC, "BiasSpectr.Start", 19), (names.START_SCAN, "Scan.Action", 34)]
)
def test_measurement_costs_few_questions(bench: Make, action: str, start: str, most: int) -> None:
    # without polls at rest: all questions are of the requests, and of the reported end. Bias, setpoint and speed are
    # read at both ends for the caption
    made = bench(speed=20.0)
    peer = made.start(poll_period_s=3600.0, trace=True)
    ready(peer)
    for _ in range(3):
        assert peer.set(names.SPEC_KIND, "IV").ok
        assert peer.act(action).ok
        peer.until(FREE)
    exchanges = [one for one in read_trace(made.folder / FILE) if isinstance(one, TracedExchange)]
    begun = [one.at_s for one in exchanges if one.what == start]
    asked = [
        one.what
        for one in exchanges
        # how often the state is asked for until the microscope is free depends on the load
        if one.connection == 0 and begun[1] <= one.at_s < begun[2] and one.what not in OF_THE_STATE
    ]
    assert len(asked) <= most, asked


def test_setting_is_read_before_and_after_it_once(bench: Make) -> None:
    made = bench()
    peer = made.start(poll_period_s=3600.0, trace=True)
    ready(peer)
    frame = ScanParameters(Region((1e-8, 2e-8), (4e-7, 3e-7)), (32, 64), "")
    assert peer.ask(ControlRequest.SET_SCAN_PARAMS, frame).ok
    assert peer.set(names.TIP_BIAS_VOLTAGE, "0.1").ok
    asked = [one.what for one in read_trace(made.folder / FILE) if isinstance(one, TracedExchange)]
    frame_set, bias_set = asked.index("Scan.FrameSet"), asked.index("Bias.Set")
    before = asked[frame_set - 9 : frame_set]
    assert before[:3] == ["Scan.BufferGet", "Scan.FrameGet", "Scan.SpeedGet"]
    assert before[3:6] == ["Piezo.RangeGet", "Piezo.XYZLimitsGet", "Piezo.CalibrGet"]
    assert before[6:] == ["Scan.BufferGet", "Scan.BufferSet", "Scan.SpeedGet"], asked
    assert asked[frame_set + 1 : frame_set + 4] == ["Scan.SpeedGet", "Scan.BufferGet", "Scan.FrameGet"]
    assert asked[bias_set - 1 :] == ["Bias.Get", "Bias.Set", "Bias.Get"]


def test_stopped_spectrum_is_not_published(bench: Make) -> None:
    made = bench(speed=2.0)
    peer = made.start()
    ready(peer)
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    assert peer.act(names.STOP_SPEC).ok
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not any(isinstance(one, Spectrum) for one in received)


# --- what a tip needs besides ---


def test_pulse_crash_retract_and_engage(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = made.start()
    ready(peer)
    assert peer.act(names.PULSE).ok
    assert states(peer.until(FREE)) == ["BUSY_PARAM", "FREE"]
    assert peer.act(names.CRASH).ok
    assert states(peer.until(FREE)) == ["MOVING", "FREE"]
    assert made.emulator.rig.world.truth(made.clock.now_s())["marks"], "a crater"
    assert peer.act(names.RETRACT).ok
    assert states(peer.until(FREE)) == ["COARSE_MOTOR", "FREE"]
    assert not made.emulator.rig.engaged
    assert peer.act(names.ENGAGE).ok
    peer.until(FREE)
    assert made.emulator.rig.engaged


@pytest.mark.parametrize("action", [names.PULSE, names.CRASH])
def test_treatment_ends_once_the_feedback_holds_the_current(bench: Make, action: str) -> None:
    # results T4: the request was over before the tip was back
    made = bench(speed=5.0, feedback={"mode": "current", "setpoint": 1e-10})
    peer = made.start()
    ready(peer)
    made.at_panel(lambda emulator: setattr(emulator.software.z_controller, "state", "off"))
    assert peer.act(action).ok  # the feedback was off: the clock counts alone
    peer.until(FREE)
    made.at_panel(lambda emulator: setattr(emulator.software.z_controller, "state", "on"))
    assert peer.act(action).ok
    began_s = made.clock.now_s()
    made.at_panel(lambda emulator: setattr(emulator.software.z_controller, "state", "off"))
    peer.until(FREE)
    assert made.clock.now_s() - began_s >= 5.0
    made.until_logged(f"5 s after {action} the current is not at its setpoint: the feedback is off")
    response = peer.act(names.START_SCAN)
    assert not response.ok
    assert "feedback" in response.reason
    made.at_panel(lambda emulator: setattr(emulator.software.z_controller, "state", "on"))
    assert peer.act_once_free(names.START_SCAN).ok


def test_retracting_stops_a_scan(bench: Make) -> None:
    made = bench(speed=10.0)
    peer = made.start()
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    assert peer.act(names.RETRACT).ok
    received = peer.until(FREE)
    assert states(received)[:2] == ["SCANNING", "INTERRUPTED"]
    assert not any(isinstance(one, Scan) for one in received)
    assert not made.emulator.rig.engaged


def test_retracting_ends_an_auto_approach_which_would_bring_the_tip_back(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = made.start()
    peer.until(FREE)
    made.at_panel(lambda emulator: emulator.software.functions.call("AutoApproach.OnOffSet", [1]))
    peer.until(ScopeState.COARSE_MOTOR)
    assert peer.act(names.RETRACT).ok
    peer.until(FREE)
    assert not made.emulator.rig.engaged


@pytest.mark.parametrize("scanning", [False, True])
def test_tip_without_feedback_is_retracted_at_the_end_of_a_run(bench: Make, scanning: bool) -> None:
    made = bench(speed=5.0)
    left_in_danger(made, scanning=scanning, retracts=True)
    assert not made.emulator.rig.engaged
    assert "the run is stopping with the feedback off: the tip was retracted" in made.log_text()


@pytest.mark.parametrize("kind", ["slow", "dialog", "refused", "cut"])
def test_tip_is_retracted_despite_slow_refusing_or_lost_nanonis(bench: Make, kind: str) -> None:
    made = bench(speed=5.0)
    peer = made.start(retracts=True)
    ready(peer)
    assert peer.set(names.FEEDBACK_ON, False).ok
    made.strike(kind, count=2, duration_s=10.0)  # two seconds, real time
    assert made.let_go() == ExitCode.ORPHAN
    assert not made.emulator.rig.engaged
    assert "the run is stopping with the feedback off: the tip was retracted" in made.log_text()


def test_tip_without_feedback_stays_if_the_file_allows_it(bench: Make) -> None:
    made = bench(speed=5.0)
    left_in_danger(made, scanning=False, retracts=False)
    assert made.emulator.rig.engaged


def test_drift_compensation_is_switched_on_by_a_rate_and_off_by_none(bench: Make) -> None:
    made = bench()
    peer = made.start()
    peer.until(FREE)
    assert peer.set("x-drift-rate-x", "2", "pm/s").ok
    on, x, y, *_ = made.emulator.software.core.registers.get("Piezo.DriftComp")
    assert (on, x, y) == (1, pytest.approx(2e-12), 0.0)
    assert peer.set("x-drift-rate-x", 0).ok
    assert made.emulator.software.core.registers.get("Piezo.DriftComp")[0] == 0


def test_drift_rate_of_an_axis_at_its_limit_is_refused(bench: Make) -> None:
    made = bench()
    peer = made.start()
    peer.until(FREE)
    registers = made.emulator.software.core.registers
    assert peer.set("x-drift-rate-x", "2", "pm/s").ok
    made.at_panel(lambda _: registers.put("Piezo.DriftSaturated", 1, 0, 0))
    refused = peer.set("x-drift-rate-x", "4", "pm/s")
    assert "has reached its limit of 10 % of the piezo's range" in refused.reason
    assert peer.set("x-drift-rate-y", "3", "pm/s").ok
    assert registers.get("Piezo.DriftComp")[:3] == (1, pytest.approx(2e-12), pytest.approx(3e-12))
    assert peer.set("x-drift-rate-x", 0).ok
    assert peer.set("x-drift-rate-y", 0).ok, "switched off, so that it can begin again"
    assert peer.set("x-drift-rate-x", "4", "pm/s").ok


def _left_by_earlier_work(on: int, emulator: Emulated) -> None:
    emulator.software.core.registers.put("Piezo.DriftComp", on, 0.0, 0.0, 5e-11, 10.0)


def test_drift_rate_in_z_comes_into_force_only_if_it_was(bench: Make) -> None:
    made = bench()
    peer = made.start()
    peer.until(FREE)
    registers = made.emulator.software.core.registers
    for was_on in (0, 1):
        made.at_panel(partial(_left_by_earlier_work, was_on))
        assert peer.set("x-drift-rate-x", "2", "pm/s").ok
        assert registers.get("Piezo.DriftComp")[3] == pytest.approx(5e-11 * was_on)


def test_measured_value_is_compared_within_the_resolution_of_its_row(bench: Make) -> None:
    # spectra F4: the read-back of z has noise
    z = {"vendor": "ZCtrl.ZPos", "unit": "m"}
    made = bench()
    peer = made.start(parameters={"x-z": {**z, "resolution": "1 nm"}, "x-exact-z": z})
    ready(peer)
    assert peer.set(names.FEEDBACK_ON, "false").ok
    held_m = float(peer.get("x-z"))
    assert peer.set("x-z", held_m + 5e-9, "m").ok
    assert float(peer.get("x-z")) == pytest.approx(held_m + 5e-9, rel=1e-9)
    refused = [peer.set("x-exact-z", held_m + step * 1e-9, "m") for step in range(5)]
    assert ControlResponse.PARAM_ERROR in [one.code for one in refused]
    assert all(
        "its row needs a `resolution`" in one.reason for one in refused if one.code == ControlResponse.PARAM_ERROR
    )


# --- what a curve sweeps ---


def test_settings_of_a_curve_are_those_of_its_module(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    sweeps = made.emulator.software.spectra.sweeps
    asked = {
        "x-spec-from": ("-500", "mV"), "x-spec-to": ("0.25", "V"), "x-spec-points": ("64", ""),
        "x-spec-point-time": ("2", "ms"), "x-spec-z-offset": ("-50", "pm"),
        "x-lock-in-amplitude": ("10", "mV"), "x-lock-in-frequency": ("797", "Hz"),
    }  # fmt: skip
    for name, (value, unit) in asked.items():
        assert peer.set(name, value, unit).ok, name
    assert sweeps["BiasSpectr"].limits == pytest.approx((-0.5, 0.25))
    assert (sweeps["BiasSpectr"].points, sweeps["ZSpectr"].points) == (64, None)
    registers = made.emulator.software.core.registers
    assert registers.get("BiasSpectr.Timing")[1] == pytest.approx(-50e-12)
    assert registers.get("BiasSpectr.Timing")[5] == pytest.approx(2e-3)
    assert registers.got("LockIn.ModAmpGet", (1,)) == (pytest.approx(0.01),)
    assert peer.set(names.SPEC_KIND, "force").ok
    assert float(peer.get("x-spec-points")) != 64.0
    for name, number in {"x-spec-z-from": 20e-9, "x-spec-z-to": -1e-9, "x-spec-points": 32}.items():
        assert peer.set(name, number, names.OF_CURVES[name]).ok, name
    assert registers.get("ZSpectr.Range") == pytest.approx((20e-9, -21e-9))
    assert (sweeps["BiasSpectr"].points, sweeps["ZSpectr"].points) == (64, 32)
    assert float(peer.get("x-spec-z-to")) == -1e-9


# --- at the panel ---


def test_continuous_scan_without_saving_is_switched_off(bench: Make) -> None:
    made = bench()
    made.at_panel(
        lambda emulator: emulator.software.scans.properties.__dict__.update(
            continuous=True, bouncy=True, autosave="off"
        )
    )
    peer = made.start()
    ready(peer)
    assert scanned(peer)["Z Forward"].filename.endswith(".sxm")
    left_behind = made.emulator.software.scans.properties
    assert (left_behind.continuous, left_behind.bouncy, left_behind.autosave) == (False, False, "all")


def test_start_is_refused_while_the_continuous_scan_stays_on(bench: Make) -> None:
    # results T5: the switch was set, and never read back
    class Stuck(ScanProperties):
        continuous = property(lambda _: True, lambda *_: None)

    made = bench()
    made.at_panel(lambda emulator: setattr(emulator.software.scans.properties, "__class__", Stuck))
    peer = made.start()
    ready(peer)
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "the continuous scan stays on at Nanonis' panel (Scan Control)" in response.reason
    assert made.emulator.software.scans.running is None


def test_every_whole_frame_of_a_continuous_scan_at_the_panel_is_published(bench: Make) -> None:
    made = bench(speed=10.0)
    peer = made.start(live_lines_s=1.0)
    ready(peer, shape=(40, 32))

    def scan_on(emulator: Emulated) -> None:
        emulator.software.scans.properties.continuous = True
        emulator.software.scans.start(upwards=True)

    made.at_panel(scan_on)
    received = peer.until(FREE) + peer.until(FREE)
    made.at_panel(lambda emulator: emulator.software.core.rig.stop_scan(made.clock.now_s()))
    last = peer.until(FREE)
    assert states(received + last) == ["SCANNING", "FREE", "SCANNING", "FREE", "SCANNING", "INTERRUPTED", "FREE"]
    files = [Path(scan.filename).name for scan in scans(received) if scan.channel == "Z Forward"]
    assert files == ["unnamed001.sxm", "unnamed002.sxm"]
    assert not scans(last)
    began = {one.began_ns for one in received if isinstance(one, ScanLines)}
    assert len(began) == 2, "the lines of each frame by themselves"


def test_saving_can_be_left_alone(bench: Make) -> None:
    made = bench(speed=5.0)  # an unsaved scan must be seen running
    made.at_panel(lambda emulator: emulator.software.scans.properties.__dict__.update(autosave="off"))
    peer = made.start(autosave=False)
    ready(peer)
    assert scanned(peer)["Z Forward"].filename.endswith(".nc")
    assert made.emulator.software.scans.properties.autosave == "off"


@pytest.mark.parametrize("release", ["2021", "2022", "2023", "2024", "2025"])
def test_every_release(bench: Make, release: str) -> None:
    made = bench(release=release)
    made.at_panel(lambda emulator: emulator.software.scans.properties.__dict__.update(continuous=True))
    peer = made.start()
    ready(peer)
    assert scanned(peer)
    assert "release " in peer.get("x-controller")
    assert peer.set("x-drift-rate-y", "1", "pm/s").ok
    assert made.emulator.software.core.registers.get("Piezo.DriftComp")[2] == pytest.approx(1e-12)


def test_session_folder_may_have_another_path_on_the_controller(bench: Make) -> None:
    made = bench(session_path="D:\\Data\\2026")
    peer = made.start(session_dir=str(made.data))
    ready(peer)
    assert scanned(peer)["Z Forward"].filename == str(made.data / "unnamed001.sxm")


def test_ports_that_serve_one_client_each(bench: Make) -> None:
    made = bench(one_each=True, ports=2)
    peer = made.start()
    ready(peer)
    assert scanned(peer)
