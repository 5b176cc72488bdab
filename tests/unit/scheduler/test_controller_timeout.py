"""A microscope that is lost or reports impossible values is flagged, and the flag is cleared when it is back."""

from __future__ import annotations

import pytest
from tests.unit.scheduler.logic_lab import Lab

from afspm.model import ControlResponse, Problem, ScopeState
from afspm.scheduler.events import Tick
from afspm.scheduler.settings import ControlSettings, SchedulerSettings

LOST = Problem.DEVICE_MALFUNCTION
PATIENCE_S = 3.0


@pytest.fixture
def lab() -> Lab:
    made = Lab(SchedulerSettings(control=ControlSettings(malfunction_after_s=PATIENCE_S)))
    made.translator()
    made.scope_is(ScopeState.FREE)
    assert made.take_control("series") is ControlResponse.SUCCESS
    return made


def lose(lab: Lab, for_s: float) -> None:
    """Lose the microscope for a time, with a tick at each deadline of the scheduler."""
    lab.scope_is(ScopeState.UNDEFINED)
    until_s = lab.now_s + for_s
    while (due_s := lab.core.deadline_s()) is not None and due_s <= until_s:
        lab.later(due_s - lab.now_s)
        lab.step(Tick())
    lab.later(until_s - lab.now_s)


def problems(lab: Lab) -> dict[int, str]:
    return dict(lab.core.control.problems)


def test_microscope_lost_for_a_moment_costs_nothing(lab: Lab) -> None:
    lose(lab, PATIENCE_S - 0.1)
    lab.scope_is(ScopeState.SCANNING)
    lab.later(100.0)
    lab.step(Tick())
    assert (problems(lab), lab.holder) == ({}, "series")
    assert lab.core.deadline_s() is None


def test_microscope_that_stays_lost_is_a_malfunction_and_frees_control(lab: Lab) -> None:
    lose(lab, PATIENCE_S)
    assert (problems(lab), lab.holder) == ({LOST: "translator"}, None)
    assert lab.take_control("series") is ControlResponse.WRONG_EXP_PROBLEM
    lab.entries()
    assert lab.core.deadline_s() is None  # there is nothing more to wait for


def test_malfunction_ends_when_the_microscope_is_back(lab: Lab) -> None:
    lose(lab, 10.0)
    lab.scope_is(ScopeState.FREE)
    assert problems(lab) == {}
    assert lab.take_control("series") is ControlResponse.SUCCESS


def test_flag_of_another_component_stays(lab: Lab) -> None:
    lab.flag("corrector", LOST)
    lose(lab, 10.0)
    lab.scope_is(ScopeState.FREE)
    assert problems(lab) == {LOST: "corrector"}


def test_the_flag_comes_again_as_long_as_the_microscope_is_lost(lab: Lab) -> None:
    lose(lab, 10.0)
    assert lab.clear("person", LOST) is ControlResponse.SUCCESS
    lab.step(Tick())
    assert problems(lab) == {LOST: "translator"}


def test_restarted_scheduler_knows_the_author_of_a_flag(lab: Lab) -> None:
    lose(lab, 10.0)
    again = Lab(state=lab.core.snapshot())
    again.translator()
    assert problems(again) == {LOST: "translator"}
    again.scope_is(ScopeState.FREE)
    assert problems(again) == {}


def test_loss_counts_from_its_first_report(lab: Lab) -> None:
    lose(lab, PATIENCE_S - 1.0)
    lose(lab, 1.0)  # the translator says it again to a scheduler that connects
    assert problems(lab) == {LOST: "translator"}
