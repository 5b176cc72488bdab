"""Limits through the whole scheduler, also over its kill."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from tests.unit.scheduler.logic_lab import NS, Lab, in_control, killed, kinds, replies

from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    Parameter,
    ProbePosition,
    Problem,
    Region,
    ResponseDetail,
    ScanParameters,
)
from afspm.scheduler.control.arbitration import RoleTable, Rules
from afspm.scheduler.events import Effect, Forward, Tick, TranslatorCaughtUp, TranslatorDown, TranslatorUp
from afspm.scheduler.safety.limits import ExperimentLimits, Limit
from afspm.scheduler.settings import SchedulerSettings

ACTION, PARAM = ControlRequest.ACTION, ControlRequest.PARAM
NO_RESPONSE = ControlResponse.NO_RESPONSE
STAGE = Region((0.0, 0.0), (6e-6, 6e-6))
PULSES = SchedulerSettings(limits=ExperimentLimits(actions={"x-pulse": Limit(interval_s=600.0)}))


HERE: dict[str, Any] = {
    "scan_top_left_y": "0",
    "scan_size_x": "1e-6",
    "scan_size_y": "1e-6",
    "scan_angle": "0",
    "probe_pos_y": "0",
}
REGION = SchedulerSettings(limits=ExperimentLimits(region=STAGE, region_source="experiment.toml:9"))


@pytest.mark.parametrize("action", ["start-scan", "x-pulse"])
def test_place_moved_out_of_the_region_at_the_panel_is_refused_when_used(action: str) -> None:
    lab = in_control(REGION)
    lab.publish("ScanParameters2d", ScanParameters(Region((0.0, 0.0), (1e-6, 1e-6)), (32, 32)))
    lab.publish("ProbePosition", ProbePosition((0.0, 0.0)))
    lab.ask("experiment", ACTION, action, "experiment/a/1")
    (reply,) = replies(lab.answer_reads(scan_top_left_x="8e-6", probe_pos_x="9e-6", **HERE))
    assert reply.response.code == ControlResponse.ACTION_ERROR
    assert "experiment.toml:9" in reply.response.reason
    lab.ask("experiment", ACTION, action, "experiment/a/2")
    assert sent(lab.answer_reads(scan_top_left_x="1e-6", probe_pos_x="1e-6", **HERE)) == [action]


VOLTAGE = SchedulerSettings(
    limits=ExperimentLimits({"x-pulse-voltage": Limit(-4.0, 4.0, unit="V", source="experiment.toml:7")})
)


def test_pulse_with_a_voltage_in_force_beyond_its_limit_is_refused() -> None:
    lab = in_control(VOLTAGE)
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    (reply,) = replies(lab.answer_reads(x_pulse_voltage="5"))
    assert reply.response.code == ControlResponse.ACTION_ERROR
    assert "x-pulse: x-pulse-voltage = 5 V is above the highest allowed, 4 V" in reply.response.reason
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/2")
    assert sent(lab.answer_reads(x_pulse_voltage="-4.001")) == ["x-pulse"]


def test_pulse_of_a_microscope_without_the_limited_parameter_is_sent() -> None:
    lab = in_control(VOLTAGE)
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    assert sent(lab.answer_reads()) == ["x-pulse"]


@pytest.mark.parametrize("lacking", [ControlResponse.PARAM_NOT_SUPPORTED, ControlResponse.CMD_NOT_SUPPORTED])
def test_published_place_counts_if_the_microscope_has_no_such_parameter(lacking: ControlResponse) -> None:
    lab = in_control(REGION)
    lab.publish("ScanParameters2d", ScanParameters(Region((0.0, 0.0), (1e-6, 1e-6)), (32, 32)))
    lab.ask("experiment", ACTION, "start-scan", "experiment/a/1")
    assert sent(lab.answer_reads(lacking)) == ["start-scan"]
    lab.answer(lab.forwarded[-1])
    lab.ask("experiment", PARAM, Parameter("scan-size-x", "9e-6"), "experiment/a/2")
    (reply,) = replies(lab.answer_reads(lacking))
    assert "outside the region" in reply.response.reason


def set_(name: str, value: str, number: int) -> tuple[ControlRequest, Parameter, str]:
    return PARAM, Parameter(name, value), f"experiment/a/{number}"


def test_request_sent_without_waiting_is_checked_against_all_earlier_ones() -> None:
    """The frame would be wider, and then moved; each change alone fits into the region."""
    lab = in_control(REGION)
    lab.publish("ScanParameters2d", ScanParameters(Region((0.0, 0.0), (1e-6, 1e-6)), (32, 32)))
    for request in (set_("scan-size-x", "3.4e-6", 1), set_("scan-top-left-x", "1.9e-6", 2)):
        lab.ask("experiment", *request)
    lab.ask("experiment", ACTION, "start-scan", "experiment/a/3")
    assert sent(lab.answer_reads(scan_top_left_x="-0.5e-6", **HERE)) == [Parameter("scan-size-x", "3.4e-6")]
    lab.answer(lab.forwarded[-1])
    wider = HERE | {"scan_size_x": "3.4e-6"}
    effects = lab.answer_reads(scan_top_left_x="-0.5e-6", **wider)  # for the second, and for the third
    assert sent(effects) == ["start-scan"]
    codes = {reply.response.id: reply.response.code for reply in replies(lab.effects)}
    assert codes["experiment/a/2"] == ControlResponse.PARAM_ERROR


def test_probe_stays_in_a_turned_region_along_both_axes() -> None:
    diamond = Region((0.0, 0.0), (2e-6, 2e-6), math.pi / 4)
    lab = in_control(SchedulerSettings(limits=ExperimentLimits(region=diamond)))
    lab.ask("experiment", *set_("probe-pos-x", "1e-6", 1))
    lab.ask("experiment", *set_("probe-pos-y", "1e-6", 2))
    assert sent(lab.answer_reads(probe_pos_x="0", probe_pos_y="0")) == [Parameter("probe-pos-x", "1e-6")]
    lab.answer(lab.forwarded[-1])
    (reply,) = replies(lab.answer_reads(probe_pos_x="1e-6", probe_pos_y="0"))
    assert (reply.response.id, reply.response.code) == ("experiment/a/2", ControlResponse.PARAM_ERROR)


def test_rate_holds_for_changes_sent_at_once() -> None:
    lab = in_control(SchedulerSettings(limits=ExperimentLimits({BIAS: Limit(rate_per_s=0.1)})))
    told(lab, "0")  # read ahead
    lab.later(experiment_s=10.0)
    for n in range(1, 6):
        lab.ask("experiment", PARAM, Parameter(BIAS, f"{n * 0.9}", "V"), f"experiment/a/{n}")
    told(lab, "0")
    lab.answer(lab.forwarded[-1])
    for _ in range(2, 6):
        (reply,) = replies(told(lab, "0.9"))
        assert "per second" in reply.response.reason


def test_old_packet_does_not_replace_read_values() -> None:
    lab = in_control(REGION)
    lab.ask("experiment", *set_("scan-top-left-x", "1.9e-6", 1))
    reads = {"scan_top_left_x": "-0.5e-6"} | HERE | {"scan_size_x": "3.4e-6"}
    while (asked := lab.in_flight()) is not None:
        lab.publish("ScanParameters2d", ScanParameters(Region((0.0, 0.0), (1e-6, 1e-6)), (32, 32)))
        name = asked.request.subject.name
        payload = lab.codec.encode(Parameter(name, reads[name.replace("-", "_")], "" if name == "scan-angle" else "m"))
        effects = lab.answer(asked, payload=payload)
    (reply,) = replies(effects)
    assert "outside the region" in reply.response.reason


def test_value_is_read_again_after_an_unanswered_change() -> None:
    lab = in_control(STEPS)
    lab.ask("experiment", PARAM, Parameter(BIAS, "0.1", "V"), "experiment/a/1")
    told(lab, "0")
    lab.later(STEPS.control.request_timeout_s + STEPS.waits.answer_s)
    lab.step(Tick())  # overdue, and the next may be sent
    lab.ask("experiment", PARAM, Parameter(BIAS, "-0.1", "V"), "experiment/a/2")
    (reply,) = replies(told(lab, "0.1"))
    assert "a step of 200 mV" in reply.response.reason


def test_reading_request_is_sent_after_the_turn_of_a_command() -> None:
    lab = in_control(STEPS)
    lab.ask("experiment", PARAM, Parameter(BIAS, "0.1", "V"), "experiment/a/1")
    lab.ask("other", PARAM, Parameter("scan-speed"), "other/a/1")
    assert sent(told(lab, "0")) == [Parameter(BIAS, "0.1", "V")]
    assert sent(lab.answer(lab.forwarded[-1])) == [Parameter("scan-speed")]


def test_queued_adjustment_is_refused_once_a_problem_is_flagged() -> None:
    rules = Rules(RoleTable(operate=("ada",)), adjustable=frozenset({BIAS}))
    lab = in_control(SchedulerSettings(rules=rules))
    lab.ask("experiment", ACTION, "start-scan", "experiment/a/1")
    lab.ask("ada", PARAM, Parameter(BIAS, "0.1", "V"), "ada/a/1")
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    while (waiting := lab.in_flight()) is not None:
        lab.answer(waiting)
    assert Parameter(BIAS, "0.1", "V") not in sent(lab.effects)
    assert [one.response.code for one in replies(lab.effects) if one.name == "ada"] == [ControlResponse.NOT_IN_CONTROL]


def test_interval_holds_for_a_forgotten_id() -> None:
    lab = in_control(PULSES)
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    lab.answer(lab.forwarded[-1])
    for n in range(2, 332):
        lab.ask("experiment", *set_("scan-speed", "1e-6", n))
        lab.answer(lab.forwarded[-1])
    (reply,) = replies(lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1"))
    assert (reply.response.code, reply.response.detail) == (NO_RESPONSE, ResponseDetail.OUTCOME_UNKNOWN)
    lab.later(experiment_s=600.0)
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    assert sent(lab.effects).count("x-pulse") == 1


@pytest.mark.parametrize("id_", ["pulse", "experiment/key/pulse/0"])
def test_interval_holds_for_a_repeated_unnumbered_id(id_: str) -> None:
    lab = in_control(PULSES)
    lab.ask("experiment", ACTION, "x-pulse", id_)
    lab.answer(lab.forwarded[-1])
    for n in range(330):
        lab.ask("experiment", PARAM, Parameter("scan-speed", "1e-6"), f"speed-{n}")
        lab.answer(lab.forwarded[-1])
    (reply,) = replies(lab.ask("experiment", ACTION, "x-pulse", id_))
    assert sent(lab.effects).count("x-pulse") == 1
    assert reply.response.code in (ControlResponse.SUCCESS, ControlResponse.ACTION_ERROR)


def test_refused_repetition_is_answered_as_unknown_outcome() -> None:
    lab = in_control(STEPS)
    lab.ask("experiment", PARAM, Parameter(BIAS, "0.1", "V"), "experiment/a/1")
    told(lab, "0")
    lab.later(STEPS.control.request_timeout_s + STEPS.waits.answer_s)
    lab.step(Tick())
    lab.ask("experiment", PARAM, Parameter(BIAS, "0.1", "V"), "experiment/a/1")
    (reply,) = replies(told(lab, "3"))
    assert (reply.response.code, reply.response.detail) == (NO_RESPONSE, ResponseDetail.OUTCOME_UNKNOWN)
    assert "a step of 2.9 V" in reply.response.reason


def test_interval_outlives_a_kill_before_the_answer() -> None:
    lab = in_control(PULSES)
    effects = lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    assert kinds(effects) == ["SaveState", "Forward"]
    again = killed(lab, PULSES)
    again.later(experiment_s=599.0)
    assert again.says("experiment", ACTION, "x-pulse", "experiment/a/2") is ControlResponse.ACTION_ERROR
    assert "Forward" in kinds(again.ask("experiment", ACTION, "x-pulse", "experiment/a/1"))
    again.answer(again.forwarded[-1])
    again.later(experiment_s=600.0)
    assert "Forward" in kinds(again.ask("experiment", ACTION, "x-pulse", "experiment/a/3"))


@pytest.mark.parametrize("answer", [ControlResponse.ACTION_ERROR, ControlResponse.NOT_FREE])
def test_request_refused_by_the_microscope_may_be_repeated_at_once(answer: ControlResponse) -> None:
    lab = in_control(PULSES)
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    lab.answer(lab.forwarded[-1], answer)
    assert "Forward" in kinds(lab.ask("experiment", ACTION, "x-pulse", "experiment/a/2"))


def test_use_of_unknown_outcome_counts() -> None:
    lab = in_control(PULSES)
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    lab.answer(lab.forwarded[-1], ControlResponse.NO_RESPONSE)
    assert lab.says("experiment", ACTION, "x-pulse", "experiment/a/2") is ControlResponse.ACTION_ERROR


BIAS = "tip-bias-voltage"
STEPS = SchedulerSettings(limits=ExperimentLimits({BIAS: Limit(step=0.1)}))


def told(lab: Lab, value: str) -> list[Effect]:
    """Answer the read of the bias."""
    forward = lab.forwarded[-1]
    assert forward.request.subject == Parameter(BIAS)
    return lab.answer(forward, payload=lab.codec.encode(Parameter(BIAS, value, "V")))


def sent(effects: list[Effect]) -> list[object]:
    return [effect.request.subject for effect in effects if isinstance(effect, Forward)]


def test_step_is_measured_from_the_value_read_at_that_time() -> None:
    lab = in_control(STEPS)
    assert sent(lab.ask("experiment", PARAM, Parameter(BIAS, "0.2", "V"), "experiment/a/1")) == [Parameter(BIAS)]
    assert sent(told(lab, "0.1")) == [Parameter(BIAS, "0.2", "V")]
    lab.answer(lab.forwarded[-1])
    lab.ask("experiment", PARAM, Parameter(BIAS, "0.3", "V"), "experiment/a/2")
    (reply,) = replies(told(lab, "-3"))  # somebody was at the panel
    assert "a step of 3.3 V" in reply.response.reason
    assert reply.response.id == "experiment/a/2"


def test_unreadable_parameter_is_not_set() -> None:
    lab = in_control(STEPS)
    lab.ask("experiment", PARAM, Parameter(BIAS, "0.2", "V"), "experiment/a/1")
    (reply,) = replies(lab.answer(lab.forwarded[-1], ControlResponse.PARAM_NOT_SUPPORTED))
    assert reply.response.code == ControlResponse.PARAM_ERROR
    assert "reports no value now" in reply.response.reason


def test_client_may_retry_after_a_read_in_vain() -> None:
    lab = in_control(STEPS)
    lab.ask("experiment", PARAM, Parameter(BIAS, "0.2", "V"), "experiment/a/1")
    lab.later(STEPS.control.request_timeout_s)
    (reply,) = replies(lab.step(Tick()))
    assert reply.response.code == ControlResponse.NO_RESPONSE
    assert reply.response.detail is ResponseDetail.NOT_SENT


def test_client_that_loses_control_during_the_read_sets_nothing() -> None:
    lab = in_control(STEPS)
    lab.ask("experiment", PARAM, Parameter(BIAS, "0.2", "V"), "experiment/a/1")
    effects = lab.ask("classifier", ControlRequest.ADD_EXP_PRBLM, Problem.TIP_SHAPE_CHANGED)
    (code,) = [reply.response.code for reply in replies(effects) if reply.name == "experiment"]
    assert code == ControlResponse.NOT_IN_CONTROL
    assert not sent(told(lab, "0.1"))


def test_two_changes_of_one_value_do_not_overlap() -> None:
    lab = in_control(replace(STEPS, rules=Rules(RoleTable(operate=("ada", "ben")))))
    lab.mode("ada", ControlMode.MANUAL)
    lab.ask("ada", PARAM, Parameter(BIAS, "0.1", "V"), "ada/a/1")
    read = lab.forwarded[-1]
    assert lab.ask("ben", PARAM, Parameter(BIAS, "-0.1", "V"), "ben/a/1") == []
    assert sent(lab.answer(read, payload=lab.codec.encode(Parameter(BIAS, "0", "V")))) == [Parameter(BIAS, "0.1", "V")]
    assert sent(lab.answer(lab.forwarded[-1])) == [Parameter(BIAS)]
    (reply,) = replies(told(lab, "0.1"))
    assert (reply.name, "a step of 200 mV" in reply.response.reason) == ("ben", True)


def test_waiting_change_by_a_person_is_dropped_when_the_mode_is_automated() -> None:
    lab = in_control(replace(STEPS, rules=Rules(RoleTable(operate=("ada", "ben")))))
    lab.mode("ada", ControlMode.MANUAL)
    lab.ask("ada", PARAM, Parameter(BIAS, "0.1", "V"), "ada/a/1")
    read = lab.forwarded[-1]
    effects = lab.ask("ben", ControlRequest.SET_CONTROL_MODE, int(ControlMode.AUTOMATED))
    (code,) = [reply.response.code for reply in replies(effects) if reply.name == "ada"]
    assert code == ControlResponse.NOT_IN_CONTROL
    assert not sent(lab.answer(read, payload=lab.codec.encode(Parameter(BIAS, "0", "V"))))


def test_refusal_goes_to_the_newest_connection() -> None:
    lab = in_control(STEPS)
    lab.ask("experiment", PARAM, Parameter(BIAS, "3", "V"), "experiment/a/1")
    read = lab.forwarded[-1]
    lab.is_gone("experiment")
    newest = lab.connect("experiment")
    lab.ask("experiment", PARAM, Parameter(BIAS, "3", "V"), "experiment/a/1")
    (reply,) = replies(lab.answer(read, payload=lab.codec.encode(Parameter(BIAS, "0", "V"))))
    assert (reply.connection, "step" in reply.response.reason) == (newest, True)


def test_rate_is_measured_from_the_read_at_connection() -> None:
    settings = SchedulerSettings(limits=ExperimentLimits({BIAS: Limit(rate_per_s=0.1)}))
    lab = Lab(settings)
    lab.step(TranslatorUp())
    lab.answer(next(one for one in lab.forwarded if one.request.kind == ControlRequest.ACTION_SUPPORT))
    assert lab.forwarded[-1].request.subject == Parameter(BIAS)
    told(lab, "0")
    lab.step(TranslatorCaughtUp())
    lab.take_control("experiment")
    lab.later(experiment_s=10.0)
    lab.ask("experiment", PARAM, Parameter(BIAS, "0.9", "V"), "experiment/a/1")
    assert sent(told(lab, "0")) == [Parameter(BIAS, "0.9", "V")]


def test_without_a_translator_nothing_is_read() -> None:
    lab = in_control(SchedulerSettings(limits=ExperimentLimits({BIAS: Limit(high=3.0)})))
    lab.step(TranslatorDown())
    (reply,) = replies(lab.ask("experiment", PARAM, Parameter(BIAS, "0.2", "V"), "experiment/a/1"))
    assert reply.response.code == ControlResponse.NO_RESPONSE
    lab = in_control(STEPS)
    lab.step(TranslatorDown())
    (reply,) = replies(lab.ask("experiment", PARAM, Parameter(BIAS, "0.2", "V"), "experiment/a/1"))
    assert reply.response.code == ControlResponse.NO_RESPONSE


@pytest.mark.parametrize("said", ["nan", "0,5", ""])
def test_no_answer_of_a_microscope_ends_the_scheduler(said: str) -> None:
    lab = in_control(SchedulerSettings())
    lab.ask("experiment", PARAM, Parameter(BIAS), "experiment/a/1")
    (reply,) = replies(told(lab, said))
    assert reply.response.code == ControlResponse.SUCCESS


def test_time_of_a_use_is_experiment_time() -> None:
    lab = in_control(PULSES)
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    lab.answer(lab.forwarded[-1])
    lab.later(experiment_s=300.0)
    (reply,) = replies(lab.ask("experiment", ACTION, "x-pulse", "experiment/a/2"))
    assert "300 s ago" in reply.response.reason
    lab.now_ns += 300 * NS
    forwards = lab.ask("experiment", ACTION, "x-pulse", "experiment/a/3")
    assert any(isinstance(effect, Forward) for effect in forwards)
