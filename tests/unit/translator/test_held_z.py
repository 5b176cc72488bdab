"""A z held without feedback at the simulated microscope: refusals, aborts, and the way back."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from afspm import wire
from afspm.basics.errors import Refused
from afspm.driver import Driver
from afspm.model import ControlRequest, ControlResponse, Parameter, Response, names
from afspm.simulation.simulator import Simulator

ACTION, PARAM = ControlRequest.ACTION, ControlRequest.PARAM
STM = {
    "feedback": {"mode": "current", "setpoint": 1e-10},
    "noise": {"white_m": 1e-12, "current_a": 1e-14},
    "surface": {"kind": "lattice"},
    "initial": {names.TIP_BIAS_VOLTAGE: "100 mV", "scan-resolution-x": 16, "scan-resolution-y": 16},
}


class AtOnce(Simulator):
    """A simulated microscope that computes a scan at its start, so that the clock of a test is never ahead of it."""

    def run_drawing(self, work: Callable[[], None]) -> None:
        work()


@pytest.fixture
def held(bench: Any, tmp_path: Path) -> Any:
    """A translator of the simulated microscope, on the bench of this folder."""
    return type(bench)(tmp_path / "simulated", STM, AtOnce)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path) -> None:
    (tmp_path / "simulated").mkdir()


def act(held: Any, action: str) -> Response:
    answer: Response = held.ask(ACTION, action)
    return answer


def put(held: Any, name: str, value: object) -> Response:
    answer: Response = held.ask(PARAM, Parameter(name, str(value)))
    return answer


def get(held: Any, name: str) -> str | None:
    response = held.ask(PARAM, Parameter(name))
    assert response.ok, response.reason
    return wire.decode_parameter(response.payload).value


def number(held: Any, name: str) -> float:
    return float(get(held, name) or "nan")


def until_free(held: Any) -> None:
    for _ in range(200):
        held.look()
        if held.translator.state.sequence.published.state.name == "FREE":
            return
    raise AssertionError("the microscope is never free")


def crashes(held: Any) -> int:
    lines = (held.folder / "truth.jsonl").read_text().splitlines()
    return sum('"crash"' in line for line in lines)


def at_offset(held: Any, offset_m: float, bias_v: float = 0.01) -> None:
    assert act(held, names.HOLD_Z).ok
    assert put(held, names.TIP_BIAS_VOLTAGE, bias_v).ok
    assert put(held, names.HELD_Z_OFFSET, offset_m).ok
    until_free(held)


def test_current_follows_bias_and_offset_and_the_way_back_restores_all(held: Any) -> None:
    before = {name: get(held, name) for name in (names.TIP_BIAS_VOLTAGE, names.ZCTRL_SETPOINT, names.ZCTRL_IGAIN)}
    z_m = number(held, names.TIP_Z)
    at_offset(held, -100e-12)
    assert get(held, names.Z_IS_HELD) == "true"
    assert get(held, names.FEEDBACK_ON) == "false"
    assert number(held, names.TIP_Z) == pytest.approx(z_m - 100e-12, abs=1e-13)
    assert number(held, names.CURRENT) == pytest.approx(1e-10 * 0.1 * 7.39, rel=0.05)  # exp(100 pm / 50 pm)
    assert put(held, names.ZCTRL_SETPOINT, 5e-10).ok
    assert put(held, names.ZCTRL_IGAIN, 10.0).ok
    assert act(held, names.RELEASE_Z).ok
    until_free(held)
    assert {name: get(held, name) for name in before} == before
    assert get(held, names.FEEDBACK_ON) == "true"
    assert number(held, names.TIP_Z) == pytest.approx(z_m, abs=1e-13)
    assert held.translator.observer.panel.feedback.wished is True


def test_feedback_that_the_run_switched_off_is_wished_off_and_scans_are_whole(held: Any) -> None:
    at_offset(held, -50e-12)
    assert held.translator.observer.panel.feedback.wished is False
    assert act(held, names.START_SCAN).ok
    held.heard()
    for _ in range(400):
        held.look(1.0)
        if "FREE" in (heard := held.heard()):
            break
    assert "Scan2d" in heard, "a scan without the wished feedback is complete"
    assert not any(one.by_hand for one in held.beside if hasattr(one, "by_hand"))


def test_moves_are_ramps_at_the_speed(held: Any) -> None:
    assert put(held, names.HELD_Z_SPEED, 50e-12).ok
    assert act(held, names.HOLD_Z).ok
    z_m = number(held, names.TIP_Z)
    assert put(held, names.HELD_Z_OFFSET, 100e-12).ok
    heights = [0.0]
    for _ in range(21):
        held.look(0.1)
        heights.append(number(held, names.TIP_Z) - z_m)
    assert all(height <= 5e-12 * looks + 1e-15 for looks, height in enumerate(heights)), "never faster"
    assert max(after - before for before, after in pairwise(heights)) < 10.1e-12
    assert heights[-1] == pytest.approx(100e-12, abs=1e-15)


def test_late_step_of_a_ramp_is_no_longer_than_any_other(held: Any) -> None:
    assert act(held, names.HOLD_Z).ok
    z_m = number(held, names.TIP_Z)
    assert put(held, names.HELD_Z_OFFSET, -100e-12).ok
    held.look(60.0)
    assert number(held, names.TIP_Z) - z_m == pytest.approx(-10e-12, abs=1e-13)


def test_z_that_does_not_follow_ends_the_hold(held: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert act(held, names.HOLD_Z).ok
    monkeypatch.setattr(held.translator.driver, "move_z", lambda z_m: None)
    assert put(held, names.HELD_Z_OFFSET, -100e-12).ok
    until_free(held)
    assert get(held, names.Z_IS_HELD) == "false"
    assert "and reads" in act(held, names.RELEASE_Z).reason


def test_controller_that_lifts_the_tip_as_the_feedback_goes_off_holds_nothing(
    held: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver: Driver = held.translator.driver
    plain, z_m = driver.set, number(held, names.TIP_Z)

    def lifts(values: dict[str, Any]) -> None:
        plain(values)
        if values.get(names.FEEDBACK_ON) is False:
            driver.move_z(z_m + 100e-12)

    monkeypatch.setattr(driver, "set", lifts)
    assert "switch a tip lift of the controller off" in act(held, names.HOLD_Z).reason
    until_free(held)
    assert get(held, names.FEEDBACK_ON) == "true"


def test_running_scan_is_stopped_before_a_release(held: Any) -> None:
    at_offset(held, -50e-12)
    assert act(held, names.START_SCAN).ok
    assert act(held, names.RELEASE_Z).code == ControlResponse.NOT_FREE
    assert get(held, names.Z_IS_HELD) == "true"


@pytest.mark.parametrize(("bound", "bias_v"), [("1e-10", 0.01), ("5e-11", 0.01), ("1e-10", -0.01)])
def test_current_beyond_the_bound_ends_the_hold_with_the_reason(held: Any, bound: str, bias_v: float) -> None:
    assert put(held, names.HELD_Z_ABORT_CURRENT, bound).ok
    assert act(held, names.HOLD_Z).ok
    assert put(held, names.TIP_BIAS_VOLTAGE, bias_v).ok  # tip T9: a negative current is beyond the bound, too
    z_m = number(held, names.TIP_Z)
    put(held, names.HELD_Z_OFFSET, -300e-12)
    lowest_m = z_m
    for _ in range(100):
        held.look()
        lowest_m = min(lowest_m, number(held, names.TIP_Z))
    assert lowest_m > z_m - 150e-12, "it has turned back long before the offset"
    assert get(held, names.FEEDBACK_ON) == "true"
    assert get(held, names.Z_IS_HELD) == "false"
    bias = get(held, names.TIP_BIAS_VOLTAGE)
    late = put(held, names.TIP_BIAS_VOLTAGE, 0.001)
    assert late.code == ControlResponse.PARAM_ERROR, "the feedback is on, and a bias for a held tip comes late"
    assert "z is held no more: x-current was" in late.reason
    assert get(held, names.TIP_BIAS_VOLTAGE) == bias
    for what in (names.START_SCAN, names.RELEASE_Z):
        refused = act(held, what)
        assert refused.code == ControlResponse.ACTION_ERROR
        assert "z is held no more: x-current was" in refused.reason
    assert put(held, names.TIP_BIAS_VOLTAGE, 0.2).ok
    assert act(held, names.START_SCAN).ok, "once the reason was given, the microscope is as any other"


def test_abort_in_a_scan_stops_it_first(held: Any) -> None:
    at_offset(held, -50e-12)
    assert act(held, names.START_SCAN).ok
    assert put(held, names.HELD_Z_ABORT_CURRENT, 1e-15).code == ControlResponse.NOT_FREE
    held.translator.driver.held_z.keep({names.HELD_Z_ABORT_CURRENT: 1e-15})
    held.heard()
    until_free(held)
    assert held.heard()[:2] == ["INTERRUPTED", "MOVING"]
    assert get(held, names.FEEDBACK_ON) == "true"


@pytest.mark.parametrize(
    ("state", "why"),
    [
        ({names.FEEDBACK_ON: "false"}, "the z feedback is off"),
        ({names.HELD_Z_ABORT_SHIFT: "5"}, "this microscope has no parameter 'x-frequency-shift'"),
    ],
)
def test_hold_is_refused_before_anything_is_switched(held: Any, state: dict[str, str], why: str) -> None:
    for name, value in state.items():
        assert put(held, name, value).ok
    held.look()
    refused = act(held, names.HOLD_Z)
    assert refused.code == ControlResponse.ACTION_ERROR
    assert why in refused.reason
    assert get(held, names.Z_IS_HELD) == "false"


def test_withdrawn_tip_can_not_be_held(held: Any) -> None:
    assert act(held, names.RETRACT).ok
    until_free(held)
    assert "the tip is withdrawn" in act(held, names.HOLD_Z).reason


@pytest.mark.parametrize("action", [names.PULSE, names.CRASH, names.ENGAGE, names.HOLD_Z])
def test_held_z_refuses_actions_that_may_move_it(held: Any, action: str) -> None:
    at_offset(held, 0.0)
    assert act(held, action).code == ControlResponse.ACTION_ERROR
    refused = put(held, names.FEEDBACK_ON, "true")
    assert refused.code == ControlResponse.PARAM_ERROR
    assert "x-release-z switches it on" in refused.reason


def test_offset_moves_nothing_outside_a_hold(held: Any) -> None:
    z_m = number(held, names.TIP_Z)
    assert put(held, names.HELD_Z_OFFSET, -100e-12).ok
    held.look(5.0)
    assert number(held, names.TIP_Z) == z_m
    assert act(held, names.HOLD_Z).ok
    assert number(held, names.HELD_Z_OFFSET) == 0.0
    assert number(held, names.TIP_Z) == pytest.approx(z_m, abs=1e-13)


def test_withdrawing_in_a_hold_sets_back_the_settings_and_leaves_the_feedback(held: Any) -> None:
    at_offset(held, -100e-12)
    assert act(held, names.RETRACT).ok
    until_free(held)
    assert get(held, names.Z_IS_HELD) == "false"
    assert number(held, names.TIP_BIAS_VOLTAGE) == pytest.approx(0.1)
    assert "the tip was withdrawn" in act(held, names.RELEASE_Z).reason


def test_tip_away_that_moved_aside_is_brought_back_by_the_feedback(held: Any) -> None:
    at_offset(held, 500e-12)
    z_m = number(held, names.TIP_Z)
    assert put(held, "probe-pos-x", 5e-9).ok
    until_free(held)
    assert act(held, names.RELEASE_Z).ok
    held.look()
    assert get(held, names.FEEDBACK_ON) == "true", "no ramp towards a surface that may be higher here"
    assert number(held, names.TIP_Z) < z_m


@pytest.mark.parametrize("refused", [names.TIP_BIAS_VOLTAGE, names.FEEDBACK_ON, names.TIP_Z])
def test_refused_way_back_withdraws_the_tip_and_is_logged_for_a_person(
    held: Any, refused: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    at_offset(held, -100e-12)
    driver: Driver = held.translator.driver

    def refuses(*_: object) -> None:
        raise Refused(ControlResponse.PARAM_ERROR, "the controller does not take it")

    if refused == names.TIP_Z:
        monkeypatch.setattr(driver, "move_z", refuses)
    else:
        plain = driver.set
        monkeypatch.setattr(driver, "set", lambda values: refuses() if refused in values else plain(values))
    assert act(held, names.RELEASE_Z).ok
    until_free(held)
    assert get(held, names.ENGAGED) == "false"
    assert get(held, names.FEEDBACK_ON) == "false"
    critical = [one.getMessage() for one in caplog.records if one.levelname == "CRITICAL"]
    assert len(critical) == 1
    assert "the way back from a held z failed" in critical[0]
    assert "as before it: tip-bias-voltage 0.1 V" in critical[0]
    assert crashes(held) == 0


def test_feedback_switched_on_by_a_person_ends_the_hold(held: Any) -> None:
    at_offset(held, -100e-12)
    held.translator.driver.put_in_force({names.FEEDBACK_ON: True})
    held.look()
    assert get(held, names.Z_IS_HELD) == "false"
    assert number(held, names.TIP_BIAS_VOLTAGE) == pytest.approx(0.1)
    assert "the feedback was switched on beside it" in act(held, names.RELEASE_Z).reason


# tip T5: the bias came first, while the setpoint was ten times as high
@pytest.mark.parametrize("is_on", [True, False], ids=["by a person", "by the run"])
@pytest.mark.parametrize(("bias_v", "setpoint_a"), [(1.0, 1e-9), (0.01, 1e-11), (-1.0, 1e-9)])
def test_way_back_never_narrows_the_gap_and_ends_with_the_feedback_on(
    held: Any, monkeypatch: pytest.MonkeyPatch, bias_v: float, setpoint_a: float, is_on: bool
) -> None:
    names_of_gap = (names.TIP_BIAS_VOLTAGE, names.ZCTRL_SETPOINT)
    at_offset(held, 0.0, bias_v)
    assert put(held, names.ZCTRL_SETPOINT, setpoint_a).ok
    driver: Driver = held.translator.driver
    gaps: list[float] = []
    plain = driver.set

    def watched(values: dict[str, Any]) -> None:
        plain(values)
        now: dict[str, Any] = driver.in_force([*names_of_gap, names.FEEDBACK_ON])
        gaps.append(abs(now[names.TIP_BIAS_VOLTAGE] / now[names.ZCTRL_SETPOINT]))
        assert names.FEEDBACK_ON in values or now[names.FEEDBACK_ON] is is_on

    if is_on:
        driver.put_in_force({names.FEEDBACK_ON: True})
    else:
        assert act(held, names.RELEASE_Z).ok
    monkeypatch.setattr(driver, "set", watched)
    until_free(held)
    assert min(gaps) >= 0.999e9, "as before and in the hold: 1 V for each nA"
    assert [number(held, name) for name in names_of_gap] == pytest.approx([0.1, 1e-10])
    assert get(held, names.FEEDBACK_ON) == "true"


def test_controller_lost_in_a_hold_ends_it(held: Any) -> None:
    at_offset(held, -100e-12)
    held.translator._connection.lose(ConnectionError("unplugged"))
    held.look(2.0)
    until_free(held)
    assert get(held, names.FEEDBACK_ON) == "true"
    assert "the controller was lost" in act(held, names.RELEASE_Z).reason


def test_tip_away_is_brought_back_by_the_feedback_after_a_lost_controller(
    held: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_offset(held, 500e-12)
    ramp = list[float]()
    monkeypatch.setattr(held.translator.driver, "move_z", ramp.append)
    held.translator._connection.lose(ConnectionError("unplugged"))
    held.look(2.0)
    until_free(held)
    assert ramp == [], "others may have moved the tip, and the surface may be higher"
    assert get(held, names.FEEDBACK_ON) == "true"


def test_run_that_ends_in_a_hold_goes_the_way_back_instead_of_withdrawing(held: Any) -> None:
    from afspm.transport.port import ParentGone

    at_offset(held, -100e-12)
    held.run_to_the_end(ParentGone())
    driver = held.translator.driver
    assert driver.in_force([names.FEEDBACK_ON, names.ENGAGED]) == {names.FEEDBACK_ON: True, names.ENGAGED: True}
    assert crashes(held) == 0


def test_tip_ramped_into_the_sample_crashes_in_the_ground_truth(held: Any) -> None:
    assert act(held, names.HOLD_Z).ok
    z_m = number(held, names.TIP_Z)
    held.translator.driver.move_z(z_m - 550e-12)
    assert crashes(held) == 0
    held.translator.driver.move_z(z_m - 600e-12)  # contact is at 50 pm ln(77 µS / 1 nS) = 563 pm
    held.look()
    assert crashes(held) > 0


def test_microscope_without_z_says_why(bench: Any) -> None:
    refused = bench.ask(ControlRequest.ACTION_SUPPORT, names.HOLD_Z)
    assert refused.code == ControlResponse.ACTION_NOT_SUPPORTED
    assert (
        "z can't be held: its driver knows no documented function that sets z while the feedback is off"
        in refused.reason
    )
