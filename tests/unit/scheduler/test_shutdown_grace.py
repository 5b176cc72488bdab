"""After the end the scheduler stays while a component still runs, and no longer."""

from __future__ import annotations

import math

import pytest
from tests.unit.scheduler.logic_lab import Lab

from afspm.model import ControlRequest, ProcessCondition, ProcessState
from afspm.scheduler.control.lifecycle import LONGEST_GRACE_S, SHUTDOWN_GRACE_S

ALIVE, ENDED = ProcessCondition.ALIVE, ProcessCondition.ENDED
AT_WORK = [c for c in ProcessCondition if c not in (ENDED, ProcessCondition.GIVEN_UP)]


def state(condition: ProcessCondition, role: str = "component") -> ProcessState:
    return ProcessState("one", role, condition, 1)


@pytest.fixture
def lab() -> Lab:
    """A core whose experiment has just ended."""
    made = Lab()
    made.translator()
    made.tell(state(ALIVE))
    assert made.core.leave_at_s == math.inf
    made.ask("boss", ControlRequest.END_EXPERIMENT)
    assert made.core.leave_at_s == made.now_s + SHUTDOWN_GRACE_S
    return made


@pytest.mark.parametrize("condition", AT_WORK)
def test_scheduler_stays_while_a_component_runs_and_some_time_after(lab: Lab, condition: ProcessCondition) -> None:
    for _ in range(4):
        lab.later(2.0)
        lab.tell(state(condition))
        assert lab.core.leave_at_s == lab.now_s + SHUTDOWN_GRACE_S
    leave_at_s = lab.core.leave_at_s
    lab.later(1.0)
    lab.tell(state(ENDED))
    assert lab.core.leave_at_s == leave_at_s


def test_scheduler_stays_for_a_bounded_time(lab: Lab) -> None:
    latest_s = lab.now_s + LONGEST_GRACE_S
    while lab.now_s < latest_s:
        lab.later(2.0)
        lab.tell(state(ALIVE))
    assert lab.core.leave_at_s == latest_s


@pytest.mark.parametrize(
    "told",
    [
        state(ENDED),
        state(ProcessCondition.GIVEN_UP),
        state(ALIVE, "translator"),
        state(ALIVE, "scheduler"),
    ],
)
def test_scheduler_stays_no_longer_for_other_processes(lab: Lab, told: ProcessState) -> None:
    leave_at_s = lab.core.leave_at_s
    lab.later(1.0)
    lab.tell(told)
    assert lab.core.leave_at_s == leave_at_s


def test_former_report_does_not_count_when_another_supervisor_reports(lab: Lab) -> None:
    leave_at_s = lab.core.leave_at_s
    lab.later(1.0)
    lab.tell(state(ENDED), supervisor="supervisor:other")
    assert lab.core.leave_at_s == leave_at_s


def test_a_scheduler_that_was_killed_at_the_end_stays_too(lab: Lab) -> None:
    again = Lab(state=lab.core.snapshot())
    assert again.core.leave_at_s == again.now_s + SHUTDOWN_GRACE_S


def test_problem_after_the_end_is_recorded_at_once(lab: Lab) -> None:
    lab.entries()
    lab.ask("judge", ControlRequest.ADD_EXP_PRBLM, 1)
    (entry,) = lab.entries()
    assert (entry.who, entry.problem, entry.refused) == ("judge", 1, True)
    assert lab.core.state.control.problems == {}
