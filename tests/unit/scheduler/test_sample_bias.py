"""No limit, rule, role or approval is passed by the name `sample-bias`."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.unit.scheduler.logic_lab import Lab, in_control, replies

from afspm.model import ControlMode, ControlRequest, ControlResponse, Feedback, Parameter, Response
from afspm.model.bias import BiasOf, BiasReference
from afspm.scheduler.control.arbitration import RoleTable, Rules
from afspm.scheduler.events import Effect, Log
from afspm.scheduler.safety.limits import ExperimentLimits, ForbiddenState, Limit, RoleLimits
from afspm.scheduler.settings import SchedulerSettings

PARAM = ControlRequest.PARAM
SIGNS: dict[BiasOf, float] = {"sample": 1.0, "tip": -1.0}
VOLTS = st.floats(-5.0, 5.0, allow_nan=False)
BOTH = ("sample-bias", "tip-bias-voltage")


def lab_with(of: BiasOf, limit: Limit | None = None, *, second: bool = False, **more: Any) -> Lab:
    limits = {} if limit is None else {"tip-bias-voltage": limit}
    bias = BiasReference(of, may_have_second=second)
    rules = more.pop("rules", Rules())
    return in_control(SchedulerSettings(rules=rules, limits=ExperimentLimits(limits, bias=bias, **more)))


def last(effects: list[Effect]) -> Response:
    return replies(effects)[-1].response


def sent(lab: Lab) -> Parameter:
    flight = lab.in_flight()
    assert flight is not None
    subject, payload = flight.request.subject, flight.request.payload
    assert not payload or lab.codec.decode(payload) == subject
    assert isinstance(subject, Parameter)
    return subject


def test_without_a_reference_it_is_refused_with_the_remedy() -> None:
    lab = lab_with("")
    for value in ("1", None):
        response = last(lab.ask("experiment", PARAM, Parameter("sample-bias", value, "V")))
        assert response.code == ControlResponse.PARAM_ERROR
        assert "bias_reference" in response.reason
    assert not lab.forwarded


@pytest.mark.parametrize("of", SIGNS)
def test_translator_gets_the_canonical_name_and_the_client_its_own(of: BiasOf) -> None:
    lab = lab_with(of)
    lab.ask("experiment", PARAM, Parameter("sample-bias", "1.5", "V"), "experiment/a/1")
    assert sent(lab) == Parameter("tip-bias-voltage", repr(SIGNS[of] * 1.5), "V")
    answered = lab.codec.encode(Parameter("tip-bias-voltage", repr(SIGNS[of] * 1.4), "V"))
    response = last(lab.answer(lab.forwarded[-1], payload=answered))
    assert lab.codec.decode(response.payload) == Parameter("sample-bias", "1.4", "V")
    again = last(lab.ask("experiment", PARAM, Parameter("sample-bias", "1.5", "V"), "experiment/a/1"))
    assert again == response
    (entry,) = (one for one in lab.entries() if one.request == PARAM)
    assert (entry.subject, float(entry.value)) == ("tip-bias-voltage", SIGNS[of] * 1.5)


def test_answer_that_is_no_number_is_no_success() -> None:
    lab = lab_with("tip")
    lab.ask("experiment", PARAM, Parameter("sample-bias"), "experiment/a/1")
    answered = lab.codec.encode(Parameter("tip-bias-voltage", "much", "V"))
    response = last(lab.answer(lab.forwarded[-1], payload=answered))
    assert (response.code, response.payload) == (ControlResponse.PARAM_ERROR, b"")


@given(st.sampled_from(sorted(SIGNS)), VOLTS, VOLTS, VOLTS, st.sampled_from(BOTH))
def test_limit_binds_both_names_by_the_sign(of: BiasOf, end: float, other: float, volts: float, name: str) -> None:
    low, high = sorted((end, other))
    lab = lab_with(of, Limit(low, high, unit="V"))
    value = volts if name == "tip-bias-voltage" else SIGNS[of] * volts
    lab.ask("experiment", PARAM, Parameter(name, repr(value), "V"))
    reach = 1e-9
    if low <= volts <= high:
        assert float(sent(lab).value or "nan") == volts
    elif volts < low - reach * abs(low) or volts > high + reach * abs(high):
        assert not lab.forwarded


def test_refusal_says_what_the_alias_is() -> None:
    reason = last(lab_with("tip", Limit(-1.0, 1.0, unit="V")).ask("experiment", PARAM, Parameter("sample-bias", "2")))
    assert "tip-bias-voltage = -2 V is below the lowest allowed" in reason.reason
    assert reason.reason.endswith("here sample-bias is -tip-bias-voltage")


def test_step_is_measured_from_the_value_in_force() -> None:
    lab = lab_with("tip", Limit(step=0.5, unit="V"))
    lab.ask("experiment", PARAM, Parameter("sample-bias", "1", "V"))
    assert "is a step of 2 V" in last(lab.answer_reads(tip_bias_voltage="1")).reason


@pytest.mark.parametrize(("of", "allowed"), [("sample", "-2"), ("tip", "2")])
@pytest.mark.parametrize("rule", ["tip-bias-voltage > 1 V and x-feedback-on", "abs(tip-bias-voltage - x-a) > 1.9 V"])
def test_rule_of_the_panel_judges_the_alias(of: BiasOf, allowed: str, rule: str) -> None:
    units = {"tip-bias-voltage": "V", "x-a": "V"} if "x-a" in rule else {"tip-bias-voltage": "V"}
    lab = lab_with(of, forbid={"rule": ForbiddenState(rule, units)})
    other = allowed.removeprefix("-") if of == "sample" else f"-{allowed}"
    lab.ask("experiment", PARAM, Parameter("sample-bias", other, "V"))
    assert "is forbidden while" in last(lab.answer_reads(tip_bias_voltage="0", x_feedback_on="true", x_a="-1")).reason
    lab.ask("experiment", PARAM, Parameter("sample-bias", allowed, "V"))
    lab.answer_reads(tip_bias_voltage="0", x_feedback_on="true", x_a="-1")
    assert float(sent(lab).value or "nan") == -2.0


@pytest.mark.parametrize(("of", "refused"), [("sample", "2"), ("tip", "-2")])
def test_rule_may_name_the_alias_and_judges_the_panel(of: BiasOf, refused: str) -> None:
    state = ForbiddenState("sample-bias > 1 V", {"tip-bias-voltage": "V"}, bias_sign=SIGNS[of])
    lab = lab_with(of, forbid={"rule": state})
    for value, is_refused in ((refused, True), (f"-{refused}".removeprefix("--"), False)):
        lab.ask("experiment", PARAM, Parameter("tip-bias-voltage", value, "V"))
        lab.answer_reads(tip_bias_voltage="0")
        assert (lab.in_flight() is None) is is_refused


def test_role_without_the_bias_may_not_set_it_by_the_alias() -> None:
    role = RoleLimits(ExperimentLimits({"scan-speed": Limit(unit="m/s")}), parameters_only=True)
    lab = lab_with("tip", roles={"experiment": role})
    reason = last(lab.ask("experiment", PARAM, Parameter("sample-bias", "1", "V"))).reason
    assert "tip-bias-voltage is not among the parameters of experiment" in reason


def test_agent_without_an_approval_may_not_set_the_alias_and_may_read_it() -> None:
    lab = lab_with("tip", second=True, rules=Rules(RoleTable(), agents=frozenset({"experiment"})))
    lab.ask("experiment", PARAM, Parameter("sample-bias", "1", "V"), "experiment/a/1")
    assert not lab.forwarded
    lab.ask("experiment", PARAM, Parameter("sample-bias"), "experiment/a/2")
    lab.answer_reads(x_sample_bias="0", tip_bias_voltage="2")
    assert lab.codec.decode(last(lab.effects).payload) == Parameter("sample-bias", "-2.0", "V")


def test_person_may_adjust_the_alias_of_an_adjustable_parameter() -> None:
    lab = lab_with("tip", rules=Rules(RoleTable(operate=("console",)), adjustable=frozenset({"tip-bias-voltage"})))
    lab.ask("console", PARAM, Parameter("sample-bias", "1", "V"))
    assert sent(lab) == Parameter("tip-bias-voltage", "-1.0", "V")


# --- the second electrode ---


@pytest.mark.parametrize(("electrode", "may"), [("0", True), ("0.0", True), ("-0.0", True), ("0.1", False)])
@pytest.mark.parametrize("value", ["1", None])
def test_alias_needs_the_second_electrode_at_0_v(value: str | None, electrode: str, *, may: bool) -> None:
    lab = lab_with("tip", second=True)
    lab.ask("experiment", PARAM, Parameter("sample-bias", value, "V"))
    assert sent(lab) == Parameter("x-sample-bias"), "read when it is asked for"
    effects = lab.answer(lab.forwarded[-1], payload=lab.codec.encode(Parameter("x-sample-bias", electrode, "V")))
    if may:
        assert sent(lab).name == "tip-bias-voltage"
    else:
        assert "x-sample-bias reads 0.1 V: set it to 0 V" in last(effects).reason
        assert lab.in_flight() is None


@pytest.mark.parametrize("electrode", ["nan", "off", None])
def test_electrode_that_shows_no_number_counts_as_not_0_v(electrode: str | None) -> None:
    lab = lab_with("tip", second=True)
    lab.ask("experiment", PARAM, Parameter("sample-bias", "1", "V"))
    payload = b"" if electrode is None else lab.codec.encode(Parameter("x-sample-bias", electrode, "V"))
    assert "x-sample-bias reads" in last(lab.answer(lab.forwarded[-1], payload=payload)).reason


def test_unreachable_electrode_refuses_and_a_microscope_without_one_does_not() -> None:
    lab = lab_with("tip", second=True)
    lab.ask("experiment", PARAM, Parameter("sample-bias", "1", "V"))
    lab.answer(lab.forwarded[-1], ControlResponse.NO_RESPONSE)
    assert lab.in_flight() is None
    lab.ask("experiment", PARAM, Parameter("sample-bias", "1", "V"))
    lab.answer_reads()
    assert sent(lab).name == "tip-bias-voltage"


def test_panel_s_own_name_does_not_ask_for_the_electrode() -> None:
    lab = lab_with("tip", second=True)
    lab.ask("experiment", PARAM, Parameter("tip-bias-voltage", "1", "V"))
    assert sent(lab) == Parameter("tip-bias-voltage", "1", "V")


def test_others_may_read_it_meanwhile_and_reading_is_no_command() -> None:
    lab = lab_with("tip", second=True)
    lab.ask("experiment", PARAM, Parameter("scan-speed", "1", "m/s"), "experiment/a/1")
    lab.ask("other", PARAM, Parameter("sample-bias"), "other/a/1")
    lab.answer(lab.forwarded[-1])
    effects = lab.answer_reads(x_sample_bias="0", tip_bias_voltage="1")
    assert lab.codec.decode(last(effects).payload) == Parameter("sample-bias", "-1.0", "V")
    lab.mode("person", ControlMode.MANUAL)
    lab.ask("other", PARAM, Parameter("sample-bias"), "other/a/2")
    assert last(lab.answer_reads(x_sample_bias="0", tip_bias_voltage="1")).ok


def test_restarted_holder_that_reads_it_with_the_feedback_off_keeps_control() -> None:
    lab = lab_with("tip", second=True)
    lab.ask("experiment", ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=False), "experiment/a/1")
    lab.answer(lab.forwarded[-1])
    lab.is_gone("experiment")
    lab.ask("experiment", PARAM, Parameter("sample-bias"), "experiment/b/1")
    assert last(lab.answer_reads(x_sample_bias="0", tip_bias_voltage="1")).ok
    assert lab.holder == "experiment"
    assert not [effect for effect in lab.effects if isinstance(effect, Log) and "danger" in effect.text]
