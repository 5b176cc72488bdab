"""A person at Asylum's panel: each act is published as such, and nothing is measured in the air."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
from tests.plugins.asylum.asylum_bench import Bench, Emulated
from tests.plugins.by_hand import (
    act_all,
    acts,
    require_no_result_of_a_moved_frame,
    require_spoiled_by,
    set_all,
    slow_scan,
    until_act,
)
from tests.plugins.vendor_bench import Peer, scans, small, states

from afspm.model import ActByHand, ControlResponse, PanelAct, ProbePosition, ScopeState, Spectrum, names
from afspm.model import ControlRequest as Ask

Make = Callable[..., Bench]
FREE = ScopeState.FREE
ACTS = frozenset({"PV", "PS", "DoScanFunc", "DoForceFunc", "SimpleEngageMe", "AfspmFeedback", "GoToSpot"})


def scanning(made: Bench) -> Peer:
    return slow_scan(made, 1e-9, result_timeout_s=5.0)


def stop(emulator: Emulated) -> None:
    emulator.controller.stop(emulator.clock.now_s())


def end_scan(emulator: Emulated) -> None:
    """Let the running scan end, with all its lines."""
    assert emulator.rig.scan is not None
    emulator.rig.scan.paused_s = -1e9


def put(name: str, value: float, emulator: Emulated) -> None:
    emulator.controller.put(name, value, emulator.clock.now_s())


def calls(made: Bench) -> Callable[[], list[str]]:
    """Return a function that returns the functions called since now that change something."""
    before = len(made.emulator.asked)
    return lambda: [name for name in made.emulator.asked[before:] if name in ACTS]


@pytest.mark.parametrize("partial_file", [False, True])
def test_stopped_scan_is_one_act_and_the_tip_stays_away(bench: Make, partial_file: bool) -> None:
    made = bench(speed=10.0, start_s=0.0, saves_partial=partial_file)
    peer = scanning(made)
    called = calls(made)
    made.at_panel(stop)
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert acts(received) == [PanelAct.WITHDRAW]
    refused = peer.act(names.START_SCAN)
    assert refused.code == ControlResponse.NOT_FREE
    assert "approach at the panel" in refused.reason
    assert called() == []
    made.at_panel(lambda emulator: emulator.controller.engage(emulator.clock.now_s()))
    peer.until(lambda one: getattr(one, "engaged", False))
    assert peer.act_once_free(names.START_SCAN).ok
    assert acts(peer.until(ScopeState.SCANNING)) == []


def test_stop_by_request_is_no_act_and_the_next_scan_engages(bench: Make) -> None:
    made = bench(speed=10.0, start_s=0.0)
    peer = scanning(made)
    assert peer.act(names.STOP_SCAN).ok
    received = peer.until(FREE)
    assert (states(received), acts(received)) == (["INTERRUPTED", "FREE"], [])
    assert peer.act_once_free(names.START_SCAN).ok
    assert acts(peer.until(ScopeState.SCANNING)) == []


def test_slow_withdrawal_by_request_is_no_act_by_hand(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    made = bench(speed=10.0, start_s=0.0)
    peer = scanning(made)
    plain, engaged = made.emulator.controller.rig.withdraw, 2

    def withdraw_slowly(now_s: float) -> None:
        plain(now_s)
        monkeypatch.setattr(made.emulator.controller, "status", lambda now_s: engaged)

    monkeypatch.setattr(made.emulator.controller.rig, "withdraw", withdraw_slowly)
    assert peer.act(names.STOP_SCAN).ok
    peer.until(FREE)
    monkeypatch.setattr(made.emulator.controller, "status", lambda now_s: 0)
    peer.until(lambda one: getattr(one, "engaged", None) is False)
    made.kill()
    assert "by hand" not in made.log_text()


def test_tip_that_asylum_withdraws_after_a_scan_is_no_act_by_hand(bench: Make) -> None:
    made = bench()
    made.at_panel(partial(put, "LastScanWithdraw", 1.0))
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert scans(received)
    made.kill()
    assert "by hand" not in made.log_text()


def test_partial_file_shows_a_stop_where_asylum_withdraws_by_itself(bench: Make) -> None:
    made = bench(speed=10.0, start_s=0.0, saves_partial=True)
    made.at_panel(partial(put, "LastScanWithdraw", 1.0))
    peer = scanning(made)
    made.at_panel(stop)
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert acts(received) == [PanelAct.STOP]
    (act,) = (one for one in received if isinstance(one, ActByHand))
    assert "of its 8 lines were not scanned" in act.evidence


def test_scan_without_feedback_is_not_published(bench: Make) -> None:
    made = bench(speed=10.0, start_s=0.0)
    peer = scanning(made)
    require_spoiled_by(
        made, peer, lambda one: one.controller.feedback_off(one.clock.now_s()), end_scan, PanelAct.FEEDBACK_OFF
    )


def test_frame_changed_in_a_scan_leaves_it_without_a_result(bench: Make) -> None:
    made = bench(speed=10.0, start_s=0.0)
    peer = scanning(made)
    require_no_result_of_a_moved_frame(made, peer, partial(put, "XOffset", 3e-6), end_scan)


@pytest.mark.parametrize(
    ("name", "value", "parameter"),
    [
        ("AmplitudeSetpointVolts", 0.5, names.ZCTRL_SETPOINT),
        ("IntegralGain", 12.0, names.ZCTRL_IGAIN),
        ("TipVoltage", 0.25, names.TIP_BIAS_VOLTAGE),
        ("SurfaceVoltage", 1.5, names.SAMPLE_BIAS),  # results M4
        ("XOffset", 3e-6, names.SCAN_TOP_LEFT_X),
    ],
)
def test_changed_setting_is_published_once(bench: Make, name: str, value: float, parameter: str) -> None:
    made = bench()
    peer = small(made)
    made.at_panel(partial(put, name, value))
    received = until_act(peer)
    assert {one.parameter for act in received if isinstance(act, ActByHand) for one in act.changes} == {parameter}
    made.at_panel(stop)
    assert acts(until_act(peer)) == [PanelAct.WITHDRAW], "the setting is not published a second time"


def test_tip_withdrawn_in_a_force_curve_spoils_it(bench: Make) -> None:
    made = bench(speed=5.0, force={"duration_s": 1e6})
    peer = small(made, result_timeout_s=5.0)
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    made.at_panel(stop)
    received = peer.until(FREE)
    assert acts(received) == [PanelAct.WITHDRAW]
    assert not [one for one in received if isinstance(one, Spectrum)]


def test_own_requests_are_no_acts_by_hand(bench: Make) -> None:
    made = bench()
    peer = small(made)
    values = {
        names.TIP_BIAS_VOLTAGE: 0.2,
        names.SCAN_SPEED: 3e-6,
        names.ZCTRL_IGAIN: 11.0,
        names.ZCTRL_SETPOINT: 0.6,
        names.SCAN_ANGLE: 12.3456789,
        names.SCAN_SIZE_X: 7.654321e-7,
    }
    set_all(peer, values)
    assert peer.ask(Ask.SET_PROBE_POS, ProbePosition((100e-9, 0.0))).ok
    act_all(
        peer,
        (names.START_SCAN, ScopeState.SCANNING),
        (names.START_SPEC, ScopeState.SPEC),
        (names.PULSE, ScopeState.BUSY_PARAM),
        (names.RETRACT, ScopeState.COARSE_MOTOR),
        (names.ENGAGE, FREE),
        (names.START_SCAN, ScopeState.SCANNING),
    )
    assert scans(peer.until(FREE))
    made.kill()
    assert "by hand" not in made.log_text()
