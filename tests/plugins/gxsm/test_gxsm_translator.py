"""The GXSM translator with the emulated program: every request of a peer, and its effects."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deadlines import DEADLINE_S
from tests.plugins.gxsm.gxsm_bench import Bench, hold_scan, scan_to_line, scan_until_line
from tests.plugins.gxsm.raw_clients import client
from tests.plugins.vendor_bench import FLAT, SHAPE, TURNED, Peer, moved, ready, scanned, scans, states

from afspm import read
from afspm.driver import FRAME
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Feedback,
    ProbePosition,
    Region,
    Response,
    ScanLines,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    Spectrum,
    names,
)

Make = Callable[..., Bench]

FREE = ScopeState.FREE
UNIT_OF = {"Height": "Å", "Amplitude": "V", "Current": "nA", "Phase": "°"}
"""Unit in which GXSM stores a channel, by the channel's name in the simulated instrument."""
KINDS: list[dict[str, Any]] = [
    {"version": 3},
    {"version": 4},
    {"version": 4, "transport": "shm"},
    {"version": 4, "card": "RPSPMC", "user_unit": "nm"},
]
KIND_IDS = ["gxsm3", "gxsm4", "gxsm4-shm", "rpspmc-nm"]


# --- scans ---


@pytest.mark.parametrize("kind", KINDS, ids=KIND_IDS)
def test_scan_has_exactly_the_frame_that_was_set(bench: Make, kind: dict[str, Any]) -> None:
    made = bench(**kind)
    began_s = made.clock.now_s()
    peer = made.start()
    ready(peer)
    found = scanned(peer)
    expected = {"Topo", "Topo Backward", "ADC1"}
    if kind["version"] == 4:
        expected = {"ZS-Topo", "ZS-Topo Backward", "I-Tunnel", "Phase"}
    assert found.keys() == expected
    for scan in found.values():
        assert scan.region == TURNED
        assert scan.shape == SHAPE
        assert scan.filename.startswith(str(made.data / "scan001-"))
        assert scan.time_ns is not None
        assert began_s - 1.0 <= scan.time_ns / 1e9 <= made.clock.now_s()  # in whole seconds in the file


@pytest.mark.parametrize("kind", KINDS, ids=KIND_IDS)
def test_rows_and_columns_match_the_sample(bench: Make, kind: dict[str, Any]) -> None:
    # Compared with the heights of the simulated sample at each pixel: an offset by half a frame or a mirrored axis
    # shows.
    made = bench(tip={"radius_m": 0.1e-9}, scanner={"band_limit_px": 0.0}, **FLAT, **kind)
    peer = made.start()
    region = Region((40e-9, -25e-9), (60e-9, 300e-9), math.radians(30))
    ready(peer, region, (48, 32))
    found = scanned(peer)
    x, y = region.pixels_m((48, 32))
    truth = made.emulator.rig.world.sample.surface_m(x, y)

    def likeness(values: np.ndarray) -> float:
        return float(np.corrcoef(values.ravel(), truth.ravel())[0, 1])

    topography = "Topo" if kind["version"] == 3 else "ZS-Topo"
    for channel in (topography, f"{topography} Backward"):
        assert found[channel].unit == "m"
        values = found[channel].values
        assert likeness(values) > 0.98
        assert float(np.ptp(values)) == pytest.approx(float(np.ptp(truth)), rel=0.3)
        for mirrored in (values[::-1], values[:, ::-1], values[::-1, ::-1]):
            assert likeness(mirrored) < likeness(values) - 0.1


@pytest.mark.parametrize("kind", KINDS, ids=KIND_IDS)
def test_stopped_scan_is_not_published(bench: Make, kind: dict[str, Any]) -> None:
    made = bench(speed=20.0, **kind)
    peer = made.start()
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    assert states(peer.until(ScopeState.SCANNING)) == ["SCANNING"]
    assert peer.act(names.STOP_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)
    assert peer.act(names.STOP_SCAN).ok, "nothing to stop is no error"


def test_existing_file_numbers_are_skipped(bench: Make) -> None:
    # GXSM starts with 001: it reports names of existing files, then counts each channel by itself.
    made = bench()
    (made.data / "scan001-M-Xp-ZSmTopo.nc").write_bytes(b"of last year")
    (made.data / "scan002-M-Xp-ZSmTopo.nc").write_bytes(b"of last year")
    (made.data / "scan001-Xp-Phase.nc").write_bytes(b"of last year")
    peer = made.start()
    ready(peer)
    found = scanned(peer)
    assert found["ZS-Topo"].filename.endswith("scan003-M-Xp-ZSmTopo.nc")
    assert found["Phase"].filename.endswith("scan002-Xp-Phase.nc")
    assert found["I-Tunnel"].filename.endswith("scan001-Xp-ImTunnel.nc")


def test_scan_saved_twice_is_published_once(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    made.at_panel(lambda emulator: setattr(emulator.program, "auto_save", True))
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert len({scan.channel for scan in scans(received)}) == len(scans(received)) == 4
    assert len(scanned(peer)) == 4


def test_gxsm_may_be_left_to_save_by_itself(bench: Make) -> None:
    made = bench()
    peer = made.start(saving="gxsm")
    ready(peer)
    found = [scanned(peer)["ZS-Topo"] for _ in range(2)]
    assert [scan.filename[-19:-16] for scan in found] == ["001", "002"]
    assert made.emulator.program.panel.auto_save
    assert len(list(made.data.glob("*.nc"))) == 8


@pytest.mark.parametrize(
    ("version", "live_lines_s", "speed", "rows"), [(3, 1.0, 5.0, 40), (4, 1.0, 5.0, 40), (4, 0.05, 1.0, 8)]
)
def test_lines_are_published_during_a_scan(
    bench: Make, version: int, live_lines_s: float, speed: float, rows: int
) -> None:
    # From the second scan on, since only files have the names of channels. GXSM reports the previous scan before the
    # first line.
    made = bench(speed=speed, version=version)
    peer = made.start(live_lines_s=live_lines_s)
    ready(peer, shape=(rows, 32))
    assert peer.act(names.START_SCAN).ok
    assert not any(isinstance(one, ScanLines) for one in peer.until(FREE))
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    for whole in scans(received):
        lines = [one for one in received if isinstance(one, ScanLines) and one.channel == whole.channel]
        assert len(lines) >= 2
        assert lines[0].first_row + len(lines[0].values) == rows, "the highest first"
        picture = None
        for one in lines:
            assert (one.unit, one.region) == (whole.unit, whole.region)
            picture = one.into(picture)
        assert picture is not None
        there = np.isfinite(picture)
        assert there.any()
        np.testing.assert_allclose(picture[there], whole.values[there], rtol=1e-6)


@pytest.mark.parametrize("version", [3, 4])
def test_scans_and_lines_have_the_base_unit_in_spite_of_the_display_unit(bench: Make, version: int) -> None:
    shown = {"Topo": "nm", "ADC1": "mV"} if version == 3 else {"ZS-Topo": "um", "I-Tunnel": "pA"}
    made = bench(speed=5.0, version=version, display_units=shown)
    peer = made.start(live_lines_s=1.0)
    ready(peer, shape=(40, 32))
    scanned(peer)
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    whole = {scan.channel: scan for scan in scans(received)}
    program = made.emulator.program
    for channel in program.channels:
        if channel.direction == "Xm":
            continue
        scan = whole[channel.label]
        unit, factor = {"Å": ("m", 1e-10)}.get(UNIT_OF[channel.source], (UNIT_OF[channel.source], 1.0))
        assert scan.unit == unit
        np.testing.assert_allclose(scan.values, program.image(channel)[::-1] * channel.dz * factor, rtol=1e-5)
        lines = [one for one in received if isinstance(one, ScanLines) and one.channel == scan.channel]
        assert lines
        for one in lines:
            assert one.unit == unit
            rows = scan.values[one.first_row : one.first_row + len(one.values)]
            np.testing.assert_allclose(one.values, rows, rtol=1e-5)


def test_channels_keep_their_names_after_a_person_opens_a_file(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    before = scanned(peer)
    made.at_panel(lambda emulator: emulator.program.open_file(Path(before["I-Tunnel"].filename)))
    after = scanned(peer)
    assert after.keys() == before.keys()
    path = Path(after["ZS-Topo"].filename)
    assert str(read(path).header["basename"]) == before["I-Tunnel"].filename, "GXSM keeps the name of the opened file"
    assert {channel: scan.unit for channel, scan in after.items()} == {
        channel: scan.unit for channel, scan in before.items()
    }


@pytest.mark.parametrize("transport", ["bridge", "shm"])
def test_gxsm_outlives_scans_of_another_size_after_a_movie(bench: Make, transport: str) -> None:
    made = bench(speed=20.0, transport=transport)
    peer = made.start()
    ready(peer)
    scanned(peer)

    def begin(emulator: Any) -> None:
        emulator.program.keep_movie()
        emulator.program.entries.set("PointsX", "48")
        emulator.program.entries.set("PointsY", "12")
        hold_scan(emulator.program, 1)
        emulator.program.start_scan()

    made.at_panel(begin)
    peer.until(ScopeState.SCANNING)  # by now the translator has looked at GXSM's memory
    made.at_panel(lambda emulator: scan_until_line(emulator.program, 1))
    received = peer.until(FREE)
    assert states(received) == ["FREE"]
    assert {scan.shape for scan in scans(received)} == {(12, 48)}


def test_a_time_element_of_another_size_ends_gxsm_during_a_scan(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = made.start()
    ready(peer, shape=(64, 32))
    gxsm = client(made.address)
    made.at_panel(lambda emulator: setattr(emulator.program.panel, "movie", (40, 12)))
    assert gxsm.call("get_slice", 0, 0, 0, 0, 1) == -1, "there is no scan yet"
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    gxsm.call("get_slice", 0, 0, -1, 0, 1)
    assert not made.emulator.program.has_crashed
    gxsm.call("get_slice", 0, 0, 0, 0, 1)
    assert made.emulator.program.has_crashed
    peer.until(ScopeState.UNDEFINED)
    gxsm.close()


def test_no_lines_of_an_upward_scan_are_published(bench: Make) -> None:
    # GXSM counts its lines from the top: in an upward scan the rows above the current line are of the previous scan
    made = bench(speed=5.0)
    peer = made.start(live_lines_s=1.0)
    ready(peer, shape=(40, 32))
    scanned(peer)

    def upward(emulator: Any) -> None:
        program, down = emulator.program, emulator.program.y_current
        program.y_current = lambda now_s: 39 - down(now_s) if program.scan.runs else down(now_s)

    made.at_panel(upward)
    assert peer.act(names.START_SCAN).ok
    assert not any(isinstance(one, ScanLines) for one in peer.until(FREE))
    made.until_logged("goes from bottom to top")


# --- parameters ---


@pytest.mark.parametrize("user_unit", ["Å", "nm", "µm"])
def test_lengths_are_right_in_any_panel_unit(bench: Make, user_unit: str) -> None:
    made = bench(user_unit=user_unit)
    peer = made.start()
    ready(peer)
    entries = made.emulator.program.entries
    shown = [entries[ref] for ref in ("OffsetX", "OffsetY", "RangeX", "RangeY", "Rotation", "PointsX", "PointsY")]
    assert shown == pytest.approx([400.0, -250.0, 3000.0, 1000.0, -30.0, 32.0, 12.0], rel=1e-12)
    moved(peer, 50e-9, -20e-9)
    assert made.emulator.rig.probe_m == pytest.approx((50e-9, -20e-9), rel=1e-9)


def test_setting_the_size_in_x_keeps_the_size_in_y(bench: Make) -> None:
    # GXSM changes RangeY with RangeX.
    made = bench()
    peer = made.start()
    ready(peer)
    assert peer.set(names.SCAN_SIZE_X, "200", "nm").ok
    assert float(peer.get(names.SCAN_SIZE_Y)) == pytest.approx(100e-9, rel=1e-12)
    assert peer.set(names.SCAN_RESOLUTION_X, 40).ok
    assert peer.get(names.SCAN_RESOLUTION_Y) == "12"
    assert float(peer.get(names.SCAN_TOP_LEFT_X)) == pytest.approx(TURNED.top_left_m[0], abs=1e-15)


def test_settings_are_reported_to_the_last_digit(bench: Make) -> None:
    peer = bench(user_unit="nm").start()
    ready(peer)
    for name, value in {
        names.TIP_BIAS_VOLTAGE: 0.123456789,
        names.SCAN_SPEED: 1.23456789e-7,
        names.MOVE_SPEED: 2.3456789e-7,
        names.ZCTRL_PGAIN: 0.123456789,
        names.ZCTRL_IGAIN: 123.456789,
        names.ZCTRL_SETPOINT: 0.66666666666e-9,
        names.SCAN_TOP_LEFT_X: 1.23456789012e-8,
        names.SCAN_SIZE_Y: 3.33333333333e-7,
        names.SCAN_ANGLE: -12.3456789012,
        names.SAMPLE_SLOPE_X: 0.0123456789,
    }.items():
        response = peer.set(name, value)
        assert response.ok, (name, response.reason)
        if name in FRAME:
            peer.until(FREE)
        assert float(peer.get(name)) == pytest.approx(value, rel=1e-13), name


def test_feedback_is_set_and_its_switch_can_only_be_read(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    assert peer.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(proportional_gain=0.25, setpoint=0.5e-9)).ok
    received = peer.until(lambda one: isinstance(one, Feedback))
    assert (received[-1].on, received[-1].proportional_gain, received[-1].setpoint) == (
        True,
        0.25,
        pytest.approx(0.5e-9),
    )
    assert made.emulator.rig.setup.feedback.proportional_gain == 0.25
    assert made.emulator.rig.setup.feedback.integral_gain == pytest.approx(1500.0), "as it was"
    assert peer.get("x-feedback-on") == "true"
    response = peer.set("x-feedback-on", False)
    assert response.code == ControlResponse.PARAM_ERROR
    assert "is read-only" in response.reason
    # peers send back the whole message that was published, with one part changed
    again = replace(received[-1], proportional_gain=0.5)
    assert peer.ask(ControlRequest.SET_ZCTRL_PARAMS, again).ok
    assert made.emulator.rig.setup.feedback.proportional_gain == 0.5
    assert peer.ask(ControlRequest.SET_ZCTRL_PARAMS, replace(again, on=False)).code == ControlResponse.PARAM_ERROR
    assert peer.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=True)).ok


def test_the_feedback_is_switched_where_gxsm_has_actions_for_it(bench: Make) -> None:
    made = bench(feedback_actions=["FB-ON", "FB-OFF"])
    peer = made.start(feedback_actions=["FB-ON", "FB-OFF"])
    ready(peer)
    assert peer.set("x-feedback-on", False).ok
    received = peer.until(lambda one: isinstance(one, Feedback))
    assert received[-1].on is False
    assert made.emulator.rig.setup.feedback.on is False
    assert peer.set("x-feedback-on", True).ok
    assert made.emulator.rig.setup.feedback.on


def test_the_feedback_is_not_switched_by_actions_that_this_gxsm_lacks(bench: Make) -> None:
    peer = bench().start(feedback_actions=["FB-ON", "FB-OFF"])
    peer.until(FREE)
    assert "is read-only" in peer.set("x-feedback-on", False).reason


@pytest.mark.parametrize("settings", [{}, {"card": "RPSPMC"}, {"card": "simulator"}], ids=["sranger", "rpspmc", "sim"])
def test_pulse_restores_the_bias(bench: Make, settings: dict[str, Any]) -> None:
    made = bench(speed=1.0, **settings)
    peer = made.start()
    ready(peer)
    before = peer.get(names.TIP_BIAS_VOLTAGE)
    assert peer.set(names.PULSE_VOLTAGE, -4.5).ok
    assert peer.set(names.PULSE_DURATION, "300", "ms").ok
    assert peer.act(names.PULSE).ok
    assert peer.act(names.START_SCAN).code == ControlResponse.NOT_FREE
    assert states(peer.until(FREE)) == ["BUSY_PARAM", "FREE"]
    assert peer.get(names.TIP_BIAS_VOLTAGE) == before
    (pulse,) = made.events("pulse")
    assert pulse["voltage_v"] == -4.5
    assert 0.3 <= pulse["duration_s"] < 0.6
    assert peer.set(names.PULSE_VOLTAGE, 11).code == ControlResponse.PARAM_ERROR


def test_pulse_of_a_killed_translator_is_ended_by_the_next(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = made.start()
    ready(peer)
    assert peer.set(names.PULSE_DURATION, 60).ok
    assert peer.act(names.PULSE).ok
    assert made.emulator.rig.setup.bias_v == 4.0
    made.kill()
    made.start().until(FREE)
    assert made.emulator.rig.setup.bias_v == 0.1


def test_crash_is_defined_in_the_experiment_file(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = made.start(
        parameters={
            "x-crash-depth": {"vendor": "dsp-Z-end", "unit": "Å", "sign": -1},
            "x-crash-speed": {"vendor": "dsp-Z-Slope", "unit": "Å/s"},
        },
        actions={"x-crash": {"command": "DSP_VP_FZ_EXECUTE", "for": "2 s"}},
    )
    ready(peer)
    assert peer.set(names.CRASH_DEPTH, 2, "nm").ok
    assert peer.set(names.CRASH_SPEED, 50, "nm/s").ok
    assert peer.act(names.CRASH).ok
    assert states(peer.until(FREE)) == ["BUSY_PARAM", "FREE"]
    (crash,) = made.events("crash")
    assert (crash["depth_m"], crash["speed_m_per_s"]) == pytest.approx((2e-9, 50e-9))


def test_missing_hardware_features_are_not_supported(bench: Make) -> None:
    # GXSM answers -inf, or worse, for unknown parameters: they are not requested.
    made = bench(card="simulator")
    peer = made.start()
    peer.until(FREE)
    for name in (names.SCAN_SPEED, names.ZCTRL_SETPOINT, names.SAMPLE_SLOPE_X):
        assert peer.get_response(name).code == ControlResponse.PARAM_NOT_SUPPORTED, name
        assert peer.set(name, 1).code == ControlResponse.PARAM_NOT_SUPPORTED, name
    assert peer.set(names.TIP_BIAS_VOLTAGE, 0.5).ok
    assert peer.set("x-pixel-rate", 4000).ok
    assert peer.act(names.START_SPEC).code == ControlResponse.ACTION_NOT_SUPPORTED
    made.until_logged("unsupported: move-speed, sample-slope-x")
    assert peer.get("x-controller") == "GXSM (simulator)"


def test_gxsms_own_simulator_scans(bench: Make) -> None:
    peer = bench(card="simulator").start()
    ready(peer)
    assert peer.set("x-pixel-rate", 4000).ok
    assert scanned(peer)["ZS-Topo"].region == TURNED


def test_a_frame_beyond_the_scanner_is_refused_and_the_old_one_stays(bench: Make) -> None:
    made = bench(reach_m=0.5e-6)
    peer = made.start()
    ready(peer)
    far = Region((0.8e-6, 0.0), (300e-9, 100e-9))
    response = peer.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(far, SHAPE, ""))
    assert response.code == ControlResponse.PARAM_ERROR
    assert "the former values were restored" in response.reason
    assert float(peer.get(names.SCAN_TOP_LEFT_X)) == pytest.approx(TURNED.top_left_m[0], rel=1e-9)
    assert any(dialog.startswith("Valid Range of OffsetX") for dialog in made.emulator.program.dialogs)


def test_a_size_beyond_the_scanner_is_refused_and_the_frame_stays_where_it_is(bench: Make) -> None:
    made = bench(reach_m=0.5e-6)
    peer = made.start()
    ready(peer)
    before = made.emulator.program.frame()
    response = peer.set(names.SCAN_SIZE_X, 1.1e-6)
    assert response.code == ControlResponse.PARAM_ERROR
    assert "the former values were restored" in response.reason
    after = made.emulator.program.frame()
    assert after.center_m == pytest.approx(before.center_m, abs=1e-15), "GXSM moves the tip with the offset at once"
    assert after.size_m == pytest.approx(before.size_m, abs=1e-15)


def test_other_parameters_and_actions_of_the_experiment_file(bench: Make) -> None:
    made = bench()
    peer = made.start(
        parameters={
            "x-motor": {"vendor": "dsp-fbs-motor"},
            "x-wrong": {"vendor": "dsp-nonsense"},
        },
        actions={"x-stop-all": {"command": "DSP_CMD_STOPALL"}, "x-nonsense": {"command": "DSP_CMD_NONSENSE"}},
    )
    peer.until(FREE)
    assert peer.set("x-motor", 1.5).ok
    assert made.emulator.program.entries["dsp-fbs-motor"] == 1.5
    assert peer.get_response("x-wrong").code == ControlResponse.PARAM_NOT_SUPPORTED
    assert peer.act("x-stop-all").ok
    response = peer.act("x-nonsense")
    assert response.code == ControlResponse.ACTION_NOT_SUPPORTED
    assert "DSP_CMD_NONSENSE" in response.reason


# --- the probe, and spectra ---


def test_probe_moves_only_within_the_frame(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    moved(peer, 100e-9, 10e-9)
    assert made.emulator.rig.probe_m == pytest.approx((100e-9, 10e-9), rel=1e-9)
    assert float(peer.get(names.PROBE_POS_X)) == 100e-9
    response = peer.ask(ControlRequest.SET_PROBE_POS, ProbePosition((500e-9, 0.0)))
    assert response.code == ControlResponse.PARAM_ERROR
    assert "only within the scan frame" in response.reason
    assert float(peer.get(names.PROBE_POS_X)) == 100e-9


@pytest.mark.parametrize(
    ("kind", "first", "settings"),
    [
        ("IV", "Bias-mon", {}),
        ("force", "Z-mon", {"version": 3}),
        ("IV", "Bias-mon", {"transport": "shm"}),
        ("VP", "Bias-mon", {"card": "RPSPMC"}),
    ],
)
def test_spectrum_has_its_position(bench: Make, kind: str, first: str, settings: dict[str, Any]) -> None:
    # A scan in between moves the tip: it is sent back first.
    made = bench(speed=20.0, **settings)
    peer = made.start()
    ready(peer)
    moved(peer, 52.3456789e-9, -20e-9)
    scanned(peer)
    assert peer.set(names.SPEC_KIND, kind).ok
    assert peer.act(names.START_SPEC).ok
    received = peer.until(FREE)
    assert states(received) == ["SPEC", "FREE"]
    (spectrum,) = (one for one in received if isinstance(one, Spectrum))
    assert spectrum.position_m == (52.3456789e-9, -20e-9)
    assert spectrum.kind == kind
    assert spectrum.names[0] == first
    assert spectrum.filename.endswith("-VP001-VP.vpdata")
    true = made.emulator.rig.spectrum
    assert true is not None
    assert true.position_m == pytest.approx((52.3456789e-9, -20e-9), rel=1e-6)
    np.testing.assert_allclose(spectrum.values[:, 0], true.values[:, 0], rtol=1e-6)


@pytest.mark.parametrize("card", ["SRanger", "RPSPMC"])
def test_curve_sweeps_the_bias_that_was_asked_for(bench: Make, card: str) -> None:
    made = bench(speed=20.0, card=card)
    peer = made.start()
    ready(peer)
    for name, value, unit in (("x-spec-from", "-250", "mV"), ("x-spec-to", "0.75", "V"), ("x-spec-points", "65", "")):
        assert peer.set(name, value, unit).ok
    assert peer.act(names.START_SPEC).ok
    (spectrum,) = (one for one in peer.until(FREE) if isinstance(one, Spectrum))
    np.testing.assert_allclose(spectrum.values[:, 0], np.linspace(-0.25, 0.75, 65), atol=1e-6)


def test_a_spectrum_out_of_the_frame_is_refused(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    moved(peer, 100e-9, 10e-9)
    elsewhere = ScanParameters(Region((900e-9, 0.0), (300e-9, 100e-9)), SHAPE, "")
    assert peer.ask(ControlRequest.SET_SCAN_PARAMS, elsewhere).ok
    peer.until(FREE)
    response = peer.act(names.START_SPEC)
    assert response.code == ControlResponse.PARAM_ERROR
    assert "only within the scan frame" in response.reason


def test_spectra_one_after_the_other(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = made.start()
    ready(peer)
    files = []
    for _ in range(3):
        assert peer.act(names.START_SPEC).ok
        files += [one.filename[-12:] for one in peer.until(FREE) if isinstance(one, Spectrum)]
    assert len(files) == 3


@pytest.mark.parametrize("settings", [{}, {"card": "RPSPMC"}], ids=["sranger", "rpspmc"])
def test_a_spectrum_is_stopped_where_the_hardware_can(bench: Make, settings: dict[str, Any]) -> None:
    made = bench(speed=2.0, **settings)
    peer = made.start()
    ready(peer)
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    made.at_panel(lambda emulator: emulator.rig.stop_move(emulator.clock.now_s()))
    until_s = made.clock.now_s() + 60.0
    while made.emulator.rig.spectrum is None and made.clock.now_s() < until_s:
        peer.get(names.SPEC_KIND)
    response = peer.act(names.STOP_SPEC)
    if settings:
        assert response.code == ControlResponse.ACTION_NOT_SUPPORTED
        assert "RPSPMC" in response.reason
        return
    assert response.ok
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not any(isinstance(one, Spectrum) for one in received)


def test_offset_of_a_frame_has_a_range_of_its_own(bench: Make) -> None:
    # results T2
    peer = bench().start(parameters={"x-scan-center-x": {"range": ["-100 nm", "100 nm"]}})
    ready(peer)
    place = ScanParameters(Region((90e-9, 0.0), (200e-9, 200e-9)), (16, 16), "")
    assert peer.ask(ControlRequest.SET_SCAN_PARAMS, place).ok
    assert float(peer.get("x-scan-center-x")) == pytest.approx(90e-9)
    beyond = ScanParameters(Region((110e-9, 0.0), (100e-9, 100e-9)), (16, 16), "")
    reason = peer.ask(ControlRequest.SET_SCAN_PARAMS, beyond).reason
    assert "its centre is at 110 nm in x, beyond the scanner's -100 to 100 nm" in reason
    assert "move the frame by -10 nm in x" in reason


def test_spectrum_can_be_stopped_during_the_move_to_it(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = made.start()
    ready(peer)
    assert peer.set(names.MOVE_SPEED, "50", "nm/s").ok
    assert peer.act(names.START_SPEC).ok
    assert peer.act(names.STOP_SPEC).ok
    received = peer.until(FREE)
    assert states(received) == ["SPEC", "INTERRUPTED", "FREE"]
    assert made.emulator.rig.spectrum is None


@pytest.mark.parametrize("settings", [{}, {"card": "RPSPMC"}], ids=["sranger", "rpspmc"])
def test_spectrum_is_not_taken_during_a_scan_from_the_panel(
    bench: Make, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = bench(speed=4.0, **settings)
    peer = made.start()
    ready(peer, shape=(40, 32))
    moved(peer, 100e-9, 10e-9)
    began: list[str] = []
    monkeypatch.setattr(made.emulator.program, "take_curve", began.append)
    assert peer.set(names.MOVE_SPEED, "50", "nm/s").ok
    assert peer.act(names.START_SPEC).ok
    made.at_panel(lambda emulator: emulator.program.start_scan())
    received = peer.until(ScopeState.SCANNING) + peer.until(FREE)
    assert "INTERRUPTED" in states(received)
    assert {scan.region for scan in scans(received)} == {TURNED}, "the scan is published"
    assert began == []
    made.until_logged("another measurement began")


def test_the_approach_is_a_coarse_motor(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = made.start()
    ready(peer)
    made.at_panel(lambda emulator: setattr(emulator.rig, "engaged", False))
    assert peer.act(names.ENGAGE).ok
    assert states(peer.until(FREE)) == ["COARSE_MOTOR", "FREE"]
    assert made.emulator.rig.engaged


# --- at the panel ---

RESULT_S = 600.0
"""A minute of real time: a busy computer takes more than eight seconds to read all files of a scan."""


@pytest.mark.parametrize(
    ("kind", "saving"),
    [*((kind, "gxsm") for kind in KINDS), *((kind, "afspm") for kind in KINDS[:2])],
    ids=[*(f"{kind}-gxsm" for kind in KIND_IDS), *(f"{kind}-afspm" for kind in KIND_IDS[:2])],
)
def test_scans_repeated_at_the_panel_are_published_one_by_one_and_a_stopped_one_is_not(
    bench: Make, kind: dict[str, Any], saving: str
) -> None:
    # GXSM never stops scanning: the next scan runs already.
    made = bench(speed=10.0, **kind)
    peer = made.start(saving=saving, result_timeout_s=RESULT_S)
    ready(peer, shape=(24, 32))

    def begin(emulator: Any) -> None:
        emulator.program.panel.repeats = True
        hold_scan(emulator.program, 1, 2, 3, 4)
        emulator.program.start_scan()

    made.at_panel(begin)
    found: list[str] = []
    for number in (1, 2, 3):
        received = peer.until(ScopeState.SCANNING)
        received += completed(made, peer)
        assert set(states(received)) == {"SCANNING", "FREE"}
        assert {Path(scan.filename).name[4:7] for scan in scans(received)} == {f"00{number}"}
        found += [scan.channel for scan in scans(received)]
    assert len(found) == 3 * len(set(found)), "each channel of each scan, once"
    peer.until(ScopeState.SCANNING)

    def stop(emulator: Any) -> None:
        scan_until_line(emulator.program, 8)
        emulator.program.stop_scan()

    made.at_panel(stop)
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)


def test_start_is_refused_after_scans_that_gxsm_repeats_by_itself(bench: Make) -> None:
    # results X5: with Multi Layer each scan of the run becomes ten, until its tries were used up
    made = bench(speed=10.0)
    peer = made.start(saving="gxsm", result_timeout_s=RESULT_S)
    ready(peer, shape=(24, 32))

    def repeat(emulator: Any) -> None:  # no action switches Multi Layer off
        emulator.program.panel.repeats = True
        emulator.program.scan.activity.resume(made.clock.now_s())

    def stop(emulator: Any) -> None:
        emulator.program.panel.repeats = False
        emulator.program.stop_scan()

    def start() -> Response:  # once GXSM is free
        while (response := peer.act(names.START_SCAN)).code == ControlResponse.NOT_FREE:
            peer.get(names.SPEC_KIND)
        return response

    for number in (1, 2):
        made.at_panel(lambda emulator: hold_scan(emulator.program, 1, 2))
        assert start().ok
        peer.until(ScopeState.SCANNING)
        # a poll in mid-scan is needed, which a busy computer may miss: the scan waits for it
        made.at_panel(lambda emulator: scan_to_line(emulator.program, 12))
        peer.until(lambda packet: packet == ScopeStatus(ScopeState.SCANNING, paused=True))
        made.at_panel(repeat)
        until_s = time.monotonic() + DEADLINE_S
        while made.log_text().count("another scan was begun at GXSM's panel before the last one was") < number:
            assert time.monotonic() < until_s
            peer.get(names.SPEC_KIND)
        made.at_panel(stop)
    response = start()
    assert response.code == ControlResponse.ACTION_ERROR
    assert "Repeat, Movie or Multi Layer is on at its panel" in response.reason
    assert peer.act(names.START_SCAN).ok


def completed(made: Bench, peer: Peer) -> list[Any]:
    """Complete a held scan, and return the packets up to its end.

    The translator knows complete scans from stopped ones by a poll in mid-scan, which a busy computer may miss: the
    scan waits for it.
    """
    made.at_panel(lambda emulator: scan_to_line(emulator.program, 12))
    received = peer.until(ScopeStatus(ScopeState.SCANNING, paused=True).__eq__)

    def go_on(emulator: Any) -> None:
        emulator.program.scan.activity.resume(made.clock.now_s())

    made.at_panel(go_on)
    return received + peer.until(FREE)


def test_scan_restarted_at_once_is_published_as_two(bench: Make) -> None:
    # Stopped and restarted between two polls: the first scan is interrupted, the second complete.
    made = bench(speed=10.0)
    peer = made.start(result_timeout_s=RESULT_S)
    ready(peer, shape=(24, 32))
    scanned(peer)

    def begin(emulator: Any) -> None:
        hold_scan(emulator.program, 1, 2)
        emulator.program.start_scan()

    made.at_panel(begin)
    peer.until(ScopeState.SCANNING)

    def again(emulator: Any) -> None:
        program = emulator.program
        scan_until_line(program, 8)
        program.stop_scan()
        program.advance(made.clock.now_s())
        program.saving.advance(made.clock.now_s() + 1.0)
        program.saving.done_s = 0.0
        program.start_scan()
        program.scan.shows_s = 0.0

    made.at_panel(again)
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)
    received = completed(made, peer)
    assert set(states(received)) == {"SCANNING", "FREE"}
    assert len(scans(received)) == 4
    made.until_logged("its last row still holds the previous scan", "whether this one came to its end is unknown")


def test_autosave_is_off_only_while_a_scan_of_the_translator_runs(bench: Make) -> None:
    made = bench(speed=10.0, auto_save=False)
    peer = made.start()
    ready(peer, shape=(24, 32))
    assert made.emulator.program.panel.auto_save, "GXSM saves measurements from its panel"
    assert peer.act(names.START_SCAN).ok
    assert not made.emulator.program.panel.auto_save, "one that is stopped is not to be saved"
    assert peer.act(names.STOP_SCAN).ok
    peer.until(FREE)
    assert made.emulator.program.panel.auto_save
    assert not list(made.data.glob("*.nc"))
    scanned(peer)
    assert made.emulator.program.panel.auto_save
    assert len(list(made.data.glob("*.nc"))) == 4, "saved once"


def test_a_scan_ends_though_repeat_is_on_at_the_panel(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    made.at_panel(lambda emulator: setattr(emulator.program, "repeats", True))
    assert len(scanned(peer)) == 4


def set_clock(emulator: Any, off_s: float) -> None:
    emulator.file_clock.jump(off_s - emulator.file_clock.off_s, emulator.clock.now_s())


def test_clock_of_gxsms_computer_may_differ_and_be_set(bench: Make) -> None:
    # An hour back is more than a scan: each scan seems to have started before its predecessor.
    made = bench(speed=20.0)
    peer = made.start()
    ready(peer)

    for behind_s in (0.0, 3600.0, 3600.0, 7200.0, 60.0):
        made.at_panel(partial(set_clock, off_s=-behind_s))
        assert len(scanned(peer)) == 4


def test_scan_with_a_shorter_start_delay_counts_as_new(bench: Make) -> None:
    # At a hundred times the speed, a busy computer takes half a minute to start one.
    made = bench()
    peer = made.start()
    ready(peer, shape=(64, 32))
    late_s = 30.0
    made.at_panel(partial(set_clock, off_s=late_s))
    assert len(scanned(peer)) == 4
    made.at_panel(partial(set_clock, off_s=0.0))
    last = made.emulator.program.scan.activity
    assert last is not None
    assert made.clock.now_s() > last.start_s + late_s, "else the clock seems to have been set back"
    assert len(scanned(peer)) == 4


def test_redpitaya_measurement_at_the_panel_does_not_republish_the_previous_scan(bench: Make) -> None:
    # RPSPMC does not distinguish spectra from scans, and GXSM saves its memory again after a spectrum.
    made = bench(speed=2.5, card="RPSPMC")
    peer = made.start()
    ready(peer)
    assert len(scanned(peer)) == 4
    made.at_panel(lambda emulator: emulator.program.take_curve("IV"))
    received = peer.until(FREE)
    assert states(received)[0] == "SCANNING", "it is taken for one"
    assert not scans(received)


def test_busy_microscope_is_reported(bench: Make) -> None:
    made = bench(speed=10.0)
    peer = made.start()
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    assert peer.act(names.START_SCAN).code == ControlResponse.NOT_FREE
    assert peer.set(names.SCAN_SIZE_X, 1e-7).code == ControlResponse.NOT_FREE
    assert peer.get(names.SCAN_RESOLUTION_X) == "32"


# --- over a restart ---


def test_scan_ended_without_a_translator_is_published_by_the_next(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = made.start()
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.kill()
    until_s = made.clock.now_s() + 600.0
    while made.emulator.rig.busy(made.clock.now_s()) and made.clock.now_s() < until_s:
        pass
    peer = made.start()
    received = peer.until(FREE)
    assert {scan.region for scan in scans(received)} == {TURNED}
    assert len(list(made.data.glob("*.nc"))) == 4


@pytest.mark.parametrize(("version", "shown"), [(3, "gxsm3 3.54.0"), (4, "gxsm4 4.4.1")])
def test_version_is_reported_after_the_first_file(bench: Make, version: int, shown: str) -> None:
    made = bench(version=version)
    peer = made.start()
    ready(peer)
    hardware = peer.get(names.CONTROLLER).removeprefix("GXSM ")
    assert hardware.startswith("(")
    scanned(peer)
    assert peer.get(names.CONTROLLER) == f"{shown} {hardware}"
