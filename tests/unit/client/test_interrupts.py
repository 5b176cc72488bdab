"""Ctrl-C during a measurement of a script or notebook: the measurement is stopped, or reported as running."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from client_lab import REGION, SCAN_S, Lab

from afspm.client.scope import Scope
from afspm.model import ControlMode, Request, Response, ScopeState


@pytest.fixture(autouse=True)
def as_in_a_script() -> Iterator[None]:
    """Set the default handler of Ctrl-C, also under a runner that ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def test_interrupted_scan_is_stopped_and_control_released(
    lab: Lab, scope: Scope, caplog: pytest.LogCaptureFixture
) -> None:
    lab.at(30.0, lab.ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        scope.scan(REGION)
    assert (lab.state, lab.control.holder) == (ScopeState.FREE, None)
    assert lab.finished == []
    assert caplog.messages[-2:] == ["interrupted; stopping the scan", "the scan was stopped"]
    assert scope.scan(REGION).interruptions == ()
    assert lab.clock.passed_s < 40.0 + SCAN_S


def test_a_spectrum_is_stopped_as_well(lab: Lab, scope: Scope) -> None:
    lab.at(30.0, lab.ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        scope.spectrum((1e-7, 0.0))
    assert (lab.state, lab.control.holder) == (ScopeState.FREE, None)


def test_a_second_ctrl_c_does_not_keep_the_scan_from_being_stopped(lab: Lab, scope: Scope) -> None:
    def stopping(request: Request) -> Response | str:
        if request.subject == "stop-scan":
            lab.ctrl_c()
        return "go on"

    lab.intercept = stopping
    lab.at(30.0, lab.ctrl_c)
    lab.at(30.0, lab.ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        scope.scan(REGION)
    assert (lab.state, lab.control.holder) == (ScopeState.FREE, None)
    scope.scan(REGION)


def test_scan_that_cannot_be_stopped_is_reported(lab: Lab, scope: Scope, caplog: pytest.LogCaptureFixture) -> None:
    lab.intercept = lambda request: "no answer" if request.subject == "stop-scan" else "go on"
    lab.at(30.0, lab.ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        scope.scan(REGION)
    assert lab.state is ScopeState.SCANNING
    assert lab.clock.passed_s < 50.0
    assert caplog.messages[-1] == "the scan goes on; stop it with scope.action('stop-scan')"
    with caplog.at_level("INFO"):
        scope.scan(REGION)
    assert "waiting until the microscope is free; it is SCANNING" in caplog.messages


def test_scan_with_an_unanswered_start_is_stopped(lab: Lab, scope: Scope) -> None:
    def unanswered(request: Request) -> Response | str:
        if request.subject == "start-scan":
            lab.answer_once(request)
            lab.at(0.0, lab.ctrl_c)
            return "no answer"
        return "go on"

    lab.intercept = unanswered
    with pytest.raises(KeyboardInterrupt):
        scope.scan(REGION)
    assert (lab.state, lab.control.holder) == (ScopeState.FREE, None)


def test_nothing_is_stopped_while_control_is_waited_for(
    lab: Lab, scope: Scope, caplog: pytest.LogCaptureFixture
) -> None:
    lab.set_mode(ControlMode.MANUAL)
    lab.at(30.0, lab.ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        scope.scan(REGION)
    assert "stop-scan" not in [request.subject for request in lab.requests]
    assert not [message for message in caplog.messages if "stop" in message]


def test_a_keyed_scan_is_taken_at_the_next_call(lab: Lab, scope: Scope) -> None:
    lab.at(30.0, lab.ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        scope.scan(REGION, key="tile")
    assert scope.scan(REGION, key="tile").region == REGION
    assert len(lab.finished) == 1


def test_unanswered_action_is_reported_as_sent(lab: Lab, scope: Scope, caplog: pytest.LogCaptureFixture) -> None:
    lab.intercept = lambda request: "no answer" if request.subject == "x-pulse" else "go on"
    lab.at(1.0, lab.ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        scope.action("x-pulse")
    assert lab.control.holder is None
    assert caplog.messages[-1] == "interrupted before the answer: the microscope may have carried out x-pulse"


def test_a_program_that_handles_ctrl_c_itself_is_left_alone(lab: Lab, scope: Scope) -> None:
    heard: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
    try:
        lab.at(30.0, lab.ctrl_c)
        scope.scan(REGION)
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    assert heard == [signal.SIGINT]


def test_interrupt_between_two_waits_of_a_thread_is_heeded(lab: Lab, scope: Scope) -> None:
    def wait_twice() -> None:
        interrupts = scope._link.interrupts
        with interrupts.heeded():
            with interrupts.heeded():
                pass
            scope.interrupt()
            with interrupts.heeded():
                interrupts.heed()

    with ThreadPoolExecutor(1) as thread, pytest.raises(KeyboardInterrupt):
        thread.submit(wait_twice).result()
