"""Requests that belong together are sent in one tenure of control, or from the beginning again."""

from __future__ import annotations

import pytest
from client_lab import REGION, Lab

from afspm import model
from afspm.basics.errors import ControlLost, NoResponse
from afspm.client.scope import Scope
from afspm.model import ControlMode, ControlResponse, Problem, Response
from afspm.transport.process.parent import StopRequested

TIP = Problem.TIP_SHAPE_CHANGED


def taken_over_before(lab: Lab, subject: str) -> None:
    """Have a person set MANUAL just before this action arrives, and hand back later."""

    def person(request: model.Request) -> Response | str:
        if request.subject == subject:
            lab.intercept = lambda request: "go on"
            lab.set_mode(ControlMode.MANUAL)
            lab.at(60.0, lambda: lab.set_mode(ControlMode.AUTOMATED))
        return "go on"

    lab.intercept = person


def test_unbroken_block_does_not_continue_after_lost_control(lab: Lab, scope: Scope) -> None:
    taken_over_before(lab, "start-spec")
    with scope.control(unbroken=True):
        scope.move_probe((1e-6, 0.0))
        with pytest.raises(ControlLost, match="control was lost: you are not in control"):
            scope.action("start-spec")
    assert lab.begun_scans == 0
    with scope.control(unbroken=True):  # waits for control
        scope.action("start-spec")
    assert lab.begun_scans == 1
    assert lab.control.holder is None


def test_unbroken_block_stays_broken_though_control_is_free_again(lab: Lab, scope: Scope) -> None:
    with scope.control():
        with scope.control(unbroken=True):
            lab.set_mode(ControlMode.MANUAL)
            lab.set_mode(ControlMode.AUTOMATED)
            for _ in range(2):
                with pytest.raises(ControlLost):
                    scope.set("tip-bias-voltage", 1.0)
            with pytest.raises(ControlLost):
                scope.scan(REGION)
        assert lab.begun_scans == 0
        scope.set("tip-bias-voltage", 1.0)  # the block around it waits, as ever
    assert lab.values["tip-bias-voltage"] == "1.0"


def test_a_scan_in_an_unbroken_block_is_not_taken_again(lab: Lab, scope: Scope) -> None:
    lab.at(30.0, lambda: lab.flag(TIP))
    lab.at(500.0, lambda: lab.clear(TIP))
    with pytest.raises(ControlLost), scope.control(unbroken=True):
        scope.scan(REGION)
    assert lab.begun_scans == 1
    assert len(scope.scan(REGION).interruptions) == 0


def test_action_of_unknown_outcome_is_distinguished_from_one_not_done(lab: Lab, scope: Scope) -> None:
    def silent(request: model.Request) -> Response | str:
        if request.subject != "start-spec":
            return "go on"
        lab.set_mode(ControlMode.MANUAL)
        return Response(ControlResponse.NO_RESPONSE, reason="the translator is not connected")

    lab.intercept = silent
    with pytest.raises(NoResponse, match="before the action was answered"), scope.control(unbroken=True):
        scope.action("start-spec")


def sleep_with_feedback_off(scope: Scope) -> None:
    with scope.control():
        scope.set_feedback(on=False)
        scope.sleep(60.0)


@pytest.mark.parametrize("was_on", [True, False])
def test_stopped_process_keeps_control_if_it_leaves_the_feedback_off(lab: Lab, scope: Scope, *, was_on: bool) -> None:
    scope.set_feedback(on=was_on)
    lab.at(5.0, lab.parent_goes)
    with pytest.raises(StopRequested):
        sleep_with_feedback_off(scope)
    assert lab.control.holder == ("experiment" if was_on else None)
