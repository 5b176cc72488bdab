"""A tip left in danger, through the whole scheduler."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from tests.unit.scheduler.logic_lab import Lab, in_control, killed, kinds, replies, resumed

from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    Feedback,
    Parameter,
    Problem,
    ResponseDetail,
    ScopeState,
)
from afspm.scheduler.events import Disconnected, Kill, Log, Stopped, Tick, TranslatorDown, TranslatorUp
from afspm.scheduler.safety.watchdog import WatchdogSettings
from afspm.scheduler.settings import ControlSettings, SchedulerSettings, Waits
from afspm.scheduler.write_ahead import StateFile

ACTION, PARAM = ControlRequest.ACTION, ControlRequest.PARAM
OFF = Feedback(on=False)
END = ControlRequest.END_EXPERIMENT


def feedback_off(settings: SchedulerSettings | None = None) -> Lab:
    lab = in_control(settings or SchedulerSettings())
    lab.scope_is(ScopeState.FREE)
    lab.publish("ZCtrlParameters", OFF)
    lab.effects.clear()
    return lab


def sent(lab: Lab) -> list[object]:
    """Return the actions and settings sent to the microscope."""
    asked = [one.request for one in lab.forwarded]
    return [request.subject for request in asked if request.kind != ControlRequest.ACTION_SUPPORT]


def said(lab: Lab, level: str) -> list[str]:
    return [effect.text for effect in lab.effects if isinstance(effect, Log) and effect.level == level]


def test_solver_of_another_problem_does_not_measure_with_a_withdrawn_tip() -> None:
    lab = feedback_off()
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    assert sent(lab) == ["x-retract"]
    lab.take_control("corrector", Problem.TIP_SHAPE_CHANGED)
    assert lab.says("corrector", ACTION, "start-scan") is ControlResponse.NOT_FREE
    lab.answer(lab.forwarded[-1])
    assert lab.says("corrector", ACTION, "start-scan") is ControlResponse.NOT_FREE
    lab.step(Tick())
    assert lab.core.control.holder is None
    tip = int(Problem.TIP_SHAPE_CHANGED)
    assert lab.says("corrector", ControlRequest.REQUEST_CTRL, tip) is ControlResponse.WRONG_EXP_PROBLEM
    assert sent(lab) == ["x-retract"]


def test_tip_approached_by_hand_is_withdrawn_at_the_next_danger() -> None:
    lab = in_control(SchedulerSettings())
    lab.scope_is(ScopeState.COARSE_MOTOR)
    lab.publish("ZCtrlParameters", Feedback(on=True))
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    lab.answer(lab.forwarded[-1])
    lab.step(Tick())
    lab.scope_is(ScopeState.FREE)
    for problem in (Problem.DEVICE_MALFUNCTION, Problem.TIP_SHAPE_CHANGED):
        lab.ask("person", ControlRequest.RMV_EXP_PRBLM, int(problem))
    lab.take_control("experiment")
    lab.publish("ZCtrlParameters", OFF)
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    assert sent(lab) == ["x-retract", "x-retract"]


def test_tip_withdrawn_late_is_left_to_a_person() -> None:
    lab = feedback_off(SchedulerSettings(control=ControlSettings(request_timeout_s=1.0), waits=Waits(answer_s=1.0)))
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    overdue = lab.forwarded[-1]
    lab.ask("person", ControlRequest.SET_CONTROL_MODE, int(ControlMode.MANUAL))
    lab.later(1.5)
    lab.step(Tick())
    lab.later(1.5)
    lab.step(Tick())
    lab.ask("person", ControlRequest.SET_CONTROL_MODE, int(ControlMode.AUTOMATED))
    lab.answer(overdue)
    lab.step(Tick())
    assert Problem.DEVICE_MALFUNCTION in lab.core.control.problems


@pytest.mark.parametrize("word", ["false", "0", "0.0", "Off", "no"])
def test_feedback_being_switched_off_counts_as_off(word: str) -> None:
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
def test_person_who_resumes_a_run_stopped_with_the_feedback_off_is_called(
    mode: ControlMode, retract: str | None, is_called: bool
) -> None:
    settings = SchedulerSettings(watchdog=WatchdogSettings(retract=retract))
    lab = feedback_off(settings)
    lab.mode("person", mode)
    lab.step(Stopped())
    assert (Problem.DEVICE_MALFUNCTION in resumed(lab, settings).core.control.problems) is is_called


def test_person_who_resumes_a_run_stopped_without_danger_is_not_called() -> None:
    lab = feedback_off()
    lab.publish("ZCtrlParameters", Feedback(on=True))
    lab.step(Stopped())
    assert not resumed(lab, SchedulerSettings()).core.control.problems


def test_a_lease_that_runs_out_leaves_no_danger() -> None:
    lab = feedback_off(SchedulerSettings(control=ControlSettings(lease_s=60.0)))
    lab.later(experiment_s=60.0)
    lab.step(Tick())
    assert lab.holder is None
    assert sent(lab) == ["x-retract"]


def test_release_with_the_feedback_off_is_logged_once() -> None:
    lab = feedback_off()
    lab.says("experiment", ControlRequest.RELEASE_CTRL)
    lab.take_control("experiment")
    lab.says("experiment", ControlRequest.RELEASE_CTRL)
    assert said(lab, "WARNING") == ["the feedback is off, and no component is in control: it gave control back"]
    assert sent(lab) == []


def test_danger_taken_over_by_a_person_is_logged_and_not_retracted_also_at_the_end() -> None:
    lab = feedback_off()
    lab.mode("person", ControlMode.MANUAL)
    assert said(lab, "WARNING") == ["the feedback is off, and no component is in control: the mode changed to MANUAL"]
    lab.effects.clear()
    assert any(isinstance(effect, Kill) for effect in lab.ask("person", END))
    assert sent(lab) == []


def test_tip_that_can_not_be_retracted_is_critical() -> None:
    lab = Lab()
    lab.translator(ControlResponse.ACTION_NOT_SUPPORTED)
    lab.take_control("experiment")
    lab.publish("ZCtrlParameters", OFF)
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    assert said(lab, "CRITICAL") == ["the feedback is off, and no component is in control: a problem was flagged"]
    assert sent(lab) == []


@pytest.mark.parametrize("code", [ControlResponse.SUCCESS, ControlResponse.ACTION_ERROR])
def test_after_a_retract_no_component_commands_until_a_person_clears_the_malfunction(
    code: ControlResponse,
) -> None:
    lab = feedback_off()
    lab.give_up("experiment")
    lab.take_control("experiment")
    lab.answer(lab.forwarded[-1], code)
    deadline_s = lab.core.deadline_s()
    assert deadline_s is not None
    assert deadline_s <= lab.now_s
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
    """Return a core with a dead holder and a failed retract, after the call for a person."""
    lab = feedback_off(settings)
    lab.give_up("experiment")
    lab.answer(lab.forwarded[-1], ControlResponse.ACTION_ERROR, reason="a dialog is open")
    lab.step(Tick())
    assert Problem.DEVICE_MALFUNCTION in lab.core.control.problems
    assert said(lab, "ERROR") == [
        "the microscope does not x-retract: a dialog is open; "
        "it is asked again in 10 s, unless a component or a person takes over"
    ]
    return lab


def tried_again(lab: Lab) -> bool:
    """Return whether the retract is sent once more when it is due."""
    before = len(lab.forwarded)
    lab.later(real_s=10.0)
    lab.step(Tick())
    return [forward.request.subject for forward in lab.forwarded[before:]] == ["x-retract"]


def test_retract_is_retried_until_it_succeeds() -> None:
    lab = not_retracted(SchedulerSettings())
    deadline_s = lab.core.deadline_s()
    assert deadline_s is not None
    assert deadline_s <= lab.now_s + 10.0
    assert tried_again(lab)
    lab.answer(lab.forwarded[-1])
    assert said(lab, "INFO")[-1] == "x-retract: done"
    assert not tried_again(lab)


def test_solver_of_the_malfunction_is_not_disturbed() -> None:
    lab = not_retracted(SchedulerSettings())
    lab.take_control("doctor", Problem.DEVICE_MALFUNCTION)
    assert "Forward" in kinds(lab.ask("doctor", PARAM, Parameter("x-feedback-on", "true"), "doctor/a/1"))
    lab.answer(lab.forwarded[-1])
    assert not tried_again(lab)


def test_solver_of_another_problem_may_not_command_a_tip_in_danger() -> None:
    lab = feedback_off()
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    lab.take_control("corrector", Problem.TIP_SHAPE_CHANGED)
    lab.answer(lab.forwarded[-1], ControlResponse.ACTION_ERROR)
    (reply,) = replies(lab.ask("corrector", ACTION, "x-pulse", "corrector/a/1"))
    assert reply.response.code == ControlResponse.NOT_FREE
    assert "only components that solve device-malfunction" in reply.response.reason
    lab.clear("corrector", Problem.TIP_SHAPE_CHANGED)
    assert lab.holder is None
    lab.step(Tick())  # people are called
    assert tried_again(lab)


@pytest.mark.parametrize("by_hand", [False, True])
def test_person_who_took_over_or_cleared_the_malfunction_is_not_disturbed(by_hand: bool) -> None:
    lab = not_retracted(SchedulerSettings())
    if by_hand:
        lab.mode("person", ControlMode.MANUAL)
    else:
        lab.clear("person", Problem.DEVICE_MALFUNCTION)
        lab.take_control("experiment")
        assert "Forward" in kinds(lab.ask("experiment", ACTION, "start-scan", "experiment/a/9"))
        lab.answer(lab.forwarded[-1])
    assert not tried_again(lab)


@pytest.mark.parametrize("seen_to", [False, True])
def test_duty_to_retract_outlives_a_kill(seen_to: bool) -> None:
    lab = not_retracted(SchedulerSettings())
    if seen_to:
        lab.take_control("doctor", Problem.DEVICE_MALFUNCTION)
    again = killed(lab, SchedulerSettings())
    assert sent(again) == []
    again.later(real_s=1.0)
    again.step(Tick())
    again.step(Tick())
    assert sent(again) == ([] if seen_to else ["x-retract"])


def test_resumed_run_with_a_tip_out_of_danger_is_not_disturbed() -> None:
    lab = not_retracted(SchedulerSettings())
    again = killed(lab, SchedulerSettings())
    again.publish("ZCtrlParameters", Feedback(on=True))
    for _ in range(3):
        again.later(real_s=10.0)
        again.step(Tick())
    assert sent(again) == []


def test_retract_waiting_for_the_translator_is_dropped_once_the_tip_is_attended() -> None:
    lab = feedback_off()
    lab.step(TranslatorDown())
    lab.give_up("experiment")
    assert said(lab, "WARNING")[-1] == "x-retract will be sent when the translator is back, since its process died"
    lab.later(real_s=10.0)
    lab.step(Tick())
    assert said(lab, "CRITICAL") == ["the tip was left in danger and can't be retracted: its translator is not there"]
    lab.step(Tick())
    assert Problem.DEVICE_MALFUNCTION in lab.core.control.problems
    lab.mode("person", ControlMode.MANUAL)
    lab.publish("ZCtrlParameters", Feedback(on=True))
    lab.step(TranslatorUp())
    lab.later(real_s=10.0)
    lab.step(Tick())
    assert sent(lab) == []


def test_a_scan_that_goes_on_when_the_controller_is_found_again_is_stopped_and_the_tip_retracted() -> None:
    lab = feedback_off()
    lab.scope_is(ScopeState.SCANNING)
    lab.scope_is(ScopeState.UNDEFINED)
    lab.later(real_s=6.0)
    lab.step(Tick())
    for _ in range(3):
        lab.answer(lab.forwarded[-1], ControlResponse.NO_RESPONSE, detail=ResponseDetail.NOT_SENT)
    lab.scope_is(ScopeState.SCANNING)
    lab.later(real_s=10.0)
    lab.step(Tick())
    lab.step(Tick())
    assert sent(lab)[-1] == "stop-scan"
    lab.answer(lab.forwarded[-1])
    lab.scope_is(ScopeState.FREE)
    assert sent(lab)[-1] == "x-retract"


def asks_to_switch_off() -> Lab:
    """Return a core whose holder's request to switch the feedback off is with the translator."""
    lab = in_control(SchedulerSettings())
    lab.scope_is(ScopeState.FREE)
    lab.publish("ZCtrlParameters", Feedback(on=True))
    lab.ask("experiment", ControlRequest.SET_ZCTRL_PARAMS, OFF, "experiment/a/1")
    return lab


@pytest.mark.parametrize("in_time", [False, True])
def test_feedback_of_unknown_state_counts_as_off(in_time: bool) -> None:
    lab = asks_to_switch_off()
    if in_time:
        lab.answer(lab.forwarded[-1], ControlResponse.NO_RESPONSE, reason="the controller can't be reached")
    else:
        lab.later(real_s=11.0)
        lab.step(Tick())
    lab.give_up("experiment")
    assert sent(lab)[-1] == "x-retract"


def test_refused_switch_off_of_the_feedback_is_no_danger() -> None:
    lab = asks_to_switch_off()
    late = lab.forwarded[-1]
    lab.later(real_s=5.0)
    lab.step(Tick())
    lab.answer(late, ControlResponse.PARAM_ERROR)
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    assert sent(lab)[-1] != "x-retract"


def test_retract_is_sent_though_the_feedback_is_no_longer_known() -> None:
    # faults, mutant of watchdog.py: only a feedback that is on makes the retract unnecessary
    lab = in_control(SchedulerSettings())
    lab.scope_is(ScopeState.SCANNING)
    lab.ask("experiment", ControlRequest.SET_ZCTRL_PARAMS, OFF, "experiment/a/1")
    in_flight = lab.forwarded[-1]
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    lab.answer(in_flight, ControlResponse.PARAM_ERROR)
    assert sent(lab)[-1] == "stop-scan"
    lab.answer(lab.forwarded[-1])
    lab.scope_is(ScopeState.FREE)
    assert sent(lab)[-1] == "x-retract"


def test_a_scheduler_that_was_killed_knows_that_the_feedback_is_off() -> None:
    again = killed(feedback_off_and_saved(), SchedulerSettings())
    for _ in range(3):
        again.later(real_s=1.0)
        again.step(Tick())
    again.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    assert sent(again) == ["x-retract"]


def feedback_off_and_saved() -> Lab:
    lab = in_control(SchedulerSettings())
    lab.scope_is(ScopeState.FREE)
    lab.publish("ZCtrlParameters", OFF)
    return lab


def test_danger_left_by_hand_is_logged_when_the_mode_is_automated() -> None:
    lab = in_control(SchedulerSettings())
    lab.mode("person", ControlMode.MANUAL)
    lab.publish("ZCtrlParameters", OFF)
    lab.mode("person", ControlMode.AUTOMATED)
    assert (
        said(lab, "WARNING")[-1] == "the feedback is off, and no component is in control: the mode is automated again"
    )


def test_ending_experiment_retries_the_retract_and_then_leaves_it_to_the_translator() -> None:
    lab = not_retracted(SchedulerSettings())
    lab.ask("person", END)
    before = len(lab.forwarded)
    while not any(isinstance(effect, Kill) for effect in lab.effects):
        lab.answer(lab.forwarded[-1], ControlResponse.ACTION_ERROR)
        lab.later(real_s=1.0)
        lab.step(Tick())
    assert len(lab.forwarded) - before >= 5
    assert any("did not retract" in text for text in said(lab, "CRITICAL"))
    assert [effect.tip_is_safe for effect in lab.effects if isinstance(effect, Kill)] == [False]


def test_waiting_commands_are_not_sent_after_the_final_retract() -> None:
    lab = feedback_off()
    lab.ask("experiment", ACTION, "x-pulse", "experiment/a/1")
    lab.ask("experiment", ACTION, "x-engage", "experiment/a/2")
    lab.ask("person", END)
    lab.answer(lab.forwarded[-1])
    lab.answer(lab.forwarded[-1])
    assert sent(lab) == ["x-pulse", "x-retract"]


def test_run_stopped_in_danger_without_a_translator_is_critical() -> None:
    lab = feedback_off()
    lab.step(TranslatorDown())
    lab.step(Stopped())
    assert said(lab, "CRITICAL") == [
        "the run is stopped, the feedback is off, and no translator is there to retract the tip"
    ]


def test_repeated_end_during_a_retract_gets_one_answer_by_the_newest_connection() -> None:
    lab = feedback_off()
    lab.ask("experiment", END, None, "experiment/a/9")
    lab.ask("experiment", END, None, "experiment/a/9")
    lab.is_gone("experiment")
    newest = lab.connect("experiment")
    lab.ask("experiment", END, None, "experiment/a/9")
    lab.effects.clear()
    lab.answer(lab.forwarded[-1])
    lab.step(Tick())
    answers = [(reply.connection, reply.response.code) for reply in replies(lab.effects)]
    assert answers == [(newest, ControlResponse.SUCCESS)]


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


def test_ending_experiment_waits_for_a_bounded_time() -> None:
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


def test_scheduler_killed_during_the_end_retracts_first() -> None:
    lab = feedback_off()
    lab.ask("experiment", END)
    again = killed(lab, SchedulerSettings())
    assert sent(again) == ["x-retract"]
    assert not any(isinstance(effect, Kill) for effect in again.effects)
    assert kinds(again.answer(again.forwarded[-1]))[-1] == "Kill"


def test_an_experiment_without_danger_ends_at_once() -> None:
    lab = in_control(SchedulerSettings())
    assert kinds(lab.ask("experiment", END))[-1] == "Kill"


def restarted_over_a_retract() -> Lab:
    """Return a core restarted during a retract; a person took and gave back control, and the translator still hangs."""
    lab = feedback_off()
    lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    assert sent(lab) == ["x-retract"]
    again = Lab(state=lab.core.snapshot(), now=(lab.now_s, lab.now_ns))
    again.later(5.0)
    again.step(Tick())
    for mode in (ControlMode.MANUAL, ControlMode.AUTOMATED):
        again.mode("person", mode)
    again.take_control("corrector", Problem.TIP_SHAPE_CHANGED)
    again.step(TranslatorUp())
    assert not again.core.state.watchdog.owes_retract
    return again


def test_unanswered_retract_blocks_commands_after_a_restart_until_the_translator_answers() -> None:
    lab = restarted_over_a_retract()
    assert lab.says("corrector", ACTION, "start-scan") is ControlResponse.NOT_FREE
    assert "start-scan" not in sent(lab)


def test_retract_of_a_killed_scheduler_that_a_person_overrode_calls_a_person() -> None:
    lab = restarted_over_a_retract()
    lab.answer(lab.forwarded[0])  # the first question: the translator has served everything before it
    assert lab.core.state.watchdog.left_to_people
    lab.step(Tick())
    assert Problem.DEVICE_MALFUNCTION in lab.core.control.problems


def test_second_kill_does_not_forget_the_retract_of_the_first_life() -> None:
    again = Lab(state=restarted_over_a_retract().core.snapshot())
    again.step(TranslatorUp())
    assert again.says("corrector", ACTION, "start-scan") is ControlResponse.NOT_FREE


def restarted_with_feedback_off() -> Lab:
    lab = Lab(SchedulerSettings())
    lab.translator()
    lab.scope_is(ScopeState.FREE)
    lab.ask("experiment", ControlRequest.REQUEST_CTRL, 0, "experiment/a/1")
    lab.publish("ZCtrlParameters", OFF)
    lab.step(Disconnected(lab.connections.pop("experiment")))
    lab.ask("experiment", ControlRequest.REQUEST_CTRL, 0, "experiment/b/1")
    assert lab.holder == "experiment"
    return lab


@pytest.mark.parametrize("request_id", ["experiment/b/2", "experiment/key/tile/1"])
def test_restarted_holder_does_not_measure_with_the_feedback_off_of_its_earlier_life(request_id: str) -> None:
    lab = restarted_with_feedback_off()
    (reply,) = replies(lab.ask("experiment", ACTION, "start-scan", request_id))
    assert reply.response.code == ControlResponse.NOT_IN_CONTROL
    assert "its process died" in reply.response.reason
    assert sent(lab) == ["x-retract"]
    lab.answer(lab.forwarded[-1])
    lab.step(Tick())
    assert int(Problem.DEVICE_MALFUNCTION) in lab.core.control.problems


def test_restarted_scheduler_knows_that_the_holder_had_died_with_the_feedback_off() -> None:
    again = resumed(restarted_with_feedback_off(), SchedulerSettings())
    again.ask("experiment", ControlRequest.REQUEST_CTRL, 0, "experiment/c/1")
    (reply,) = replies(again.ask("experiment", ACTION, "start-scan", "experiment/c/2"))
    assert reply.response.code == ControlResponse.NOT_IN_CONTROL
    assert sent(again) == ["x-retract"]


@pytest.mark.parametrize("on", [True, False])
def test_restarted_holder_that_sets_the_feedback_itself_goes_on(on: bool) -> None:
    lab = restarted_with_feedback_off()
    lab.ask("experiment", ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=on), "experiment/b/2")
    lab.answer(lab.forwarded[-1])
    lab.publish("ZCtrlParameters", Feedback(on=on))
    lab.ask("experiment", ACTION, "start-spec", "experiment/b/3")
    assert sent(lab) == [Feedback(on=on), "start-spec"]
    assert lab.holder == "experiment"


def test_damaged_state_does_not_lose_the_holder_that_left_the_tip_in_danger(tmp_path: Path) -> None:
    lab = feedback_off()
    lab.publish("ZCtrlParameters", OFF)
    path, log = tmp_path / "scheduler.json", logging.getLogger("scheduler")
    file = StateFile(path, log)
    file.save(lab.core.snapshot())
    file.close()
    path.write_bytes(path.read_bytes() + b'{"kind": "sch')  # the power failed
    again = Lab(SchedulerSettings(), state=StateFile(path, log).load())
    again.translator()
    assert again.says("other", ControlRequest.REQUEST_CTRL, 0) is ControlResponse.ALREADY_UNDER_CONTROL
    again.later(real_s=SchedulerSettings().waits.restart_grace_s)
    again.step(Tick())
    assert sent(again) == ["x-retract"]
