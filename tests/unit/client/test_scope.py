"""Scope, with a scheduler that decides by the real table and a microscope in memory."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client_lab import OTHER_REGION, REGION, SCAN_S, SOURCE, Lab, LabPort

from afspm import model, wire
from afspm.basics.errors import (
    AfspmError,
    ControlLost,
    ExperimentEnded,
    InvalidValue,
    MeasurementFailed,
    NoResponse,
    Refused,
    UnitError,
)
from afspm.client.experiment_link import ExperimentLink
from afspm.client.scope import Scope
from afspm.model import (
    ActByHand,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Packet,
    PanelAct,
    ProbePosition,
    Problem,
    Region,
    Request,
    Response,
    Scan,
    ScopeState,
    ScopeStatus,
)
from afspm.scheduler.control.arbitration import ArbitrationEvent
from afspm.transport.port import CUT_OFF_SHOWS_WITHIN_S, CaughtUp
from afspm.transport.process.parent import StopRequested

TIP = Problem.TIP_SHAPE_CHANGED


def test_scan_has_all_channels_at_the_requested_place(lab: Lab, scope: Scope) -> None:
    scans = scope.scan(REGION, shape=(4, 6))
    assert list(scans) == ["Height", "Phase"]
    assert scans.region == REGION
    assert scans.first.shape == (4, 6)
    assert scans.interruptions == ()


def test_control_is_requested_and_released_by_each_call(lab: Lab, scope: Scope) -> None:
    scope.scan(REGION)
    assert lab.control.holder is None
    assert lab.count(ControlRequest.REQUEST_CTRL) == lab.count(ControlRequest.RELEASE_CTRL) == 1


def test_words_of_a_person_about_the_feedback_need_no_control_and_may_be_refused(lab: Lab, scope: Scope) -> None:
    answers = [Response(ControlResponse.SUCCESS), Response(ControlResponse.NOT_IN_CONTROL, reason="only a person")]
    asked = []

    def answer(request: Request) -> Response | str:
        if request.kind != ControlRequest.ACTION:
            return "go on"
        asked.append(request.subject)
        return answers.pop(0)

    lab.intercept = answer
    scope.feedback_may_be_off()
    with pytest.raises(Refused, match="only a person"):
        scope.feedback_may_be_off()
    assert asked == [model.names.FEEDBACK_MAY_BE_OFF] * 2
    assert lab.count(ControlRequest.REQUEST_CTRL) == 0


def test_an_explicit_block_keeps_control_over_several_calls(lab: Lab, scope: Scope) -> None:
    with scope.control():
        scope.scan(REGION)
        assert lab.control.holder == lab.name
        assert scope.in_control
        scope.scan(OTHER_REGION)
    assert lab.control.holder is None
    assert lab.count(ControlRequest.REQUEST_CTRL) == 1


def test_the_region_is_set_only_when_it_differs(lab: Lab, scope: Scope) -> None:
    for _ in range(3):
        scope.scan(REGION, shape=(8, 8))
    assert lab.count(ControlRequest.SET_SCAN_PARAMS) == 1
    scope.scan(OTHER_REGION)
    assert lab.count(ControlRequest.SET_SCAN_PARAMS) == 2


def test_a_region_in_sample_coordinates_is_set_each_time(lab: Lab, scope: Scope) -> None:
    region = model.Region((0.0, 0.0), (1e-6, 1e-6), frame=model.Frame.SAMPLE)
    scope.scan(region)
    scope.scan(region)
    assert lab.count(ControlRequest.SET_SCAN_PARAMS) == 2


def test_a_controller_that_rounds_is_not_set_again_and_again(lab: Lab, scope: Scope) -> None:
    coarse = model.Region((1e-9, 0.0), (1e-6, 1e-6))
    publish = lab.move
    lab.move = lambda thing: publish(model.ScanParameters(coarse, (8, 8)))  # type: ignore[method-assign]
    scope.scan(REGION)
    scope.scan(REGION)
    assert lab.count(ControlRequest.SET_SCAN_PARAMS) == 1


def test_a_problem_interrupts_and_the_scan_is_taken_when_it_is_cleared(lab: Lab, scope: Scope) -> None:
    lab.at(30.0, lambda: lab.flag(TIP))
    lab.at(500.0, lambda: lab.clear(TIP))
    scans = scope.scan(REGION)
    assert lab.clock.passed_s == pytest.approx(500.0 + SCAN_S, abs=5.0)
    assert len(scans.interruptions) == 1
    assert "tip-shape-changed" in scans.interruptions[0]
    assert lab.begun_scans == 2


def test_manual_mode_interrupts_with_a_reason(lab: Lab, scope: Scope) -> None:
    lab.at(30.0, lambda: lab.set_mode(ControlMode.MANUAL))
    lab.at(60.0, lambda: lab.set_mode(ControlMode.AUTOMATED))
    scans = scope.scan(REGION)
    assert "MANUAL" in scans.interruptions[0]


def test_scan_during_a_problem_waits_without_repeated_requests(lab: Lab, scope: Scope) -> None:
    lab.flag(TIP)
    lab.at(3600.0, lambda: lab.clear(TIP))
    scans = scope.scan(REGION)
    assert scans.interruptions == ()
    # once at the beginning, once at the end, and now and then in between should a message have been lost
    assert lab.count(ControlRequest.REQUEST_CTRL) <= 2 + 3600.0 / 10.0


def _grants_without_answer(lab: Lab, request: Request) -> str | None:
    if request.kind != ControlRequest.REQUEST_CTRL:
        return "go on"
    lab.does(ArbitrationEvent.REQUEST_CONTROL, lab.name)
    return None


def test_control_that_is_granted_after_the_timeout_is_released(lab: Lab, scope: Scope) -> None:
    lab.intercept = lambda request: _grants_without_answer(lab, request)
    with pytest.raises(NoResponse):
        scope.scan(REGION, timeout_s=0.5)
    assert lab.control.holder is None


def test_control_that_is_granted_after_an_interrupt_is_released(lab: Lab, scope: Scope) -> None:
    lab.intercept = lambda request: _grants_without_answer(lab, request)
    lab.at(0.5, lab.ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        scope.scan(REGION)
    assert lab.control.holder is None


def test_scan_waits_for_another_solver(lab: Lab, scope: Scope) -> None:
    lab.does(ArbitrationEvent.REQUEST_CONTROL, "other")
    lab.at(7.0, lambda: lab.does(ArbitrationEvent.RELEASE_CONTROL, "other"))
    scope.scan(REGION)
    assert lab.count(ControlRequest.REQUEST_CTRL) == 2


def test_region_is_set_again_after_another_component_moved_the_tip(lab: Lab, scope: Scope) -> None:
    def repair() -> None:
        lab.parameters = model.ScanParameters(OTHER_REGION, (8, 8))
        lab.publish(lab.parameters)
        lab.clear(TIP)

    lab.at(30.0, lambda: lab.flag(TIP))
    lab.at(60.0, repair)
    assert scope.scan(REGION).region == REGION


def test_restart_of_the_translator_costs_one_attempt(lab: Lab, scope: Scope) -> None:
    lab.at(50.0, lab.restart_translator)
    scans = scope.scan(REGION)
    assert lab.begun_scans == 2
    assert "restarted" in scans.interruptions[0]


def test_accepted_scan_that_never_begins_is_requested_again(lab: Lab, scope: Scope) -> None:
    swallowed: list[str] = []

    def swallow(request: model.Request) -> Response | str:
        if request.subject == "start-scan" and not swallowed:
            swallowed.append(request.id)
            return Response(ControlResponse.SUCCESS)
        return "go on"

    lab.intercept = swallow
    scope.scan(REGION)
    ids = [request.id for request in lab.requests if request.subject == "start-scan"]
    assert len(set(ids)) == 2


def test_scan_of_the_requested_shape_counts_without_values(lab: Lab, scope: Scope) -> None:
    """Some translators publish a scan's parameters and leave the values in the controller's files."""

    def publish(region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        lab.publish(Scan(region, "Height", "m", np.empty((0, 0)), lab.clock.now_ns(), "a.dat", shape))

    lab.publish_scan = publish  # type: ignore[method-assign]
    scans = scope.scan(REGION, shape=(8, 8))
    assert (scans.first.shape, scans.first.values.size, scans.first.filename) == ((8, 8), 0, "a.dat")
    assert lab.begun_scans == 1


def test_channels_that_got_lost_with_the_translator_are_noticed(lab: Lab, scope: Scope) -> None:
    scope.scan(REGION)

    def die_while_publishing() -> None:
        lab.publish(Scan(REGION, "Height", "m", np.zeros((8, 8)), lab.clock.now_ns()))
        lab.restart_translator()

    lab.at(50.0, die_while_publishing)
    scans = scope.scan(REGION)
    assert list(scans) == ["Height", "Phase"]
    assert "without Phase" in scans.interruptions[0]


def test_scan_of_nothing_but_nan_is_taken_again_and_given_up(lab: Lab, scope: Scope) -> None:
    def publish(region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        for channel in lab.channels:
            lab.publish(Scan(region, channel, "m", np.full(shape, np.nan), lab.clock.now_ns()))

    measured, lab.publish_scan = lab.publish_scan, publish  # type: ignore[method-assign]
    lab.at(150.0, lambda: setattr(lab, "publish_scan", measured))
    scans = scope.scan(REGION)
    assert "all are NaN" in scans.interruptions[0]
    assert lab.begun_scans == 2
    lab.publish_scan = publish  # type: ignore[method-assign]
    with pytest.raises(MeasurementFailed, match="failed 5 times: no channel has any value, all are NaN"):
        scope.scan(REGION)


def test_channel_of_nothing_but_nan_is_logged(lab: Lab, scope: Scope, caplog: pytest.LogCaptureFixture) -> None:
    def publish(region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        for channel, value in (("Height", 0.0), ("Phase", np.nan)):
            lab.publish(Scan(region, channel, "m", np.full(shape, value), lab.clock.now_ns()))

    lab.publish_scan = publish  # type: ignore[method-assign]
    assert list(scope.scan(REGION)) == ["Height", "Phase"]
    assert "scan without any value in Phase: NaN alone" in caplog.text


@pytest.mark.parametrize(
    ("how", "is_full", "said"),
    [
        ("stop", True, "the disk of the run is full"),
        ("stop", False, "stopped at the microscope, or its file is missing"),
        ("restart_translator", True, "the disk of the run is full"),
        ("restart_translator", False, "was it restarted"),
    ],
)
def test_scan_without_a_result_on_a_full_disk_names_the_disk(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str, is_full: bool, said: str
) -> None:
    monkeypatch.setattr("afspm.client.keyed_results.is_full", lambda folder: is_full)
    scope = Scope(ExperimentLink(LabPort(lab), lab.name, source=SOURCE), state_dir=tmp_path)
    for i in range(20):
        lab.at(50.0 * (i + 1), getattr(lab, how))
    with pytest.raises(MeasurementFailed, match=said):
        scope.scan(REGION)


def test_a_channel_that_is_switched_off_costs_one_scan_and_no_more(lab: Lab, scope: Scope) -> None:
    scope.scan(REGION)
    lab.channels = ("Height",)
    assert list(scope.scan(REGION)) == ["Height"]
    scope.scan(REGION)
    assert lab.begun_scans == 4


def test_repeatedly_stopped_scan_is_given_up(lab: Lab, scope: Scope) -> None:
    for i in range(20):
        lab.at(50.0 * (i + 1), lab.stop)
    with pytest.raises(NoResponse, match="failed 5 times"):
        scope.scan(REGION)


def test_scan_that_a_person_stops_is_never_given_up(lab: Lab, scope: Scope) -> None:
    def stop() -> None:
        if lab.state is ScopeState.SCANNING:
            lab.publish(ActByHand(lab.clock.now_ns(), PanelAct.STOP, "seen"))
            lab.stop()

    for i in range(8):
        lab.at(50.0 * (i + 1), stop)
    found = scope.scan(REGION)
    assert found.region == REGION
    by_hand = [why for why in found.interruptions if "the measurement was stopped at the microscope (seen)" in why]
    assert len(by_hand) > 5


def test_earlier_packets_are_not_taken_for_the_scan(lab: Lab, scope: Scope) -> None:
    lab.publish_scan(OTHER_REGION)
    lab.publish(ScopeStatus(ScopeState.FREE))
    assert scope.scan(REGION).region == REGION


def test_a_scan_whose_beginning_was_lost_with_the_connection_is_recognised(lab: Lab, scope: Scope) -> None:
    lose = lab.go

    def without_busy(state: ScopeState) -> None:
        if state is ScopeState.SCANNING:
            lab.state = state
        else:
            lose(state)

    lab.go = without_busy  # type: ignore[method-assign]
    lab.at(2.0, lambda: lab.publish_scan(REGION))
    lab.at(2.1, lambda: lose(ScopeState.FREE))
    scope.scan(REGION)
    assert lab.begun_scans == 1


def lose_second_channel(lab: Lab) -> None:
    """Lose the beginning and the second channel of the next scan, whose first one arrives after the state FREE."""
    go = lab.go

    def late_result() -> None:
        go(ScopeState.FREE)
        lab.publish_scan(REGION)
        lab.lost.append(lab.inbox.pop())

    def without_busy(state: ScopeState) -> None:
        lab.state = state
        lab.go = go  # type: ignore[method-assign]
        lab.at(2.0, late_result)

    lab.intercept = lambda request: (
        (setattr(lab, "go", without_busy) if request.subject == "start-scan" and not lab.begun_scans else None)
        or "go on"
    )


def test_lost_result_of_a_free_microscope_is_asked_for(
    lab: Lab, scope: Scope, caplog: pytest.LogCaptureFixture
) -> None:
    # faults 3
    lose_second_channel(lab)
    scans = scope.scan(REGION)
    assert list(scans) == ["Height", "Phase"]
    assert lab.begun_scans == 1
    assert lab.clock.passed_s < SCAN_S
    assert "the microscope has been free for 10 s, and its Scan2d has not arrived" in caplog.text


def test_lost_result_of_a_free_microscope_is_not_waited_for_without_end(lab: Lab, scope: Scope) -> None:
    # faults 3
    lose_second_channel(lab)
    lab.request_since = lambda since_ns: None  # type: ignore[method-assign]
    assert list(scope.scan(REGION)) == ["Height"]


def test_time_limit_ends_the_wait_for_a_lost_result(lab: Lab, scope: Scope) -> None:
    lose_second_channel(lab)
    with pytest.raises(NoResponse, match="not finished in time"):
        scope.scan(REGION, timeout_s=8.0)
    assert lab.clock.passed_s < 9.0


def test_scan_is_not_taken_twice_if_the_connection_is_cut_at_its_start(lab: Lab, scope: Scope) -> None:
    publish = lab.publish

    def withhold(thing: object, envelope: str | None = None) -> Packet:
        heard = list(lab.inbox)
        packet = publish(thing, envelope)
        lab.inbox[:] = heard
        return packet

    def cut(request: model.Request) -> str:
        if request.subject == "start-scan" and not lab.begun_scans:
            lab.publish = withhold  # type: ignore[method-assign]
            lab.at(CUT_OFF_SHOWS_WITHIN_S, lab.disconnect)
            lab.at(2 * SCAN_S, connect)
        return "go on"

    def connect() -> None:
        lab.publish = publish  # type: ignore[method-assign]
        lab.inbox += lab.replay()

    lab.intercept = cut
    assert scope.scan(REGION).region == REGION
    assert lab.begun_scans == 1


def test_repr_of_a_scope_shows_the_present_state(lab: Lab, scope: Scope) -> None:
    with scope.control():
        name = scope.control_state.holder
        assert repr(scope) == f"<Scope {name!r}: FREE, AUTOMATED, {name} is in control>"
    lab.flag(Problem.TIP_SHAPE_CHANGED)
    assert scope.control_state.problems
    assert "no component is in control, tip-shape-changed is flagged" in repr(scope)
    assert "'tip-shape-changed': 1" in repr(scope.problems)


def test_a_refusal_is_raised_with_its_reason(lab: Lab, scope: Scope) -> None:
    lab.intercept = lambda request: (
        Response(ControlResponse.PARAM_ERROR, reason="the limit of scan-size-x is 1 um")
        if request.kind == ControlRequest.SET_SCAN_PARAMS
        else "go on"
    )
    with pytest.raises(Refused, match="limit of scan-size-x") as caught:
        scope.scan(REGION)
    assert caught.value.response == ControlResponse.PARAM_ERROR
    assert lab.control.holder is None


def test_request_waits_for_a_busy_microscope(lab: Lab, scope: Scope) -> None:
    lab.state = ScopeState.BUSY_PARAM
    lab.at(12.0, lambda: lab.go(ScopeState.FREE))
    scope.scan(REGION)
    assert lab.begun_scans == 1
    assert lab.clock.passed_s > 12.0 + SCAN_S
    assert lab.count(ControlRequest.SET_SCAN_PARAMS) <= 4, "asked when it is free, not again and again"


def test_condition_that_is_waited_for_is_logged_once(lab: Lab, scope: Scope, caplog: pytest.LogCaptureFixture) -> None:
    warm = ["8.2 K", "7.9 K", "6 K"]

    def refuse_while_warm(request: model.Request) -> Response | str:
        if request.subject == "start-scan" and warm:
            return Response(ControlResponse.NOT_FREE, reason=f"the condition cold does not hold: it is {warm.pop(0)}")
        return "go on"

    lab.intercept = refuse_while_warm
    with caplog.at_level(logging.INFO):
        scope.scan(REGION)
    waits = [message for message in caplog.messages if message.startswith("waiting")]
    assert waits == ["waiting: the condition cold does not hold: it is 8.2 K"]


def test_a_lost_answer_repeats_the_request_with_its_id_and_executes_it_once(lab: Lab, scope: Scope) -> None:
    lost: list[str] = []

    def lose_first(request: model.Request) -> Response | str | None:
        if request.subject == "start-scan" and not lost:
            lost.append(request.id)
            lab.answer_once(request)
            return None
        return "go on"

    lab.intercept = lose_first
    scope.scan(REGION)
    starts = [request.id for request in lab.requests if request.subject == "start-scan"]
    assert len(starts) == 2
    assert len(set(starts)) == 1
    assert lab.begun_scans == 1


def test_unseen_scan_during_lost_control_is_not_taken_again(lab: Lab, scope: Scope) -> None:
    lab.begin_unheard(REGION, in_s=20.0)
    lab.at(5.0, lambda: lab.flag(TIP))
    lab.at(40.0, lambda: lab.clear(TIP))
    scope.scan(REGION, shape=(8, 8))
    assert lab.begun_scans == 1
    assert len({request.id for request in lab.requests if request.subject == "start-scan"}) == 1


def test_value_is_read_again_once_lost_control_is_back(lab: Lab, scope: Scope) -> None:
    silent = Response(ControlResponse.NO_RESPONSE, reason="not sent: the controller has not started yet")
    lab.intercept = lambda request: silent if request.kind == ControlRequest.PARAM else "go on"
    lab.at(5.0, lambda: lab.flag(TIP))
    lab.at(20.0, lambda: setattr(lab, "intercept", lambda request: "go on"))
    lab.at(30.0, lambda: lab.clear(TIP))
    with scope.control():
        assert scope.get("tip-bias-voltage") == 0.5


def test_scan_not_begun_before_lost_control_is_requested_with_the_same_id(lab: Lab, scope: Scope) -> None:
    lab.intercept = lambda request: (
        Response(ControlResponse.NO_RESPONSE)
        if request.subject == "start-scan" and lab.clock.passed_s < 20.0
        else "go on"
    )
    lab.at(5.0, lambda: lab.flag(TIP))
    lab.at(40.0, lambda: lab.clear(TIP))
    scope.scan(REGION, shape=(8, 8))
    assert lab.begun_scans == 1
    assert len({request.id for request in lab.requests if request.subject == "start-scan"}) == 1


def test_foreign_scan_during_lost_control_does_not_count(lab: Lab, scope: Scope) -> None:
    lab.begin_unheard(OTHER_REGION, in_s=20.0)  # a test scan of the repair; ours was begun and is lost
    lab.at(5.0, lambda: lab.flag(TIP))
    lab.at(40.0, lambda: lab.clear(TIP))
    assert scope.scan(REGION, shape=(8, 8)).region == REGION
    assert lab.begun_scans == 2


def test_silent_translator_gets_the_request_again_with_the_same_id(lab: Lab, scope: Scope) -> None:
    def silent(request: model.Request) -> Response | str:
        late = lab.clock.passed_s < 20.0 and request.kind == ControlRequest.SET_SCAN_PARAMS
        return Response(ControlResponse.NO_RESPONSE) if late else "go on"

    lab.intercept = silent
    scope.scan(REGION)
    sets = {request.id for request in lab.requests if request.kind == ControlRequest.SET_SCAN_PARAMS}
    assert len(sets) == 1


@pytest.mark.parametrize(("late_s", "warnings"), [(3.0, 0), (9.0, 1)])
def test_translator_without_a_connection_is_warned_of_only_after_a_while(
    lab: Lab, scope: Scope, caplog: pytest.LogCaptureFixture, late_s: float, warnings: int
) -> None:
    until_s, reason = lab.clock.passed_s + late_s, "not sent: the translator is not connected"

    def unconnected(request: model.Request) -> Response | str:
        if request.kind != ControlRequest.SET_SCAN_PARAMS or lab.clock.passed_s >= until_s:
            return "go on"
        return Response(ControlResponse.NO_RESPONSE, reason=reason, detail=model.ResponseDetail.NOT_SENT)

    lab.intercept = unconnected
    with caplog.at_level("WARNING"):
        scope.scan(REGION)
    assert [reason in record.getMessage() for record in caplog.records] == [True] * warnings


def test_translator_that_stays_silent_is_reported(lab: Lab, scope: Scope) -> None:
    lab.intercept = lambda request: (
        Response(ControlResponse.NO_RESPONSE) if request.kind == ControlRequest.PARAM else "go on"
    )
    with pytest.raises(NoResponse, match="does not answer"):
        scope.set("tip-bias-voltage", 1.0)


def test_schedulers_answer_about_a_slow_translator_precedes_a_repetition(lab: Lab, scope: Scope) -> None:
    done_s = lab.clock.passed_s + 25.0
    unanswered: set[float] = set()

    def slow(request: model.Request) -> str | None:
        if request.subject != "x-pulse":
            return "go on"
        assert not unanswered, "asked again too soon"
        asked_s, left_s = lab.clock.passed_s, done_s - lab.clock.passed_s
        unanswered.add(asked_s)
        code = ControlResponse.SUCCESS if left_s < 5.0 else ControlResponse.NO_RESPONSE

        def answer() -> None:
            unanswered.remove(asked_s)
            lab.answer_now(Response(code, id=request.id))

        lab.at(min(left_s, 5.0) + 0.01, answer)
        return None

    lab.intercept = slow
    scope.action("x-pulse")
    assert lab.clock.passed_s == pytest.approx(done_s, abs=0.1)


def test_scheduler_that_never_answers_is_reported(lab: Lab, scope: Scope) -> None:
    lab.intercept = lambda request: None
    with pytest.raises(NoResponse, match="sent 4 times"):
        scope.flag(TIP)


def test_restarted_scheduler_gets_the_request_again_with_the_same_id(lab: Lab, scope: Scope) -> None:
    down: list[str] = []

    def dies(request: model.Request) -> str | None:
        if request.kind == ControlRequest.ADD_EXP_PRBLM and not down:
            down.append(request.id)
            lab.at(0.1, lab.disconnect)
            lab.at(90.0, lab.connect)
            return None
        return "go on"

    lab.intercept = dies
    scope.flag(TIP)
    assert [request.id for request in lab.requests] == down * 2
    assert 90.0 < lab.clock.passed_s < 92.0
    assert TIP in lab.control.problems


def test_the_answer_to_an_earlier_request_is_not_taken_for_this_ones(lab: Lab, scope: Scope) -> None:
    from afspm.transport.port import ReplyReceived

    late = Response(ControlResponse.FAILURE, reason="of another", id="experiment/0/other")
    lab.intercept = lambda request: (lab.inbox.append(ReplyReceived(late)), "go on")[1]
    scope.flag(TIP)


def test_nothing_is_measured_before_the_schedulers_packets_arrive(lab: Lab, scope: Scope) -> None:
    """The cache may show that the measurement is already done."""
    lab.inbox.remove(CaughtUp(SOURCE))
    lab.at(100.0, lambda: lab.inbox.append(CaughtUp(SOURCE)))
    scope.scan(REGION)
    assert lab.clock.passed_s == pytest.approx(100.0 + SCAN_S, abs=5.0)


def test_measurement_without_packets_ends_at_its_timeout(lab: Lab, scope: Scope) -> None:
    lab.inbox.remove(CaughtUp(SOURCE))
    with pytest.raises(NoResponse, match="its packets do not arrive"):
        scope.scan(REGION, timeout_s=10.0)
    assert lab.begun_scans == 0


def test_problem_that_may_be_flagged_unseen_is_cleared(lab: Lab, scope: Scope) -> None:
    scope.flag(Problem.THERMAL_DRIFT)
    scope.clear(TIP)
    assert lab.count(ControlRequest.RMV_EXP_PRBLM) == 1


def test_missing_state_of_the_microscope_is_logged_once(
    lab: Lab, scope: Scope, caplog: pytest.LogCaptureFixture
) -> None:
    lab.inbox = [one for one in lab.inbox if getattr(getattr(one, "packet", None), "envelope", "") != "ScopeStateMsg"]
    lab.at(20.0, lambda: lab.publish(ScopeStatus(ScopeState.FREE)))
    scope.set("tip-bias-voltage", "1 V")
    assert [record.message for record in caplog.records if "has published no state yet" in record.message]
    assert lab.clock.passed_s == pytest.approx(20.0, abs=1.0)


def test_timeouts_are_reported_in_words(lab: Lab, scope: Scope) -> None:
    with pytest.raises(NoResponse, match="not finished in time"):
        scope.scan(REGION, timeout_s=50.0)
    lab.stop()
    lab.flag(TIP)
    with pytest.raises(ControlLost, match="not given in time"), scope.control(timeout_s=5.0):
        pass
    assert lab.clock.passed_s < 60.0


def test_only_flagged_problems_are_cleared(lab: Lab, scope: Scope) -> None:
    assert scope.clear_all() == ()
    lab.flag(TIP)
    lab.flag(4)
    assert set(scope.clear_all()) == {"tip-shape-changed", "thermal-drift"}
    assert not lab.control.problems


def test_a_solver_gets_control_and_loses_it_when_it_has_solved(lab: Lab, scope: Scope) -> None:
    lab.flag(TIP)
    with scope.control(solving="tip-shape-changed"):
        scope.action("x-pulse")
        scope.clear("EP_TIP_SHAPE_CHANGED")
        with pytest.raises(ControlLost, match="nothing to solve"):
            scope.action("x-pulse")
    assert lab.control.holder is None
    assert not lab.control.problems


def test_solving_an_unflagged_problem_is_refused_at_once(lab: Lab, scope: Scope) -> None:
    with pytest.raises(ControlLost, match="not flagged"), scope.control(solving=TIP):
        pass
    assert lab.clock.passed_s < 1.0


def test_waiting_solver_gets_an_error_when_another_has_solved_the_problem(lab: Lab, scope: Scope) -> None:
    lab.flag(TIP)
    lab.does(ArbitrationEvent.REQUEST_CONTROL, "other", TIP)
    lab.at(5.0, lambda: lab.clear(TIP))
    with pytest.raises(ControlLost, match="nothing to solve"), scope.control(solving=TIP):
        pass
    assert lab.clock.passed_s < 6.0


def test_an_error_in_the_block_still_gives_control_back(lab: Lab, scope: Scope) -> None:
    with pytest.raises(ZeroDivisionError), scope.control():
        _ = 1 / 0
    assert lab.control.holder is None


def test_an_old_control_state_is_not_taken_for_a_loss(lab: Lab, scope: Scope) -> None:
    """Control was granted; a state from before the grant arrives later."""

    def grant_quietly(request: model.Request) -> Response | str:
        if request.kind != ControlRequest.REQUEST_CTRL:
            return "go on"
        lab.at(0.5, lambda: lab.publish(model.ControlState(ControlMode.AUTOMATED, None, ())))
        lab.at(0.6, lambda: lab.publish(lab.control.published()))
        publish, lab.publish = lab.publish, lambda thing, envelope=None: None  # type: ignore[assignment,return-value]
        response = lab.answer(request)
        lab.publish = publish  # type: ignore[method-assign]
        return response

    lab.intercept = grant_quietly
    with scope.control():
        scope.scan(REGION)
        assert scope.in_control
    assert lab.count(ControlRequest.REQUEST_CTRL) == 1


def test_changes_that_leave_the_obstacle_cause_no_request(lab: Lab, scope: Scope) -> None:
    lab.flag(TIP)
    for second in range(1, 9):
        lab.at(second, lambda second=second: lab.flag(second + 10))  # type: ignore[misc]
        lab.at(second + 0.5, lambda second=second: lab.clear(second + 10))  # type: ignore[misc]
    lab.at(9.5, lambda: lab.clear(TIP))
    scope.scan(REGION)
    assert lab.count(ControlRequest.REQUEST_CTRL) == 2


def test_request_survives_repeated_restarts_of_the_scheduler(lab: Lab, scope: Scope) -> None:
    lives: list[str] = []

    def dies(request: model.Request) -> str | None:
        lives.append(request.id)
        if len(lives) > 8:
            return "go on"
        lab.at(0.1, lab.disconnect)
        lab.at(2.0, lab.connect)
        return None

    lab.intercept = dies
    scope.flag(TIP)
    assert len(set(lives)) == 1


def test_spectrum_is_taken_at_the_requested_place(lab: Lab, scope: Scope) -> None:
    spectrum = scope.spectrum((2e-7, 3e-7), kind="IV")
    assert spectrum.position_m == (2e-7, 3e-7)
    assert lab.values["x-spec-kind"] == "IV"
    assert lab.control.holder is None


def test_a_spectrum_of_another_kind_than_the_last_is_taken_once(lab: Lab, scope: Scope) -> None:
    assert [scope.spectrum((2e-7, 3e-7), kind=kind).kind for kind in ("IV", "force", "IV")] == ["IV", "force", "IV"]
    assert len(lab.executed) == 4, "more than the probe's move and three spectra"


def test_the_probe_stands_where_it_was_moved_to_when_the_call_returns(lab: Lab, scope: Scope) -> None:
    scope.move_probe((1e-7, 2e-7))
    assert scope.probe_position == model.ProbePosition((1e-7, 2e-7))
    assert scope.state is ScopeState.FREE


@pytest.mark.parametrize("shape", [np.array([4, 6]), (np.int64(4), np.int64(6)), [4, 6]])
def test_a_shape_may_be_of_numpy(lab: Lab, scope: Scope, shape: tuple[int, int]) -> None:
    assert scope.scan(REGION, shape=shape, key="once").first.shape == (4, 6)


def test_closed_scope_is_reported_as_closed(lab: Lab, scope: Scope) -> None:
    scope.scan(REGION)
    scope.close()
    for call in (lambda: scope.scan(REGION), lambda: scope.state, lambda: next(scope.events())):
        with pytest.raises(NoResponse, match=r"close\(\) has left"):
            call()


def test_a_place_may_be_an_array(lab: Lab, scope: Scope) -> None:
    place = np.array([2e-7, 3e-7])
    scope.move_probe(place)  # type: ignore[arg-type]
    assert scope.spectrum(place).position_m == (2e-7, 3e-7)  # type: ignore[arg-type]


def test_invalid_place_region_or_time_is_refused_with_a_valid_example(lab: Lab, scope: Scope) -> None:
    for wrong, hint in (
        (lambda: scope.spectrum(0), "(1e-7, 0)"),  # type: ignore[arg-type]
        (lambda: scope.move_probe((0.0, 0.0, 0.0)), "(1e-7, 0)"),  # type: ignore[arg-type]
        (lambda: scope.scan(1e-6), "Region("),  # type: ignore[arg-type]
        (lambda: scope.sleep("1 min"), "seconds"),  # type: ignore[arg-type]
        (lambda: scope.sleep(math.nan), "seconds"),
    ):
        with pytest.raises(InvalidValue) as refused:
            wrong()
        assert hint in refused.value.hint
    assert lab.executed == []


def test_parameters_have_units_both_ways(lab: Lab, scope: Scope) -> None:
    assert scope.set("tip-bias-voltage", 250.0, "mV") == pytest.approx(250.0)
    assert scope.get("tip-bias-voltage", "mV") == pytest.approx(250.0e3)  # the laboratory told V
    assert scope.set("tip-bias-voltage", "1.5 V") == 1.5
    assert scope.get("tip-bias-voltage") == 1.5


def test_a_unit_of_another_kind_is_refused(lab: Lab, scope: Scope) -> None:
    with pytest.raises(UnitError):
        scope.get("tip-bias-voltage", "nm")


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_value_that_is_not_finite_is_not_sent(lab: Lab, scope: Scope, value: float) -> None:
    with pytest.raises(InvalidValue):
        scope.set("tip-bias-voltage", value)
    assert not any(request.kind == ControlRequest.PARAM for request in lab.requests)


def test_switches_and_words_are_set_too(lab: Lab, scope: Scope) -> None:
    assert scope.set("x-light", True, "") is True
    assert lab.values["x-light"] == "true"
    assert scope.set("x-mode", "tapping", "") == "tapping"
    assert scope.set("x-light", np.False_, "") is False  # type: ignore[arg-type]
    for count in (np.float64(3.0), np.array(3.0)):
        assert scope.set("x-count", count, "") == 3.0  # type: ignore[arg-type]
        assert lab.values["x-count"] == "3.0"


def test_reading_needs_no_control(lab: Lab, scope: Scope) -> None:
    lab.flag(TIP)
    assert scope.get("tip-bias-voltage") == 0.5
    assert scope.supports("x-pulse")
    assert not scope.supports("x-crash")
    assert lab.count(ControlRequest.REQUEST_CTRL) == 0


def test_reading_takes_control_if_the_scheduler_requires_it(lab: Lab, scope: Scope) -> None:
    lab.intercept = lambda request: (
        Response(ControlResponse.NOT_IN_CONTROL)
        if request.kind == ControlRequest.PARAM and lab.control.holder != lab.name
        else "go on"
    )
    assert scope.get("tip-bias-voltage") == 0.5


def test_feedback_as_text_is_refused_with_the_call_that_takes_it(scope: Scope) -> None:
    with pytest.raises(InvalidValue, match="a finite number, not '80 pA'") as caught:
        scope.set_feedback(setpoint="80 pA")  # type: ignore[arg-type]
    assert 'scope.set("zctrl-setpoint", "50 pA")' in caught.value.hint


def test_set_feedback_returns_when_the_feedback_is_published(lab: Lab, scope: Scope) -> None:
    scope.set_feedback(on=np.False_, setpoint=2.0)  # type: ignore[arg-type]
    assert scope.feedback == model.Feedback(on=False, setpoint=2.0)


def test_mode_and_problems_are_seen(lab: Lab, scope: Scope) -> None:
    scope.flag(TIP)
    scope.set_mode(ControlMode.MANUAL)
    assert scope.mode is ControlMode.MANUAL
    assert scope.control_state.problems == (TIP,)


def test_the_end_of_the_experiment_ends_every_call(lab: Lab, scope: Scope) -> None:
    lab.at(30.0, lab.kill)
    with pytest.raises(ExperimentEnded):
        scope.scan(REGION)
    with pytest.raises(ExperimentEnded):
        scope.get("tip-bias-voltage")


def test_a_stop_goes_through_a_script_that_catches_everything(lab: Lab, scope: Scope) -> None:
    lab.at(30.0, lab.parent_goes)

    def script() -> None:
        try:
            scope.scan(REGION)
        except Exception:
            pytest.fail("a script would have gone on")

    with pytest.raises(StopRequested):
        script()
    assert lab.requests[-1].kind == ControlRequest.RELEASE_CTRL


def test_events_are_iterated_over_and_none_is_lost_in_the_body(lab: Lab, scope: Scope) -> None:
    seen = []
    lab.at(1.0, lambda: lab.publish_scan(REGION))
    with scope.events("Scan2d", timeout_s=500.0) as events:
        for event in events:
            assert isinstance(event.message, Scan)
            seen.append((event.message.region, event.message.channel))
            if len(seen) == 1:
                scope.scan(OTHER_REGION)
    assert seen == [(region, channel) for region in (REGION, OTHER_REGION) for channel in ("Height", "Phase")]


def test_events_that_wait_unread_are_not_new(lab: Lab, scope: Scope) -> None:
    assert scope.state is ScopeState.FREE
    lab.most_at_once = 16
    for _ in range(40):
        lab.publish_scan(OTHER_REGION)
    events = scope.events("Scan2d", timeout_s=10.0)
    lab.at(1.0, lambda: lab.publish_scan(REGION))
    assert [event.message.region for event in events] == [REGION, REGION]


@pytest.mark.parametrize("envelope", [["Scan2d"], "scan", "Peaks", 5])
def test_events_of_an_envelope_that_never_comes_are_refused(lab: Lab, scope: Scope, envelope: Any) -> None:
    with pytest.raises(InvalidValue, match="envelope"):
        scope.events(envelope)
    assert scope.scan(REGION).region == REGION


def test_prefix_of_an_envelope_in_either_length_is_accepted(scope: Scope) -> None:
    scope.events("", "Scan", "Scan2d_2000.0_Height")


def test_values_of_the_wrong_kind_are_refused_with_a_valid_example(lab: Lab, scope: Scope) -> None:
    with pytest.raises(InvalidValue, match="rows, columns"):
        scope.scan(REGION, shape=128)  # type: ignore[arg-type]
    for shape in ((127.5, 64), ("128", "64"), (math.inf, 64)):
        with pytest.raises(InvalidValue, match="256, 256"):
            scope.scan(REGION, shape=shape)  # type: ignore[arg-type]
    with pytest.raises(InvalidValue, match="key"):
        scope.scan(REGION, key=5)  # type: ignore[arg-type]
    with pytest.raises(InvalidValue, match="mode"):
        scope.set_mode("MANUAL")  # type: ignore[arg-type]
    sweep = scope.sweep({"scan-speed": [1e-6]}, measure="scans")  # type: ignore[arg-type]
    with pytest.raises(InvalidValue, match="scans"), sweep:
        pass
    assert not lab.requests


def test_the_end_of_the_experiment_ends_an_iteration(lab: Lab, scope: Scope) -> None:
    lab.at(5.0, lab.kill)
    assert [event.envelope for event in scope.events("Scan2d")] == []


def test_wait_until_returns_when_the_condition_holds(lab: Lab, scope: Scope) -> None:
    lab.at(40.0, lambda: lab.flag(TIP))
    assert scope.wait_until(lambda: TIP in scope.control_state.problems, timeout_s=100.0)
    assert 40.0 <= lab.clock.passed_s < 41.0
    assert not scope.wait_until(lambda: False, timeout_s=5.0)


def test_sleeping_passes_the_time_of_the_experiment(lab: Lab, scope: Scope) -> None:
    scope.sleep(900.0)
    assert lab.clock.passed_s == pytest.approx(900.0)


def test_request_waits_for_control_lost_during_silence(lab: Lab, scope: Scope) -> None:
    """Then the answer never comes: the scheduler forwards requests only for the holder of control."""
    lab.intercept = lambda request: (
        Response(ControlResponse.NO_RESPONSE)
        if request.subject == "start-scan" and lab.clock.passed_s < 300.0
        else "go on"
    )
    lab.at(10.0, lambda: lab.flag(TIP))
    lab.at(400.0, lambda: lab.clear(TIP))
    scope.scan(REGION)
    assert lab.begun_scans == 1


def test_an_action_whose_answer_and_control_were_lost_is_not_done_twice(lab: Lab, scope: Scope) -> None:
    done: list[str] = []

    def silent(request: model.Request) -> Response | str:
        if request.subject != "x-pulse":
            return "go on"
        if not done:
            lab.answer_once(request)
            lab.flag(TIP)
            lab.at(30.0, lambda: lab.clear(TIP))
        done.append(request.id)
        return Response(ControlResponse.NO_RESPONSE) if lab.clock.passed_s < 20.0 else "go on"

    lab.intercept = silent
    scope.action("x-pulse")
    assert len(set(done)) == 1
    assert lab.executed.count(done[0]) == 1


def test_a_scan_that_is_seen_to_begin_needs_no_answer(lab: Lab, scope: Scope) -> None:
    def lost(request: model.Request) -> Response | str:
        if request.subject != "start-scan":
            return "go on"
        lab.answer_once(request)
        return Response(ControlResponse.NO_RESPONSE, reason="outcome unknown")

    lab.intercept = lost
    assert scope.scan(REGION).region == REGION
    assert lab.begun_scans == 1


def test_only_the_newest_progress_of_a_tight_loop_waits_and_arrives(lab: Lab, scope: Scope) -> None:
    scope.scan(REGION)
    for done in range(10_000):
        scope.progress(done, 10_000)
    assert lab.count(model.RELAY_REQUEST) == 1
    scope.sleep(1.0)
    told = [request.subject for request in lab.requests if request.kind == model.RELAY_REQUEST]
    assert len(told) == 2
    assert wire.decode(told[-1].message, told[-1].payload).done == 9_999


def test_note_needs_no_control_and_has_the_time_of_its_scan(lab: Lab, scope: Scope) -> None:
    scans = scope.scan(REGION)
    scope.note("tip changed here", scan=scans)
    scope.note("the door slammed", time_ns=7)
    told = [wire.decode("Note", one.payload) for one in lab.told("Note")]
    assert [(note.who, note.text, note.scan_ns) for note in told] == [
        (lab.name, "tip changed here", scans.time_ns),
        (lab.name, "the door slammed", None),
    ]
    assert (told[0].time_ns, told[1].time_ns) == (scans.time_ns, 7)
    assert lab.count(ControlRequest.REQUEST_CTRL) == 1


def test_note_on_a_scan_of_unknown_time_is_refused(scope: Scope) -> None:
    scan = Scan(REGION, "Height", "m", np.zeros((2, 2)))
    with pytest.raises(InvalidValue, match="has no time of its end"):
        scope.note("here", scan=scan)


def test_a_place_may_be_text_with_units(lab: Lab, scope: Scope) -> None:
    scope.move_probe(("100 nm", 0.0))
    assert lab.position.xy_m == (1e-7, 0.0)
    with pytest.raises(UnitError):
        scope.move_probe(("1e-7", "0"))


def test_states_and_modes_are_shown_by_their_names(lab: Lab, scope: Scope) -> None:
    assert (str(scope.state), f"{scope.mode}") == ("FREE", "AUTOMATED")


def test_properties_of_a_scope_show_the_present_state(lab: Lab, scope: Scope) -> None:
    lab.flag(TIP)
    assert "tip-shape-changed is flagged" in repr(scope)


def _others_work_while_this_one_computes(lab: Lab, work: Callable[[], object]) -> None:
    # with more packets than one poll returns
    lab.does(ArbitrationEvent.REQUEST_CONTROL, "other")
    for _ in range(100):
        lab.publish(ScopeStatus(ScopeState.FREE))
    work()
    lab.does(ArbitrationEvent.RELEASE_CONTROL, "other")


def _put_probe(lab: Lab, xy_m: tuple[float, float]) -> None:
    lab.position = ProbePosition(xy_m)
    lab.publish(lab.position)


def test_property_is_the_present_one_after_many_unread_packets(lab: Lab, scope: Scope) -> None:
    assert scope.state is ScopeState.FREE
    lab.most_at_once = 16
    _others_work_while_this_one_computes(lab, lambda: _put_probe(lab, (5e-7, 0.0)))
    assert scope.probe_position == ProbePosition((5e-7, 0.0))


def test_probe_that_another_component_has_moved_unread_is_moved_back(lab: Lab, scope: Scope) -> None:
    lab.most_at_once = 16
    scope.move_probe((1e-7, 0.0))
    _others_work_while_this_one_computes(lab, lambda: _put_probe(lab, (5e-7, 0.0)))
    scope.move_probe((1e-7, 0.0))
    assert lab.position.xy_m == (1e-7, 0.0)


def test_probe_that_a_person_has_moved_unread_in_a_block_is_moved_back(lab: Lab, scope: Scope) -> None:
    lab.most_at_once = 16
    with scope.control():
        scope.move_probe((1e-7, 0.0))
        lab.set_mode(ControlMode.MANUAL)
        _others_work_while_this_one_computes(lab, lambda: _put_probe(lab, (5e-7, 0.0)))
        lab.set_mode(ControlMode.AUTOMATED)
        scope.move_probe((1e-7, 0.0))
    assert lab.position.xy_m == (1e-7, 0.0)


def test_packets_that_arrive_after_the_answer_of_a_grant_are_awaited(lab: Lab, scope: Scope) -> None:
    scope.move_probe((1e-7, 0.0))
    lab.most_at_once = 1

    def moved_before(request: Request) -> str:
        if request.kind == ControlRequest.REQUEST_CTRL:
            _put_probe(lab, (5e-7, 0.0))
        return "go on"

    lab.intercept = moved_before
    scope.move_probe((1e-7, 0.0))
    assert lab.position.xy_m == (1e-7, 0.0)


def test_unread_scan_of_another_component_is_not_taken_for_the_result(lab: Lab, scope: Scope) -> None:
    scope.scan(REGION)
    lab.most_at_once = 16

    def scanned() -> None:
        lab.publish(ScopeStatus(ScopeState.SCANNING))
        lab.publish_scan(REGION)
        lab.publish(ScopeStatus(ScopeState.FREE))

    _others_work_while_this_one_computes(lab, scanned)
    begun_s = lab.clock.passed_s
    scope.scan(REGION)
    assert lab.clock.passed_s >= begun_s + SCAN_S


def test_second_thread_is_refused_while_one_waits_in_a_call(lab: Lab, scope: Scope) -> None:
    refused: list[AfspmError] = []

    def ask() -> None:
        with pytest.raises(AfspmError, match="another thread") as caught:
            scope.get("tip-bias-voltage")
        refused.append(caught.value)

    def meanwhile() -> None:
        other = threading.Thread(target=ask)
        other.start()
        other.join()

    lab.at(50.0, meanwhile)
    assert scope.scan(REGION).interruptions == ()
    assert refused
    assert scope.get("tip-bias-voltage") == 0.5


def test_read_lets_an_instrument_measure_and_asks_the_microscope_as_get_does(lab: Lab, scope: Scope) -> None:
    lab.values["source.bias"] = "0.25"
    asked = []
    lab.intercept = lambda request: asked.append(request.subject.name) or "go on"
    assert (scope.read("source.bias"), scope.read("tip-bias-voltage")) == (0.25, 0.5)
    assert asked == ["source.bias.now", "tip-bias-voltage"]


def test_wait_accepts_a_target_that_the_instrument_has_rounded(lab: Lab, scope: Scope) -> None:
    lab.values |= {"source.bias": "0", "source.bias.target": "0.1667", "source.bias.busy": "false"}
    assert scope.set("source.bias", 1 / 6, "V", wait=True) == pytest.approx(1 / 6)
    lab.values["source.bias.target"] = "0.2"
    with pytest.raises(NoResponse, match=r"its target is 0\.2 now"):
        scope.set("source.bias", 1 / 6, "V", wait=True)


def test_setting_with_wait_is_sent_after_the_first_reading(lab: Lab, scope: Scope) -> None:
    lab.values |= {"source.bias": "0", "source.bias.target": "0.25", "source.bias.busy": "false"}
    connected_s = lab.clock.passed_s + 6.0

    def answer(request: model.Request) -> Response | str:
        is_bias = request.kind == ControlRequest.PARAM and request.subject.name == "source.bias"
        if is_bias and lab.clock.passed_s < connected_s:
            return Response(ControlResponse.PARAM_ERROR, reason="source.bias is not known: not connected yet")
        return "go on"

    lab.intercept = answer
    assert scope.set("source.bias", 0.25, "V", wait=True) == 0.25
    connected_s = math.inf
    with pytest.raises(Refused, match="not connected yet"):
        scope.set("source.bias", 0.25, "V", wait=True)


def test_wait_outlasts_a_restart_of_the_instrument_but_not_an_error(lab: Lab, scope: Scope) -> None:
    lab.values |= {"source.bias": "0", "source.bias.target": "0.25", "source.bias.busy": "false"}
    begun_s, lasts_s = lab.clock.passed_s, 30.0
    unknown = Response(ControlResponse.PARAM_ERROR, reason="source.bias is not known: status 400: no sensor")

    def answer(request: model.Request) -> Response | str:
        is_read = request.kind == ControlRequest.PARAM and request.subject.value is None
        return unknown if is_read and lab.clock.passed_s - begun_s < lasts_s else "go on"

    lab.intercept = answer
    assert scope.set("source.bias", 0.25, "V", wait=True) == 0.25
    assert lab.clock.passed_s - begun_s > lasts_s
    lasts_s = math.inf
    with pytest.raises(NoResponse, match=r"no value for 60 s .* status 400: no sensor"):
        scope.set("source.bias", 0.25, "V", wait=True)


MISTAKES: dict[str, Callable[[Scope], object]] = {
    "set: parameter": lambda scope: scope.set(b"scan-speed", 1.0),  # type: ignore[arg-type]
    "set: unit": lambda scope: scope.set("x-gain", 1.0, 5),  # type: ignore[arg-type]
    "set: x-gain": lambda scope: scope.set("x-gain", None),  # type: ignore[arg-type]
    "set: scan-speed": lambda scope: scope.set("scan-speed", 10**400),
    "get: timeout_s": lambda scope: scope.get("scan-speed", timeout_s="5"),  # type: ignore[arg-type]
    "action: name": lambda scope: scope.action(""),
    "flag: problem": lambda scope: scope.flag(math.nan),  # type: ignore[arg-type]
    "control: solving": lambda scope: scope.control(solving=1.5).__enter__(),  # type: ignore[arg-type]
    "set_mode: mode": lambda scope: scope.set_mode(-1),  # type: ignore[arg-type]
    "set_feedback: setpoint": lambda scope: scope.set_feedback(setpoint=math.nan),
    "progress: done": lambda scope: scope.progress(-1, 0),
    "progress: of": lambda scope: scope.progress(0, 10**20),
    "note: text": lambda scope: scope.note("\ud800"),
    "wait_until: condition": lambda scope: scope.wait_until(None),  # type: ignore[arg-type]
    "sweep: parameters": lambda scope: scope.sweep({1: [0.5]}),  # type: ignore[dict-item]
    "a place is": lambda scope: scope.move_probe((math.inf, 0.0)),
    "a scan of": lambda scope: scope.scan(REGION, shape=(10**20, 10)),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_wrong_argument_is_an_error_with_a_remedy_before_anything_is_sent(lab: Lab, scope: Scope, mistake: str) -> None:
    with pytest.raises(InvalidValue) as error:
        MISTAKES[mistake](scope)
    assert str(error.value).startswith(mistake)
    assert error.value.hint or "must be" in error.value.what
    sent = {request.kind for request in lab.requests}
    assert sent <= {ControlRequest.REQUEST_CTRL, ControlRequest.RELEASE_CTRL}
