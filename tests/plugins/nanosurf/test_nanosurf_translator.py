"""The Nanosurf translator with an emulated Studio: requests, their effects, and publications."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_clock import FakeClock
from tests.plugins.nanosurf.nanosurf_bench import Bench
from tests.plugins.vendor_bench import FLAT, TURNED, moved, ready, scanned, scans, small, states

from afspm.basics import ConfigError, ExitCode, InvalidValue
from afspm.emulation import Faults, SimulatedInstrument
from afspm.model import ControlResponse, Region, Scan, ScanLines, ScopeState, Spectrum, names
from afspm.plugins.nanosurf import Nanosurf
from afspm.plugins.nanosurf.emulator import NanosurfEmulator
from afspm.plugins.nanosurf.emulator.studio import SETPOINT, StudioProgram

Make = Callable[..., Bench]
Settings = dict[str, Any]
FREE = ScopeState.FREE


@pytest.mark.parametrize("release", [13, 17, 19])
@pytest.mark.parametrize("direction", ["up", "down"])
def test_scan_shows_the_sample_in_place(bench: Make, release: int, direction: str) -> None:
    made = bench(release=release, tip={"radius_m": 0.1e-9}, scanner={"band_limit_px": 0.0}, **FLAT)
    peer = made.start(release=release)
    region = Region((40e-9, -25e-9), (60e-9, 300e-9), math.radians(30))
    ready(peer, region, (48, 32))
    assert peer.set(names.SCAN_DIRECTION, direction).ok
    found = scanned(peer)
    x, y = region.pixels_m((48, 32))
    truth = made.emulator.rig.world.sample.surface_m(x, y)

    def likeness(values: np.ndarray) -> float:
        return float(np.corrcoef(values.ravel(), truth.ravel())[0, 1])

    for channel in ("Height Forward", "Height Backward"):
        scan = found[channel]
        assert scan.region == region
        assert likeness(scan.values) > 0.95
        for mirrored in (scan.values[::-1], scan.values[:, ::-1], scan.values[::-1, ::-1]):
            assert likeness(mirrored) < likeness(scan.values) - 0.1
    assert made.emulator.rig.scan is not None
    assert made.emulator.rig.scan.upwards is (direction == "up")


@pytest.mark.parametrize(
    ("path", "kept"), [("imaging.scan_mode", 0), ("data.storage.nhf_auto_store_mode", 0)], ids=["repeats", "unsaved"]
)
def test_start_is_refused_while_studio_keeps_another_switch(
    bench: Make, monkeypatch: pytest.MonkeyPatch, path: str, kept: int
) -> None:
    # results T5: switches were set, and never read back
    made = bench()
    peer = small(made)
    program = made.emulator.program
    assert isinstance(program, StudioProgram)
    program.values[path] = kept
    put = program.put
    monkeypatch.setattr(program, "put", lambda name, value: put(name, kept if name == path else value))
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.ACTION_ERROR
    assert f"Studio keeps {path} = {kept}" in response.reason
    assert not program.scanning


def test_studio_before_the_present_tree_scans_and_moves_the_tip_along_z(bench: Make) -> None:
    made = bench(release=13)
    peer = made.start(release=13)
    peer.until(FREE)
    made.until_logged("before Studio 17 curves of force and positions of the tip are not supported")
    for act, is_engaged in ((names.RETRACT, False), (names.ENGAGE, True)):
        assert peer.act(act).ok
        peer.until(ScopeState.COARSE_MOTOR)
        peer.until(FREE)
        assert made.emulator.rig.engaged is is_engaged
    assert peer.set(names.ZCTRL_SETPOINT, 0.6).ok
    assert peer.get(names.ZCTRL_SETPOINT) == "0.6"
    refused = peer.set(names.ZCTRL_SETPOINT, 11.0)
    assert refused.code == ControlResponse.PARAM_ERROR
    for response in (peer.act(names.START_SPEC), peer.act(names.STOP_SPEC)):
        assert response.code == ControlResponse.ACTION_NOT_SUPPORTED
        assert "known from Nanosurf Studio 17 on" in response.reason
    assert peer.set(names.PROBE_POS_X, 0.0).code == ControlResponse.PARAM_NOT_SUPPORTED
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    assert peer.act(names.STOP_SCAN).ok
    assert not scans(peer.until(FREE))


def test_retraction_stops_a_scan_before_the_present_tree(bench: Make) -> None:
    made = bench(release=13, speed=5.0)
    peer = made.start(release=13)
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    assert peer.act(names.RETRACT).ok
    assert not scans(peer.until(FREE))
    assert not made.emulator.rig.engaged


def test_studio_of_an_unknown_release_is_refused() -> None:
    with pytest.raises(ConfigError, match="Nanosurf Studio 12 is too old: afspm knows the commands of 13 and later"):
        Nanosurf(release=12)
    with pytest.raises(ConfigError, match="known from Nanosurf Studio 17 on"):
        Nanosurf(release=13, image_buffer=4410)


def test_lines_without_the_number_of_their_buffer_are_refused() -> None:
    # paper F3: `LineWatch` was called done where no line ever came
    with pytest.raises(ConfigError, match="lines of a running scan need `image_buffer`"):
        Nanosurf(live_lines_s=1.0)


def test_the_setpoint_of_a_frequency_shift_is_in_hertz(tmp_path: Path) -> None:
    rig = SimulatedInstrument({"feedback": {"mode": "frequency-shift", "setpoint": -20.0}}, 3, 1000.0)
    faults, log = Faults([], NanosurfEmulator.all_faults(), 0.0), logging.getLogger("test")
    studio = StudioProgram(rig, faults, FakeClock(), tmp_path, log, start_s=0.1, file_s=0.1)
    assert (studio.setpoint_unit, list(studio.setpoint_units), studio.get(SETPOINT)) == ("Hz", ["Hz"], -20.0)
    studio.put(SETPOINT, -35.0)
    assert studio.get(SETPOINT) == -35.0
    with pytest.raises(InvalidValue, match="has no unit 'V'"):
        studio.set_setpoint_unit("V")


@pytest.mark.parametrize("direction", ["up", "down"])
def test_lines_are_published_during_a_scan(bench: Make, direction: str) -> None:
    made = bench(speed=5.0)
    peer = made.start(live_lines_s=1.0, image_buffer=4410)
    ready(peer, shape=(40, 32))
    assert peer.set(names.SCAN_DIRECTION, direction).ok
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    lines = [one for one in received if isinstance(one, ScanLines) and one.channel == "Height Forward"]
    whole = next(one for one in received if isinstance(one, Scan) and one.channel == "Height Forward")
    assert len(lines) >= 2
    for part in lines:
        rows = whole.values[part.first_row : part.first_row + len(part.values)]
        np.testing.assert_allclose(part.values, rows, atol=1e-6 * np.ptp(whole.values))
    assert (lines[0].first_row == 0) is (direction == "up")


def test_a_force_curve_is_taken_where_the_tip_was_sent(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    moved(peer, 120e-9, -40e-9)
    scanned(peer)
    assert peer.act(names.START_SPEC).ok
    received = peer.until(FREE)
    assert states(received) == ["SPEC", "FREE"]
    (curve,) = [one for one in received if isinstance(one, Spectrum)]
    assert curve.position_m == (120e-9, -40e-9)
    assert curve.kind == "force"
    taken = made.emulator.rig.spectrum
    assert taken is not None
    assert taken.position_m == pytest.approx((120e-9, -40e-9))
    assert len(curve["Deflection"]) == 2 * len(taken.values)


def test_a_force_curve_is_a_single_one_at_the_tip_with_any_grid_on_the_panel(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)

    def put(emulator: Any, name: str, value: float) -> None:
        emulator.program.put(f"spectroscopy.grid_{name}", value)

    for name, value in (("columns", 4), ("rows", 3), ("center_offset_x", 10e-6), ("width", 5e-6)):
        made.at_panel(partial(put, name=name, value=value))
    moved(peer, 120e-9, -40e-9)
    assert peer.act(names.START_SPEC).ok
    curves = [one for one in peer.until(FREE) if isinstance(one, Spectrum)]
    assert [curve.position_m for curve in curves] == [(120e-9, -40e-9)]
    taken = made.emulator.rig.spectrum
    assert taken is not None
    assert taken.position_m == pytest.approx((120e-9, -40e-9))


def test_a_force_curve_can_be_stopped(bench: Make) -> None:
    made = bench(speed=1.0, force={"duration_s": 20.0})
    peer = small(made)
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    made.at_panel(lambda emulator: None)
    assert peer.act(names.STOP_SPEC).ok
    received = peer.until(FREE)
    assert not any(isinstance(one, Spectrum) for one in received)


def test_stop_that_overtakes_the_start_of_its_curve_is_repeated(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    # Start and stop use two connections.
    stops: list[StudioProgram] = []
    stop_curve = StudioProgram.stop_curve

    def stop(program: StudioProgram) -> None:
        stops.append(program)
        if len(stops) > 1:
            stop_curve(program)

    monkeypatch.setattr(StudioProgram, "stop_curve", stop)
    made = bench(speed=1.0, force={"duration_s": 20.0})
    peer = small(made)
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    made.at_panel(lambda emulator: None)
    assert peer.act(names.STOP_SPEC).ok
    assert not any(isinstance(one, Spectrum) for one in peer.until(FREE))
    assert len(stops) > 1


def test_the_tip_is_withdrawn_at_any_time_and_brought_back(bench: Make) -> None:
    made = bench(speed=10.0)
    peer = made.start()
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    assert peer.act(names.RETRACT).ok
    peer.until(FREE)
    assert not made.emulator.rig.engaged
    assert peer.act(names.ENGAGE).ok
    assert "COARSE_MOTOR" in states(peer.until(FREE))
    assert made.emulator.rig.engaged


def test_approach_during_a_restart_is_not_taken_for_done(bench: Make) -> None:
    made = bench(speed=10.0)
    peer = small(made)
    made.at_panel(lambda emulator: setattr(emulator.rig.setup, "approach_s", 20.0))
    assert peer.act(names.ENGAGE).ok
    made.kill()
    made.start()
    # a peer that joins late misses INTERRUPTED, which is in force for a moment
    made.until_logged("lost during the approach")


def test_refused_withdrawal_is_no_success(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(now_s: float) -> None:
        raise InvalidValue("the z scanner is locked")

    made = bench()
    peer = small(made)
    monkeypatch.setattr(made.emulator.rig, "withdraw", refuse)
    response = peer.act(names.RETRACT)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "the z scanner is locked" in response.reason


def test_the_tip_is_withdrawn_where_a_second_connection_waits(bench: Make) -> None:
    made = bench(speed=10.0, one_client=True)
    peer = made.start(reply_timeout_s=5.0)  # a busy computer answers late
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    assert peer.act(names.RETRACT).ok
    made.until_logged("the tip is withdrawn by the first")
    peer.until(FREE)
    assert not made.emulator.rig.engaged


def test_stopped_run_stops_the_scan(bench: Make) -> None:
    made = bench(speed=10.0)
    peer = made.start(retracts=True)
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    assert made.let_go() == ExitCode.ORPHAN
    assert not made.emulator.program.scanning
    assert made.emulator.rig.engaged, "the tip stays as it is"


def test_settings_reach_the_instrument(bench: Make) -> None:
    made = bench()
    peer = small(made)
    assert peer.set(names.ZCTRL_SETPOINT, 0.65, "V").ok
    assert peer.set(names.ZCTRL_IGAIN, 2500).ok
    assert peer.set(names.SCAN_SPEED, 4e-6, "m/s").ok
    scanned(peer)
    setup = made.emulator.rig.setup
    assert setup.feedback.setpoint == 0.65
    assert setup.feedback.integral_gain == pytest.approx(1250.0)
    assert setup.line_s == pytest.approx(2 * setup.region.size_m[0] / 4e-6)
    assert math.isclose(float(peer.get(names.ZCTRL_IGAIN)), 2500)


def test_restarted_translator_finds_the_scan(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = made.start()
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.kill()
    peer = made.start()
    received = peer.until(FREE)
    assert "SCANNING" in states(received)
    assert {scan.region for scan in scans(received)} == {TURNED}


@pytest.mark.parametrize(
    ("emulator", "settings", "logged"),
    [
        ({"release": 19}, {"release": 18}, "Studio is release 19, not 18"),
        ({"release": 13}, {}, "Studio is release 13, not 19"),
        ({"release": 12}, {}, "Nanosurf Studio 12 is too old: afspm knows the commands of 13 and later"),
        ({}, {"session": "91-99-999"}, "Studio has no single measurement session 91-99-999"),
        ({}, {"parameters": {"zctrl-setpoint": {"unit": "nm"}}}, "Studio has z_control.setpoint in V, not in nm"),
        ({}, {"parameters": {"x-a": {"vendor": "no.such"}}}, "Studio has no no.such"),
        ({}, {"parameters": {"x-a": {"vendor": "imaging.overscan_x", "unit": "m"}}}, "no imaging.overscan_x"),
        ({}, {"gallery_dir": "/nowhere/at/all"}, "does not exist on this computer"),
    ],
)
def test_mismatches_are_reported(bench: Make, emulator: dict[str, int], settings: dict[str, Any], logged: str) -> None:
    made = bench(**emulator)
    made.start(**settings)
    made.until_logged(logged)


def test_move_that_never_arrives_is_given_up(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    made = bench()
    peer = small(made)
    monkeypatch.setattr(made.emulator.rig, "probe_at", lambda now_s: (2e-9, 0.0))  # its sensor is off by 2 nm
    assert peer.set(names.PROBE_POS_X, 0.0).ok
    assert states(peer.until(FREE)) == ["MOVING", "FREE"]
    made.until_logged("the tip did not reach the position")


def test_value_in_another_unit_is_neither_read_nor_set(bench: Make) -> None:
    made = bench()
    peer = small(made)
    studio = made.emulator.program
    assert isinstance(studio, StudioProgram)
    made.at_panel(lambda emulator: studio.set_setpoint_unit("m"))
    made.until_logged("Studio has z_control.setpoint in m, not in V")
    assert not peer.set(names.ZCTRL_SETPOINT, "0.5", "V").ok
    assert studio.values[SETPOINT] == 0.7
    made.at_panel(lambda emulator: studio.set_setpoint_unit("V"))
    made.until_logged("the controller answers again")
    assert peer.get(names.ZCTRL_SETPOINT) == "0.7"


def test_refused_values_change_none(bench: Make) -> None:
    made = bench()
    peer = made.start(parameters={"scan-speed": {"range": [1e-9, 1.0]}})
    ready(peer)
    before = dict(made.emulator.program.values)  # type: ignore[attr-defined]
    # at this speed, the narrow frame takes more lines in a second than Studio allows
    refused = peer.set(names.SCAN_SPEED, 0.9, "m/s")
    assert "Studio refused" in refused.reason
    assert "not within" in refused.reason
    assert made.emulator.program.values == before  # type: ignore[attr-defined]


def test_commands_missing_in_the_release_are_not_called(bench: Make) -> None:
    made = bench(release=19)
    asked: list[bytes] = []
    answer = made.emulator.answer
    made.emulator.answer = lambda client, request: asked.append(request) or answer(client, request)  # type: ignore[method-assign]
    scanned(small(made))
    assert asked
    assert not any(b"is_scanning" in script for script in asked)
