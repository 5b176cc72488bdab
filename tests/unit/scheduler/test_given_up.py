"""A holder whose process is over loses control at once, and nobody else does."""

from __future__ import annotations

import pytest
from tests.unit.scheduler.logic_lab import Lab, killed, published

from afspm.model import ControlRequest, ProcessCondition, ProcessState
from afspm.scheduler.control.supervisor_registry import SILENT_S
from afspm.scheduler.events import TranslatorCaughtUp, TranslatorUp
from afspm.scheduler.settings import SchedulerSettings

ALIVE, RESTARTING = ProcessCondition.ALIVE, ProcessCondition.RESTARTING
ENDED, GIVEN_UP = ProcessCondition.ENDED, ProcessCondition.GIVEN_UP
GRACE_S = SchedulerSettings().control.grace_s


def state(condition: ProcessCondition, name: str = "series", starts: int = 1) -> ProcessState:
    return ProcessState(name, "component", condition, 1, starts=starts)


@pytest.fixture
def lab() -> Lab:
    """One in which the series is in control, and its supervisor has told that it lives."""
    made = Lab()
    made.translator()
    made.take_control("series")
    made.tell(state(ALIVE))
    made.later(1.0)
    return made


@pytest.mark.parametrize("condition", [ENDED, GIVEN_UP])
def test_who_is_over_loses_control_at_once_and_all_are_told(lab: Lab, condition: ProcessCondition) -> None:
    lab.is_gone("series")
    effects = lab.tell(state(condition))
    assert lab.holder is None
    assert "ControlState" in [packet.envelope for packet in published(effects)]


def test_who_is_being_restarted_keeps_control_for_its_grace(lab: Lab) -> None:
    lab.is_gone("series")
    lab.tell(state(RESTARTING))
    assert lab.holder == "series"
    lab.later(GRACE_S)
    lab.tell(state(RESTARTING))
    assert lab.holder is None


def test_that_it_is_over_may_be_known_before_its_connection_is_lost(lab: Lab) -> None:
    lab.tell(state(ENDED))
    assert lab.holder == "series"
    assert lab.core.deadline_s() is None
    lab.is_gone("series")
    lab.tell(state(ENDED))
    assert lab.holder is None


def test_who_is_connected_long_after_its_process_was_over_is_another_and_has_its_grace(lab: Lab) -> None:
    lab.tell(state(ENDED))
    lab.later(GRACE_S + 1.0)
    lab.is_gone("series")
    lab.tell(state(ENDED))
    assert lab.holder == "series"


def test_who_was_started_anew_by_hand_does_not_lose_control_by_what_is_said_again(lab: Lab) -> None:
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


def test_one_that_was_ordered_anew_and_is_over_again_loses_control_again(lab: Lab) -> None:
    lab.give_up("series")
    for starts in (2, 3):  # also where nothing was told of its life in between
        lab.later(1.0)
        lab.take_control("series")
        lab.later(1.0)
        lab.is_gone("series")
        lab.tell(state(GIVEN_UP, starts=starts))
        assert lab.holder is None


def test_who_is_over_on_one_computer_and_was_started_on_another_stays_in_control(lab: Lab) -> None:
    lab.is_gone("series")
    lab.tell(state(ALIVE), supervisor="supervisor:other")
    lab.tell(state(ENDED))
    assert lab.holder == "series"


def test_a_supervisor_that_has_not_been_heard_of_for_long_does_not_speak_for_it(lab: Lab) -> None:
    lab.tell(state(ALIVE), supervisor="supervisor:other")
    lab.later(SILENT_S + 1.0)
    lab.is_gone("series")
    lab.tell(state(ENDED))
    assert lab.holder is None


def test_only_a_supervisor_is_believed(lab: Lab) -> None:
    lab.is_gone("series")
    lab.tell(state(GIVEN_UP), supervisor="stranger:lab")
    assert lab.holder == "series"


def test_a_person_who_acts_by_a_component_that_is_over_loses_control(lab: Lab) -> None:
    lab.ask("series", ControlRequest.RELEASE_CTRL)
    lab.take_control("dashboard:Ada")
    lab.is_gone("dashboard:Ada")
    lab.tell(state(ENDED, "dashboard"))
    assert lab.holder is None


def test_the_scheduler_that_was_killed_meanwhile_hears_of_it_and_waits_for_what_was_before(lab: Lab) -> None:
    settings = SchedulerSettings()
    again = Lab(settings, state=lab.core.snapshot())
    again.tell(state(GIVEN_UP))
    assert again.holder == "series"
    again.step(TranslatorUp())
    again.step(TranslatorCaughtUp())
    again.tell(state(GIVEN_UP))
    assert again.holder is None


def test_what_a_killed_scheduler_knew_already_takes_nothing_from_who_was_in_control_since(lab: Lab) -> None:
    lab.give_up("series")
    lab.later(1.0)
    lab.take_control("series")
    again = killed(lab, SchedulerSettings())
    again.tell(state(GIVEN_UP))
    assert again.holder == "series"
