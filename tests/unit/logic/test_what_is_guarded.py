"""Limits, through the whole scheduler: where something is done, over its own death."""

from __future__ import annotations

import pytest
from logic_lab import NS, Lab, in_control, killed, kinds, replies

from afspm.logic.events import Forward
from afspm.logic.limits import Limit, Limits
from afspm.logic.settings import SchedulerSettings
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Parameter,
    ProbePosition,
    Region,
    ScanParameters,
)

ACTION, PARAM = ControlRequest.ACTION, ControlRequest.PARAM
STAGE = Region((0.0, 0.0), (6e-6, 6e-6))
PULSES = SchedulerSettings(limits=Limits(actions={"x-pulse": Limit(interval_s=600.0)}))


@pytest.mark.parametrize("action", ["start-scan", "x-pulse"])
def test_what_was_moved_out_of_the_region_at_the_panel_is_refused_when_it_is_to_be_used(action: str) -> None:
    lab = in_control(SchedulerSettings(limits=Limits(region=STAGE, region_source="experiment.toml:9")))
    lab.publish("ScanParameters2d", ScanParameters(Region((8e-6, 8e-6), (1e-6, 1e-6)), (32, 32)))
    lab.publish("ProbePosition", ProbePosition((9e-6, 0.0)))
    (reply,) = replies(lab.ask("experiment", ACTION, action, "experiment/a/1"))
    assert reply.response.code == ControlResponse.ACTION_ERROR
    assert "experiment.toml:9" in reply.response.reason
    lab.publish("ScanParameters2d", ScanParameters(Region((1e-6, 1e-6), (1e-6, 1e-6)), (32, 32)))
    lab.publish("ProbePosition", ProbePosition((1e-6, 0.0)))
    assert "Forward" in kinds(lab.ask("experiment", ACTION, action, "experiment/a/2"))


def test_an_interval_outlives_the_scheduler_that_was_killed_before_it_heard_the_answer() -> None:
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
def test_what_the_microscope_refused_may_be_asked_at_once(answer: ControlResponse) -> None:
    lab = in_control(PULSES)
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    lab.answer(lab.forwarded[-1], answer)
    assert "Forward" in kinds(lab.ask("experiment", ACTION, "x-pulse", "experiment/a/2"))


def test_what_may_have_been_done_counts() -> None:
    lab = in_control(PULSES)
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    lab.answer(lab.forwarded[-1], ControlResponse.NO_RESPONSE)
    assert lab.says("experiment", ACTION, "x-pulse", "experiment/a/2") is ControlResponse.ACTION_ERROR


def test_the_value_that_a_step_is_measured_from_outlives_the_scheduler() -> None:
    settings = SchedulerSettings(limits=Limits({"tip-bias-voltage": Limit(step=0.1)}))
    lab = in_control(settings)
    lab.ask("experiment", PARAM, Parameter("tip-bias-voltage"))
    lab.answer(lab.forwarded[-1], payload=lab.codec.encode(Parameter("tip-bias-voltage", "0.1", "V")))
    again = killed(lab, settings)
    too_far = replies(again.ask("experiment", PARAM, Parameter("tip-bias-voltage", "0.3", "V"), "experiment/a/2"))
    assert "a step of 0.2 V" in too_far[0].response.reason
    assert "Forward" in kinds(
        again.ask("experiment", PARAM, Parameter("tip-bias-voltage", "0.2", "V"), "experiment/a/3")
    )


def test_what_an_older_scheduler_saved_is_taken_up() -> None:
    lab = in_control(PULSES)
    state = lab.core.snapshot()
    del state["guard"]
    assert Lab(PULSES, state=state).holder == "experiment"


def test_the_time_of_a_use_is_that_of_the_experiment() -> None:
    lab = in_control(PULSES)
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    lab.answer(lab.forwarded[-1])
    lab.later(experiment_s=300.0)
    (reply,) = replies(lab.ask("experiment", ACTION, "x-pulse", "experiment/a/2"))
    assert "300 s ago" in reply.response.reason
    lab.now_ns += 300 * NS
    forwards = lab.ask("experiment", ACTION, "x-pulse", "experiment/a/3")
    assert any(isinstance(effect, Forward) for effect in forwards)
