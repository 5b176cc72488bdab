"""Limits and dangers, through the whole scheduler: where something is done, what is left behind, over its own death."""

from __future__ import annotations

import json

import pytest
from logic_lab import NS, Lab, replies

from afspm.logic.events import ComponentDied, Effect, Forward, Kill, Log, SaveState, Stopped, Tick
from afspm.logic.limits import Limit, Limits
from afspm.logic.settings import SchedulerSettings
from afspm.logic.watchdog import WatchdogSettings
from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    Feedback,
    Parameter,
    ProbePosition,
    Problem,
    Region,
    ScanParameters,
    ScopeState,
)

ACTION, PARAM = ControlRequest.ACTION, ControlRequest.PARAM
STAGE = Region((0.0, 0.0), (6e-6, 6e-6))
PULSES = SchedulerSettings(limits=Limits(actions={"x-pulse": Limit(interval_s=600.0)}))


def kinds(effects: list[Effect]) -> list[str]:
    return [type(effect).__name__ for effect in effects]


def in_control(settings: SchedulerSettings) -> Lab:
    lab = Lab(settings)
    lab.translator()
    lab.take_control("experiment")
    return lab


def killed(lab: Lab, settings: SchedulerSettings) -> Lab:
    """The scheduler that is started with what was saved last."""
    saved = [effect.state for effect in lab.effects if isinstance(effect, SaveState)][-1]
    again = Lab(settings, state=json.loads(json.dumps(saved)))
    again.now_s, again.now_ns = lab.now_s, lab.now_ns
    again.translator()
    return again


def resumed(lab: Lab, settings: SchedulerSettings) -> Lab:
    """The same, when it has caught up with the translator."""
    again = killed(lab, settings)
    for _ in range(3):  # one decision in each
        again.later(real_s=settings.catch_up_s)
        again.step(Tick())
    return again


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


# --- what is left in danger ---

OFF = Feedback(on=False)
END = ControlRequest.END_EXPERIMENT


def feedback_off(settings: SchedulerSettings | None = None) -> Lab:
    lab = in_control(settings or SchedulerSettings())
    lab.scope_is(ScopeState.FREE)
    lab.publish("ZCtrlParameters", OFF)
    lab.effects.clear()
    return lab


def sent(lab: Lab) -> list[object]:
    return [forward.request.subject for forward in lab.forwarded]


def said(lab: Lab, level: str) -> list[str]:
    return [effect.text for effect in lab.effects if isinstance(effect, Log) and effect.level == level]


def test_who_solves_a_problem_gets_a_microscope_that_is_safe() -> None:
    lab = feedback_off()
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    assert sent(lab) == ["x-retract"]
    lab.take_control("corrector", Problem.TIP_SHAPE_CHANGED)
    assert lab.says("corrector", ACTION, "start-scan") is ControlResponse.NOT_FREE
    lab.answer(lab.forwarded[-1])
    lab.ask("corrector", ACTION, "start-scan", "corrector/a/2")
    assert sent(lab) == ["x-retract", "start-scan"]


@pytest.mark.parametrize("word", ["false", "0", "0.0", "Off", "no"])
def test_a_feedback_that_is_just_being_switched_off_counts(word: str) -> None:
    for answered in (False, True):
        lab = in_control(SchedulerSettings())
        lab.ask("experiment", ControlRequest.SET_ZCTRL_PARAMS, OFF, "experiment/a/1")
        if answered:
            lab.answer(lab.forwarded[-1])
        lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
        if not answered:
            lab.answer(lab.forwarded[-1])
        assert sent(lab)[-1] == "x-retract"
    lab = in_control(SchedulerSettings())
    lab.ask("experiment", PARAM, Parameter("x-feedback-on", word), "experiment/a/1")
    lab.answer(lab.forwarded[-1])
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    assert sent(lab)[-1] == "x-retract"


def test_a_solver_may_work_with_the_feedback_off_and_is_not_disturbed() -> None:
    lab = in_control(SchedulerSettings())
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    lab.take_control("corrector", Problem.TIP_SHAPE_CHANGED)
    lab.publish("ZCtrlParameters", OFF)
    lab.flag("classifier", Problem.THERMAL_DRIFT)
    assert lab.holder == "corrector"
    lab.publish("ZCtrlParameters", Feedback(on=True))
    lab.clear("classifier", Problem.TIP_SHAPE_CHANGED)
    assert sent(lab) == []


@pytest.mark.parametrize(
    ("mode", "retract", "is_called"),
    [
        (ControlMode.AUTOMATED, "x-retract", True),
        (ControlMode.AUTOMATED, None, False),
        (ControlMode.MANUAL, "x-retract", False),
    ],
)
def test_who_resumes_a_run_that_was_stopped_with_the_feedback_off_is_called(
    mode: ControlMode, retract: str | None, is_called: bool
) -> None:
    settings = SchedulerSettings(watchdog=WatchdogSettings(retract=retract))
    lab = feedback_off(settings)
    lab.mode("person", mode)
    lab.step(Stopped())
    assert (Problem.DEVICE_MALFUNCTION in resumed(lab, settings).core.control.problems) is is_called


def test_who_resumes_a_run_that_was_stopped_without_danger_is_not_called() -> None:
    lab = feedback_off()
    lab.publish("ZCtrlParameters", Feedback(on=True))
    lab.step(Stopped())
    assert not resumed(lab, SchedulerSettings()).core.control.problems


def test_a_lease_that_runs_out_leaves_no_danger() -> None:
    lab = feedback_off(SchedulerSettings(lease_s=60.0))
    lab.later(experiment_s=60.0)
    lab.step(Tick())
    assert lab.holder is None
    assert sent(lab) == ["x-retract"]


def test_whoever_gives_control_back_with_the_feedback_off_is_heard_of_once() -> None:
    lab = feedback_off()
    lab.says("experiment", ControlRequest.RELEASE_CTRL)
    lab.take_control("experiment")
    lab.says("experiment", ControlRequest.RELEASE_CTRL)
    assert said(lab, "WARNING") == ["the feedback is off, and nobody looks after it: it gave control back"]
    assert sent(lab) == []


def test_a_person_who_takes_over_is_told_and_not_disturbed_nor_when_the_experiment_ends() -> None:
    lab = feedback_off()
    lab.mode("person", ControlMode.MANUAL)
    assert said(lab, "WARNING") == ["the feedback is off, and nobody looks after it: the mode is manual"]
    lab.effects.clear()
    assert any(isinstance(effect, Kill) for effect in lab.ask("person", END))
    assert sent(lab) == []


def test_what_can_not_be_retracted_is_critical() -> None:
    lab = Lab()
    lab.translator(ControlResponse.ACTION_NOT_SUPPORTED)
    lab.take_control("experiment")
    lab.publish("ZCtrlParameters", OFF)
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    assert said(lab, "CRITICAL") == ["the feedback is off, and nobody looks after it: a problem was flagged"]
    assert sent(lab) == []


@pytest.mark.parametrize("code", [ControlResponse.SUCCESS, ControlResponse.ACTION_ERROR])
def test_after_the_tip_was_retracted_or_could_not_be_nobody_goes_on_until_a_person_says_so(
    code: ControlResponse,
) -> None:
    lab = feedback_off()
    lab.step(ComponentDied("experiment"))
    lab.take_control("experiment")
    lab.answer(lab.forwarded[-1], code)
    assert lab.core.deadline_s() is not None
    assert lab.core.deadline_s() <= lab.now_s
    again = killed(lab, SchedulerSettings())  # nothing of it is lost with the scheduler
    for one in (lab, again):
        while Problem.DEVICE_MALFUNCTION not in one.core.control.problems:
            one.now_s = max(one.now_s, one.core.deadline_s() or 0.0)
            one.step(Tick())
        assert one.holder is None
        assert any("bring it back to the surface" in text for text in said(one, "WARNING"))
        assert one.says("experiment", ControlRequest.REQUEST_CTRL, 0) is ControlResponse.WRONG_EXP_PROBLEM
        one.clear("person", Problem.DEVICE_MALFUNCTION)
        one.take_control("experiment")
        one.step(Tick())
        assert one.holder == "experiment"


def not_retracted(settings: SchedulerSettings) -> Lab:
    """A tip whose holder is dead, and that the microscope did not retract; people were called."""
    lab = feedback_off(settings)
    lab.step(ComponentDied("experiment"))
    lab.answer(lab.forwarded[-1], ControlResponse.ACTION_ERROR, reason="a dialog is open")
    lab.step(Tick())
    assert Problem.DEVICE_MALFUNCTION in lab.core.control.problems
    assert said(lab, "ERROR") == [
        "the microscope does not x-retract: a dialog is open; it is asked again in 10 s, unless somebody sees to it"
    ]
    return lab


def tried_again(lab: Lab) -> bool:
    """Whether retracting is asked once more, when it is due."""
    before = len(lab.forwarded)
    lab.later(real_s=10.0)
    lab.step(Tick())
    return [forward.request.subject for forward in lab.forwarded[before:]] == ["x-retract"]


def test_a_tip_that_was_not_retracted_is_until_it_is() -> None:
    lab = not_retracted(SchedulerSettings())
    deadline_s = lab.core.deadline_s()
    assert deadline_s is not None
    assert deadline_s <= lab.now_s + 10.0
    assert tried_again(lab)
    lab.answer(lab.forwarded[-1])
    assert said(lab, "INFO")[-1] == "x-retract: done"
    assert not tried_again(lab)


def test_a_component_that_solves_it_is_not_disturbed() -> None:
    lab = not_retracted(SchedulerSettings())
    lab.take_control("doctor", Problem.DEVICE_MALFUNCTION)
    assert "Forward" in kinds(lab.ask("doctor", PARAM, Parameter("x-feedback-on", "true"), "doctor/a/1"))
    lab.answer(lab.forwarded[-1])
    assert not tried_again(lab)


def test_a_person_who_has_taken_over_is_not_disturbed() -> None:
    lab = not_retracted(SchedulerSettings())
    lab.mode("person", ControlMode.MANUAL)
    assert not tried_again(lab)


@pytest.mark.parametrize("attended", [False, True])
def test_a_scheduler_that_was_killed_has_not_forgotten_such_a_tip(attended: bool) -> None:
    lab = not_retracted(SchedulerSettings())
    if attended:
        lab.take_control("doctor", Problem.DEVICE_MALFUNCTION)
    assert sent(killed(lab, SchedulerSettings())) == ([] if attended else ["x-retract"])


def test_an_experiment_that_ends_with_such_a_tip_tries_once_more_and_says_so() -> None:
    lab = not_retracted(SchedulerSettings())
    lab.ask("person", END)
    assert sent(lab) == ["x-retract", "x-retract"]
    assert kinds(lab.answer(lab.forwarded[-1], ControlResponse.ACTION_ERROR))[-1] == "Kill"
    assert any("did not retract" in text for text in said(lab, "CRITICAL"))


def test_the_experiment_ends_when_the_tip_is_out_of_danger() -> None:
    lab = feedback_off()
    lab.scope_is(ScopeState.SCANNING)
    assert not replies(lab.ask("experiment", END, None, "experiment/a/9"))
    assert sent(lab) == ["stop-scan"]
    assert not replies(lab.ask("other", END, None, "other/a/1"))
    lab.answer(lab.forwarded[-1])
    lab.scope_is(ScopeState.FREE)
    assert sent(lab) == ["stop-scan", "x-retract"]
    assert not any(isinstance(effect, Kill) for effect in lab.effects)
    effects = lab.answer(lab.forwarded[-1])
    assert [(reply.name, reply.response.ok) for reply in replies(effects)] == [("experiment", True), ("other", False)]
    assert kinds(effects)[-1] == "Kill"


def test_an_experiment_that_ends_does_not_wait_for_ever() -> None:
    lab = feedback_off()
    lab.ask("experiment", END)
    deadline_s = lab.core.deadline_s()
    while not any(isinstance(effect, Kill) for effect in lab.effects):
        assert deadline_s is not None
        lab.now_s = max(lab.now_s, deadline_s)
        lab.step(Tick())
        deadline_s = lab.core.deadline_s()
    assert lab.now_s <= 100.0 + 15.0
    assert any("did not retract" in text for text in said(lab, "CRITICAL"))


def test_a_scheduler_that_is_killed_while_it_ends_sees_to_the_tip_first() -> None:
    lab = feedback_off()
    lab.ask("experiment", END)
    again = killed(lab, SchedulerSettings())
    assert sent(again) == ["x-retract"]
    assert not any(isinstance(effect, Kill) for effect in again.effects)
    assert kinds(again.answer(again.forwarded[-1]))[-1] == "Kill"


def test_an_experiment_without_danger_ends_at_once() -> None:
    lab = in_control(SchedulerSettings())
    assert kinds(lab.ask("experiment", END))[-1] == "Kill"
