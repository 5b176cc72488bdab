"""Stages and coarse motors: what moves, when, and what may be measured afterwards; through the whole scheduler."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from tests.unit.scheduler.logic_lab import Lab, in_control, killed, replies

from afspm.model import (
    RELAY_REQUEST,
    ActByHand,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Feedback,
    InstrumentReading,
    InstrumentReadings,
    PanelAct,
    Parameter,
    RelayedMessage,
    Response,
    ResponseDetail,
    ScopeState,
    TipStatus,
    names,
)
from afspm.scheduler.control.arbitration import RoleTable, Rules
from afspm.scheduler.instruments.conditions import InstrumentSettings
from afspm.scheduler.safety.limit_checker import LimitChecker
from afspm.scheduler.safety.limits import ExperimentLimits, ForbiddenState, Limit
from afspm.scheduler.safety.movers import Mover, MoverSettings, MoverState
from afspm.scheduler.settings import SchedulerSettings

ACTION = ControlRequest.ACTION
AWAY, RIGHT, STAGE = "COARSE_OUT", "COARSE_RIGHT", "lab.stage-x"
MOVERS = {
    AWAY: Mover("away", 1000, 20),
    RIGHT: Mover("lateral", 30, 10),
    STAGE: Mover("lateral", 5.0, unit="mm"),
}
LIMITS = ExperimentLimits(
    {STAGE: Limit(step=2.0, unit="mm")},
    forbid={f"changes({one}) and x-engaged": ForbiddenState(f"changes({one}) and x-engaged") for one in (AWAY, RIGHT)},
    movers=MoverSettings(MOVERS, 40, names.APPROACH, undeclared=("COARSE_UP",)),
)
SETTINGS = SchedulerSettings(limits=LIMITS, rules=Rules(RoleTable(approve=("page",))))


class Motor:
    """A scheduler with a microscope whose tip and current read as given."""

    def __init__(self, settings: SchedulerSettings = SETTINGS) -> None:
        self.lab: Lab = in_control(settings)
        self.tip: dict[str, Any] = {"x_engaged": "true"}
        self.lab.answer_reads(**self.tip)
        self.lab.scope_is(ScopeState.FREE)
        self.number = 0

    def refusal(self, action: str) -> Response:
        """Ask for an action, and return its refusal; it is refused for certain."""
        found = self.asks(action)
        assert found is not None, f"{action} was sent"
        return found

    def does(self, action: str, code: ControlResponse = ControlResponse.SUCCESS) -> None:
        """Ask for an action, which is sent, and let the translator answer it."""
        found = self.asks(action)
        assert found is None, found
        detail = ResponseDetail.OUTCOME_UNKNOWN if code == ControlResponse.NO_RESPONSE else ResponseDetail.NONE
        flight = self.lab.in_flight()
        assert flight is not None
        self.lab.answer(flight, code, detail=detail)
        self.lab.scope_is(ScopeState.FREE)

    def asks(self, action: str) -> Response | None:
        self.number += 1
        asked = f"experiment/1/{self.number}"
        effects = self.lab.ask("experiment", ACTION, action, asked)
        effects = effects + self.lab.answer_reads(**self.tip)
        return next((one.response for one in replies(effects) if one.response.id == asked), None)

    def withdraws(self) -> None:
        self.does(names.RETRACT)
        self.tip = {"x_engaged": "false"}

    def lands(self) -> None:
        self.does(names.APPROACH)
        self.tip = {"x_engaged": "true"}

    def goes_right(self) -> None:
        self.withdraws()
        self.does(AWAY)
        self.does(AWAY)
        self.does(RIGHT)

    @property
    def state(self) -> MoverState:
        limits: LimitChecker = self.lab.core.state.limits
        return limits.state.movers


@pytest.fixture
def motor() -> Motor:
    """A run whose tip was proved at the sample."""
    made = Motor()
    assert made.refusal(names.START_SCAN).again_ns is not None
    made.lab.later(experiment_s=1.0)
    made.does(names.START_SCAN)
    return made


def test_motor_moves_only_a_tip_that_reads_as_withdrawn(motor: Motor) -> None:
    assert "first withdraw the tip" in motor.refusal(AWAY).reason
    motor.tip = {}
    assert "a value is unknown: x-engaged" in motor.refusal(AWAY).reason
    motor.tip = {"x_engaged": "false"}
    motor.does(AWAY)


def test_lateral_move_needs_its_steps_away(motor: Motor) -> None:
    motor.withdraws()
    why = motor.refusal(RIGHT).reason
    assert "0 of 40 steps away from the sample" in why
    assert "afspm continue --tip-is-clear" in why
    motor.does(AWAY)
    assert "20 of 40" in motor.refusal(RIGHT).reason
    motor.does(AWAY)
    motor.does(RIGHT)


@pytest.mark.parametrize("code", [ControlResponse.NO_RESPONSE, ControlResponse.ACTION_ERROR])
def test_steps_away_count_only_when_they_were_made(motor: Motor, code: ControlResponse) -> None:
    motor.withdraws()
    motor.does(AWAY)
    motor.does(AWAY, code)
    assert "20 of 40" in motor.refusal(RIGHT).reason


@pytest.mark.parametrize("action", [names.ENGAGE, names.APPROACH, names.RETRACT])
def test_steps_away_are_forgotten_when_the_tip_moves_otherwise(motor: Motor, action: str) -> None:
    motor.withdraws()
    motor.does(AWAY)
    motor.does(AWAY)
    if action == names.ENGAGE:
        why = motor.refusal(action).reason
        assert why.startswith("x-engage may not reach the sample")
        assert why.endswith("approach (x-approach)")
        return
    motor.does(action)
    assert "0 of 40" in motor.refusal(RIGHT).reason


def test_steps_away_are_forgotten_when_the_motor_moves_without_a_request(motor: Motor) -> None:
    motor.goes_right()
    motor.lab.publish("TipStatus", TipStatus(engaged=False))
    motor.lab.scope_is(ScopeState.COARSE_MOTOR)  # a person approaches, and withdraws before the tip is there
    motor.lab.scope_is(ScopeState.FREE)
    why = motor.refusal(RIGHT)
    assert "0 of 40" in why.reason
    assert why.detail is ResponseDetail.STEP_AWAY_AGAIN


def test_steps_away_count_though_the_motor_is_seen_moving(motor: Motor) -> None:
    motor.withdraws()
    for _ in range(2):
        motor.asks(AWAY)
        motor.lab.scope_is(ScopeState.COARSE_MOTOR)
        flight = motor.lab.in_flight()
        assert flight is not None
        motor.lab.answer(flight)
        motor.lab.scope_is(ScopeState.FREE)
    motor.does(RIGHT)


def test_steps_away_are_forgotten_when_a_person_brings_the_tip_back(motor: Motor) -> None:
    motor.withdraws()
    motor.does(AWAY)
    motor.does(AWAY)
    motor.lab.publish("TipStatus", TipStatus(engaged=True))
    motor.lab.publish("TipStatus", TipStatus(engaged=False))
    assert "0 of 40" in motor.refusal(RIGHT).reason


def test_moves_end_with_their_total(motor: Motor) -> None:
    motor.goes_right()
    motor.does(RIGHT)
    motor.does(RIGHT, ControlResponse.ACTION_ERROR)  # it does not count
    motor.does(RIGHT, ControlResponse.NO_RESPONSE)  # it counts
    assert "would go 10 steps after 30 steps, and at most 30 steps in a run" in motor.refusal(RIGHT).reason


def test_undeclared_motor_is_refused(motor: Motor) -> None:
    motor.withdraws()
    assert "declare it in the experiment file ([limits.movers.COARSE_UP])" in motor.refusal("COARSE_UP").reason


@pytest.mark.parametrize("code", [ControlResponse.SUCCESS, ControlResponse.NO_RESPONSE])
def test_nothing_is_measured_after_a_move_before_the_tip_was_read_twice(motor: Motor, code: ControlResponse) -> None:
    motor.withdraws()
    motor.does(AWAY, code)
    assert "has moved since the last approach: approach (x-approach)" in motor.refusal(names.START_SCAN).reason
    motor.lands()
    first = motor.refusal(names.START_SCAN)
    assert "a second reading is awaited" in first.reason
    assert first.again_ns == motor.lab.now_ns + 10**9
    motor.lab.later(experiment_s=0.5)
    assert motor.refusal(names.PULSE).again_ns == first.again_ns
    motor.lab.later(experiment_s=0.5)
    motor.does(names.START_SCAN)


def test_landing_that_is_lost_within_a_second_is_none(motor: Motor) -> None:
    motor.goes_right()
    motor.lands()
    assert motor.refusal(names.START_SPEC).again_ns is not None
    motor.tip = {"x_engaged": "false"}
    motor.lab.later(experiment_s=1.0)
    assert motor.refusal(names.START_SPEC).again_ns is None
    motor.tip = {"x_engaged": "true"}
    motor.lab.later(experiment_s=1.0)
    assert motor.refusal(names.START_SPEC).again_ns == motor.lab.now_ns + 10**9, "from the beginning"


def test_current_far_from_the_setpoint_is_no_landing(motor: Motor) -> None:
    read = {"x-engaged": Parameter("x-engaged", "true"), "zctrl-setpoint": Parameter("zctrl-setpoint", "1e-10", "A")}
    for amperes, is_there in (("9e-11", True), ("-9e-11", True), ("1e-12", False), ("3e-10", False), ("nan", False)):
        values = {**read, "x-current": Parameter("x-current", amperes, "A")}
        shown = MoverState(is_unproved=True).read(values, 1)
        assert (shown.at_sample_ns is not None) is is_there, amperes
    for setpoint, unit in (("0", "A"), ("", "A"), ("-1e-10", "A"), ("0", "V")):
        values = {**read, "x-current": Parameter("x-current", "9e-11", "A")}
        values["zctrl-setpoint"] = Parameter("zctrl-setpoint", setpoint, unit)
        shown = MoverState(is_unproved=True).read(values, 1)
        assert (shown.at_sample_ns is not None) is (setpoint == "-1e-10" or unit == "V"), (setpoint, unit)


def test_ways_and_needed_approach_survive_a_kill_and_steps_away_do_not(motor: Motor) -> None:  # tip T1
    motor.goes_right()
    before = motor.state
    assert before.retracted == 40
    after = killed(motor.lab, SETTINGS).core.state.limits.state.movers
    assert (after.ways, after.is_unproved, after.needs_approach) == (before.ways, True, True)
    assert (after.retracted, after.is_unknown) == (0, True)


def pauses(motor: Motor) -> None:
    motor.lab.mode("page", ControlMode.MANUAL)
    motor.lab.mode("page", ControlMode.AUTOMATED)
    motor.lab.take_control("experiment")


def loses_contact(motor: Motor) -> None:
    motor.lab.scope_is(ScopeState.UNDEFINED)
    motor.lab.scope_is(ScopeState.FREE)


def changes_at_the_panel(motor: Motor) -> None:
    motor.lab.publish("ActByHand", ActByHand(motor.lab.now_ns, PanelAct.VALUES))


@pytest.mark.parametrize(
    "others_act", [pauses, loses_contact, changes_at_the_panel, lambda motor: motor.lab.translator()]
)
def test_steps_away_end_where_others_may_have_used_the_motor(
    motor: Motor, others_act: Callable[[Motor], None]
) -> None:  # tip T1
    motor.withdraws()
    motor.lab.publish("TipStatus", TipStatus(engaged=False))
    motor.does(AWAY)
    motor.does(AWAY)
    others_act(motor)
    refused = motor.refusal(RIGHT)
    assert "0 of 40 steps" in refused.reason
    assert "others may have moved it" in refused.reason
    assert refused.detail is ResponseDetail.STEP_AWAY_AGAIN
    motor.does(AWAY)
    assert motor.refusal(RIGHT).detail is ResponseDetail.STEP_AWAY_AGAIN
    motor.does(AWAY)
    motor.does(RIGHT)


def test_tip_is_read_twice_after_others_may_have_moved_it(motor: Motor) -> None:
    motor.lab.publish("TipStatus", TipStatus(engaged=True))
    assert motor.refusal(names.START_SCAN).again_ns is not None, "shown there for the first time"
    motor.lab.later(experiment_s=1.0)
    motor.does(names.START_SCAN)
    pauses(motor)
    motor.does(names.START_SCAN)  # a tip that was away in between would have been seen
    loses_contact(motor)
    assert motor.refusal(names.START_SCAN).again_ns is not None
    motor.lab.later(experiment_s=1.0)
    motor.does(names.START_SCAN)


def test_withdrawn_tip_counts_as_away_only_as_long_as_it_is_shown(motor: Motor) -> None:
    motor.withdraws()
    motor.lab.publish("TipStatus", TipStatus(engaged=False))
    pauses(motor)
    assert motor.lab.core.state.microscope.risk.tip_away
    motor.lab.publish("TipStatus", TipStatus(engaged=True))
    assert not motor.lab.core.state.microscope.risk.tip_away


def test_word_of_a_person_stands_for_the_steps_until_the_next_approach(motor: Motor) -> None:
    motor.withdraws()
    assert motor.lab.says("experiment", ACTION, names.TIP_IS_CLEAR) == ControlResponse.NOT_IN_CONTROL
    motor.lab.mode("page", ControlMode.MANUAL)
    assert motor.lab.says("experiment", ACTION, names.TIP_IS_CLEAR) == ControlResponse.NOT_IN_CONTROL
    motor.lab.publish("TipStatus", TipStatus(engaged=True))
    assert motor.lab.says("page", ACTION, names.TIP_IS_CLEAR) == ControlResponse.ACTION_ERROR
    motor.lab.publish("TipStatus", TipStatus(engaged=False))
    assert motor.lab.says("page", ACTION, names.TIP_IS_CLEAR) == ControlResponse.SUCCESS
    motor.lab.mode("page", ControlMode.AUTOMATED)  # by the same client: the word is of this moment
    motor.lab.take_control("experiment")
    motor.does(RIGHT)
    pauses(motor)
    assert "0 of 40" in motor.refusal(RIGHT).reason
    motor.lab.mode("page", ControlMode.MANUAL)
    assert motor.lab.says("page", ACTION, names.TIP_IS_CLEAR) == ControlResponse.SUCCESS
    motor.lab.later(real_s=61.0)
    motor.lab.mode("page", ControlMode.AUTOMATED)  # much later
    motor.lab.take_control("experiment")
    assert "0 of 40" in motor.refusal(RIGHT).reason
    motor.lab.mode("page", ControlMode.MANUAL)
    assert motor.lab.says("page", ACTION, names.TIP_IS_CLEAR) == ControlResponse.SUCCESS
    motor.lab.mode("quiet", ControlMode.AUTOMATED)  # by another
    motor.lab.take_control("experiment")
    assert "0 of 40" in motor.refusal(RIGHT).reason
    motor.lands()
    motor.withdraws()
    assert "0 of 40" in motor.refusal(RIGHT).reason


def test_stage_of_another_instrument_counts_its_way() -> None:
    settings = LIMITS.movers
    state = MoverState(retracted=40)
    for request in ("a", "b"):
        state = state.sent(settings, STAGE, 2.0, request, is_repeated=False)
    assert state.refusal(settings, STAGE, 1.0)[0] == ""
    assert "would go 1.5 mm after 4 mm, and at most 5 mm in a run" in state.refusal(settings, STAGE, 1.5)[0]


def test_approach_by_the_motor_is_proved_even_without_a_move(motor: Motor) -> None:
    motor.withdraws()
    motor.lands()
    assert motor.refusal(names.START_SCAN).again_ns is not None
    motor.lab.later(experiment_s=1.0)
    motor.does(names.START_SCAN)
    motor.withdraws()
    motor.does(names.ENGAGE)  # by the piezo
    motor.tip = {"x_engaged": "true"}
    motor.does(names.START_SCAN)


def test_run_begins_without_a_proof() -> None:
    motor = Motor()
    assert "the tip reads at the sample for less than 1 s" in motor.refusal(names.START_SCAN).reason
    away = Motor()
    away.tip = {"x_engaged": "false"}
    assert "the tip does not read at the sample" in away.refusal(names.START_SCAN).reason
    assert "x-engage may not reach the sample" in away.refusal(names.ENGAGE).reason


def test_late_answer_and_the_answer_to_its_repetition_count_once(motor: Motor) -> None:
    motor.withdraws()
    motor.does(AWAY, ControlResponse.NO_RESPONSE)
    asked = f"experiment/1/{motor.number}"
    motor.lab.ask("experiment", ACTION, AWAY, asked)
    motor.lab.answer_reads(**motor.tip)
    flight = motor.lab.in_flight()
    assert flight is not None
    motor.lab.answer(flight)
    motor.lab.scope_is(ScopeState.FREE)
    assert motor.state.retracted == 20


def test_steps_of_before_an_approach_do_not_count_after_it(motor: Motor) -> None:
    motor.withdraws()
    motor.does(AWAY, ControlResponse.NO_RESPONSE)
    asked = f"experiment/1/{motor.number}"
    motor.lands()
    motor.withdraws()
    motor.lab.ask("experiment", ACTION, AWAY, asked)  # the translator answers from memory
    motor.lab.answer_reads(**motor.tip)
    flight = motor.lab.in_flight()
    assert flight is not None
    motor.lab.answer(flight)
    motor.lab.scope_is(ScopeState.FREE)
    assert "0 of 40" in motor.refusal(RIGHT).reason


def test_steps_count_when_they_are_made(motor: Motor) -> None:
    motor.withdraws()
    motor.does(AWAY)
    motor.asks(AWAY)
    flight = motor.lab.in_flight()
    assert flight is not None
    motor.lab.answer(flight)  # accepted
    motor.lab.scope_is(ScopeState.COARSE_MOTOR)
    assert motor.state.retracted == 20
    motor.lab.scope_is(ScopeState.INTERRUPTED)
    motor.lab.scope_is(ScopeState.FREE)
    assert "20 of 40" in motor.refusal(RIGHT).reason


def test_feedback_brings_no_tip_to_a_sample_that_has_moved(motor: Motor) -> None:
    motor.goes_right()
    asked = "experiment/1/on"
    effects = motor.lab.ask("experiment", ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=True), asked)
    effects = effects + motor.lab.answer_reads(**motor.tip)
    (refused,) = [one.response for one in replies(effects) if one.response.id == asked]
    assert "the feedback would bring the tip to the sample" in refused.reason
    motor.lands()
    motor.lab.ask("experiment", ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=True), "experiment/1/there")
    motor.lab.answer_reads(**motor.tip)
    flight = motor.lab.in_flight()
    assert flight is not None
    assert flight.request.subject == Feedback(on=True)


def test_tip_that_reads_at_the_sample_needs_an_approach_after_a_move(motor: Motor) -> None:
    motor.goes_right()
    motor.tip = {"x_engaged": "true"}
    assert "since the last approach" in motor.refusal(names.START_SCAN).reason
    motor.lab.mode("page", ControlMode.MANUAL)
    motor.lab.publish("TipStatus", TipStatus(engaged=True))  # a person has approached
    motor.lab.mode("page", ControlMode.AUTOMATED)
    motor.lab.take_control("experiment")
    assert motor.refusal(names.START_SCAN).again_ns is not None


# tip T9
def test_stage_that_others_move_asks_for_an_approach() -> None:
    motor = Motor(replace(SETTINGS, instruments=InstrumentSettings(("lab",))))
    for target in (1.0, 1.0, 3.0):
        reading = InstrumentReading(STAGE, target, "mm", 0.1, target)
        report = motor.lab.codec.encode(InstrumentReadings(motor.lab.now_ns, "lab", (reading,)))
        motor.lab.ask("lab", RELAY_REQUEST, RelayedMessage("InstrumentReadings", report))
    assert "has moved since the last approach: approach (x-approach)" in motor.refusal(names.START_SCAN).reason


# tip T9
def test_repeated_step_away_counts_for_the_way_once_and_never_for_the_distance() -> None:
    state = MoverState().sent(LIMITS.movers, AWAY, 20.0, "a", is_repeated=False)
    state = state.withdrawn()  # the steps before it no longer count
    state = state.sent(LIMITS.movers, AWAY, 20.0, "a", is_repeated=True).done("a").free()  # answered from memory
    assert (state.retracted, state.ways[AWAY]) == (0, 20.0)
    assert "0 of 40 steps" in state.refusal(LIMITS.movers, RIGHT, 10.0)[0]


# tip T9
def test_refused_move_leaves_the_approach_that_an_earlier_move_needs(motor: Motor) -> None:
    motor.withdraws()
    motor.does(AWAY)
    motor.does(AWAY, ControlResponse.ACTION_ERROR)
    motor.tip = {"x_engaged": "true"}
    assert "has moved since the last approach: approach (x-approach)" in motor.refusal(names.START_SCAN).reason
