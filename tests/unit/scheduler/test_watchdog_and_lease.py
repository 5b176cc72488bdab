"""The actions that the scheduler itself sends to the microscope."""

from __future__ import annotations

from dataclasses import replace

import pytest
from tests.unit.scheduler.core_parts import Dog
from tests.unit.scheduler.logic_lab import Lab, killed

from afspm.model import LEASE_REQUEST, ControlEvent, ControlRequest, ControlResponse, ScopeState
from afspm.scheduler.control.arbitration import Cause
from afspm.scheduler.control.holder_timeout import Lease
from afspm.scheduler.events import Tick
from afspm.scheduler.safety.watchdog import SafetyResult, WatchdogSettings
from afspm.scheduler.settings import ControlSettings, SchedulerSettings, Waits

OK, NOT_FREE, SILENCE = (
    int(c) for c in (ControlResponse.SUCCESS, ControlResponse.NOT_FREE, ControlResponse.NO_RESPONSE)
)
SCANNING, SPEC, FREE = ScopeState.SCANNING, ScopeState.SPEC, ScopeState.FREE


def watchdog(*states: ScopeState, **settings: object) -> Dog:
    made = Dog(WatchdogSettings(**settings))  # type: ignore[arg-type]
    for state in states:
        made.state(state)
    return made


@pytest.mark.parametrize(("state", "stop"), [(SCANNING, ["stop-scan"]), (SPEC, ["stop-spec"]), (FREE, [])])
def test_running_measurement_is_stopped_when_control_is_taken(state: ScopeState, stop: list[str]) -> None:
    assert watchdog(FREE, state).control_taken(Cause.PROBLEM, None) == stop


@pytest.mark.parametrize("cause", [Cause.RELEASED, Cause.SOLVED])
def test_running_measurement_goes_on_when_control_is_released(cause: Cause) -> None:
    assert watchdog(SCANNING).control_taken(cause, None) == []


def test_experiment_file_may_let_the_measurement_run() -> None:
    assert watchdog(SCANNING, stop_when={Cause.MANUAL}).control_taken(Cause.PROBLEM, None) == []


def test_a_scan_that_is_just_being_started_is_stopped_too() -> None:
    assert watchdog(FREE).control_taken(Cause.PROBLEM, "start-scan") == ["stop-scan"]
    begun = watchdog(FREE)
    begun.started("start-scan", begun.states_seen)
    assert begun.control_taken(Cause.PROBLEM, None) == ["stop-scan"]


def test_start_whose_states_have_come_already_is_not_running() -> None:
    done = watchdog(FREE)
    seen = done.states_seen
    done.state(SCANNING)
    done.state(FREE)
    done.started("start-scan", seen)
    assert done.control_taken(Cause.PROBLEM, None) == []


def test_a_dead_holder_s_tip_is_retracted_in_a_dangerous_state_once_it_has_stopped() -> None:
    dog = watchdog(FREE)
    dog.feedback(on=False)
    dog.state(SCANNING)
    assert dog.control_taken(Cause.DEAD, None) == ["stop-scan", "x-retract"]
    assert dog.owes_retract
    assert dog.next_action() == "stop-scan"
    assert dog.next_action() is None
    assert dog.answered(OK, 0.0) is SafetyResult.DONE
    assert dog.next_action() is None
    dog.state(ScopeState.INTERRUPTED)
    assert dog.next_action() == "x-retract"
    assert dog.answered(NOT_FREE, 0.0) is SafetyResult.AGAIN
    assert dog.next_action() is None
    dog.state(FREE)
    assert dog.next_action() == "x-retract"
    assert dog.answered(OK, 0.0) is SafetyResult.DONE
    assert not dog.owes_retract


def off(*states: ScopeState, **settings: object) -> Dog:
    """Return a watchdog that knows that the feedback is off."""
    made = watchdog(*states, **settings)
    made.feedback(on=False)
    return made


@pytest.mark.parametrize("cause", [Cause.PROBLEM, Cause.IDLE, Cause.DEAD, Cause.ENDED, Cause.SOLVED])
def test_the_tip_is_retracted_where_the_holder_could_not_put_the_danger_right(cause: Cause) -> None:
    assert off(FREE).control_taken(cause, None) == ["x-retract"]
    assert off(SCANNING, stop_when=()).control_taken(cause, None) == ["stop-scan", "x-retract"]
    assert watchdog(FREE).control_taken(cause, None) == []


@pytest.mark.parametrize("cause", [Cause.RELEASED, Cause.SOLVED, Cause.MANUAL])
def test_danger_left_knowingly_is_logged_once_and_not_retracted(cause: Cause) -> None:
    dog = off(FREE)
    assert dog.control_taken(cause, None, by_holder=cause is not Cause.MANUAL) == []
    assert dog.untold() == "the feedback is off"
    assert dog.untold() is None
    dog.feedback(on=True)
    assert dog.untold() is None
    dog.feedback(on=False)
    assert dog.untold() == "the feedback is off"


def test_attended_danger_is_neither_logged_nor_retracted() -> None:
    dog = off(FREE)
    dog.control_taken(Cause.PROBLEM, None)
    assert dog.next_action() == "x-retract"
    assert dog.answered(OK, 0.0) is SafetyResult.DONE
    assert dog.untold() is None
    assert dog.control_taken(Cause.ENDED, None) == []


def retracted() -> Dog:
    dog = off(FREE)
    dog.control_taken(Cause.PROBLEM, None)
    dog.next_action()
    dog.answered(OK, 0.0)
    dog.state(ScopeState.COARSE_MOTOR)
    dog.feedback(on=False)  # as a controller says that has withdrawn its tip
    return dog


def test_withdrawn_tip_is_in_no_danger_until_it_may_be_back() -> None:
    dog = retracted()
    dog.started("start-scan", dog.states_seen)
    assert dog.danger is None
    assert dog.control_taken(Cause.PROBLEM, None) == ["stop-scan"]
    dog.feedback(on=True)
    dog.feedback(on=False)
    assert dog.danger == "the feedback is off"
    for action in ("x-engage", "x-approach-of-mine"):
        dog = retracted()
        dog.started(action, dog.states_seen)
        assert dog.danger == "the feedback is off"
        dog.started("x-retract", dog.states_seen, certain=False)
        assert dog.danger == "the feedback is off"
        dog.started("x-retract", dog.states_seen)
        assert dog.danger is None


def test_danger_without_a_retract_is_logged() -> None:
    dog = off(FREE, retract=None)
    assert dog.control_taken(Cause.PROBLEM, None) == []
    assert dog.untold() == "the feedback is off"
    assert watchdog(ScopeState.COARSE_MOTOR).untold() == "the microscope is in COARSE_MOTOR"
    assert off(FREE, dangerous=()).untold() is None


def test_scan_of_a_dead_holder_is_only_stopped_with_the_feedback_on() -> None:
    dog = watchdog(SCANNING)
    dog.feedback(on=True)
    assert dog.control_taken(Cause.DEAD, None) == ["stop-scan"]


def test_a_microscope_that_can_not_retract_is_not_asked_to() -> None:
    dog = watchdog(ScopeState.COARSE_MOTOR)
    dog.watchdog = dog.watchdog.with_retract(is_supported=False)
    assert dog.control_taken(Cause.DEAD, None) == []
    dog.watchdog = dog.watchdog.with_retract(is_supported=True)  # by the translator that was started next
    assert dog.control_taken(Cause.DEAD, None) == ["x-retract"]
    assert watchdog(ScopeState.COARSE_MOTOR, retract=None).control_taken(Cause.DEAD, None) == []


def test_action_without_a_response_is_retried_and_then_fails() -> None:
    dog = watchdog(SCANNING, attempts=3)
    dog.control_taken(Cause.MANUAL, None)
    results = []
    for _ in range(3):
        assert dog.next_action() == "stop-scan"
        results.append(dog.answered(SILENCE, 0.0))
    assert results == [SafetyResult.AGAIN, SafetyResult.AGAIN, SafetyResult.FAILED]
    assert dog.tip.stops == ()


def test_unsent_stop_is_sent_when_the_translator_is_back_unless_the_scan_has_ended() -> None:
    dog = watchdog(SCANNING)
    dog.control_taken(Cause.MANUAL, None)
    dog.next_action()
    dog.tell("unsent", 0.0)
    assert dog.next_action() == "stop-scan"
    dog.tell("unsent", 0.0)
    dog.state(FREE)
    assert dog.next_action() is None


ERROR = int(ControlResponse.ACTION_ERROR)


def refused(**settings: object) -> Dog:
    """Return a watchdog whose retract failed at 100 s."""
    dog = off(FREE, **settings)
    dog.control_taken(Cause.DEAD, None)
    assert dog.next_action() == "x-retract"
    assert dog.answered(ERROR, 100.0) is SafetyResult.FAILED
    return dog


def test_failed_retract_is_retried_at_growing_intervals() -> None:
    dog = refused(again_s=10.0, longest_s=30.0)
    times, now_s = [], 100.0
    for _ in range(4):
        assert dog.left_to_people
        assert dog.put_off
        assert dog.next_action() is None
        assert dog.due_s is not None
        times.append(dog.due_s - now_s)
        now_s = dog.due_s
        assert dog.look_again(now_s, is_seen_to=False) is None
        assert not dog.put_off
        assert dog.next_action() == "x-retract"
        assert dog.answered(ERROR, now_s) is SafetyResult.FAILED
    assert times == [10.0, 20.0, 30.0, 30.0]
    dog.look_again(now_s + 30.0, is_seen_to=False)
    assert dog.next_action() == "x-retract"
    assert dog.answered(OK, now_s + 30.0) is SafetyResult.DONE
    assert (dog.due_s, dog.danger, dog.owes_retract) == (None, None, False)


def test_component_attending_to_the_tip_is_not_disturbed() -> None:
    dog = refused()
    dog.look_again(110.0, is_seen_to=True)
    assert (dog.next_action(), dog.due_s) == (None, None)
    dog = refused()
    dog.control_taken(Cause.MANUAL, None)
    assert (dog.next_action(), dog.due_s) == (None, None)
    dog = refused()
    dog.control_taken(Cause.RELEASED, None, was_seen_to=True)
    assert (dog.next_action(), dog.due_s) == (None, None)


def test_release_by_a_holder_not_attending_to_the_tip_keeps_the_duty() -> None:
    dog = refused()
    dog.control_taken(Cause.SOLVED, None, by_holder=True)
    assert dog.put_off
    dog.look_again(110.0, is_seen_to=False)
    assert dog.next_action() == "x-retract"


def test_tip_is_retracted_at_once_when_its_solver_dies() -> None:
    dog = refused()
    assert dog.control_taken(Cause.DEAD, None, was_seen_to=True) == ["x-retract"]
    assert dog.next_action() == "x-retract"


def test_tip_out_of_danger_by_then_is_not_retracted() -> None:
    dog = refused()
    dog.feedback(on=True)
    dog.look_again(110.0, is_seen_to=False)
    assert (dog.next_action(), dog.due_s) == (None, None)


def test_retract_at_a_microscope_never_free_is_put_off_and_a_person_called() -> None:
    dog = off(FREE, again_s=10.0)
    dog.control_taken(Cause.DEAD, None)
    dog.next_action()
    assert dog.answered(NOT_FREE, 100.0) is SafetyResult.AGAIN
    assert (dog.due_s, dog.left_to_people, dog.put_off) == (110.0, False, False)
    told = dog.look_again(110.0, is_seen_to=True)
    assert told == "the tip was left in danger and can't be retracted: the microscope is never free for that"
    assert (dog.due_s, dog.left_to_people, dog.put_off) == (120.0, True, True)
    dog.look_again(120.0, is_seen_to=False)
    assert dog.next_action() == "x-retract"


def test_retract_without_a_translator_is_put_off_and_logged() -> None:
    dog = off(FREE, again_s=10.0)
    dog.control_taken(Cause.DEAD, None)
    dog.next_action()
    dog.tell("unsent", 100.0)
    assert dog.due_s == 110.0
    told = dog.look_again(110.0, is_seen_to=False)
    assert told == "the tip was left in danger and can't be retracted: its translator is not there"
    assert dog.left_to_people
    dog.tell("translator_is_there", 115.0)
    assert dog.due_s == 116.0, "what it says of the feedback is heard first"


def restarted(dog: Dog) -> Dog:
    again = Dog(WatchdogSettings())
    again.tell("restored", dog.tip)
    again.microscope = replace(again.microscope, risk=dog.microscope.risk)
    return again


def test_retract_without_a_translator_after_a_restart_is_put_off_and_logged() -> None:
    dog = off(FREE)
    dog.control_taken(Cause.DEAD, None)
    again = restarted(dog)
    again.tell("begun", 100.0)
    assert again.look_again(110.0, is_seen_to=False) is not None
    assert again.left_to_people


def test_restarted_scheduler_repeats_its_unanswered_retract() -> None:
    dog = off(FREE)
    dog.control_taken(Cause.DEAD, None)
    assert dog.next_action() == "x-retract"
    again = restarted(dog)
    assert again.next_action() == "x-retract"
    again.tell("seen_to")
    assert again.owes_retract, "what the microscope is being asked can't be called off"


def test_a_late_withdrawal_leaves_nothing_owed_but_a_person_to_call() -> None:
    dog = refused()
    dog.tell("people_called")
    dog.tell("done_late", "x-retract")
    assert (dog.owes_retract, dog.due_s, dog.left_to_people) == (False, None, True)


@pytest.mark.parametrize("answer", [OK, ERROR, NOT_FREE])
def test_unstoppable_scan_does_not_prevent_the_retract(answer: int) -> None:
    dog = off(SCANNING, again_s=10.0)
    dog.control_taken(Cause.DEAD, None)
    assert dog.next_action() == "stop-scan"
    dog.answered(answer, 100.0)
    dog.state(SCANNING)
    if answer == NOT_FREE:
        assert dog.next_action() == "stop-scan"
        dog.answered(answer, 100.0)
    if answer != ERROR:
        assert dog.next_action() is None
        assert dog.due_s == 110.0
        assert dog.look_again(110.0, is_seen_to=False) is not None
    assert dog.next_action() == "x-retract"


def test_a_scan_that_was_not_seen_when_control_was_taken_is_stopped_first() -> None:
    dog = off(ScopeState.UNDEFINED)
    assert dog.control_taken(Cause.PROBLEM, None) == ["x-retract"]
    dog.state(SCANNING)
    assert dog.next_action() == "stop-scan"
    dog.answered(OK, 0.0)
    dog.state(ScopeState.INTERRUPTED)
    assert dog.next_action() == "x-retract"


def test_lost_microscope_keeps_its_last_state() -> None:
    dog = watchdog(ScopeState.COARSE_MOTOR, ScopeState.UNDEFINED)
    assert dog.danger == "the microscope is in COARSE_MOTOR"
    assert dog.control_taken(Cause.PROBLEM, None) == ["x-retract"]


def test_unknown_feedback_counts_as_off_until_known() -> None:
    dog = watchdog(FREE)
    dog.feedback(on=True)
    dog.feedback_may_be_off()
    assert dog.danger == "the feedback is off"
    dog.feedback_was_left()
    assert dog.danger is None
    dog.feedback_may_be_off()
    dog.feedback(on=False)
    dog.feedback_was_left()
    assert dog.danger == "the feedback is off"


def test_unsupported_action_is_not_retried() -> None:
    dog = off(FREE)
    dog.control_taken(Cause.DEAD, None)
    dog.next_action()
    assert dog.answered(int(ControlResponse.ACTION_NOT_SUPPORTED), 0.0) is SafetyResult.FAILED
    assert (dog.due_s, dog.owes_retract, dog.left_to_people) == (None, False, True)


NS = 10**9


def test_idle_holder_has_a_deadline_that_commands_move() -> None:
    lease = Lease(60 * NS).held_by("greedy", 0)
    assert lease.deadline_ns(is_free=True) == 60 * NS
    assert lease.used(30 * NS).deadline_ns(is_free=True) == 90 * NS


def test_while_the_microscope_works_its_holder_is_not_idle() -> None:
    lab = Lab(SchedulerSettings(control=ControlSettings(lease_s=60.0)))
    lab.translator()
    lab.take_control("experiment")
    assert lab.core.deadline_ns() is not None
    lab.scope_is(SCANNING)
    assert lab.core.deadline_ns() is None
    lab.later(experiment_s=1000.0)
    lab.scope_is(FREE)
    assert lab.core.deadline_ns() == lab.now_ns + 60 * NS


def test_repeated_request_for_control_does_not_renew_a_lease() -> None:
    lease = Lease(60 * NS).held_by("greedy", 0).held_by("greedy", 59 * NS)
    assert lease.deadline_ns(is_free=True) == 60 * NS


def test_without_a_lease_or_a_holder_there_is_no_deadline() -> None:
    assert Lease().held_by("greedy", 0).deadline_ns(is_free=True) is None
    assert Lease(NS).deadline_ns(is_free=True) is None


def leased(lab: Lab, lease_s: float = 20.0) -> Lab:
    """Return a core with a running scan, whose holder requested a lease."""
    lab.translator()
    lab.scope_is(FREE)
    lab.take_control("gateway:Ada")
    assert lab.says("gateway:Ada", LEASE_REQUEST, lease_s) is ControlResponse.SUCCESS
    lab.scope_is(SCANNING)
    return lab


def test_requested_lease_runs_out_during_a_scan_and_stops_it() -> None:
    lab = leased(Lab(SchedulerSettings()))
    until_s = lab.now_s + 20.0
    lab.entries()
    assert lab.core.deadline_s() == until_s
    lab.later(real_s=19.8)
    lab.step(Tick())
    assert lab.holder == "gateway:Ada"
    lab.later(real_s=0.2)
    lab.step(Tick())
    assert lab.holder is None
    assert lab.forwarded[-1].request.subject == "stop-scan"
    assert [entry.reason for entry in lab.entries() if entry.event is ControlEvent.CONTROL_LOST] == [Cause.IDLE.text]


def test_renewals_and_commands_restart_a_requested_lease_and_a_release_ends_it() -> None:
    lab = leased(Lab(SchedulerSettings()))
    lab.later(real_s=15.0)
    assert lab.says("gateway:Ada", LEASE_REQUEST, 20.0) is ControlResponse.SUCCESS
    lab.later(real_s=15.0)
    lab.ask("gateway:Ada", ControlRequest.ACTION, "stop-scan", "gateway:Ada/a/1")
    lab.later(real_s=15.0)
    lab.step(Tick())
    assert lab.holder == "gateway:Ada"
    lab.says("gateway:Ada", ControlRequest.RELEASE_CTRL)
    lab.take_control("gateway:Ada")
    lab.later(real_s=1000.0)
    lab.step(Tick())
    assert lab.holder == "gateway:Ada", "it asked for no lease this time"


def test_only_the_holder_has_a_lease() -> None:
    lab = leased(Lab(SchedulerSettings()))
    assert lab.says("gateway:Max", LEASE_REQUEST, 1.0) is ControlResponse.NOT_IN_CONTROL
    lab.later(real_s=19.0)
    lab.step(Tick())
    assert lab.holder == "gateway:Ada"


def test_requested_lease_outlives_the_scheduler_and_restarts() -> None:
    settings = SchedulerSettings(waits=Waits(restart_grace_s=1000.0))
    lab = killed(leased(Lab(settings)), settings)
    lab.later(real_s=19.0)
    lab.step(Tick())
    assert lab.holder == "gateway:Ada"
    lab.later(real_s=21.0)
    lab.step(Tick())
    lab.step(Tick())
    assert lab.holder is None
