"""The Park translator with an emulated SmartScan: requests, their effects, and publications."""

from __future__ import annotations

import math
from collections.abc import Callable
from threading import Event
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tests.plugins.park.park_bench import Bench
from tests.plugins.vendor_bench import FLAT, SOON, TURNED, left_in_danger, moved, ready, scanned, scans, small, states

from afspm.basics import InvalidValue
from afspm.model import ControlResponse, Region, ScopeState, Spectrum, names

pytestmark = pytest.mark.slow

Make = Callable[..., Bench]
Settings = dict[str, Any]
FREE, UNDEFINED = ScopeState.FREE, ScopeState.UNDEFINED
VARIANTS: list[Settings] = [
    {"errors": errors, "values": values, "replies": replies, "scan_words": words}
    for errors, values, replies, words in (
        ("rpc", "text", "at-end", ("true", "false")),
        ("result", "native", "at-once", ("Scanning", "Idle")),
        ("value", "text", "at-once", ("1", "0")),
        ("result", "text", "at-end", ("running", "stopped")),
    )
]


def test_scan_shows_the_sample_in_place(bench: Make) -> None:
    made = bench(tip={"radius_m": 0.1e-9}, scanner={"band_limit_px": 0.0}, **FLAT)
    peer = made.start()
    region = Region((40e-9, -25e-9), (60e-9, 300e-9), math.radians(30))
    ready(peer, region, (48, 32))
    found = scanned(peer)
    x, y = region.pixels_m((48, 32))
    truth = made.emulator.rig.world.sample.surface_m(x, y)

    def likeness(values: np.ndarray) -> float:
        return float(np.corrcoef(values.ravel(), truth.ravel())[0, 1])

    assert {"Height Forward", "Height Backward"} <= set(found)
    for channel in ("Height Forward", "Height Backward"):
        scan = found[channel]
        assert scan.region == region
        assert likeness(scan.values) > 0.95
        for mirrored in (scan.values[::-1], scan.values[:, ::-1], scan.values[::-1, ::-1]):
            assert likeness(mirrored) < likeness(scan.values) - 0.1


@pytest.mark.parametrize("variant", VARIANTS)
def test_tip_moves_scans_and_withdraws_with_every_form_of_reply(bench: Make, variant: Settings) -> None:
    made = bench(**variant)
    peer = made.start()
    ready(peer)
    moved(peer, 120e-9, -40e-9)
    assert made.emulator.rig.probe_m == pytest.approx((120e-9, -40e-9))
    assert scanned(peer)
    for action, engaged in ((names.RETRACT, False), (names.ENGAGE, True)):
        assert peer.act(action).ok
        assert states(peer.until(FREE)) == ["COARSE_MOTOR", "FREE"]
        assert made.emulator.rig.engaged is engaged


@pytest.mark.parametrize("variant", VARIANTS)
def test_refusal_has_smartscans_own_text(bench: Make, variant: Settings) -> None:
    made = bench(**variant)
    peer = small(made)
    made.at_panel(lambda emulator: emulator.rig.occupy("calibration", 1e4, emulator.clock.now_s()))
    # results M5: SmartScan does not report a person's other work, so the run waits for its end at first
    for code in [ControlResponse.NOT_FREE] * 2 + [ControlResponse.ACTION_ERROR]:
        response = peer.act(names.START_SCAN)
        assert response.code == code
        assert "busy with a calibration" in response.reason


@pytest.mark.parametrize("replies", ["at-end", "at-once"])
def test_restarted_translator_awaits_the_end_of_an_approach(bench: Make, replies: str) -> None:
    made = bench(speed=10.0, replies=replies)
    peer = small(made)
    made.at_panel(lambda emulator: setattr(emulator.rig.setup, "approach_s", 20.0))
    assert peer.act(names.ENGAGE).ok
    made.kill()
    peer = made.start()
    assert "COARSE_MOTOR" in states(peer.until(FREE))
    busy: list[bool] = []
    made.at_panel(lambda emulator: busy.append(emulator.rig.busy(emulator.clock.now_s())))
    assert busy == [False]


def test_scan_that_outlives_the_translator_is_published_by_the_next(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = made.start()
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.kill()
    received = made.start().until(FREE)
    assert "SCANNING" in states(received)
    assert {(scan.region, scan.shape) for scan in scans(received)} == {(TURNED, (64, 32))}


def test_withdrawing_ends_a_scan_and_lifts_the_stage(bench: Make) -> None:
    made = bench(speed=10.0)
    peer = made.start(lift=250e-6)
    ready(peer, shape=(64, 32))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    assert peer.act(names.RETRACT).ok
    peer.until(FREE)
    assert not made.emulator.rig.engaged
    assert made.emulator.program.stage_um[2] == pytest.approx(250.0)  # type: ignore[attr-defined]
    assert not made.emulator.rig.world.sample.marks, "it went up"


@pytest.mark.parametrize("scanning", [True, False])
def test_tip_is_withdrawn_at_the_end_of_a_run(bench: Make, scanning: bool) -> None:
    made = bench(speed=10.0)
    left_in_danger(made, scanning=scanning, retracts=True)
    assert not made.emulator.rig.engaged


@pytest.mark.parametrize("variant", VARIANTS)
def test_refused_withdrawal_is_no_success(bench: Make, monkeypatch: pytest.MonkeyPatch, variant: Settings) -> None:
    def refuse(now_s: float) -> None:
        raise InvalidValue("the z scanner is locked")

    made = bench(**variant)
    peer = small(made)
    monkeypatch.setattr(made.emulator.rig, "withdraw", refuse)
    response = peer.act(names.RETRACT)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "the z scanner is locked" in response.reason


@pytest.mark.parametrize(
    ("kind", "logged"),
    [
        ("no-reply", "no reply to"),
        ("late-reply", "no reply to"),
        ("half-reply", "SmartScan's reply is not JSON"),
        ("garbage", "SmartScan's reply is not JSON"),
        ("dialog", "a dialog may wait on its screen"),
    ],
)
def test_bad_reply_is_logged_and_smartscan_reconnected(bench: Make, kind: str, logged: str) -> None:
    made = bench()
    peer = small(made, **SOON)
    made.strike(kind, duration_s=500.0)
    peer.until(UNDEFINED)
    peer.until(FREE)
    made.until_logged(logged)
    response = peer.act_once_free(names.START_SCAN)
    assert response.ok, response.reason
    assert scans(peer.until(FREE))


def test_value_that_is_no_number_is_logged_and_scans_go_on(bench: Make) -> None:
    made = bench()
    peer = small(made, **SOON)
    made.strike("nan")
    made.until_logged("SmartScan replied")
    while not (response := peer.act(names.START_SCAN)).ok:  # the frame itself may have been no number
        assert response.code in (ControlResponse.NOT_FREE, ControlResponse.NO_RESPONSE), response.reason
    while not scans(peer.until(FREE)):
        pass


def test_unknown_word_is_named_and_not_guessed(bench: Make) -> None:
    made = bench(scan_words=("true", "schläft"))
    made.start(**SOON)
    made.until_logged("replied 'schläft' to scan_query")


def test_words_can_be_added(bench: Make) -> None:
    peer = bench(scan_words=("misst", "ruht")).start(scanning_words=["misst"], idle_words=["Ruht"])
    ready(peer)
    assert scanned(peer)


@pytest.mark.parametrize(("kind", "state"), [("late-file", "FREE"), ("half-file", "FREE")])
def test_late_file_is_awaited(bench: Make, kind: str, state: str) -> None:
    made = bench()
    peer = small(made)
    made.strike(kind, duration_s=300.0)
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert scans(received)
    assert states(received)[-1] == state


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("kind", "swept"), [("force", "Z"), ("IV", "Bias")])
def test_a_curve_is_taken_where_the_tip_was_sent(bench: Make, kind: str, swept: str, variant: Settings) -> None:
    made = bench(**variant)
    peer = made.start()
    ready(peer)
    moved(peer, 120e-9, -40e-9)
    scanned(peer)
    assert peer.set(names.SPEC_KIND, kind).ok
    assert peer.act(names.START_SPEC).ok
    received = peer.until(FREE)
    assert states(received) == ["SPEC", "FREE"]
    (curve,) = [one for one in received if isinstance(one, Spectrum)]
    assert (curve.kind, curve.names[0], curve.position_m) == (kind, swept, (120e-9, -40e-9))
    taken = made.emulator.rig.spectrum
    assert taken is not None
    assert taken.position_m == pytest.approx((120e-9, -40e-9))
    there, back = taken.both_ways()
    for name, (_, values) in there.items():
        np.testing.assert_allclose(curve[name], [*values, *back[name][1]], rtol=1e-5, atol=1e-6 * np.ptp(values))


def test_a_curve_can_be_stopped(bench: Make) -> None:
    made = bench(speed=1.0, force={"duration_s": 20.0})
    peer = small(made)
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    assert peer.act(names.STOP_SPEC).ok
    received = peer.until(FREE)
    assert not any(isinstance(one, Spectrum) for one in received)


def test_stop_that_overtakes_the_start_of_its_curve_is_repeated(bench: Make) -> None:
    # Start and stop use two connections.
    made = bench(speed=1.0, force={"duration_s": 20.0})
    peer = small(made)
    stops: list[float] = []

    def stop() -> None:
        stops.append(made.clock.now_s())
        if len(stops) > 1:
            made.emulator.program.stop_curve()

    def replace_stop(emulator: Any) -> None:
        emulator.program._methods["spect.stop"] = stop

    made.at_panel(replace_stop)
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    pace = Event()
    while made.emulator.rig.spectrum is None:  # SPEC is published during the move, too, after which no curve begins
        pace.wait(0.005)
    assert peer.act(names.STOP_SPEC).ok
    assert not any(isinstance(one, Spectrum) for one in peer.until(FREE))
    assert len(stops) > 1


def test_curve_stopped_during_the_move_to_it_is_not_taken(bench: Make) -> None:
    made = bench()
    peer = made.start()
    ready(peer)
    moved(peer, 120e-9, -40e-9)
    made.at_panel(lambda emulator: emulator.rig.move_probe((1e-6, 0.0), emulator.clock.now_s()))
    made.at_panel(lambda emulator: setattr(emulator.rig.setup, "move_speed_m_s", 5e-9))
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    assert peer.act(names.STOP_SPEC).ok
    assert states(peer.until(FREE)) == ["INTERRUPTED", "MOVING", "FREE"]
    assert made.emulator.rig.spectrum is None


def test_withdrawing_ends_a_curve(bench: Make) -> None:
    made = bench(speed=1.0, force={"duration_s": 20.0})
    peer = small(made)
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    assert peer.act(names.RETRACT).ok
    assert not any(isinstance(one, Spectrum) for one in peer.until(FREE))
    assert not made.emulator.rig.engaged


def test_refused_curve_has_no_result(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.at_panel(lambda emulator: emulator.rig.occupy("calibration", 1e4, emulator.clock.now_s()))
    peer.act(names.START_SPEC)
    received = peer.until(FREE)
    assert states(received)[-2:] == ["INTERRUPTED", "FREE"]
    made.until_logged("busy with a calibration")


def test_setting_one_gain_keeps_the_others(bench: Make) -> None:
    made = bench()
    peer = small(made)
    assert peer.set(names.ZCTRL_IGAIN, 0.25).ok
    assert (peer.get(names.ZCTRL_IGAIN), peer.get(names.ZCTRL_PGAIN)) == ("0.25", "0.5")
    feedback = made.emulator.rig.setup.feedback
    assert (feedback.proportional_gain, feedback.integral_gain) == pytest.approx((0.1, 750.0))
    assert peer.set(names.ZCTRL_PGAIN, 1000.0).code == ControlResponse.PARAM_ERROR


def test_picture_of_another_program_does_not_cost_the_scan(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = made.start()
    ready(peer, shape=(40, 32))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    Image.new("L", (8, 8)).save(made.data / "screenshot.tif")
    assert scans(peer.until(FREE))


def test_refused_move_leaves_the_position(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise InvalidValue("beyond the scanner")

    made = bench()
    peer = small(made)
    monkeypatch.setattr(made.emulator.rig, "move_probe", refuse)
    response = peer.set(names.PROBE_POS_X, 1e-6)
    assert response.code == ControlResponse.PARAM_ERROR
    assert "beyond the scanner" in response.reason
    assert float(peer.get(names.PROBE_POS_X)) == 0.0


def test_refused_frame_keeps_the_speed_of_the_tip(bench: Make) -> None:
    peer = small(bench())
    assert peer.set(names.SCAN_SPEED, 5e-9).ok
    response = peer.set(names.SCAN_SIZE_X, 50e-6)  # 0.00005 lines per second: too slow for SmartScan
    assert response.code == ControlResponse.PARAM_ERROR
    assert float(peer.get(names.SCAN_SIZE_X)) == pytest.approx(1e-6)
    assert float(peer.get(names.SCAN_SPEED)) == pytest.approx(5e-9)


def test_unreported_gains_are_not_supported(bench: Make) -> None:
    made = bench(reports_gains=False)
    peer = small(made)
    assert peer.get_response(names.ZCTRL_IGAIN).code == ControlResponse.PARAM_NOT_SUPPORTED
    assert scanned(peer)
    made.until_logged("does not report the gains")


@pytest.mark.parametrize("kind", ["spectrum-refused", "no-file"])
def test_curve_without_a_file_is_reported(bench: Make, kind: str) -> None:
    made = bench()
    peer = small(made, result_timeout_s=2.0)
    made.strike(kind)
    assert peer.act(names.START_SPEC).ok
    received = peer.until(FREE)
    assert not any(isinstance(one, Spectrum) for one in received)
    assert "INTERRUPTED" in states(received)
    made.strike("late-file", duration_s=100.0)
    assert peer.act(names.START_SPEC).ok
    assert [one.kind for one in peer.until(FREE) if isinstance(one, Spectrum)] == ["force"]


@pytest.mark.parametrize("replies", ["at-end", "at-once"])
def test_long_command_keeps_the_microscope_busy_and_connected(bench: Make, replies: str) -> None:
    made = bench(speed=1.0, replies=replies)  # a sweep takes 3 s, and a reply may take one
    peer = small(made, actions={"x-sweep": {"command": "spm.ncm.sweepAutoFullRange()"}}, reply_timeout_s=1.0)
    assert peer.act("x-sweep").ok
    assert states(peer.until(FREE)) == ["COARSE_MOTOR", "FREE"]
    assert not made.emulator.rig.busy(made.clock.now_s())


def test_move_of_the_stage_is_refused_since_no_value_shows_the_tip(bench: Make) -> None:
    made = bench()
    peer = small(made, actions={"x-up": {"command": "spm.zstage.move(10, 1)"}})
    assert "it needs a withdrawn tip, and this microscope never shows the tip" in peer.act("x-up").reason
    assert not made.emulator.rig.busy(made.clock.now_s())


def test_unknown_command_is_refused_with_smartscans_own_text(bench: Make) -> None:
    peer = small(bench(), actions={"x-mode": {"command": "spm.head.setMode('ncm')"}})
    response = peer.act("x-mode")
    assert response.code == ControlResponse.ACTION_ERROR
    assert "SmartScan: TypeError: " in response.reason
