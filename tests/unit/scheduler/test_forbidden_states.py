"""Forbidden states: how rules are read, which requests they refuse, and with which reasons."""

from __future__ import annotations

import json
from typing import Any

import pytest
from tests.unit.scheduler.logic_lab import Lab, in_control, replies

from afspm.model import (
    ActByHand,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Feedback,
    PanelAct,
    Parameter,
    Request,
    ScopeState,
)
from afspm.model.panel import ChangedValue
from afspm.model.snapshot import from_plain, to_plain
from afspm.scheduler.safety import rule_language
from afspm.scheduler.safety.forbidden_states import PresentState, in_states, refusal
from afspm.scheduler.safety.limits import ExperimentLimits, ForbiddenState
from afspm.scheduler.safety.rule_language import RuleError
from afspm.scheduler.settings import SchedulerSettings

BIAS, SETPOINT = "tip-bias-voltage", "zctrl-setpoint"
RULE = "abs(tip-bias-voltage) > 1 V and zctrl-setpoint > 100 pA"
UNITS = {BIAS: "V", "x-sample-bias": "V", SETPOINT: "A", "scan-speed": "m/s", "cryo.t": "K"}


def limits(rule: str = RULE, units: dict[str, str] = UNITS) -> ExperimentLimits:
    return ExperimentLimits(forbid={rule: ForbiddenState(rule, units, "night.toml:7")})


def present(*states: ScopeState, **values: object) -> PresentState:
    """Return the values by name, with underscores for hyphens and a double one for a dot; a tuple has candidates."""
    found = {
        name.replace("__", ".").replace("_", "-"): tuple(
            str(one) for one in (given if isinstance(given, tuple) else (given,))
        )
        for name, given in values.items()
    }
    parameters = {name: tuple(Parameter(name, one, UNITS.get(name)) for one in given) for name, given in found.items()}
    return PresentState({**parameters, **(in_states(states) if states else {})})


def set_(name: str, value: str, unit: str | None = None) -> Request:
    return Request(int(ControlRequest.PARAM), Parameter(name, value, unit), id="i")


def action(name: str) -> Request:
    return Request(int(ControlRequest.ACTION), name)


@pytest.mark.parametrize(
    ("rule", "at", "said"),
    [
        ("", 0, "the rule ends where a name or a number is expected"),
        ("a > 1 bb", 4, "'bb' is not a unit"),
        ("a > 1 V b", 8, "'b' where `and`, `or` or the end is expected"),
        ("a = 1", 2, "'=' is not expected"),
        ("a > 1,5 V", 5, "',' is not expected"),
        ("1 > 2", 0, "no quantity"),
        ("0 < a < 1", 6, "two sides"),
        ("(a > 1", 6, "the rule ends where `)` is expected"),
        ("abs(1) > 1", 4, "'1' where the name of a quantity is expected"),
        ("abs(a)", 6, "the rule ends where <, <=, > or >= is expected"),
        ("abs(a - 1) > 1", 8, "'1' where the name of a quantity is expected"),
        ("abs(a - b - c) > 1", 10, "'-' where `)` is expected"),
        ("a - b > 1", 2, "'-' where"),
        ("a > 1 degC", 4, "does not count from zero"),
        ("(" * 30 + "a" + ")" * 30, 20, "nested"),
        ("a" * 1001, 0, "at most 1000 characters"),
    ],
)
def test_wrong_rule_is_refused_with_its_place(rule: str, at: int, said: str) -> None:
    with pytest.raises(RuleError) as refused:
        rule_language.parse(rule)
    assert said in refused.value.what
    assert refused.value.at == at


@pytest.mark.parametrize(
    ("rule", "known", "expected"),
    [
        ("a > 1 and b > 1 or c", {"a": 2, "b": 0, "c": True}, True),
        ("not (a > 1 or c)", {"a": 0, "c": False}, True),
        ("not not c", {"c": True}, True),
        ("a > 1 and b > 1", {"a": 0}, False),  # whatever b is
        ("a > 1 and b > 1", {"a": 2}, None),
        ("a > 1 or b > 1", {"a": 2}, True),
        ("abs(a) >= 1", {"a": -1.0}, True),
        ("a > 1", {"a": 1 + 1e-8}, False),  # rounded by a controller
        ("abs(a - b) > 3", {"a": 2.0, "b": -2.0}, True),
        ("abs(a - b) > 3", {"a": 2.0, "b": 2.0}, False),
        ("abs(a - b) > 3", {"a": 9.0}, None),
        ("not abs(a - b) > c", {"a": 0.0, "b": 4.0, "c": 5.0}, True),
        ("-1.5 <= a", {"a": -1.5}, True),
    ],
)
def test_rule_is_true_false_or_unknown(rule: str, known: dict[str, Any], expected: bool | None) -> None:
    assert rule_language.holds(rule_language.parse(rule), known) is expected


def test_request_into_a_forbidden_state_is_refused_with_rule_values_and_remedy() -> None:
    why = refusal(limits(), set_(BIAS, "-2000", "mV"), present(tip_bias_voltage=0.1, zctrl_setpoint=150e-12))
    assert why == (
        "tip-bias-voltage = -2 V is forbidden while zctrl-setpoint = 150 pA: abs(tip-bias-voltage) > 1 V and"
        " zctrl-setpoint > 100 pA (night.toml:7); first bring zctrl-setpoint to at most 100 pA"
    )


@pytest.mark.parametrize(
    ("bias", "sample_v", "is_refused"), [("2 V", -2.0, True), ("2 V", 0.5, False), ("1 V", -4.0, False)]
)
def test_voltage_between_tip_and_sample_may_have_a_limit(bias: str, sample_v: float, is_refused: bool) -> None:
    # results M4: a limit of 3 V on the tip allowed 4.5 V
    rule = "abs(tip-bias-voltage - x-sample-bias) > 3 V"
    now = present(tip_bias_voltage=1.5, x_sample_bias=sample_v)
    why = refusal(limits(rule), set_(BIAS, *bias.split()), now)
    assert bool(why) is is_refused
    if is_refused:
        assert why.startswith("tip-bias-voltage = 2 V is forbidden while x-sample-bias = -2 V: abs(tip-bias-voltage - ")


@pytest.mark.parametrize(
    ("request_", "is_refused"),
    [
        (set_(BIAS, "0.5", "V"), False),  # ends it
        (set_(BIAS, "1.5", "V"), False),  # moves away
        (set_(BIAS, "2.5", "V"), True),
        (set_(BIAS, "-1.5", "V"), False),
        (set_(BIAS, "2", "V"), True),  # stays
        (set_("scan-speed", "1", "m/s"), False),  # has nothing to do with it
        (Request(int(ControlRequest.SET_ZCTRL_PARAMS), Feedback(setpoint=120e-12)), False),
        (Request(int(ControlRequest.SET_ZCTRL_PARAMS), Feedback(setpoint=200e-12)), True),
        (Request(int(ControlRequest.SET_ZCTRL_PARAMS), Feedback(on=False)), False),
        (action("start-scan"), True),
        (action("x-pulse"), True),
        (action("stop-scan"), False),
        (action("stop-spec"), False),
        (action("x-retract"), False),
    ],
)
def test_forbidden_state_is_left_and_nothing_begins_in_it(request_: Request, is_refused: bool) -> None:
    now = present(ScopeState.FREE, tip_bias_voltage=2.0, zctrl_setpoint=150e-12)
    assert bool(refusal(limits(), request_, now)) is is_refused


def test_unknown_value_refuses_where_it_decides() -> None:
    unknown = PresentState({BIAS: (Parameter(BIAS, "2", "V"),)}, {SETPOINT: "the microscope reports no value now"})
    why = refusal(limits(), set_(BIAS, "3", "V"), unknown)
    assert "can't be checked" in why
    assert "zctrl-setpoint: the microscope reports no value now" in why
    assert not refusal(limits(), set_(BIAS, "0.5", "V"), unknown)  # allowed at any setpoint
    assert not refusal(limits(), set_(BIAS, "1.5", "V"), unknown)  # moves away at any setpoint
    assert not refusal(limits(), action("x-retract"), unknown)
    assert refusal(limits(), action("start-scan"), unknown)


def test_started_scan_counts_as_running() -> None:
    rule = limits("SCANNING and scan-speed > 10 um/s")
    fast = present(ScopeState.FREE, scan_speed=2e-5)
    assert "start-scan is forbidden while scan-speed = 20 µm/s" in refusal(rule, action("start-scan"), fast)
    scanning = present(ScopeState.SCANNING, scan_speed=1e-6)
    assert "first wait until the microscope is not SCANNING" in refusal(rule, set_("scan-speed", "2e-5"), scanning)


def test_instrument_on_its_way_counts_at_both_ends() -> None:
    rule = limits("cryo.t > 20 K and tip-bias-voltage > 5 V")
    for values in ((25.0, 4.0), (4.0, 25.0)):
        assert refusal(rule, set_(BIAS, "6", "V"), present(cryo__t=values, tip_bias_voltage=1.0))
    assert not refusal(rule, set_(BIAS, "6", "V"), present(cryo__t=(4.0, 10.0), tip_bias_voltage=1.0))


def test_parameters_set_by_an_action_are_judged() -> None:
    with_action = ExperimentLimits(forbid=limits().forbid, sets={"x-high": (Parameter(BIAS, "3", "V"),)})
    assert refusal(with_action, action("x-high"), present(tip_bias_voltage=0.0, zctrl_setpoint=1e-9))
    assert not refusal(with_action, action("x-high"), present(tip_bias_voltage=0.0, zctrl_setpoint=1e-11))


# tip T9
def test_both_values_that_an_action_gives_one_parameter_are_judged() -> None:
    ends = Parameter(BIAS, "3", "V"), Parameter(BIAS, "0.5", "V")
    swept = ExperimentLimits(forbid=limits().forbid, sets={"x-sweep": ends})
    assert refusal(swept, action("x-sweep"), present(tip_bias_voltage=0.0, zctrl_setpoint=1e-9))


# tip T9
def test_difference_that_was_within_the_rounding_of_large_values_begins_when_they_are_small() -> None:
    forbid = limits("tip-bias-voltage > x-sample-bias").forbid
    low = ExperimentLimits(forbid=forbid, sets={"x-low": (Parameter(BIAS, "0.4"), Parameter("x-sample-bias", "0"))})
    assert refusal(low, action("x-low"), present(tip_bias_voltage=1e9 + 0.5, x_sample_bias=1e9))


def test_limits_with_rules_survive_json() -> None:
    assert from_plain(ExperimentLimits, json.loads(json.dumps(to_plain(limits())))) == limits()


# --- in a scheduler -------------------------------------------------------------------------------------------------


def test_values_are_read_from_the_microscope_before_a_request_is_sent() -> None:
    lab = in_control(SchedulerSettings(limits=limits()))
    lab.answer_reads(tip_bias_voltage="0.1", zctrl_setpoint="1e-9")  # at the connection
    lab.ask("experiment", ControlRequest.PARAM, Parameter(BIAS, "2", "V"), "experiment/1/1")
    effects = lab.answer_reads(tip_bias_voltage="0.1", zctrl_setpoint="1e-9")
    (reply,) = [one for one in replies(effects) if one.response.id == "experiment/1/1"]
    assert reply.response.code == ControlResponse.PARAM_ERROR
    assert "is forbidden while zctrl-setpoint = 1 nA" in reply.response.reason
    lab.ask("experiment", ControlRequest.PARAM, Parameter(BIAS, "2", "V"), "experiment/1/2")
    lab.answer_reads(tip_bias_voltage="0.1", zctrl_setpoint="1e-11")  # a person has changed it meanwhile
    sent = lab.in_flight()
    assert sent is not None
    assert sent.request.subject == Parameter(BIAS, "2", "V")


def test_person_who_sets_a_forbidden_state_keeps_the_microscope() -> None:
    lab: Lab = in_control(SchedulerSettings(limits=limits()))
    lab.answer_reads(tip_bias_voltage="0.1", zctrl_setpoint="1e-9")
    assert lab.core.control.mode is ControlMode.AUTOMATED
    change = ChangedValue(BIAS, "0.1", "3", "V")
    lab.publish("ActByHand", ActByHand(lab.now_ns, PanelAct.VALUES, "seen", (change,)))
    assert lab.core.control.mode is ControlMode.MANUAL
    outside = lab.core.state.panel.outside
    assert "tip-bias-voltage = 3 V and zctrl-setpoint = 1 nA is a forbidden state" in outside[BIAS]


STAGE = "changes(lab.stage-x) and x-engaged"


def test_request_that_moves_a_stage_is_refused_while_the_tip_is_at_the_sample() -> None:
    rule = limits(STAGE)
    why = refusal(rule, set_("lab.stage-x", "3", "mm"), present(x_engaged="true"))
    assert why == (
        "a change of lab.stage-x is forbidden while x-engaged = true: changes(lab.stage-x) and x-engaged (night.toml:7)"
        "; first withdraw the tip (x-retract)"
    )
    assert not refusal(rule, set_("lab.stage-x", "3", "mm"), present(x_engaged="false"))
    assert "a value is unknown: x-engaged" in refusal(rule, set_("lab.stage-x", "3", "mm"), PresentState())
    assert not refusal(rule, set_(BIAS, "3", "V"), present(x_engaged="true"))
    assert not refusal(rule, Request(int(ControlRequest.PARAM), Parameter("lab.stage-x")), present(x_engaged="true"))
    assert not refusal(rule, action("start-scan"), present(ScopeState.FREE, x_engaged="true"))


def test_action_of_the_maker_is_named_in_a_rule() -> None:
    rule = limits("changes(COARSE_STEP) and x-engaged")
    assert refusal(rule, action("COARSE_STEP"), present(x_engaged="true"))
    assert not refusal(rule, action("COARSE_STEP"), present(x_engaged="false"))
    assert not refusal(rule, action("start-scan"), present(ScopeState.FREE, x_engaged="true"))


def test_action_changes_what_its_command_sets() -> None:
    step = ExperimentLimits(
        forbid=limits("changes(x-steps) and x-engaged").forbid, sets={"STEP": (Parameter("x-steps", "5"),)}
    )
    assert refusal(step, action("STEP"), present(x_engaged="true"))


def test_change_of_the_sample_bias_is_a_change_at_the_panel() -> None:
    rule = ForbiddenState("changes(sample-bias) and SCANNING", {}, bias_sign=-1.0)
    both = ExperimentLimits(forbid={"": rule})
    assert refusal(both, set_(BIAS, "1", "V"), present(ScopeState.SCANNING))


def test_target_of_an_instrument_makes_it_busy() -> None:
    rule = limits("cryo.t.busy and x-engaged")
    why = refusal(rule, set_("cryo.t", "4.6", "K"), present(x_engaged="true", cryo__t__busy="false"))
    assert why.startswith("cryo.t.busy = true is forbidden while x-engaged = true")
    why = refusal(rule, action("start-scan"), present(ScopeState.FREE, x_engaged="true", cryo__t__busy="true"))
    assert "start-scan is forbidden while" in why
    either = limits("changes(x-engage) and cryo.t.busy")
    why = refusal(either, action("x-engage"), present(cryo__t__busy="true"))
    assert why.endswith("; first wait until cryo.t has arrived")
