"""A person at SmartScan's panel: each act is published as such, and no scan of the run follows it by itself."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, cast

import pytest
from tests.plugins.by_hand import (
    act_all_to_their_end,
    acts,
    require_no_result_of_a_moved_frame,
    require_spoiled_by,
    set_all,
    slow_scan,
    until_act,
)
from tests.plugins.park.park_bench import Bench, Emulated
from tests.plugins.vendor_bench import Peer, moved, scanned, scans, small, states

from afspm.model import ActByHand, ControlResponse, PanelAct, ScopeState, names
from afspm.plugins.park.emulator.smartscan import SmartScanProgram

Make = Callable[..., Bench]
FREE = ScopeState.FREE
SLOW: dict[str, Any] = {"speed": 10.0, "start_s": 0.0}


def scanning(made: Bench) -> Peer:
    return slow_scan(made, 1e-9, result_timeout_s=5.0)


def program(emulator: Emulated) -> SmartScanProgram:
    return cast(SmartScanProgram, emulator.program)


def stop(emulator: Emulated) -> None:
    program(emulator).stop_scan(emulator.clock.now_s())


def withdraw(emulator: Emulated) -> None:
    program(emulator).withdraw(emulator.clock.now_s())


def end_scan(emulator: Emulated) -> None:
    """Let the running scan end, with all its lines."""
    assert emulator.rig.scan is not None
    emulator.rig.scan.paused_s = -1e9


def put(path: str, value: object, emulator: Emulated) -> None:
    program(emulator).ask("set", path, [value])


@pytest.mark.parametrize("act", [stop, withdraw])
@pytest.mark.parametrize("saves_partial", [False, True])
def test_scan_ended_by_a_person_is_one_act_and_nothing_follows(
    bench: Make, monkeypatch: pytest.MonkeyPatch, act: Callable[[Emulated], None], saves_partial: bool
) -> None:
    made = bench(**SLOW)
    made.at_panel(lambda emulator: setattr(program(emulator), "saves_partial", saves_partial))
    peer = scanning(made)
    plain, called = program(made.emulator).ask, list[str]()

    def ask(kind: str, path: str, given: list[object]) -> object:
        if kind in ("call", "set"):
            called.append(path)
        return plain(kind, path, given)

    monkeypatch.setattr(program(made.emulator), "ask", ask)
    made.at_panel(act)
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert acts(received) == [PanelAct.STOP]
    (told,) = (one for one in received if isinstance(one, ActByHand))
    assert ("of its 8 lines were not scanned" if saves_partial else "and left no complete file") in told.evidence
    assert called == []


# results M5
def test_scan_stopped_before_the_first_poll_is_begun_once_more(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    made = bench(speed=10.0, start_s=0.0)
    peer = small(made)
    plain, left = program(made.emulator).start_scan, [stop]

    def start(now_s: float) -> None:
        plain(now_s)
        if left:
            left.pop()(made.emulator)

    monkeypatch.setattr(program(made.emulator), "start_scan", start)
    response = peer.act(names.START_SCAN)
    assert response.code == ControlResponse.NOT_FREE
    assert "did not begin the scan that it was asked for" in response.reason
    assert scanned(peer)


# results M3
def test_scan_made_faster_and_then_stopped_is_stopped_by_hand(bench: Make) -> None:
    made = bench(**SLOW)
    peer = scanning(made)
    made.at_panel(lambda emulator: put("scan.rate", 100.0, emulator))
    made.at_panel(stop)
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert PanelAct.STOP in acts(received)


def test_stop_by_request_is_no_act_by_hand(bench: Make) -> None:
    peer = scanning(bench(**SLOW))
    assert peer.act(names.STOP_SCAN).ok
    received = peer.until(FREE)
    assert (states(received), acts(received)) == (["INTERRUPTED", "FREE"], [])


def test_missing_file_of_a_whole_scan_is_no_act_by_hand(bench: Make) -> None:
    made = bench()
    peer = small(made, result_timeout_s=5.0)
    made.strike("no-file")
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "INTERRUPTED", "FREE"]
    assert acts(received) == []


def test_scan_without_feedback_is_not_published(bench: Make) -> None:
    made = bench(**SLOW)
    peer = scanning(made)
    require_spoiled_by(made, peer, partial(put, "zservo.enable", False), end_scan, PanelAct.FEEDBACK_OFF)


def test_frame_changed_in_a_scan_leaves_it_without_a_result(bench: Make) -> None:
    made = bench(**SLOW)
    peer = scanning(made)
    require_no_result_of_a_moved_frame(
        made, peer, lambda one: program(one).ask("call", "scan.setScanGeometry", [{"offsetX": 3.0}]), end_scan
    )


@pytest.mark.parametrize(
    ("path", "value", "parameter"),
    [
        ("zservo.setpoint.value", 0.5, names.ZCTRL_SETPOINT),
        ("zservo.gain", {"i": 0.25}, names.ZCTRL_IGAIN),
        ("bias.tip", 0.25, names.TIP_BIAS_VOLTAGE),
        ("bias.sample", 1.5, names.SAMPLE_BIAS),  # results M4
        ("scan.rate", 2.5, names.SCAN_SPEED),
    ],
)
def test_changed_setting_is_published_once(bench: Make, path: str, value: object, parameter: str) -> None:
    made = bench()
    peer = small(made)
    made.at_panel(partial(put, path, value))
    received = until_act(peer)
    assert {one.parameter for act in received if isinstance(act, ActByHand) for one in act.changes} == {parameter}
    made.at_panel(partial(put, "zservo.enable", False))
    assert acts(until_act(peer)) == [PanelAct.FEEDBACK_OFF], "the setting is not published a second time"


def test_own_requests_are_no_acts_by_hand(bench: Make) -> None:
    made = bench()
    peer = small(made)
    values = {
        names.TIP_BIAS_VOLTAGE: 0.2,
        names.SCAN_SPEED: 3e-6,
        names.ZCTRL_IGAIN: 0.4,
        names.ZCTRL_SETPOINT: 0.6,
        names.SCAN_ANGLE: 12.3456789,
        names.SCAN_SIZE_X: 7.654321e-7,
    }
    set_all(peer, values)
    moved(peer, 100e-9, 0.0)
    received = act_all_to_their_end(
        peer,
        (names.START_SCAN, ScopeState.SCANNING),
        (names.START_SPEC, ScopeState.SPEC),
        (names.RETRACT, ScopeState.COARSE_MOTOR),
        (names.ENGAGE, ScopeState.COARSE_MOTOR),
        (names.START_SCAN, ScopeState.SCANNING),
    )
    assert scans(received)
    made.kill()
    assert "by hand" not in made.log_text()
