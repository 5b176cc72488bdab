"""A z that its holder held without feedback is released when the holder loses control, through the whole scheduler."""

from __future__ import annotations

import pytest
from tests.unit.scheduler.core_parts import Held
from tests.unit.scheduler.logic_lab import Lab, in_control, killed

from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    Feedback,
    Parameter,
    Problem,
    Request,
    ScopeState,
    names,
)
from afspm.scheduler.events import Disconnected, Log, Tick
from afspm.scheduler.safety.limit_checker import LimitChecker
from afspm.scheduler.safety.limits import ExperimentLimits, Limit
from afspm.scheduler.settings import SchedulerSettings

ACTION = ControlRequest.ACTION
ON, OFF = Feedback(on=True), Feedback(on=False)


@pytest.fixture
def held() -> Lab:
    """A scheduler whose holder, `experiment`, holds z."""
    lab = in_control(SchedulerSettings())
    lab.scope_is(ScopeState.FREE)
    lab.publish("ZCtrlParameters", ON)
    lab.ask("experiment", ACTION, names.HOLD_Z)
    lab.publish("ZCtrlParameters", OFF)
    lab.answer(lab.forwarded[-1])
    lab.forwarded.clear()
    return lab


def sent(lab: Lab) -> list[object]:
    asked = [one.request for one in lab.forwarded]
    return [request.subject for request in asked if request.kind == ACTION]


def returns(lab: Lab) -> None:
    """Let the translator go the way back."""
    lab.answer(lab.forwarded[-1])
    lab.scope_is(ScopeState.MOVING)
    lab.publish("ZCtrlParameters", ON)
    lab.scope_is(ScopeState.FREE)


def dies(lab: Lab) -> None:
    lab.step(Disconnected(lab.connections["experiment"]))
    lab.later(60.0)
    lab.step(Tick())


def test_z_of_a_dead_holder_is_released_and_the_tip_stays(held: Lab) -> None:
    dies(held)
    assert sent(held) == [names.RELEASE_Z]
    returns(held)
    held.later(60.0)
    held.step(Tick())
    assert sent(held) == [names.RELEASE_Z], "the feedback is on: nothing is retracted"


# tip T9
def test_hold_that_is_not_answered_when_its_holder_dies_is_released() -> None:
    lab = in_control(SchedulerSettings())
    lab.scope_is(ScopeState.FREE)
    lab.publish("ZCtrlParameters", ON)
    lab.ask("experiment", ACTION, names.HOLD_Z)
    hold = lab.forwarded[-1]
    dies(lab)
    lab.publish("ZCtrlParameters", OFF)
    lab.answer(hold)
    assert sent(lab) == [names.HOLD_Z, names.RELEASE_Z]


@pytest.mark.parametrize("how", ["problem", "manual", "released"])
def test_z_is_released_however_control_is_lost(held: Lab, how: str) -> None:
    if how == "problem":
        held.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    elif how == "manual":
        held.says("page", ControlRequest.SET_CONTROL_MODE, int(ControlMode.MANUAL))
    else:
        held.says("experiment", ControlRequest.RELEASE_CTRL, 0)
    assert sent(held) == [names.RELEASE_Z]
    returns(held)
    held.later(60.0)
    held.step(Tick())
    assert sent(held) == [names.RELEASE_Z]


def test_scan_is_stopped_before_z_is_released(held: Lab) -> None:
    held.scope_is(ScopeState.SCANNING)
    dies(held)
    assert sent(held) == [names.STOP_SCAN]
    held.answer(held.forwarded[-1])
    assert sent(held) == [names.STOP_SCAN, names.RELEASE_Z]
    held.answer(held.forwarded[-1], ControlResponse.NOT_FREE)
    held.scope_is(ScopeState.INTERRUPTED)
    held.scope_is(ScopeState.FREE)
    assert sent(held)[2:] == [names.RELEASE_Z]
    returns(held)
    assert sent(held)[3:] == []


def test_refused_release_is_sent_again_once_the_microscope_is_free(held: Lab) -> None:
    dies(held)
    held.answer(held.forwarded[-1], ControlResponse.NOT_FREE)
    held.scope_is(ScopeState.FREE)
    assert sent(held) == [names.RELEASE_Z, names.RELEASE_Z]


# tip T9
def test_scan_in_a_hold_is_stopped_before_its_release_also_if_its_holder_gives_control_back(held: Lab) -> None:
    held.scope_is(ScopeState.SCANNING)
    held.says("experiment", ControlRequest.RELEASE_CTRL, 0)
    assert sent(held) == [names.STOP_SCAN]


def test_tip_is_retracted_if_the_feedback_is_not_on_in_time(held: Lab) -> None:
    dies(held)
    held.answer(held.forwarded[-1])
    held.scope_is(ScopeState.MOVING)
    assert sent(held) == [names.RELEASE_Z], "the way back takes its time"
    held.later(held.core.state.watchdog.settings.again_s + 0.1)
    held.step(Tick())
    assert sent(held) == [names.RELEASE_Z, names.RETRACT]


def test_refused_way_back_is_logged_and_the_tip_retracted(held: Lab) -> None:
    dies(held)
    held.answer(held.forwarded[-1], ControlResponse.ACTION_ERROR, reason="the way back failed")
    errors = [effect.text for effect in held.effects if isinstance(effect, Log) and effect.level == "ERROR"]
    assert errors == ["the microscope does not x-release-z: the way back failed"]
    assert sent(held) == [names.RELEASE_Z, names.RETRACT]


def test_released_z_is_released_once(held: Lab) -> None:
    held.ask("experiment", ACTION, names.RELEASE_Z)
    returns(held)
    held.says("experiment", ControlRequest.RELEASE_CTRL, 0)
    assert sent(held) == [names.RELEASE_Z]


def test_z_that_is_held_no_more_is_not_released_again(held: Lab) -> None:
    held.publish("ZCtrlParameters", ON)  # the translator has gone the way back by itself
    held.ask("experiment", ACTION, names.RELEASE_Z)
    held.answer(held.forwarded[-1], ControlResponse.ACTION_ERROR, reason="x-current was 3 nA")
    held.says("experiment", ControlRequest.RELEASE_CTRL, 0)
    assert sent(held) == [names.RELEASE_Z]


def test_restarted_scheduler_releases_the_z_of_a_holder_that_does_not_come_back(held: Lab) -> None:
    lab = killed(held, SchedulerSettings())
    lab.publish("ZCtrlParameters", OFF)
    lab.scope_is(ScopeState.FREE)
    lab.later(120.0)
    lab.step(Tick())
    assert sent(lab) == [names.RELEASE_Z]


def offset(value: str, unit: str = "pm") -> Request:
    return Request(int(ControlRequest.PARAM), Parameter(names.HELD_Z_OFFSET, value, unit), id="i")


@pytest.mark.parametrize(
    ("limit", "value", "why"),
    [
        (None, "-1", "is towards the sample, which no limit bounds: write [limits.x-held-z-offset] min = …"),
        (Limit(high=1e-9), "-1", "which no limit bounds"),
        (Limit(low=-100.0, unit="pm"), "-101", "below the lowest allowed, -100 pm"),
        (Limit(low=-1e-10), "-100", ""),
        (None, "100", ""),
    ],
)
def test_offset_towards_the_sample_needs_a_limit(limit: Limit | None, value: str, why: str) -> None:
    limits = ExperimentLimits({} if limit is None else {names.HELD_Z_OFFSET: limit})
    refusal = Held(LimitChecker(limits)).check("experiment", offset(value), 0)
    assert (refusal.reason if refusal else "") == why or (why and refusal and why in refusal.reason)
