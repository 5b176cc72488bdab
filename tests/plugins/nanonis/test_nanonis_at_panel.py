"""A person at Nanonis' panel: each act is published as such, and nothing is measured in the air."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tests.plugins.by_hand import (
    act_all,
    acts,
    require_no_result_of_a_moved_frame,
    require_spoiled_by,
    set_all,
    slow_scan,
    until_act,
)
from tests.plugins.nanonis.nanonis_bench import Bench, Emulated
from tests.plugins.vendor_bench import scans, small, states

from afspm.model import (
    ActByHand,
    ControlRequest,
    ControlResponse,
    Feedback,
    MeasurementConditions,
    PanelAct,
    ProbePosition,
    ScopeState,
    Spectrum,
    names,
)

Make = Callable[..., Bench]
FREE = ScopeState.FREE
ACTS = ("Start", "Stop", "Action", "Set", "Pulse", "Withdraw", "StartMove", "Home", "Save")


def does(name: str, *arguments: object) -> Callable[[Emulated], object]:
    """Return what a person does by the panel's counterpart of a function of the interface."""
    return lambda emulator: emulator.software.functions.call(name, list(arguments))


def call(made: Bench, name: str, *arguments: object) -> None:
    made.at_panel(does(name, *arguments))


def end_scan(emulator: Emulated) -> None:
    """Let the running scan end, with all its lines."""
    assert emulator.rig.scan is not None
    emulator.rig.scan.paused_s = -1e9


def lift(emulator: Emulated) -> None:
    """Withdraw the tip while the scan goes on in the air."""
    emulator.rig.engaged = False
    emulator.software.z_controller.state = "off"
    emulator.rig.switch_feedback(emulator.clock.now_s(), on=False)


def calls(made: Bench) -> Callable[[], list[str]]:
    """Return a function that returns the functions called since now that change something."""

    def acts_asked() -> list[str]:
        return [name for of_port in made.emulator.asked.values() for name in of_port if name.endswith(ACTS)]

    before = len(acts_asked())
    return lambda: acts_asked()[before:]


def test_stopped_scan_is_an_act_by_hand_and_nothing_follows_it(bench: Make) -> None:
    made = bench()
    peer = slow_scan(made)
    called = calls(made)
    call(made, "Scan.Action", 1, 0)
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert acts(received) == [PanelAct.STOP]
    (act,) = (one for one in received if isinstance(one, ActByHand))
    assert "of its 8 lines were not scanned" in act.evidence
    assert called() == []


def test_stop_by_request_is_no_act_by_hand(bench: Make) -> None:
    peer = slow_scan(bench())
    assert peer.act(names.STOP_SCAN).ok
    received = peer.until(FREE)
    assert (states(received), acts(received)) == (["INTERRUPTED", "FREE"], [])


def test_shadow_leaves_a_scan_in_the_air_to_the_person(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    made = bench(speed=20.0)
    monkeypatch.setattr(made, "translator", "afspm.plugins.nanonis.shadow.NanonisShadow")
    peer = made.start()
    peer.until(FREE)
    called = calls(made)
    made.strike("safe-tip")
    made.until_logged("Nanonis' safe tip withdrew the tip")
    call(made, "Scan.Action", 0, 1)
    made.until_logged("a run would have stopped the scan")
    assert called() == []
    call(made, "Scan.Action", 1, 0)
    assert not scans(peer.until(FREE))


def test_scan_ended_by_the_safe_tip_is_no_act_by_hand(bench: Make) -> None:
    made = bench()
    peer = slow_scan(made)
    made.strike("safe-tip")
    received = peer.until(FREE)
    made.until_logged("Nanonis' safe tip withdrew the tip")
    assert not scans(received)
    refused = peer.act_once_free(names.START_SCAN)
    assert refused.code == ControlResponse.ACTION_ERROR
    assert "safe tip" in refused.reason
    made.kill()
    assert "by hand" not in made.log_text()


def test_tip_withdrawn_in_a_scan_ends_it_and_no_other_begins(bench: Make) -> None:
    made = bench()
    peer = slow_scan(made)
    called = calls(made)
    call(made, "ZCtrl.Withdraw", 0, -1)
    received = until_act(peer) + peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert acts(received) == [PanelAct.WITHDRAW]
    refused = peer.act(names.START_SCAN)
    assert refused.code == ControlResponse.NOT_FREE
    assert "approach at the panel" in refused.reason
    assert called() == []
    call(made, "ZCtrl.OnOffSet", 1)
    peer.until(lambda one: getattr(one, "engaged", False))
    assert peer.act(names.START_SCAN).ok


def test_withdrawal_that_ends_between_two_questions_is_one_act(bench: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    made = bench()
    peer = slow_scan(made)
    plain, seen = made.emulator.software.z_controller._status, list[int]()

    def status(now_s: float) -> int:
        # on its way up at the next question alone, which is the one for x-engaged
        seen.append(plain(now_s))
        return 6 if len(seen) <= 2 and seen[-1] != 2 else seen[-1]

    def withdraw_at_once(emulator: Emulated) -> None:
        emulator.rig.setup.approach_s = 0.0
        end_scan(emulator)
        emulator.software.scans.advance(emulator.clock.now_s())
        monkeypatch.setattr(emulator.software.z_controller, "_status", status)
        emulator.software.functions.call("ZCtrl.Withdraw", [0, -1])

    made.at_panel(withdraw_at_once)
    received = peer.until(FREE)
    assert acts(received) == [PanelAct.WITHDRAW]
    assert not scans(received)


def test_tip_withdrawn_before_the_run_is_measured_with_in_the_air(bench: Make) -> None:
    # as for the commissioning of a controller
    made = bench()
    call(made, "ZCtrl.Withdraw", 0, -1)
    peer = small(made)
    assert peer.get(names.ENGAGED) == "false"
    response = peer.act_once_free(names.START_SCAN)
    assert response.ok, response.reason
    assert scans(peer.until(FREE))
    made.until_logged("the measurement is in the air")


@pytest.mark.parametrize("at_the_end", [True, False])
def test_scan_that_went_on_in_the_air_is_not_published(bench: Make, at_the_end: bool) -> None:
    made = bench()
    peer = slow_scan(made)
    made.at_panel(lift)
    received = [] if at_the_end else until_act(peer)
    made.at_panel(end_scan)
    received += peer.until(FREE)
    assert acts(received) == [PanelAct.WITHDRAW]
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)


def test_scan_that_ends_while_the_tip_goes_up_is_not_published(bench: Make) -> None:
    made = bench()
    peer = slow_scan(made)

    def withdraw_slowly(emulator: Emulated) -> None:
        emulator.rig.setup.approach_s = 20.0
        end_scan(emulator)
        emulator.software.scans.advance(emulator.clock.now_s())
        emulator.software.functions.call("ZCtrl.Withdraw", [0, -1])

    made.at_panel(withdraw_slowly)
    received = peer.until(FREE)
    assert acts(received) == [PanelAct.WITHDRAW]
    assert not scans(received)


def test_scan_without_feedback_is_not_published(bench: Make) -> None:
    made = bench()
    peer = slow_scan(made)
    require_spoiled_by(made, peer, does("ZCtrl.OnOffSet", 0), end_scan, PanelAct.FEEDBACK_OFF)


def test_scan_without_feedback_that_the_run_switched_off_is_published(bench: Make) -> None:
    made = bench()
    peer = small(made)
    assert peer.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=False)).ok
    assert peer.act_once_free(names.START_SCAN).ok
    received = peer.until(FREE)
    assert acts(received) == []
    assert scans(received)


def test_frame_changed_in_a_scan_leaves_it_without_a_result(bench: Make) -> None:
    made = bench()
    peer = slow_scan(made)
    elsewhere = does("Scan.FrameSet", 5e-6, 0.0, 500e-9, 500e-9, 0.0)
    require_no_result_of_a_moved_frame(made, peer, elsewhere, end_scan)


@pytest.mark.parametrize(
    ("function", "arguments", "parameter", "value"),
    [
        ("ZCtrl.SetpntSet", (2e-10,), names.ZCTRL_SETPOINT, 2e-10),
        ("Bias.Set", (0.25,), names.TIP_BIAS_VOLTAGE, 0.25),
        ("ZCtrl.GainSet", (2.5e-11, 1e-3, 2.5e-8), names.ZCTRL_PGAIN, 2.5e-11),
        ("Scan.SpeedSet", (4e-6, 4e-6, 1.0, 1.0, 1, 1.0), names.SCAN_SPEED, 4e-6),
        ("Scan.FrameSet", (0.0, 0.0, 1e-6, 1e-6, -20.0), names.SCAN_ANGLE, 20.0),
    ],
)
def test_changed_setting_is_published_once(
    bench: Make, function: str, arguments: tuple[float, ...], parameter: str, value: float
) -> None:
    made = bench()
    peer = small(made)
    before = float(peer.get(parameter))
    call(made, function, *arguments)
    received = until_act(peer)
    changes = {one.parameter: one for act in received if isinstance(act, ActByHand) for one in act.changes}
    assert float(changes[parameter].before) == pytest.approx(before, rel=1e-5)
    assert float(changes[parameter].after) == pytest.approx(value, rel=1e-5)
    call(made, "ZCtrl.OnOffSet", 0)
    assert acts(until_act(peer)) == [PanelAct.FEEDBACK_OFF], "the setting is not published a second time"


def test_tip_withdrawn_in_a_spectrum_spoils_it(bench: Make) -> None:
    made = bench(speed=5.0, iv={"duration_s": 10.0})
    peer = small(made)
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    made.at_panel(lift)
    received = peer.until(FREE)
    assert acts(received) == [PanelAct.WITHDRAW]
    assert not [one for one in received if isinstance(one, Spectrum)]


def test_stopped_spectrum_is_an_act_by_hand(bench: Make) -> None:
    made = bench(speed=1.0, iv={"duration_s": 1e6})
    peer = small(made, result_timeout_s=1.0)
    assert peer.act(names.START_SPEC).ok
    peer.until(ScopeState.SPEC)
    call(made, "BiasSpectr.Stop")
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert acts(received) == [PanelAct.STOP]
    assert not [one for one in received if isinstance(one, Spectrum)]


def test_own_requests_are_no_acts_by_hand(bench: Make) -> None:
    made = bench()
    peer = small(made)
    values = {
        names.TIP_BIAS_VOLTAGE: 0.2,
        names.SCAN_SPEED: 3e-6,
        names.ZCTRL_PGAIN: 3e-11,
        names.ZCTRL_SETPOINT: 5e-11,
        names.SCAN_ANGLE: 12.3456789,
        names.SCAN_SIZE_X: 7.654321e-7,
    }
    set_all(peer, values)
    assert peer.ask(ControlRequest.SET_PROBE_POS, ProbePosition((100e-9, 0.0))).ok
    act_all(
        peer,
        (names.START_SCAN, ScopeState.SCANNING),
        (names.START_SPEC, ScopeState.SPEC),
        (names.PULSE, ScopeState.BUSY_PARAM),
        (names.CRASH, ScopeState.MOVING),
        (names.RETRACT, ScopeState.COARSE_MOTOR),
        (names.ENGAGE, FREE),
        (names.START_SCAN, ScopeState.SCANNING),
    )
    assert scans(peer.until(FREE))
    made.kill()
    assert "by hand" not in made.log_text()


def test_tip_on_its_way_in_a_scan_not_yet_shown_is_no_move_by_hand(bench: Make) -> None:
    made = bench(speed=1.0, as_reported=["late-status"])
    peer = small(made)
    call(made, "Scan.Action", 0, 1)
    peer.until(ScopeState.SCANNING)
    received = peer.until(FREE)
    assert scans(received)
    made.kill()
    assert "a scan was begun at the microscope" in made.log_text()
    assert "probe-pos" not in made.log_text()


def test_tip_left_elsewhere_by_a_scan_is_no_move_by_hand(bench: Make) -> None:
    made = bench(speed=1.0)
    peer = small(made)
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    made.at_panel(lambda emulator: setattr(emulator.rig, "_probe_m", (55e-9, 44e-9)))
    received, left_at = peer.until(FREE), ProbePosition((55e-9, 44e-9))
    assert scans(received)
    if left_at not in received:  # it may be read before the end of the scan is published
        peer.until(lambda one: one == left_at)
    call(made, "Bias.Set", 0.3)
    (act,) = (one for one in until_act(peer) if isinstance(one, ActByHand))
    assert [one.parameter for one in act.changes] == [names.TIP_BIAS_VOLTAGE]
    made.kill()
    assert "probe-pos" not in made.log_text()


def test_scan_of_a_frame_beyond_the_scanner_is_published_with_a_warning_once(bench: Make) -> None:
    made = bench(speed=5.0, range_m=2e-6, as_reported=["over-range"])
    peer = small(made)
    call(made, "Scan.FrameSet", 0.9e-6, 0.0, 400e-9, 400e-9, 0.0)
    for _ in range(2):
        call(made, "Scan.Action", 0, 1)
        received = peer.until(FREE)
        assert scans(received)
        (conditions,) = (one for one in received if isinstance(one, MeasurementConditions))
        assert "beyond the scanner's -1 to 1 µm" in conditions.unproved[-1]
    made.kill()
    assert made.log_text().count("the scan may not show the place that it names: its corners are at 0.7125") == 1
