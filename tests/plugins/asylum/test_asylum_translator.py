"""The Asylum translator with the emulated microscope: every request of a peer, and its effects."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from deadlines import DEADLINE_S
from igor2 import binarywave
from tests.plugins.asylum.asylum_bench import Bench, Emulated
from tests.plugins.vendor_bench import FLAT, SHAPE, TURNED, Peer, left_in_danger, moved, ready, scanned, states

from afspm import read
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Feedback,
    MeasurementConditions,
    ProbePosition,
    Region,
    Scan,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    Spectrum,
    names,
)
from afspm.plugins.asylum import Asylum
from afspm.plugins.asylum.emulator.wire import CallFailed

Make = Callable[..., Bench]

FREE = ScopeState.FREE


def moved_exactly(peer: Peer, x_m: float, y_m: float) -> None:
    assert ProbePosition((x_m, y_m)) in moved(peer, x_m, y_m)


# --- scans ---


def test_start_is_refused_while_last_scan_stays_0(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    # results T5: the switch was set, and never read back
    made = bench()
    peer = made.start()
    ready(peer)
    values = made.emulator.controller.values
    put = values.put
    monkeypatch.setattr(values, "put", lambda name, value: put(name, 0 if name == "LastScan" else value))
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "LastScan stays 0" in response.reason


def test_start_is_refused_while_saving_stays_off(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    values = made.emulator.controller.values
    values.put("SaveImage", 0)
    put = values.put
    monkeypatch.setattr(values, "put", lambda name, value: put(name, 0 if name == "SaveImage" else value))
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "SaveImage stays off" in response.reason


def test_scan_whose_start_leaves_last_scan_at_0_is_named(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    made.strike("keeps-scanning")
    values = made.emulator.controller.values
    put, is_kept = values.put, []

    def keeps(name: str, value: float) -> None:
        is_kept.extend([True] if (name, value) == ("LastScan", 0) else [])
        put(name, 0 if name == "LastScan" and is_kept else value)

    monkeypatch.setattr(values, "put", keeps)
    assert peer.act(names.START_SCAN).ok
    made.until_logged("the scan runs, but LastScan is 0")


@pytest.mark.parametrize("volts", [0.0, -0.5])
def test_amplitude_that_presses_the_tip_into_the_sample_is_refused(bench: Make, volts: float) -> None:
    peer = bench().start()
    ready(peer)
    assert "an amplitude is above 0 V" in peer.set(names.ZCTRL_SETPOINT, volts).reason


def test_deflection_may_be_negative(bench: Make) -> None:
    peer = bench().start(parameters={names.ZCTRL_SETPOINT: {"vendor": "DeflectionSetpointVolts"}})
    ready(peer)
    assert peer.set(names.ZCTRL_SETPOINT, -0.5).ok


def test_scan_has_exactly_the_frame_that_was_set(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    scans = scanned(peer)
    assert {"HeightTrace", "HeightRetrace", "AmplitudeTrace", "PhaseTrace"} <= scans.keys()
    for scan in scans.values():
        assert scan.region == TURNED
        assert scan.shape == SHAPE
        assert scan.filename == str(made.data / "Image0000.ibw")
        assert scan.time_ns is not None
        assert abs(scan.time_ns / 1e9 - made.clock.now_s()) < 600.0
    assert scans["HeightTrace"].unit == "m"
    assert scans["PhaseTrace"].unit == "deg"


def test_amplitude_at_the_setpoint_is_the_setpoint_by_the_calibration_of_the_panel(bench: Make) -> None:
    # paper F3: with another calibration in the files than in the loop every gain seemed wrong
    made = bench()
    peer = made.start()
    ready(peer)
    amplitude = scanned(peer)["AmplitudeTrace"]
    values = made.emulator.controller.values
    sensitivity = made.emulator.rig.world.settings.feedback.sensitivity_m_per_v
    assert values.get("AmpInvOLS") == sensitivity
    assert values.get("AmplitudeSetpointMeters") == pytest.approx(0.7 * sensitivity)
    assert np.median(amplitude.values) == pytest.approx(0.7 * sensitivity, rel=0.02)


def test_scan_has_the_set_frame_to_the_last_digit(bench: Make) -> None:
    made = bench()
    peer = made.start()
    peer.until(FREE)
    odd = Region((1e-6 / 3, -1e-7 / 7), (1e-6 / 9, 1e-6 / 7), 1 / 3)
    assert peer.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(odd, SHAPE, "")).ok
    packet = peer.until(lambda one: isinstance(one, ScanParameters) and one.shape == SHAPE)[-1]
    assert packet.region.size_m == pytest.approx(odd.size_m, rel=1e-14)
    assert packet.region.center_m == pytest.approx(odd.center_m, rel=1e-12)
    peer.until(FREE)
    assert {scan.region for scan in scanned(peer).values()} == {packet.region}


@pytest.mark.parametrize("direction", ["up", "down"])
def test_rows_and_columns_match_the_sample(bench: Make, direction: str) -> None:
    # Compared with the heights of the simulated sample at each pixel: an offset by half a frame or a mirrored axis
    # shows.
    made = bench(tip={"radius_m": 0.1e-9}, scanner={"band_limit_px": 0.0}, **FLAT)
    peer = made.start()
    region = Region((40e-9, -25e-9), (60e-9, 300e-9), math.radians(30))
    ready(peer, region, (48, 32))
    assert peer.set(names.SCAN_DIRECTION, direction).ok
    scans = scanned(peer)
    truth = made.emulator.rig.world.sample.surface_m(*region.pixels_m((48, 32)))

    def likeness(values: np.ndarray) -> float:
        return float(np.corrcoef(values.ravel(), truth.ravel())[0, 1])

    for channel in ("HeightTrace", "HeightRetrace"):
        values = scans[channel].values
        assert likeness(values) > 0.98
        for mirrored in (values[::-1], values[:, ::-1], values[::-1, ::-1]):
            assert likeness(mirrored) < likeness(values) - 0.1
    assert read(scans["HeightTrace"].filename).upwards is (direction == "up")


def test_stopped_scan_is_not_published_and_withdraws_the_tip(bench: Make) -> None:
    made = bench(speed=10.0, saves_partial=True)
    peer = made.start()
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    assert peer.get("x-engaged") == "true"
    assert peer.act(names.STOP_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not any(isinstance(one, Scan) for one in received)
    assert peer.get("x-engaged") == "false"
    assert peer.act(names.STOP_SCAN).ok, "nothing to stop is no error"
    assert peer.act(names.ENGAGE).ok
    peer.until(FREE)
    assert peer.get("x-engaged") == "true"


def test_images_from_the_panel_are_published(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = made.start()
    ready(peer)

    def press(emulator: object) -> None:
        made.emulator.controller.values.put("LastScan", 1)
        made.emulator.controller.scan(made.clock.now_s(), True)

    made.at_panel(press)
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "FREE"]
    assert {one.region for one in received if isinstance(one, Scan)} == {TURNED}


def test_consecutive_images_from_the_panel_are_each_published_once(bench: Make) -> None:
    made = bench(speed=8.0)
    peer = made.start()
    ready(peer)

    def suffix(last_scan: bool = False) -> int:
        found: list[float] = []

        def at_panel(emulator: Emulated) -> None:
            emulator.controller.values.put("LastScan", float(last_scan))
            found.append(emulator.controller.values.get("BaseSuffix"))

        made.at_panel(at_panel)
        return round(found[0])

    made.at_panel(lambda emulator: emulator.controller.scan(made.clock.now_s(), True))
    received = peer.until(lambda one: one == ScopeStatus(ScopeState.SCANNING))
    deadline_s = made.clock.monotonic_s() + DEADLINE_S
    while suffix() < 2:
        assert made.clock.monotonic_s() < deadline_s
    last = f"Image{suffix(last_scan=True):04d}.ibw"
    received += peer.until(lambda one: isinstance(one, Scan) and Path(one.filename).name == last)
    files = [Path(one.filename).name for one in received if isinstance(one, Scan) and one.channel == "HeightTrace"]
    assert files == [f"Image{i:04d}.ibw" for i in range(len(files))]
    assert len(files) > 2
    assert states(peer.until(FREE)) == ["FREE"]


def test_scan_that_outlives_the_translator_is_published_by_the_next(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = made.start()
    ready(peer)
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.kill()
    peer = made.start()
    scans = [one for one in peer.until(FREE) if isinstance(one, Scan)]
    assert {(scan.region, Path(scan.filename).name) for scan in scans} == {(TURNED, "Image0000.ibw")}
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    scans = [one for one in peer.until(FREE) if isinstance(one, Scan)]
    assert {Path(scan.filename).name for scan in scans} == {"Image0001.ibw"}


def test_scan_of_another_frame_than_the_set_one_is_not_complete(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    # as if the ratios meant something else: what its panels say, and what it scans
    made.at_panel(lambda emulator: emulator.controller.values.put("FastRatio", 1.0))
    assert peer.act(names.START_SCAN).ok
    assert states(peer.until(FREE)) == ["SCANNING", "INTERRUPTED", "FREE"]
    made.until_logged(
        "its frame is 300 x 300 nm around (40, -25) nm at 30°, and 300 x 100 nm around (40, -25) nm at 30°"
    )


# --- parameters ---


def test_frame_in_asylums_values(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    values = made.emulator.controller.values
    assert values.get("XOffset") == pytest.approx(40e-9, abs=1e-20)
    assert values.get("YOffset") == pytest.approx(-25e-9, abs=1e-20)
    assert values.get("ScanSize") == pytest.approx(300e-9)
    assert values.get("SlowRatio") / values.get("FastRatio") == pytest.approx(1 / 3)
    assert values.size() == pytest.approx((300e-9, 100e-9))
    assert values.get("ScanAngle") == pytest.approx(-30.0), "clockwise"
    assert (values.get("ScanPoints"), values.get("ScanLines")) == (32, 12)


def test_speed_sets_scan_rate_and_survives_a_change_of_width(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    values = made.emulator.controller.values
    assert peer.set(names.SCAN_SPEED, 3, "um/s").ok
    assert values.get("ScanRate") == pytest.approx(3e-6 / (2.5 * 300e-9))
    assert peer.set(names.SCAN_SIZE_X, 150, "nm").ok
    assert float(peer.get(names.SCAN_SPEED)) == pytest.approx(3e-6)
    assert values.get("ScanRate") == pytest.approx(3e-6 / (2.5 * 150e-9))
    assert values.get("ScanSpeed") == pytest.approx(3e-6)


def test_feedback_is_set_and_switched(bench: Make) -> None:
    made = bench()
    peer = made.start()
    peer.until(FREE)
    assert peer.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(False, 0.5, 20.0, 0.6)).ok
    packet = peer.until(lambda one: isinstance(one, Feedback) and one.on is False)[-1]
    assert (packet.proportional_gain, packet.integral_gain) == pytest.approx((0.5, 20.0))
    assert packet.setpoint == pytest.approx(0.6)
    assert made.emulator.controller.values.get("AmplitudeSetpointVolts") == pytest.approx(0.6)
    assert peer.set(names.FEEDBACK_ON, True).ok
    assert peer.get(names.FEEDBACK_ON) == "true"


def test_withdrawn_tip_is_not_reported_without_feedback(bench: Make) -> None:
    # A withdrawn tip is in no danger: the scheduler would retract it again and notify a person.
    made = bench(speed=10.0)
    peer = made.start()
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    assert peer.act(names.STOP_SCAN).ok
    received = [*peer.until(lambda one: isinstance(one, Feedback)), *peer.until(FREE)]
    assert [one.on for one in received if isinstance(one, Feedback)] == [None]
    assert (peer.get(names.FEEDBACK_ON), peer.get(names.ENGAGED)) == ("false", "false")
    assert peer.act(names.ENGAGE).ok
    peer.until(lambda one: isinstance(one, Feedback) and one.on is True)


def test_feedback_is_switched_on_after_its_other_settings(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    made = bench()
    peer = made.start()
    peer.until(FREE)
    assert peer.set(names.FEEDBACK_ON, False).ok
    controller, engaged_with = made.emulator.controller, []
    plain = controller.engage

    def engage(now_s: float) -> None:
        engaged_with.append(controller.values.get("AmplitudeSetpointVolts"))
        plain(now_s)

    monkeypatch.setattr(controller, "engage", engage)
    assert peer.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(True, 0.5, 20.0, 0.625)).ok
    assert engaged_with == [0.625], "with the setpoint of before the tip may crash"
    assert peer.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=True, setpoint=0.75)).ok
    assert engaged_with == [0.625], "it is on: Engage is not pressed again"


def test_switching_feedback_on_waits_for_the_tip(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = made.start(reply_timeout_s=5.0)
    peer.until(FREE)
    assert peer.act(names.RETRACT).ok
    peer.until(FREE)
    response = peer.set(names.FEEDBACK_ON, True)
    assert response.ok, response.reason
    assert made.emulator.rig.engaged


def test_feedback_that_stays_off_is_an_error(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    made = bench()
    peer = made.start(reply_timeout_s=1.0)
    peer.until(FREE)
    assert peer.set(names.FEEDBACK_ON, False).ok
    monkeypatch.setattr(made.emulator.controller, "engage", lambda _now_s: None)
    response = peer.set(names.FEEDBACK_ON, True)
    assert response.code == ControlResponse.PARAM_ERROR
    assert "set False instead of True" in response.reason


@pytest.mark.parametrize("scanning", [False, True])
def test_tip_without_feedback_is_retracted_at_the_end_of_a_run(bench: Make, scanning: bool) -> None:
    made = bench(speed=5.0)
    left_in_danger(made, scanning=scanning, retracts=True)
    assert not made.emulator.rig.engaged
    why = "Asylum withdrew the tip" if scanning else "the run is stopping with the feedback off"
    assert why in made.log_text()


def test_tip_without_feedback_stays_if_the_file_allows_it(bench: Make) -> None:
    made = bench(speed=5.0)
    left_in_danger(made, scanning=False, retracts=False)
    assert made.emulator.rig.engaged


def test_a_row_of_the_table_can_name_another_value_or_a_text(bench: Make) -> None:
    made = bench()
    rows = {
        "zctrl-setpoint": {"vendor": "DeflectionSetpointVolts"},
        "x-name": {"vendor": "BaseName", "type": "text"},
    }
    peer = made.start(parameters=rows)
    peer.until(FREE)
    assert peer.set(names.ZCTRL_SETPOINT, 0.25, "V").ok
    assert made.emulator.controller.values.get("DeflectionSetpointVolts") == 0.25
    assert peer.set("x-name", "Graphite").ok
    assert peer.get("x-name") == "Graphite"


def test_unknown_asylum_value_is_named(bench: Make) -> None:
    made = bench()
    peer = made.start(parameters={"x-loss": {"vendor": "NoSuchValue", "unit": "V"}})
    peer.until(FREE)
    response = peer.set("x-loss", 1)
    assert response.code == ControlResponse.PARAM_NOT_SUPPORTED
    assert "NoSuchValue" in response.reason


@pytest.mark.parametrize(
    ("name", "value", "unit", "code"),
    [
        (names.SCAN_SIZE_X, "nan", None, ControlResponse.PARAM_ERROR),
        (names.SCAN_SIZE_X, "1", "V", ControlResponse.PARAM_ERROR),
        (names.SCAN_SIZE_X, "1", "m", ControlResponse.PARAM_ERROR),
        (names.SCAN_DIRECTION, "sideways", None, ControlResponse.PARAM_ERROR),
        ("x-engaged", "false", None, ControlResponse.PARAM_ERROR),
        ("no-such", "1", None, ControlResponse.PARAM_NOT_SUPPORTED),
    ],
)
def test_unsettable_values_are_refused(
    bench: Make, name: str, value: str, unit: str | None, code: ControlResponse
) -> None:
    made = bench()
    peer = made.start()
    peer.until(FREE)
    response = peer.set(name, value, unit)
    assert response.code == code
    assert response.reason


def test_scan_is_polled_without_disturbing_it(bench: Make) -> None:
    made = bench(speed=10.0)
    peer = made.start()
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    assert float(peer.get(names.SCAN_SIZE_X)) == pytest.approx(300e-9)
    for response in (peer.set(names.SCAN_SIZE_X, 1e-7), peer.act(names.START_SCAN), peer.act(names.START_SPEC)):
        assert response.code == ControlResponse.NOT_FREE
    assert peer.act(names.RETRACT).ok, "the way out is open"
    assert states(peer.until(FREE)) == ["INTERRUPTED", "FREE"]
    assert peer.get("x-engaged") == "false"


def test_controller_name_and_base_name(bench: Make) -> None:
    made = bench()
    peer = made.start(base_name="Tuesday")
    ready(peer)
    assert peer.get(names.CONTROLLER) == "Asylum Research, Igor Pro 6.37, SIMULATED"
    assert Path(scanned(peer)["HeightTrace"].filename).name == "Tuesday0000.ibw"


@pytest.mark.parametrize("without", [(), ("archecksuffix",)])
def test_a_base_name_of_another_night_overwrites_nothing(
    bench: Make, monkeypatch: pytest.MonkeyPatch, without: tuple[str, ...]
) -> None:
    # ARCheckSuffix finds the next free number; a release without it would start with 0000 again.
    made = bench()
    functions = made.emulator.functions()
    monkeypatch.setattr(made.emulator, "_functions", {k: f for k, f in functions.items() if k not in without})
    made.data.mkdir(exist_ok=True)
    earlier = [made.data / f"Tuesday{number:04d}.ibw" for number in range(3)]
    for file in earlier:
        file.write_bytes(b"of another night")
    peer = made.start(base_name="Tuesday")
    ready(peer)
    assert Path(scanned(peer)["HeightTrace"].filename).name == "Tuesday0003.ibw"
    assert [file.read_bytes() for file in earlier] == [b"of another night"] * 3


def test_files_are_found_on_a_mounted_drive(bench: Make) -> None:
    made = bench(save_path="C:Users:Asylum User:Documents:240820:")
    peer = made.start(folders={"c:users:Asylum User:Documents": str(made.folder)})
    ready(peer)
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "240820 does not exist on this computer" in response.reason
    (made.folder / "240820").symlink_to(made.data, target_is_directory=True)
    assert Path(scanned(peer)["HeightTrace"].filename).parent.name == "240820"


def test_commands_of_the_experiment_file(bench: Make) -> None:
    made = bench()
    commands = {"x-drive": 'PV "DriveAmplitude", 0.25', "x-odd": 'DoForceFunc "Nothing"', "x-typo": 'PV "A'}
    peer = made.start(actions={name: {"command": text} for name, text in commands.items()})
    peer.until(FREE)
    assert peer.act("x-drive").ok
    assert made.emulator.controller.values.get("DriveAmplitude") == 0.25
    assert "it returned 1" in peer.act("x-odd").reason
    assert "as in JSON" in peer.act("x-typo").reason


# --- the probe, and force curves ---


def test_probe_reaches_its_place_on_a_rotated_image(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    scanned(peer)
    moved_exactly(peer, 70e-9, 10e-9)
    assert made.emulator.rig.probe_m == pytest.approx((70e-9, 10e-9), abs=1e-16)


def test_probe_reaches_its_place_despite_another_spot_on_the_panel(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    made.at_panel(lambda emulator: emulator.controller.values.put("ForceSpotNumber", 0))
    moved_exactly(peer, 70e-9, 10e-9)
    assert made.emulator.rig.probe_m == pytest.approx((70e-9, 10e-9), abs=1e-16)


def test_before_the_first_scan_spots_count_on_the_open_image(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    moved_exactly(peer, 70e-9, 10e-9)
    assert made.emulator.rig.probe_m == pytest.approx((70e-9, 10e-9), abs=1e-16)


@pytest.mark.parametrize("kind", ["scan-refused", "aborted"])
def test_after_a_failed_start_spots_count_on_the_previous_image(bench: Make, kind: str) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    scanned(peer)
    moved_exactly(peer, 70e-9, 10e-9)
    ready_again = Region((900e-9, 0.0), (500e-9, 500e-9))
    assert peer.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(ready_again, SHAPE, "")).ok
    peer.until(FREE)
    plain = made.emulator.controller.scan
    if kind == "aborted":

        def abort(now_s: float, down: bool | None) -> None:
            made.emulator.controller.scan = plain  # type: ignore[method-assign]
            raise CallFailed(107, "User abort.")

        made.emulator.controller.scan = abort  # type: ignore[method-assign]
    else:
        made.strike(kind)
    assert peer.act(names.START_SCAN).code == ControlResponse.ACTION_ERROR
    assert float(peer.get(names.PROBE_POS_X)) == pytest.approx(70e-9)
    moved_exactly(peer, 50e-9, 20e-9)
    assert made.emulator.rig.probe_m == pytest.approx((50e-9, 20e-9), abs=1e-16)
    scanned(peer)
    moved_exactly(peer, 800e-9, 20e-9)
    assert made.emulator.rig.probe_m == pytest.approx((800e-9, 20e-9), abs=1e-16)


def test_probe_keeps_its_place_when_the_image_changes(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    moved_exactly(peer, 70e-9, 10e-9)
    scanned(peer)
    assert float(peer.get(names.PROBE_POS_X)) == pytest.approx(70e-9)
    assert float(peer.get(names.PROBE_POS_Y)) == pytest.approx(10e-9)


def test_force_curve_has_its_position(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    moved_exactly(peer, 70e-9, 10e-9)
    response = peer.act(names.START_SPEC)
    assert response.ok, response.reason
    received = peer.until(FREE)
    assert states(received) == ["SPEC", "FREE"]
    (curve,) = [one for one in received if isinstance(one, Spectrum)]
    assert curve.position_m == pytest.approx((70e-9, 10e-9), abs=1e-16)
    assert (curve.kind, curve.names) == ("force", ("Raw", "Defl", "ZSnsr", "Time"))
    assert curve.units == ("m", "m", "m", "s")
    raw, deflection = curve.values[:, 0], curve.values[:, 1]
    assert raw[0] == raw[-1] == 0.0
    assert deflection[raw.argmax()] == pytest.approx(deflection.max(), rel=0.1)
    note = str(binarywave.load(curve.filename)["wave"]["note"], "latin-1")
    noted = dict(line.split(": ", 1) for line in note.split("\r") if ": " in line)
    assert (noted["ImagingMode"], noted["TriggerChannel"]) == ("Contact", "DeflVolts")
    (conditions,) = [one for one in received if isinstance(one, MeasurementConditions)]
    in_force = {one.name: one.constant for one in conditions.in_force}
    assert in_force["x-spring-constant"] == pytest.approx(float(noted["SpringConstant"]))
    assert in_force["x-sensitivity"] == pytest.approx(float(noted["InvOLS"]))
    assert (in_force["tip-bias-voltage"], names.SCAN_SPEED in in_force) == (0.0, False)
    (from_file,) = read(curve.filename).spectra
    force_n = Asylum.channels_of({}).shown(from_file).of("force, retrace")
    assert force_n == pytest.approx(float(noted["SpringConstant"]) * deflection[len(deflection) // 2 :], abs=1e-11)
    for name in (
        "NumPtsPerSec",
        "TriggerPoint",
        "InputTime",
        "ApproachVelocity",
        "RetractVelocity",
    ):
        assert float(noted[name]) > 0.0


# results F0: the constant in the file was 3 N/m for a lever of 0.4 N/m, and the distance had no effect
@pytest.mark.parametrize("distance_nm", [200, 400])
def test_force_curve_has_the_distance_and_the_trigger_that_were_set(bench: Make, distance_nm: int) -> None:
    made = bench()
    peer = made.start(
        parameters={
            "x-distance": {"vendor": "ForceDist", "unit": "m"},
            "x-velocity": {"vendor": "Velocity", "unit": "m/s"},
            "x-trigger": {"vendor": "DeflectionSetpointVolts", "unit": "V"},
        }
    )
    ready(peer)
    for name, value in (("x-distance", distance_nm * 1e-9), ("x-velocity", 1e-6), ("x-trigger", 0.5)):
        assert peer.set(name, str(value)).ok
    assert peer.act(names.START_SPEC).ok
    (curve,) = [one for one in peer.until(FREE) if isinstance(one, Spectrum)]
    note = str(binarywave.load(curve.filename)["wave"]["note"], "latin-1")
    noted = dict(line.split(": ", 1) for line in note.split("\r") if ": " in line)
    assert np.ptp(curve["ZSnsr"]) == pytest.approx(distance_nm * 1e-9, rel=1e-4)
    assert [float(noted[name]) for name in ("ForceDist", "ApproachVelocity")] == pytest.approx(
        [distance_nm * 1e-9, 1e-6]
    )
    lever = made.emulator.rig.world.settings
    assert float(noted["SpringConstant"]) == lever.force.spring_n_per_m
    assert float(noted["InvOLS"]) == pytest.approx(lever.feedback.sensitivity_m_per_v)
    assert curve["Defl"].max() == pytest.approx(0.5 * float(noted["InvOLS"]), rel=0.02)


def test_force_curve_after_a_scan_is_taken_at_the_probe_position(bench: Make) -> None:
    # A scan moves the tip away.
    made = bench(speed=20.0)
    peer = made.start()
    ready(peer)
    moved_exactly(peer, 70e-9, 10e-9)
    scanned(peer)
    made.at_panel(lambda emulator: setattr(emulator.rig, "_probe_m", (120e-9, 5e-9)))
    assert peer.act(names.START_SPEC).ok
    received = peer.until(FREE)
    assert states(received) == ["SPEC", "FREE"]
    (curve,) = [one for one in received if isinstance(one, Spectrum)]
    assert curve.position_m == pytest.approx((70e-9, 10e-9))
    assert made.emulator.rig.probe_m == pytest.approx((70e-9, 10e-9), abs=1e-16)


def test_force_curve_can_be_stopped_during_the_move_to_it(bench: Make) -> None:
    made = bench(speed=2.0)
    peer = made.start(move_s=10.0)
    ready(peer)
    moved_exactly(peer, 70e-9, 10e-9)
    scanned(peer)
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    assert peer.act(names.STOP_SPEC).ok
    received = peer.until(FREE)
    assert "SPEC" not in states(received)
    assert not any(isinstance(one, Spectrum) for one in received)


def test_stopped_force_curve_is_not_published(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = made.start()
    peer.until(FREE)
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    assert peer.act(names.STOP_SPEC).ok
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not any(isinstance(one, Spectrum) for one in received)


def test_force_curve_from_the_panel_has_the_position_in_its_file(bench: Make) -> None:
    made = bench(speed=2.0)
    peer = made.start()
    peer.until(FREE)
    made.at_panel(lambda emulator: emulator.rig.move_probe((20e-9, 30e-9), emulator.clock.now_s()))
    made.at_panel(lambda emulator: emulator.rig.stop_move(emulator.clock.now_s()))
    x, y = made.emulator.rig.probe_m
    made.at_panel(lambda emulator: emulator.controller.curve(made.clock.now_s()))
    peer.until(ScopeState.SPEC)
    (curve,) = [one for one in peer.until(FREE) if isinstance(one, Spectrum)]
    assert curve.position_m == pytest.approx((x, y), rel=1e-4, abs=1e-12)


# --- the tip ---


def test_pulse_restores_the_bias(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = made.start()
    ready(peer)
    assert peer.set(names.TIP_BIAS_VOLTAGE, 0.5).ok
    assert peer.set(names.PULSE_VOLTAGE, -4.5).ok
    assert peer.set(names.PULSE_DURATION, "300", "ms").ok
    assert peer.act(names.PULSE).ok
    assert peer.act(names.START_SCAN).code == ControlResponse.NOT_FREE
    peer.until(FREE)
    assert peer.get(names.TIP_BIAS_VOLTAGE) == "0.5"
    pulse = made.events("pulse")[-1]
    assert pulse["voltage_v"] == -4.5
    assert pulse["duration_s"] >= 0.3
    assert peer.set(names.PULSE_VOLTAGE, 11).code == ControlResponse.PARAM_ERROR


def test_crash_is_an_unsaved_indentation(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = made.start(
        parameters={
            "x-crash-depth": {"vendor": "ForceDist", "unit": "m", "range": [0, 5e-6]},
            "x-crash-speed": {"vendor": "Velocity", "unit": "m/s"},
            "x-save-force": {"vendor": "SaveForce"},
        },
        actions={"x-crash": {"set": {"x-save-force": 0}, "command": 'DoForceFunc "SingleForce"', "for": "3 s"}},
    )
    ready(peer)
    assert peer.set(names.CRASH_DEPTH, 2, "um").ok
    assert peer.set(names.CRASH_SPEED, 5, "um/s").ok
    assert peer.act(names.CRASH).ok
    packets = peer.until(FREE)
    (crash,) = made.events("crash")
    assert (crash["depth_m"], crash["speed_m_per_s"]) == pytest.approx((2e-6, 5e-6))
    assert not [one for one in packets if isinstance(one, Spectrum)]
    assert peer.get("x-save-force") == "2"
    assert not list(made.data.glob("*.ibw"))
