"""Faults of a Nanonis controller: each is a named error, nothing hangs, and the translator reconnects."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from deadlines import DEADLINE_S
from tests.plugins.nanonis.nanonis_bench import Bench
from tests.plugins.vendor_bench import SOON, scanned, scans, small, states

from afspm.driver import read_result
from afspm.model import (
    ControlRequest,
    ControlResponse,
    ProbePosition,
    Response,
    Scan,
    ScanLines,
    ScopeState,
    ScopeStatus,
    Spectrum,
    names,
)
from afspm.supervisor import FreePorts

Make = Callable[..., Bench]
FREE = ScopeState.FREE
UNDEFINED = ScopeState.UNDEFINED
SEEN = 5.0
"""A speed at which a scan is seen while it lasts, on a busy computer too: or it is not known to have run."""


@pytest.mark.parametrize(
    ("kind", "logged"),
    [
        ("no-reply", "no answer to"),
        ("cut", "was closed after 0 of 40 bytes"),
        ("truncated", "the connection was closed after"),
        ("error", "an emulated error"),
        ("wrong-name", "Nanonis replied to 'Util.RTFreqGet' instead of"),
        ("garbage", "Nanonis replied to"),
        ("huge", "Nanonis announced 2147483647 bytes"),
        ("nan", "returned nan"),
    ],
)
def test_bad_reply_is_logged_and_the_controller_reconnected(bench: Make, kind: str, logged: str) -> None:
    made = bench()
    peer = small(made, **SOON)
    made.strike(kind)
    peer.until(UNDEFINED)
    peer.until(FREE)
    made.until_logged(logged)
    assert peer.act(names.START_SCAN).ok
    assert scans(peer.until(FREE))


def test_dialog_on_the_screen_silences_the_controller(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = small(made, **SOON)
    made.strike("dialog", duration_s=8.0)
    peer.until(UNDEFINED)
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.NO_RESPONSE
    assert "the controller can't be reached" in response.reason
    peer.until(FREE)
    made.until_logged("Nanonis is silent while a dialog waits for an answer on its screen")


def test_pulse_that_is_answered_at_its_end_is_awaited(bench: Make) -> None:
    # results T8: the connection was reset in the middle of the pulse
    made = bench(speed=1.0)
    peer = small(made, **SOON)
    assert peer.set(names.PULSE_DURATION, 4.0).ok
    made.strike("blocks", duration_s=60.0)
    assert peer.act(names.PULSE).ok
    assert UNDEFINED not in [one.state for one in peer.until(FREE) if isinstance(one, ScopeStatus)]


def test_silent_port_is_called_by_its_name(bench: Make) -> None:
    # results Z2
    made = bench(speed=1.0)
    peer = small(made, reply_timeout_s=0.5)
    made.strike("dialog", duration_s=6.0)
    peer.until(UNDEFINED)
    made.until_logged(
        "a port accepts connections and answers nothing: it may be wedged, or a dialog waits; restart Nanonis"
    )
    peer.until(FREE)


def test_slow_reply_is_awaited(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = small(made)
    made.strike("slow", duration_s=0.5)
    assert peer.get(names.TIP_BIAS_VOLTAGE) is not None
    made.kill()
    assert "can't be reached" not in made.log_text()


def test_refusal_has_the_controllers_own_text(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.strike("refused")
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "it is not possible now" in response.reason
    made.strike("refused")
    response = peer.set(names.TIP_BIAS_VOLTAGE, 0.3)
    assert response.code == ControlResponse.PARAM_ERROR
    assert "it is not possible now" in response.reason
    assert peer.act(names.START_SCAN).ok
    assert scans(peer.until(FREE))


def test_refused_spectrum_is_an_error_at_once(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.at_panel(lambda emulator: emulator.rig.occupy("something else", 1e6, emulator.clock.now_s()))
    response = peer.act(names.START_SPEC)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "something else" in response.reason


def test_fields_of_another_release_are_reported(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.strike("wrong-release", duration_s=1e9)
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.ACTION_ERROR
    assert "the reply to Scan.PropsGet is malformed" in response.reason
    assert "it was read as release 14573" in response.reason


def test_wrongly_reported_release_can_be_set(bench: Make) -> None:
    made = bench(release="2025")
    made.at_panel(lambda emulator: setattr(emulator.software.core, "release", 99999))
    peer = small(made, release=14573)
    assert peer.act(names.START_SCAN).ok
    assert scans(peer.until(FREE))


def test_texts_in_latin1_are_read(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.strike("not-utf8", count=3)
    assert peer.act(names.START_SCAN).ok
    assert scans(peer.until(FREE))


# --- files ---


@pytest.mark.parametrize("kind", ["file-late", "half-file"])
def test_slow_file_is_awaited(bench: Make, kind: str) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    made.strike(kind, duration_s=3.0)
    assert peer.act(names.START_SCAN).ok
    found = scans(peer.until(FREE))
    assert found[0].filename.endswith("unnamed001.sxm")


@pytest.mark.parametrize("kind", ["file-late", "half-file", "file-missing"])
def test_scan_without_a_file_is_fetched(bench: Make, kind: str) -> None:
    made = bench(speed=SEEN)
    peer = small(made)
    made.strike(kind, duration_s=1e6)
    assert peer.act(names.START_SCAN).ok
    found = scans(peer.until(FREE))
    assert found[0].filename.endswith("nanonis-0001.nc")
    # by the path that Nanonis reported, or by the folder without one
    made.until_logged("unnamed001.sxm); it was fetched over TCP", "session); it was fetched over TCP")


def test_scan_that_does_not_start_is_interrupted_and_the_previous_one_not_published(bench: Make) -> None:
    made = bench(speed=SEEN)
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    assert scans(peer.until(FREE))
    made.strike("no-start")
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
    assert not scans(received)
    made.until_logged("the controller never reported it as running")


@pytest.mark.parametrize("kinds", [("late-start",), ("ends-at-once",), ("ends-at-once", "late-start")])
def test_late_scan_is_published(bench: Make, kinds: tuple[str, ...]) -> None:
    # The wait for its end starts early: an event of another scan, or of none, is not its end.
    made = bench(speed=SEEN)
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    first = scans(peer.until(FREE))
    for kind in kinds:
        made.strike(kind, duration_s=4.0)  # which is over before the scan is
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "FREE"]
    second = scans(received)
    assert len(second) == len(first)
    assert all(scan.filename.endswith("unnamed002.sxm") for scan in second)


def test_lines_of_a_late_scan_are_not_those_of_the_previous_one(bench: Make) -> None:
    made = bench(speed=SEEN)
    peer = small(made, live_lines_s=0.5)
    assert peer.act(names.START_SCAN).ok
    peer.until(FREE)
    made.strike("late-start", duration_s=4.0)
    assert peer.act(names.START_SCAN).ok
    lines = [one for one in peer.until(FREE) if isinstance(one, ScanLines) and one.channel == "Z Forward"]
    assert len(lines) > 1
    assert [one.first_row for one in lines] == [sum(len(one.values) for one in lines[:n]) for n in range(len(lines))]


def test_lost_start_does_not_publish_the_previous_scan(bench: Make) -> None:
    made = bench()
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    assert scans(peer.until(FREE))
    made.emulator.loses = "Scan.Action"
    assert peer.act(names.START_SCAN).code == ControlResponse.NO_RESPONSE
    received = peer.until(FREE)
    made.until_logged("never reported it as running", "was fetched over TCP")
    made.emulator.loses = ""
    assert peer.act_once_free(names.START_SCAN).ok
    received += peer.until(lambda one: isinstance(one, Scan) and one.filename.endswith(".sxm"))
    received += peer.until(FREE)
    assert len(scans(received)) == 6, "Z, current and frequency shift, both ways, of the second scan alone"
    assert all(scan.filename.endswith(".sxm") for scan in scans(received))


def test_retracting_withdraws_the_tip_even_if_the_scan_can_not_be_stopped(bench: Make) -> None:
    made = bench(speed=10.0)
    peer = small(made)
    assert peer.set(names.SCAN_SPEED, 1e-7).ok
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.strike("refused")
    assert peer.act(names.RETRACT).ok
    assert not made.emulator.rig.engaged
    made.until_logged("it is not possible now")


def test_path_of_an_older_file_is_not_trusted(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    older = scans(peer.until(FREE))[0]
    made.strike("stale-name")
    assert peer.set(names.SCAN_TOP_LEFT_X, "5", "um").ok
    peer.until(FREE)
    assert peer.act(names.START_SCAN).ok
    newer = scans(peer.until(FREE))[0]
    assert newer.filename != older.filename
    assert newer.region.top_left_m[0] == pytest.approx(5e-6)
    assert not np.array_equal(newer.values, older.values)


def test_unsaved_spectrum_is_fetched(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    made.strike("autosave-off", duration_s=1e6)
    assert peer.act(names.START_SPEC).ok
    (spectrum,) = (one for one in peer.until(FREE) if isinstance(one, Spectrum))
    assert spectrum.filename.endswith(".nc")


def test_unsaved_spectrum_from_the_panel_is_not_the_previous_one(bench: Make) -> None:
    made = bench(speed=3.0)
    peer = small(made)
    assert peer.act(names.START_SPEC).ok
    assert [one for one in peer.until(FREE) if isinstance(one, Spectrum)]
    made.at_panel(lambda emulator: setattr(emulator.software.spectra.sweeps["BiasSpectr"], "saves", False))
    made.at_panel(lambda emulator: emulator.software.spectra.start("BiasSpectr", ""))
    peer.until(ScopeState.SPEC)
    received = peer.until(FREE)
    assert not [one for one in received if isinstance(one, Spectrum)], "its data is lost"
    assert states(received) == ["INTERRUPTED", "FREE"]
    made.until_logged("its data was not requested from Nanonis")


def test_unsaved_scan_is_fetched_at_once(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = small(made, result_timeout_s=1e6)  # the wait for a file is longer than this test
    made.strike("autosave-off", duration_s=1e6)
    assert peer.act(names.START_SCAN).ok
    made.emulator.ends_as_awaited = True
    found = scans(peer.until(FREE))
    assert found[0].filename.endswith(".nc")


# --- the tip, and people ---


def test_scan_stopped_at_the_panel_is_interrupted(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.strike("panel-stop")
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)
    made.until_logged("its data, which is not published, is kept in")  # stmsim K6
    (kept,) = made.folder.rglob("nanonis-*-stopped.nc")
    assert {one.values.shape for one in read_result(kept)} == {(8, 16)}


def test_scan_stopped_within_its_first_line_is_no_scan_of_zeros(bench: Make) -> None:
    made = bench(speed=1.0, unscanned="zeros")
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.at_panel(lambda emulator: emulator.software.functions.call("Scan.Action", [1, 0]))
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)


def test_safe_tip_blocks_measurements_until_the_tip_is_engaged(bench: Make) -> None:
    made = bench(speed=20.0)
    peer = small(made)
    made.strike("safe-tip")
    for action in (names.START_SCAN, names.START_SPEC, names.CRASH):
        response = peer.act(action)
        assert response.code in (ControlResponse.ACTION_ERROR, ControlResponse.NOT_FREE), action
    response = peer.act_once_free(names.START_SCAN)
    assert "safe tip" in response.reason
    made.until_logged("Nanonis' safe tip withdrew the tip")
    assert peer.act(names.ENGAGE).ok
    assert peer.act_once_free(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    assert scans(peer.until(FREE))


def test_scan_in_the_air_is_not_published(bench: Make) -> None:
    made = bench(speed=SEEN)
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.strike("safe-tip-unnoticed")
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)
    made.until_logged("Nanonis' safe tip withdrew the tip")
    assert "safe tip" in peer.act_once_free(names.START_SCAN).reason


def test_tip_being_shaped_is_busy_after_a_reconnection(bench: Make) -> None:
    # Nanonis does not report that it holds the tip in the surface.
    made = bench(speed=2.0)
    peer = small(made)
    assert peer.set(names.CRASH_SPEED, 1, "nm/s").ok
    assert peer.set(names.CRASH_DEPTH, 4, "nm").ok
    assert peer.act(names.CRASH).ok
    peer.until(ScopeState.MOVING)
    made.strike("cut", count=2)
    peer.until(UNDEFINED)
    assert states(peer.until(FREE)) == ["MOVING", "FREE"]


def test_scan_that_ended_without_a_connection_is_published(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.strike("cut", count=2)
    peer.until(UNDEFINED)
    found = scans(peer.until(FREE))
    assert found[0].filename.endswith("unnamed001.sxm")


def test_restarted_translator_publishes_scans_that_ended_meanwhile(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.kill()
    assert made.emulator.scan_ended.wait(DEADLINE_S)
    again = made.start()
    found = scans(again.until(FREE))
    assert found[0].filename.endswith("unnamed001.sxm")


def test_moving_tip_is_still_moving_after_a_reconnection(bench: Make) -> None:
    made = bench(speed=5.0)
    peer = small(made)
    assert peer.set(names.MOVE_SPEED, "20", "nm/s").ok
    assert peer.ask(ControlRequest.SET_PROBE_POS, ProbePosition((600e-9, 0.0))).ok
    peer.until(ScopeState.MOVING)
    made.strike("cut")
    received = peer.until(FREE)
    assert states(received) == ["UNDEFINED", "MOVING", "FREE"]
    assert made.emulator.rig.probe_at(made.clock.now_s()) == pytest.approx((600e-9, 0.0), abs=1e-9)


def test_restarted_software_is_found_with_its_present_settings(bench: Make) -> None:
    made = bench()
    peer = small(made)
    made.strike("crash")
    peer.until(UNDEFINED)
    made.start_controller_again()
    peer.until(lambda one: getattr(one, "shape", None) == (128, 128))
    peer.until(FREE)
    assert peer.set(names.SCAN_RESOLUTION_X, 16).ok
    assert peer.set(names.SCAN_RESOLUTION_Y, 8).ok
    peer.until(lambda one: getattr(one, "shape", None) == (8, 16))
    peer.until(FREE)
    assert peer.act(names.START_SCAN).ok
    assert scans(peer.until(FREE))


def test_unused_address_is_named(bench: Make) -> None:
    made = bench()
    made.address = f"127.0.0.1:{FreePorts().take()}"
    peer = made.start()
    response = peer.get_response(names.TIP_BIAS_VOLTAGE)
    assert response.code == ControlResponse.NO_RESPONSE
    made.until_logged(f"{made.address}: no connection")
    made.until_logged("is Nanonis running")


@pytest.mark.parametrize("seed", [1, 2])
def test_translator_survives_nonsense_replies(bench: Make, seed: int) -> None:
    # No reply of it becomes a measurement, and afterwards all values are right again.
    made = bench(seed=seed)
    peer = small(made, **SOON)
    made.strike("nonsense", duration_s=200.0)  # two seconds in real time
    ends_s = made.clock.now_s() + 200.0
    asked = 0
    while made.clock.now_s() < ends_s:
        asks: tuple[Callable[[], Response], ...] = (
            lambda: peer.act(names.START_SCAN),
            lambda: peer.set(names.SCAN_RESOLUTION_X, 32),
            lambda: peer.act(names.START_SPEC),
            lambda: peer.ask(ControlRequest.SET_PROBE_POS, ProbePosition((1e-8, 2e-8))),
            lambda: peer.act(names.STOP_SCAN),
        )
        for ask in asks:
            assert ask() is not None
            asked += 1
    assert asked >= 5
    made.emulator.software.scans.set_frame(0.0, 0.0, 1e-7, 1e-7, 0.0)
    while peer.act(names.STOP_SCAN).code == ControlResponse.NO_RESPONSE:
        pass
    peer.act_once_free(names.STOP_SCAN)
    while not (response := peer.act(names.START_SCAN)).ok:
        assert response.code in (ControlResponse.NOT_FREE, ControlResponse.NO_RESPONSE), response.reason
    found = peer.until(lambda one: isinstance(one, Scan) and bool(np.isfinite(one.values).all()))
    assert scans(found)


@pytest.mark.parametrize(
    ("function", "logged"),
    [
        ("AutoApproach.OnOffGet", "AutoApproach.OnOffGet is not asked from now on"),
        ("BiasSpectr.StatusGet", "BiasSpectr.StatusGet is not asked from now on"),
    ],
)
def test_unreadable_side_answer_ends_its_question_alone(bench: Make, function: str, logged: str) -> None:
    # nanonis.md, fact 15
    made = bench(other_layout=[function])
    peer = small(made)
    made.until_logged(logged)
    assert scanned(peer)
    assert made.log_text().count("from now on") == 1
    no_response = ControlResponse.NO_RESPONSE
    assert peer.act(names.RETRACT).code != no_response


def test_scan_that_is_not_shown_at_once_is_no_move_of_the_tip_by_hand(bench: Make) -> None:
    # nanonis.md, fact 13
    made = bench(speed=1.0, as_reported=["late-status"])
    peer = small(made)
    before = peer.get(names.PROBE_POS_X)
    assert peer.act(names.START_SCAN).ok
    assert peer.get(names.PROBE_POS_X) == before
    assert scans(peer.until(FREE))
    assert "by hand" not in made.log_text()


def test_unreadable_lines_end_the_lines_of_the_scan_alone(bench: Make) -> None:
    made = bench(speed=SEEN, other_layout=["Scan.FrameDataGrab"])
    peer = small(made, live_lines_s=1.0)
    for _ in range(2):
        assert scanned(peer)
    made.until_logged("no more lines of this scan are published")
    made.kill()
    assert made.log_text().count("no more lines of this scan are published") == 1
    assert "lost contact" not in made.log_text()


@pytest.mark.parametrize("autosave", ["all", "off"])
def test_a_channel_that_is_not_recorded_is_left_out_of_lines_and_fetched_scans(bench: Make, autosave: str) -> None:
    made = bench(speed=SEEN, as_reported=["other-layout"])
    peer = small(made, live_lines_s=0.5, autosave=autosave == "all")
    made.at_panel(lambda emulator: setattr(emulator.software.scans.properties, "autosave", autosave))
    for _ in range(2):
        assert peer.act_once_free(names.START_SCAN).ok
        received = peer.until(FREE)
        assert "Z Forward" in [one.channel for one in scans(received)]
        assert "Z Forward" in [one.channel for one in received if isinstance(one, ScanLines)]
    assert made.log_text().count("is chosen in Nanonis' Scan Control, and can't be read from its memory") == 1
    assert "ERROR" not in made.log_text()
