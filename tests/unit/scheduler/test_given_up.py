"""A holder whose process has ended for good loses control at once; no other component does."""

from __future__ import annotations

import pytest
from tests.unit.scheduler.logic_lab import Lab, killed, published

from afspm.model import ControlRequest, ProcessCondition, ProcessState, ScopeState
from afspm.scheduler.control.holder_timeout import MOST_RESTARTS
from afspm.scheduler.control.supervisor_registry import SILENT_S
from afspm.scheduler.events import Tick, TranslatorCaughtUp, TranslatorUp
from afspm.scheduler.settings import SchedulerSettings

ALIVE, RESTARTING = ProcessCondition.ALIVE, ProcessCondition.RESTARTING
ENDED, GIVEN_UP = ProcessCondition.ENDED, ProcessCondition.GIVEN_UP
GRACE_S = SchedulerSettings().control.grace_s


def state(condition: ProcessCondition, name: str = "series", starts: int = 1) -> ProcessState:
    return ProcessState(name, "component", condition, 1, starts=starts)


@pytest.fixture
def lab() -> Lab:
    """A core with the series in control, whose supervisor has reported it alive."""
    made = Lab()
    made.translator()
    made.take_control("series")
    made.tell(state(ALIVE))
    made.later(1.0)
    return made


@pytest.mark.parametrize("condition", [ENDED, GIVEN_UP])
def test_ended_holder_loses_control_at_once_and_it_is_published(lab: Lab, condition: ProcessCondition) -> None:
    lab.is_gone("series")
    effects = lab.tell(state(condition))
    assert lab.holder is None
    assert "ControlState" in [packet.envelope for packet in published(effects)]


def test_restarting_holder_keeps_control_for_its_grace(lab: Lab) -> None:
    lab.is_gone("series")
    lab.tell(state(RESTARTING))
    assert lab.holder == "series"
    lab.later(GRACE_S)
    lab.tell(state(RESTARTING))
    assert lab.holder is None


def test_exit_may_be_known_before_the_connection_is_lost(lab: Lab) -> None:
    lab.tell(state(ENDED))
    assert lab.holder == "series"
    assert lab.core.deadline_s() is None
    lab.is_gone("series")
    lab.tell(state(ENDED))
    assert lab.holder is None


def test_holder_connected_long_after_an_exit_is_another_process_with_its_grace(lab: Lab) -> None:
    lab.tell(state(ENDED))
    lab.later(GRACE_S + 1.0)
    lab.is_gone("series")
    lab.tell(state(ENDED))
    assert lab.holder == "series"


def test_holder_restarted_by_hand_keeps_control_when_the_exit_is_reported_again(lab: Lab) -> None:
    lab.give_up("series")
    lab.later(1.0)
    lab.take_control("series")
    for _ in range(3):
        lab.later(2.0)
        lab.tell(state(GIVEN_UP))
        assert lab.holder == "series"
    lab.is_gone("series")
    lab.tell(state(GIVEN_UP))
    assert lab.holder == "series"  # it may have lost its connection only


def test_holder_restarted_by_order_that_ends_again_loses_control_again(lab: Lab) -> None:
    lab.give_up("series")
    for starts in (2, 3):  # also where nothing was told of its life in between
        lab.later(1.0)
        lab.take_control("series")
        lab.later(1.0)
        lab.is_gone("series")
        lab.tell(state(GIVEN_UP, starts=starts))
        assert lab.holder is None


def test_holder_restarted_again_and_again_loses_control_once_the_microscope_is_free(lab: Lab) -> None:
    lab.scope_is(ScopeState.SCANNING)
    for starts in range(2, MOST_RESTARTS + 2):
        assert lab.holder == "series"
        lab.tell(state(ALIVE, starts=starts))
    assert lab.holder == "series"  # a restarted component waits for its scan, and keeps it
    lab.scope_is(ScopeState.FREE)
    lab.step(Tick())
    assert lab.holder is None


def test_restarts_before_control_was_given_do_not_count(lab: Lab) -> None:
    lab.tell(state(ALIVE, starts=MOST_RESTARTS))
    lab.ask("series", ControlRequest.RELEASE_CTRL)
    lab.take_control("series")
    for starts in range(MOST_RESTARTS, 2 * MOST_RESTARTS):
        lab.tell(state(ALIVE, starts=starts))
        assert lab.holder == "series"


def test_holder_moved_to_another_computer_stays_in_control(lab: Lab) -> None:
    lab.is_gone("series")
    lab.tell(state(ALIVE), supervisor="supervisor:other")
    lab.tell(state(ENDED))
    assert lab.holder == "series"


def test_report_of_a_silent_supervisor_does_not_count(lab: Lab) -> None:
    lab.tell(state(ALIVE), supervisor="supervisor:other")
    lab.later(SILENT_S + 1.0)
    lab.is_gone("series")
    lab.tell(state(ENDED))
    assert lab.holder is None


def test_only_reports_of_a_supervisor_count(lab: Lab) -> None:
    lab.is_gone("series")
    lab.tell(state(GIVEN_UP), supervisor="stranger:lab")
    assert lab.holder == "series"


def test_person_loses_control_with_the_ended_component(lab: Lab) -> None:
    lab.ask("series", ControlRequest.RELEASE_CTRL)
    lab.take_control("dashboard:Ada")
    lab.is_gone("dashboard:Ada")
    lab.tell(state(ENDED, "dashboard"))
    assert lab.holder is None


def test_restarted_scheduler_revokes_control_of_an_ended_holder_after_missed_packets(lab: Lab) -> None:
    settings = SchedulerSettings()
    again = Lab(settings, state=lab.core.snapshot())
    again.tell(state(GIVEN_UP))
    assert again.holder == "series"
    again.step(TranslatorUp())
    again.step(TranslatorCaughtUp())
    again.tell(state(GIVEN_UP))
    assert again.holder is None


def test_exit_known_before_a_kill_does_not_take_control_from_a_later_holder(lab: Lab) -> None:
    lab.give_up("series")
    lab.later(1.0)
    lab.take_control("series")
    again = killed(lab, SchedulerSettings())
    again.tell(state(GIVEN_UP))
    assert again.holder == "series"
