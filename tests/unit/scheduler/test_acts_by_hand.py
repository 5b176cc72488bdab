"""The scheduler leaves the microscope to a person who acts at its panel, until a person lets the run continue."""

from __future__ import annotations

from typing import Any

import pytest
from tests.unit.scheduler.logic_lab import Lab, killed, replies

from afspm.model import (
    ActByHand,
    ControlEvent,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Feedback,
    PanelAct,
    Parameter,
    ProcessCondition,
    ProcessState,
    ScopeState,
    TipStatus,
    names,
)
from afspm.model.panel import ChangedValue
from afspm.scheduler.control.arbitration import RoleTable, Rules
from afspm.scheduler.events import Log, Tick
from afspm.scheduler.safety.limits import ExperimentLimits, Limit
from afspm.scheduler.settings import ControlSettings, SchedulerSettings

OK = ControlResponse.SUCCESS
MANUAL, AUTOMATED = ControlMode.MANUAL, ControlMode.AUTOMATED
AWAY = TipStatus(engaged=False, by_hand="the tip was withdrawn at the microscope")
BACK = TipStatus(engaged=True)


def scanning(**control: Any) -> Lab:
    """Return a scheduler whose experiment scans, with limits of the bias."""
    limits = ExperimentLimits({names.TIP_BIAS_VOLTAGE: Limit(low=-10.0, high=10.0, step=1.0, unit="V")})
    lab = Lab(SchedulerSettings(control=ControlSettings(**control), limits=limits))
    lab.translator()
    lab.scope_is(ScopeState.FREE)
    lab.take_control("experiment")
    lab.scope_is(ScopeState.SCANNING)
    lab.effects.clear()
    lab.forwarded.clear()
    return lab


def hand(lab: Lab, act: PanelAct, *changes: ChangedValue) -> None:
    lab.publish("ActByHand", ActByHand(lab.now_ns, act, "seen", changes))


def bias(after: float) -> ChangedValue:
    return ChangedValue(names.TIP_BIAS_VOLTAGE, "1", f"{after:g}", "V")


@pytest.mark.parametrize("act", [PanelAct.STOP, PanelAct.WITHDRAW, PanelAct.FEEDBACK_OFF])
def test_act_by_hand_is_manual_and_sends_nothing(act: PanelAct) -> None:
    lab = scanning()
    hand(lab, act)
    lab.scope_is(ScopeState.INTERRUPTED)
    lab.scope_is(ScopeState.FREE)
    lab.later(60.0, 60.0)
    lab.step(Tick())
    assert (lab.core.control.mode, lab.holder, lab.forwarded) == (MANUAL, None, [])
    assert lab.says("experiment", ControlRequest.ACTION, names.START_SCAN) is ControlResponse.NOT_IN_CONTROL
    told = [one.text for one in lab.effects if isinstance(one, Log) and one.level == "WARNING"]
    assert any("nothing is sent to the microscope until `afspm continue`" in text for text in told)


@pytest.mark.parametrize("act", [PanelAct.PAUSE, PanelAct.SCAN, PanelAct.SPECTRUM])
def test_other_acts_leave_control(act: PanelAct) -> None:
    lab = scanning()
    hand(lab, act)
    assert lab.holder == "experiment"


def test_stop_leaves_control_if_the_scan_is_repeated() -> None:
    lab = scanning(stopped_by_hand="repeat")
    hand(lab, PanelAct.STOP)
    assert lab.holder == "experiment"
    hand(lab, PanelAct.WITHDRAW)
    assert lab.core.control.mode is MANUAL


def test_changed_value_is_written_down_and_kept() -> None:
    lab = scanning()
    hand(lab, PanelAct.VALUES, bias(5.0))
    assert (lab.holder, lab.forwarded) == ("experiment", [])
    (entry,) = (one for one in lab.entries() if one.event is ControlEvent.BY_HAND)
    assert entry.what == "set at the microscope: tip-bias-voltage = 5 V (before: 1 V) (seen)"
    asked = scanning(changed_by_hand="pause")
    hand(asked, PanelAct.VALUES, bias(5.0))
    assert asked.core.control.mode is MANUAL


def test_value_outside_the_limits_is_manual_until_it_is_set_back() -> None:
    lab = scanning()
    hand(lab, PanelAct.VALUES, bias(12.0))
    assert lab.core.control.mode is MANUAL
    refused = replies(lab.ask("person", ControlRequest.SET_CONTROL_MODE, int(AUTOMATED)))[-1].response
    assert refused.code == ControlResponse.FAILURE
    assert "above the highest allowed, 10 V" in refused.reason
    hand(lab, PanelAct.VALUES, bias(2.0))
    assert lab.mode("person", AUTOMATED) is OK
    assert lab.take_control("experiment") is OK


def test_value_changed_at_the_panel_in_manual_stays_and_is_logged() -> None:
    lab = scanning()
    lab.publish("ZCtrlParameters", Feedback(setpoint=1e-10))
    lab.mode("person", MANUAL)

    def left() -> list[str]:
        lab.effects.clear()
        lab.mode("person", AUTOMATED)
        return [one.text for one in lab.effects if isinstance(one, Log) and "still in force" in one.text]

    hand(lab, PanelAct.VALUES, bias(1.5), ChangedValue(names.ZCTRL_SETPOINT, "1e-10", "4e-10", "A"))
    lab.publish("ZCtrlParameters", Feedback(setpoint=4e-10))
    assert left() == ["set by hand, and still in force: tip-bias-voltage = 1.5 V, zctrl-setpoint = 400 pA"]
    lab.mode("person", MANUAL)
    for before, after in (("1.5", "3"), ("3", "1.5")):
        hand(lab, PanelAct.VALUES, ChangedValue(names.TIP_BIAS_VOLTAGE, before, after, "V"))
    assert left() == []


def test_run_continues_only_once_the_tip_is_back() -> None:
    lab = scanning()
    hand(lab, PanelAct.WITHDRAW)
    lab.publish("TipStatus", AWAY)
    refused = replies(lab.ask("person", ControlRequest.SET_CONTROL_MODE, int(AUTOMATED)))[-1].response
    assert (refused.code, refused.reason) == (
        ControlResponse.FAILURE,
        "the tip is still withdrawn: approach at the panel",
    )
    lab.publish("TipStatus", BACK)
    assert lab.mode("person", AUTOMATED) is OK
    (entry, *_) = (one for one in lab.entries() if one.mode is MANUAL)
    assert entry.reason == "the tip was withdrawn at the microscope (seen)"


def test_withdrawn_tip_is_enough_if_the_act_itself_was_lost() -> None:
    lab = scanning()
    lab.publish("TipStatus", AWAY)
    assert (lab.core.control.mode, lab.forwarded) == (MANUAL, [])


def test_restarted_scheduler_knows_the_person_at_the_panel() -> None:
    lab = scanning()
    lab.publish("TipStatus", AWAY)
    again = killed(lab, SchedulerSettings())
    again.later(5.0)
    again.step(Tick())
    assert again.core.control.mode is MANUAL
    assert again.mode("person", AUTOMATED) is ControlResponse.FAILURE


def test_agent_does_not_let_a_run_continue() -> None:
    lab = Lab(SchedulerSettings(rules=Rules(agents=frozenset({"agent"}))))
    lab.translator()
    lab.mode("person", MANUAL)
    assert lab.mode("agent", AUTOMATED) is ControlResponse.FAILURE
    assert lab.core.control.mode is MANUAL


def test_component_lets_a_run_continue_only_with_the_role() -> None:
    for roles, wanted in ((RoleTable(), ControlResponse.FAILURE), (RoleTable(set_mode=("series",)), OK)):
        lab = Lab(SchedulerSettings(rules=Rules(roles)))
        lab.translator()
        lab.tell(ProcessState("series", "component", ProcessCondition.ALIVE, 1))
        hand(lab, PanelAct.STOP)
        assert lab.mode("series", AUTOMATED) is wanted
        if wanted is not OK:
            assert lab.mode("dashboard:Ada", AUTOMATED) is OK


def test_waiting_stop_of_a_flag_is_dropped_when_a_person_acts() -> None:
    lab = scanning()
    lab.ask("experiment", ControlRequest.ACTION, "x-other", "experiment/a/1")  # in flight: what follows waits
    lab.flag("classifier", 1)
    hand(lab, PanelAct.STOP)
    lab.answer(lab.forwarded[-1])
    lab.later(60.0, 60.0)
    lab.step(Tick())
    assert [one.request.subject for one in lab.forwarded] == ["x-other"]


@pytest.mark.parametrize("by", ["a read", "a request"])
def test_value_that_was_set_back_unseen_is_read_again(by: str) -> None:
    lab = scanning()
    hand(lab, PanelAct.VALUES, bias(12.0))
    lab.scope_is(ScopeState.FREE)
    if by == "a read":
        assert lab.mode("person", AUTOMATED) is ControlResponse.FAILURE
        lab.answer_reads(tip_bias_voltage="2")
    else:
        lab.ask("witness", ControlRequest.PARAM, Parameter(names.TIP_BIAS_VOLTAGE), "witness/a/1")
        lab.answer_reads(tip_bias_voltage="2")
    assert lab.mode("person", AUTOMATED) is OK
