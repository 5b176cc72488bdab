"""The answers and packets of a translator (wire format, "What a translator does, and in which order peers see it")."""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from afspm import wire
from afspm.basics.errors import ConfigError, Refused, WireError
from afspm.basics.exit_codes import ExitCode
from afspm.client.cycle import Cycle, CycleOutcome
from afspm.driver import action
from afspm.model import (
    CLOCK_REQUEST,
    ControlRequest,
    ControlResponse,
    Feedback,
    LogLine,
    Parameter,
    ProbePosition,
    Region,
    ResponseDetail,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    TipStatus,
    names,
)
from afspm.model.events import NO_LONGER_TRUE
from afspm.storage.memory import Memory
from afspm.translator.driver_base import ControllerLost
from afspm.translator.polling import OVERDUE_RATIO, OVERDUE_S
from afspm.transport.port import ParentGone, RequestReceived, SubscriberJoined
from afspm.transport.process.parent import TIP_WITHIN_S
from afspm.wire.generated import feedback_pb2, scan_pb2

ACTION, PARAM, SUPPORT = ControlRequest.ACTION, ControlRequest.PARAM, ControlRequest.ACTION_SUPPORT
FRAME, POSITION = ControlRequest.SET_SCAN_PARAMS, ControlRequest.SET_PROBE_POS
OK, NOT_FREE, PARAM_ERROR = ControlResponse.SUCCESS, ControlResponse.NOT_FREE, ControlResponse.PARAM_ERROR


def told(response: Any) -> tuple[str | None, str | None]:
    assert response.code == OK, response.reason
    parameter = wire.decode_parameter(response.payload)
    return parameter.value, parameter.unit


def test_at_the_start_everything_in_force_is_published(make_bench: Any) -> None:
    assert make_bench().heard() == ["ScanParameters2d", "ZCtrlParameters", "ProbePosition", "FREE"]


def test_everything_is_published_again_for_a_new_scheduler(bench: Any) -> None:
    bench.translator.handle(SubscriberJoined())
    assert bench.heard() == ["ScanParameters2d", "ZCtrlParameters", "ProbePosition", "FREE"]


def test_unchanged_values_are_not_published(bench: Any) -> None:
    for _ in range(5):
        bench.look()
    assert bench.heard() == []


def test_scan_is_published_as_scanning_all_channels_free(bench: Any, scan: Any) -> None:
    assert bench.ask(ACTION, names.START_SCAN).code == OK
    assert bench.heard() == ["SCANNING"]
    bench.look()
    assert bench.heard() == []
    bench.microscope.files["a"] = [scan("Height"), scan("Phase")]
    bench.microscope.state = ScopeState.FREE
    bench.look()
    assert bench.heard() == ["Scan2d", "Scan2d", "FREE"]


def test_scan_over_before_a_look_is_published_as_a_whole(bench: Any, scan: Any) -> None:
    def at_once() -> None:
        bench.microscope.files["a"] = [scan()]

    bench.translator.requests.commands.actions[names.START_SCAN] = _with(
        bench.translator.requests.commands.actions[names.START_SCAN], at_once
    )
    assert bench.ask(ACTION, names.START_SCAN).code == OK
    assert bench.heard() == ["SCANNING", "Scan2d", "FREE"]


def _with(action: Any, do: Any) -> Any:
    from dataclasses import replace

    return replace(action, do=do)


def test_a_scan_taken_at_the_panel_is_published_too(bench: Any, scan: Any) -> None:
    bench.microscope.state = ScopeState.SCANNING
    bench.look()
    bench.microscope.files["a"] = [scan()]
    bench.microscope.state = ScopeState.FREE
    bench.look()
    bench.microscope.files["b"] = [scan()]  # begun and ended between two looks
    bench.look()
    assert bench.heard() == ["SCANNING", "Scan2d", "FREE", "SCANNING", "Scan2d", "FREE"]


def test_a_file_that_comes_late_is_waited_for(bench: Any, scan: Any) -> None:
    bench.ask(ACTION, names.START_SCAN)
    bench.microscope.state = ScopeState.FREE
    bench.microscope.files["a"] = None  # half written
    bench.look()
    assert bench.heard() == ["SCANNING"]
    bench.microscope.files["a"] = [scan()]
    bench.look()
    assert bench.heard() == ["Scan2d", "FREE"]


def test_a_scan_without_a_file_ends_as_interrupted(bench: Any) -> None:
    bench.ask(ACTION, names.START_SCAN)
    bench.microscope.state = ScopeState.FREE
    bench.look()
    bench.look(after_s=10.0)
    assert bench.heard() == ["SCANNING", "INTERRUPTED", "FREE"]


@pytest.mark.parametrize("lost", [False, True])
def test_the_tip_does_not_go_on_scanning_when_the_run_is_stopped(bench: Any, lost: bool) -> None:
    bench.ask(ACTION, names.START_SCAN)
    bench.microscope.lost = lost
    assert bench.run_to_the_end(ParentGone()) == ExitCode.ORPHAN
    assert bench.microscope.done == (["scan"] if lost else ["scan", "stop"])
    assert bench.heard() == (["SCANNING", "UNDEFINED"] if lost else ["SCANNING", "INTERRUPTED", "FREE"])


# tip T9
def test_tip_does_not_go_on_with_a_curve_when_the_run_is_stopped(bench: Any, tmp_path: Path) -> None:
    class WithCurves(type(bench.microscope)):  # type: ignore[misc]
        @action(names.STOP_SPEC)
        def stop_spec(self) -> None:
            self.done.append("stop spec")
            self.state = ScopeState.FREE

    made = type(bench)(tmp_path, None, WithCurves)
    assert made.ask(ACTION, names.START_SPEC).code == OK
    assert made.run_to_the_end(ParentGone()) == ExitCode.ORPHAN
    assert made.microscope.done == ["spec", "stop spec"]


def switched(bench: Any, to: str) -> None:
    told(bench.ask(PARAM, Parameter(names.FEEDBACK_ON, to)))


@pytest.mark.parametrize("killed", [False, True])
def test_tip_is_retracted_at_a_stop_if_a_request_has_switched_the_feedback_off(
    bench: Any, caplog: pytest.LogCaptureFixture, killed: bool
) -> None:
    switched(bench, "false")
    bench.ask(ACTION, names.START_SCAN)
    if killed:
        bench.start()
    assert bench.run_to_the_end(ParentGone()) == ExitCode.ORPHAN
    assert bench.microscope.done == ["scan", "stop", "retract"]
    assert "the feedback off: the tip was retracted" in caplog.text


class Killed(BaseException):
    """Ends the process right here."""


@pytest.mark.parametrize("answered", [False, True])
def test_translator_killed_while_switching_the_feedback_off_retracts_after_its_restart(
    bench: Any, monkeypatch: pytest.MonkeyPatch, answered: bool
) -> None:
    set_ = bench.microscope.set

    def kill(*what: Any) -> None:
        if not answered:
            set_(*what)
        raise Killed

    whom, what = (bench.translator.observer, "_observe_values") if answered else (bench.microscope, "set")
    with monkeypatch.context() as patched:
        patched.setattr(whom, what, kill)
        with pytest.raises(Killed):
            switched(bench, "false")
    bench.start()
    assert bench.translator.leaves_danger()
    assert bench.run_to_the_end(ParentGone()) == ExitCode.ORPHAN
    assert bench.microscope.done == ["retract"]


@pytest.mark.parametrize("what", ["status", "load"])
def test_retract_works_although_the_state_can_not_be_read(bench: Any, what: str) -> None:
    switched(bench, "false")
    bug = ValueError("a bug of the implementer, or a controller that makes no sense")
    bench.microscope.confused, bench.microscope.files["one.dat"] = (bug, []) if what == "status" else (None, bug)
    for _ in range(3):
        bench.look(after_s=1.0)
    assert bench.ask(ACTION, names.RETRACT).code == OK
    assert bench.microscope.done == ["retract"]


def test_retract_that_connects_does_not_connect_twice(bench: Any) -> None:
    microscope = bench.microscope
    microscope.lost = True
    bench.look()
    microscope.lost, microscope.connected = False, 0
    assert bench.ask(ACTION, names.RETRACT).code == OK
    bench.look(after_s=2.0)
    assert microscope.connected == 1
    assert bench.heard()[-1] == "FREE"


def test_retract_is_retried_on_a_new_connection(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    microscope = bench.microscope
    microscope.lost = True
    bench.look()
    microscope.lost, microscope.connected = False, 0
    with monkeypatch.context() as patched:
        patched.setattr(bench.translator.requests.commands, "do", unplugged)
        assert bench.ask(ACTION, names.RETRACT).code == ControlResponse.NO_RESPONSE
    assert bench.ask(ACTION, names.RETRACT).code == OK
    assert (microscope.connected, microscope.done) == (2, ["retract"])


@pytest.mark.parametrize("at_stop", [False, True])
def test_tip_is_retracted_although_connecting_fails_halfway(bench: Any, at_stop: bool) -> None:
    switched(bench, "false")
    bench.microscope.fails_to_connect = ConfigError("the folder of data does not exist")
    bench.microscope.confused = ConnectionError("unplugged")
    bench.look()
    if at_stop:
        assert bench.run_to_the_end(ParentGone()) == ExitCode.ORPHAN
    else:
        assert bench.ask(ACTION, names.RETRACT).code == OK
    assert bench.microscope.done[0] == "retract"


def test_question_for_the_retract_logs_no_retraction(bench: Any, caplog: pytest.LogCaptureFixture) -> None:
    bench.microscope.fails_to_connect = ConnectionError("unplugged")
    bench.microscope.confused = OSError("no space left")
    bench.look()
    bench.microscope.fails_to_connect = RuntimeError("no space left")
    assert bench.ask(ControlRequest.ACTION_SUPPORT, names.RETRACT).code == OK
    assert "retracted" not in caplog.text
    assert bench.microscope.done == []


def unplugged(*_: Any) -> Any:
    raise ConnectionError("unplugged")


@pytest.mark.parametrize("lost", [False, True])
def test_retract_at_a_stop_is_retried_if_the_controller_is_lost_or_refuses(
    bench: Any, caplog: pytest.LogCaptureFixture, lost: bool
) -> None:
    switched(bench, "false")
    bench.microscope.lost = lost
    bench.microscope.lacking = {} if lost else {names.RETRACT: "it is not possible now"}

    def is_back() -> None:
        bench.microscope.lost, bench.microscope.lacking = False, {}

    assert bench.run_to_the_end(ParentGone(), after_s=(3.0, is_back)) == ExitCode.ORPHAN
    assert bench.microscope.done == ["retract"]
    assert "the feedback off: the tip was retracted" in caplog.text
    assert "CRITICAL" not in caplog.text


@pytest.mark.parametrize("ends", [ScopeState.FREE, ScopeState.INTERRUPTED, ScopeState.COARSE_MOTOR])
def test_stopped_run_ends_once_the_tip_is_observed_away(
    bench: Any, caplog: pytest.LogCaptureFixture, ends: ScopeState
) -> None:
    """A controller may not have read the command yet."""
    bench.microscope.retracts_slowly = True
    switched(bench, "false")

    def is_there() -> None:
        bench.microscope.state = ends

    begun_s = bench.clock.t_s
    assert bench.run_to_the_end(ParentGone(), after_s=(3.0, is_there)) == ExitCode.ORPHAN
    assert bench.clock.t_s - begun_s >= 3.0
    is_away = ends is ScopeState.FREE
    assert ("the feedback off: the tip was retracted" in caplog.text) == is_away
    assert ("it is not certain that the tip was retracted" in caplog.text) == (not is_away)


def test_tip_stays_if_the_feedback_is_on_or_was_switched_off_at_the_panel(bench: Any) -> None:
    def left() -> list[str]:
        assert bench.run_to_the_end(ParentGone()) == ExitCode.ORPHAN
        done, bench.microscope.done = bench.microscope.done, []
        bench.microscope.values["Loop"] = True
        bench.start()
        return list(done)

    switched(bench, "false")
    switched(bench, "true")
    assert left() == []
    switched(bench, "false")
    bench.microscope.values["Loop"] = True  # and on again, at the panel
    bench.look()
    assert left() == []
    bench.ask(PARAM, Parameter("tip-bias-voltage", "1", "V"))
    bench.look()
    bench.microscope.values["Loop"] = False
    bench.look()
    assert left() == []  # at the panel
    switched(bench, "false")
    assert bench.ask(ACTION, names.RETRACT).code == OK
    assert left() == ["retract"]  # once
    assert bench.ask(ACTION, names.RETRACT).code == OK
    bench.microscope.values["Loop"] = False  # by that
    bench.look()
    assert left() == ["retract"]
    switched(bench, "false")
    bench.microscope.lacking = {names.RETRACT: "its motor is stuck"}
    assert not bench.ask(ACTION, names.RETRACT).ok
    bench.microscope.lacking = {}
    assert left() == ["retract"]  # at last
    bench.start(retracts=False)
    switched(bench, "false")
    assert left() == []


def test_tip_is_not_retracted_after_the_scheduler_ended_the_experiment(bench: Any) -> None:
    switched(bench, "false")
    assert bench.run_to_the_end(ParentGone(), RequestReceived([wire.CLOSE])) == ExitCode.ENDED
    assert bench.microscope.done == []


@pytest.mark.parametrize("lost", [False, True])
def test_failed_retract_without_feedback_is_critical(bench: Any, caplog: pytest.LogCaptureFixture, lost: bool) -> None:
    switched(bench, "false")
    bench.microscope.lost = lost
    bench.microscope.lacking = {names.RETRACT: "it has no coarse motor"}
    began_s = bench.clock.t_s
    assert bench.run_to_the_end(ParentGone()) == ExitCode.ORPHAN
    assert 8.0 <= bench.clock.t_s - began_s < TIP_WITHIN_S, "it ends before it is ended"
    last = caplog.records[-1]
    assert last.levelname == "CRITICAL"
    assert ("unplugged" if lost else "it has no coarse motor") in last.getMessage()


def test_a_stop_interrupts_and_no_scan_comes(bench: Any, scan: Any) -> None:
    bench.ask(ACTION, names.START_SCAN)
    bench.microscope.files["partial"] = [scan()]  # some controllers save what they have
    assert bench.ask(ACTION, names.STOP_SCAN).code == OK
    bench.look()
    assert bench.heard() == ["SCANNING", "INTERRUPTED", "FREE"]


def test_a_stop_with_nothing_running_is_a_success_without_interruption(bench: Any) -> None:
    assert bench.ask(ACTION, names.STOP_SCAN).code == OK
    bench.look()
    assert bench.heard() == []
    assert bench.microscope.done == []


def test_a_frame_is_set_as_moving_the_frame_once_free(bench: Any) -> None:
    region = Region((1e-6, 2e-6), (2e-6, 1e-6), math.radians(30))
    assert bench.ask(FRAME, ScanParameters(region, (16, 32))).code == OK
    packets = list(bench.port.packets)
    assert bench.heard() == ["MOVING", "ScanParameters2d", "FREE"]
    published = packets[1][1]
    assert published.shape == (16, 32)
    assert published.region.center_m == pytest.approx(region.center_m, rel=1e-12)
    assert published.region.angle_rad == pytest.approx(region.angle_rad, rel=1e-12)
    assert bench.microscope.values["A"] == pytest.approx(-30)  # this controller counts clockwise
    assert (bench.microscope.values["NX"], bench.microscope.values["NY"]) == (32, 16)


def test_frame_in_force_already_is_published_once(bench: Any) -> None:
    same = ScanParameters(Region.from_top_left((0.0, 0.0), (1e-6, 0.5e-6)), (4, 8))
    assert bench.ask(FRAME, same).code == OK
    assert bench.heard() == ["MOVING", "ScanParameters2d", "FREE"]


def test_long_move_ends_when_the_controller_reports_it(bench: Any) -> None:
    bench.microscope.state = ScopeState.MOVING
    bench.look()
    assert bench.heard() == ["MOVING"]
    assert bench.ask(POSITION, ProbePosition((1e-6, 1e-6))).code == NOT_FREE
    bench.microscope.state = ScopeState.FREE
    assert bench.ask(POSITION, ProbePosition((1e-6, 1e-6))).code == OK
    assert bench.heard() == ["FREE", "MOVING", "ProbePosition", "FREE"]


def test_scanner_settles_after_a_move_of_the_frame_before_a_scan(make_bench: Any) -> None:
    # results C38
    bench = make_bench({"settle_before_scan_s": 5.0})
    bench.heard()
    elsewhere = ScanParameters(Region.from_top_left((3e-7, 0.0), (1e-6, 0.5e-6)), (4, 8))
    assert bench.ask(FRAME, elsewhere).code == OK
    assert bench.heard() == ["MOVING", "ScanParameters2d"]
    polls = 0
    while bench.translator.wait_s() > 0.0 and bench.clock.t_s < 1004.9:
        bench.look(after_s=min(1.0, bench.translator.wait_s()))
        polls += 1
    assert polls > 5, "the controller is polled meanwhile"
    assert bench.ask(ACTION, names.START_SCAN).code == NOT_FREE
    assert bench.ask(ACTION, names.STOP_SCAN).code == OK
    assert bench.microscope.done == []
    bench.look(after_s=1005.0 - bench.clock.t_s)
    assert bench.heard() == ["FREE"]
    assert bench.ask(ACTION, names.START_SCAN).code == OK


def test_tip_can_be_retracted_while_the_scanner_settles(make_bench: Any) -> None:
    bench = make_bench({"settle_before_scan_s": 5.0})
    assert bench.ask(FRAME, ScanParameters(Region.from_top_left((3e-7, 0.0), (1e-6, 0.5e-6)), (4, 8))).code == OK
    assert bench.ask(ACTION, names.RETRACT).code == OK
    assert bench.microscope.done == ["retract"]


@pytest.mark.parametrize(
    ("x_m", "pixels"), [(0.0, (4, 8)), (0.0, (16, 32)), (5e-9, (4, 8))], ids=["same", "pixels", "drift"]
)
def test_scan_begins_at_once_where_the_scanner_has_hardly_moved(
    make_bench: Any, x_m: float, pixels: tuple[int, int]
) -> None:
    bench = make_bench({"settle_before_scan_s": 5.0})
    assert bench.ask(FRAME, ScanParameters(Region.from_top_left((x_m, 0.0), (1e-6, 0.5e-6)), pixels)).code == OK
    assert bench.ask(PARAM, Parameter("scan-speed", "2", "um/s")).code == OK
    assert bench.ask(ACTION, names.START_SCAN).code == OK


def test_only_fields_in_the_message_are_set(bench: Any) -> None:
    message = scan_pb2.ScanParameters2d()
    message.spatial.roi.size.y = 250.0
    message.spatial.length_units = "nm"
    assert bench.ask(FRAME, payload=message.SerializeToString()).code == OK
    assert (bench.microscope.values["W"], bench.microscope.values["H"]) == (1000.0, pytest.approx(250.0))
    gain = feedback_pb2.ZCtrlParameters(proportionalGain=0.0)
    assert bench.ask(ControlRequest.SET_ZCTRL_PARAMS, payload=gain.SerializeToString()).code == OK
    assert bench.microscope.values["P"] == 0.0
    assert (bench.microscope.values["Setpoint"], bench.microscope.values["Loop"]) == (1.0, True)


def test_feedback_is_switched_off_and_published(bench: Any) -> None:
    assert bench.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=False)).code == OK
    assert bench.microscope.values["Loop"] is False
    assert bench.port.packets[-1][1] == TipStatus(feedback_on=False)
    assert bench.heard()[-1] == "ZCtrlParameters"
    assert told(bench.ask(PARAM, Parameter("x-feedback-on", "true"))) == ("true", None)
    assert bench.microscope.values["Loop"] is True


def test_feedback_is_switched_on_last_and_off_first(bench: Any) -> None:
    order: list[set[str]] = []
    bench.microscope.after_set = lambda given: order.append(set(given))
    assert bench.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=False, setpoint=0.5e-9)).code == OK
    assert bench.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=True, setpoint=0.75e-9)).code == OK
    assert order == [{"Loop"}, {"Setpoint"}, {"Setpoint"}, {"Loop"}]


def test_a_gain_sent_as_float32_is_the_number_that_was_meant(bench: Any) -> None:
    assert bench.ask(ControlRequest.SET_ZCTRL_PARAMS, Feedback(proportional_gain=0.1)).code == OK
    assert bench.microscope.values["P"] == 0.1


def test_a_change_at_the_panel_is_published_once(bench: Any) -> None:
    bench.microscope.values["X"] = 100.0
    bench.look()
    bench.microscope.values["Setpoint"] = 2.0
    bench.look()
    bench.look()
    assert bench.heard() == ["ScanParameters2d", "ZCtrlParameters"]


def test_parameters_are_answered_in_the_unit_of_the_request(bench: Any) -> None:
    assert told(bench.ask(PARAM, Parameter("scan-speed"))) == ("1e-06", "m/s")
    assert told(bench.ask(PARAM, Parameter("scan-speed", "1500.0", "nm/s"))) == ("1500", "nm/s")
    assert bench.microscope.values["Speed"] == 1.5
    assert told(bench.ask(PARAM, Parameter("scan-angle", "45"))) == ("45", "deg")
    assert told(bench.ask(PARAM, Parameter("scan-angle", None, "rad")))[0] == f"{math.pi / 4:.15g}"
    assert told(bench.ask(PARAM, Parameter("scan-resolution-x"))) == ("8", "px")


@pytest.mark.parametrize(
    ("name", "value", "unit"),
    [
        ("scan-speed", "fast", None),
        ("scan-speed", "nan", "um/s"),
        ("scan-speed", "inf", None),
        ("scan-speed", "1e400", None),
        ("scan-speed", "1_0", "um/s"),
        ("scan-speed", "1", "V"),
        ("scan-speed", "1", "parsec per fortnight and then some"),
        ("scan-speed", "1", "m/s"),  # a metre a second is a million times the limit
        ("scan-speed", "", "um/s"),
        ("scan-size-x", "0", "nm"),
        ("scan-size-x", "-5", "nm"),
        ("scan-top-left-x", "9.9", "um"),  # the corner is in reach, the frame is not
        ("scan-resolution-x", "7.5", "px"),
        ("scan-resolution-x", "1000000000", "px"),
        ("x-feedback-on", "perhaps", None),
        ("x-mode", "CV", None),
        ("x-serial", "008", None),
        ("x-mode", "I" * 1000, None),
    ],
)
def test_impossible_value_is_refused_with_a_reason_and_changes_nothing(
    bench: Any, name: str, value: str, unit: str | None
) -> None:
    before = dict(bench.microscope.values)
    response = bench.ask(PARAM, Parameter(name, value, unit))
    assert response.code == PARAM_ERROR
    assert len(response.reason) > 10
    assert bench.microscope.values == before
    assert bench.heard() == []


def test_a_billion_pixels_are_refused(make_bench: Any) -> None:
    unbounded = {name: {"range": [1, 1e9]} for name in (names.SCAN_RESOLUTION_X, names.SCAN_RESOLUTION_Y)}
    bench = make_bench({"parameters": unbounded})
    response = bench.ask(FRAME, ScanParameters(shape=(31623, 31623)))
    assert response.code == PARAM_ERROR
    assert "pixels" in response.reason


def test_a_turned_frame_whose_corner_is_out_of_reach_is_refused(bench: Any) -> None:
    region = Region((9e-6, 0.0), (2e-6, 2e-6), math.radians(45))
    response = bench.ask(FRAME, ScanParameters(region))
    assert response.code == PARAM_ERROR
    assert "its corners are at -1.4142 to 1.4142 µm in y" not in response.reason
    assert "its corners are at 7.5858 to 10.414 µm in x, beyond the scanner's -10 to 10 µm" in response.reason
    assert "move the frame by -414.21 nm in x" in response.reason
    assert bench.ask(FRAME, ScanParameters(Region((9e-6, 0.0), (2e-6, 2e-6)))).code == OK


def test_the_reason_names_value_limit_and_where_it_was_set(bench: Any) -> None:
    reason = bench.ask(PARAM, Parameter("scan-speed", "200", "um/s")).reason
    # users A: no such file is beside the experiment file
    assert reason == "scan-speed: 200 µm/s is outside 0.001 µm/s to 100 µm/s (set in the driver's parameters.toml)"


def test_value_changed_by_the_controller_is_refused_and_restored(bench: Any) -> None:
    bench.microscope.stuck = {"Speed": 3.0}
    response = bench.ask(PARAM, Parameter("scan-speed", "5", "um/s"))
    assert response.code == PARAM_ERROR
    assert "set 3 µm/s instead of 5 µm/s" in response.reason
    bench.microscope.stuck = {"Speed": 5.00005}  # its precision
    assert bench.ask(PARAM, Parameter("scan-speed", "5", "um/s")).code == OK


def test_difference_below_the_digits_shown_is_in_the_reason(bench: Any) -> None:
    # contributors K4
    bench.microscope.stuck = {"Bias": 100.00001}
    reason = bench.ask(PARAM, Parameter("tip-bias-voltage", "100", "mV")).reason
    assert "set 100 mV instead of 100 mV, 1e-05 mV off: if that is its precision" in reason


def test_change_in_the_rest_of_the_frame_is_refused_and_restored(bench: Any) -> None:
    values = bench.microscope.values

    def square(given: Any) -> None:
        if "H" not in given and "W" in given:
            values["H"] = given["W"]

    bench.microscope.after_set = square
    response = bench.ask(PARAM, Parameter("scan-size-x", "2", "um"))
    assert response.code == PARAM_ERROR
    assert (
        response.reason == "scan-size-y: the controller set 2000 nm instead of 500 nm; the former values were restored"
    )
    assert (values["W"], values["H"]) == (1000.0, 500.0)


def test_refused_frame_restores_the_speed_of_a_controller_with_lines_per_second(bench: Any) -> None:
    values = bench.microscope.values
    speed_before = values["Speed"]

    def half_set(given: Any) -> None:
        if given.get("W") == 2000.0:  # the width is set, its line rate is refused
            values["Speed"] *= 2.0
            raise Refused(PARAM_ERROR, "the line rate is too low")

    bench.microscope.after_set = half_set
    assert bench.ask(PARAM, Parameter("scan-size-x", "2", "um")).code == PARAM_ERROR
    assert (values["W"], values["Speed"]) == (1000.0, speed_before)


def test_only_disturbing_requests_are_refused_during_a_scan(bench: Any) -> None:
    bench.ask(ACTION, names.START_SCAN)
    assert bench.ask(ACTION, names.START_SCAN).code == NOT_FREE
    assert bench.ask(ACTION, names.START_SPEC).code == NOT_FREE
    assert bench.ask(FRAME, ScanParameters(shape=(4, 4))).code == NOT_FREE
    assert bench.ask(PARAM, Parameter("scan-speed", "1", "um/s")).code == NOT_FREE
    bench.microscope.adjustable = frozenset({"scan-speed"})
    assert bench.ask(PARAM, Parameter("scan-speed", "1", "um/s")).code == OK
    assert "SS_SCANNING" in bench.ask(PARAM, Parameter("zctrl-pgain", "1")).reason
    assert bench.ask(PARAM, Parameter("scan-speed")).code == OK
    assert bench.ask(SUPPORT, names.START_SPEC).code == OK
    assert bench.ask(PARAM, Parameter("tip-bias-voltage", "1", "V")).code == OK  # the table allows it
    assert bench.microscope.done == ["scan"]


def test_unknown_names_are_refused_with_the_nearest(bench: Any) -> None:
    unknown = bench.ask(PARAM, Parameter("scan-sped"))
    assert unknown.code == ControlResponse.PARAM_NOT_SUPPORTED
    assert "scan-speed" in unknown.reason
    for kind in (ACTION, SUPPORT):
        response = bench.ask(kind, "start-scam")
        assert response.code == ControlResponse.ACTION_NOT_SUPPORTED
        assert "start-scan" in response.reason
    assert bench.ask(SUPPORT, names.STOP_SPEC).code == ControlResponse.ACTION_NOT_SUPPORTED


@pytest.mark.parametrize(
    ("frames", "code"),
    [
        ([], ControlResponse.FAILURE),
        ([b""], ControlResponse.FAILURE),
        ([b"\1\1"], ControlResponse.FAILURE),
        ([b"\xfe"], ControlResponse.CMD_NOT_SUPPORTED),
        ([b"\0"], ControlResponse.CMD_NOT_SUPPORTED),
        ([b"\6", b"\1"], ControlResponse.CMD_NOT_SUPPORTED),
        ([bytes([CLOCK_REQUEST])], ControlResponse.CMD_NOT_SUPPORTED),
        ([b"\3", b"\x0a\xff"], ControlResponse.FAILURE),
        ([b"\2"], PARAM_ERROR),
        ([b"\1", b"x", b"y", b"z"], ControlResponse.FAILURE),
    ],
)
def test_malformed_requests_are_answered(bench: Any, frames: list[bytes], code: ControlResponse) -> None:
    response = bench.ask_frames(frames)
    assert response.code == code
    assert response.reason
    assert bench.ask(PARAM, Parameter("scan-speed")).code == OK


def test_errors_of_a_controller_become_responses_with_their_reason(bench: Any) -> None:
    tune = bench.ask(ACTION, "x-tune")
    assert (tune.code, tune.reason) == (ControlResponse.ACTION_ERROR, "no resonance was found")
    assert "a bug" in bench.ask(ACTION, "x-explode").reason
    bench.microscope.fails = RuntimeError("E42")
    assert "E42" in bench.ask(PARAM, Parameter("scan-speed", "2", "um/s")).reason


def test_lost_controller_is_logged_and_reconnected(bench: Any) -> None:
    bench.microscope.lost = True
    bench.look()
    assert bench.heard() == ["UNDEFINED"]
    response = bench.ask(PARAM, Parameter("scan-speed"))
    assert (response.code, response.detail) == (ControlResponse.NO_RESPONSE, ResponseDetail.NOT_SENT)
    bench.microscope.lost = False
    bench.look(after_s=5.0)
    assert bench.heard() == ["ScanParameters2d", "ZCtrlParameters", "ProbePosition", "FREE"]


def test_missing_controller_is_logged_once(make_bench: Any, tmp_path: Any) -> None:
    bench = make_bench()
    bench.microscope.lost = True
    bench.start()
    for _ in range(5):
        bench.look(after_s=1.0)
    assert bench.heard() == ["UNDEFINED"]
    bench.microscope.lost = False
    bench.look(after_s=1.0)
    assert bench.heard()[-1] == "FREE"


@pytest.mark.parametrize("error", [ValueError("0x1f"), KeyError("status"), WireError("a reply to another question")])
def test_controller_with_impossible_values_is_lost_until_they_are_valid(bench: Any, error: Any) -> None:
    bench.microscope.confused = error
    bench.look()
    assert bench.heard() == ["UNDEFINED"]
    response = bench.ask(ACTION, names.START_SCAN)
    assert response.code == ControlResponse.NO_RESPONSE
    bench.microscope.confused = None
    bench.look(after_s=1.0)
    assert bench.heard()[-1] == "FREE"
    assert bench.ask(ACTION, names.START_SCAN).code == OK


def test_request_to_a_controller_with_impossible_values_is_not_executed(bench: Any) -> None:
    bench.microscope.confused = ValueError("0x1f")
    response = bench.ask(ACTION, names.START_SCAN)
    assert (response.code, bench.microscope.done) == (ControlResponse.NO_RESPONSE, [])
    assert "ValueError: 0x1f (conftest.py:" in response.reason
    assert bench.heard() == ["UNDEFINED"]


def test_a_controller_that_starts_with_its_translator_is_waited_for_and_nothing_is_wrong(
    bench: Any, caplog: Any
) -> None:
    caplog.set_level(logging.INFO)
    bench.microscope.lost = True
    bench.start()
    bench.look(1.8)
    for subject in (Parameter("scan-speed"), names.RETRACT):  # who asks then has to wait, and is refused nothing
        response = bench.ask(PARAM if isinstance(subject, Parameter) else ACTION, subject)
        assert (response.code, response.detail) == (ControlResponse.NO_RESPONSE, ResponseDetail.NOT_SENT)
    assert caplog.records == []
    bench.look(0.3)
    (told,) = caplog.records
    assert told.levelno == logging.WARNING  # it may be started later
    assert "no contact with the controller yet" in told.message
    assert "unplugged" in told.message
    bench.look(1.0)
    bench.microscope.lost = False
    bench.look(0.9)
    assert len(caplog.records) == 1
    bench.look(0.2)
    assert caplog.records[-1].message == "the controller answers again"


def test_a_controller_that_starts_late_is_found_soon(bench: Any, caplog: Any) -> None:
    caplog.set_level(logging.INFO)
    bench.microscope.lost = True
    bench.start()
    assert bench.translator.wait_s() == pytest.approx(0.1)
    bench.microscope.lost = False
    bench.look(0.11)
    assert "ScanParameters2d" in bench.heard()
    assert caplog.records == []


def test_requests_to_a_lost_controller_are_logged_and_not_called_refused(bench: Any, caplog: Any) -> None:
    caplog.set_level(logging.INFO)
    bench.microscope.lost = True
    bench.look()
    bench.ask(PARAM, Parameter("scan-speed"))
    lost, asked = caplog.messages
    assert "lost contact" in lost
    assert asked.startswith("not sent: the controller can't be reached")


def test_the_request_after_a_scan_comes_before_the_values_are_read(bench: Any, scan: Any) -> None:
    bench.ask(ACTION, names.START_SCAN)
    bench.look(0.05)
    bench.microscope.files["1"] = [scan()]
    bench.microscope.state = ScopeState.FREE
    bench.look(0.045)  # the values are due 5 ms later
    assert bench.heard()[-1] == "FREE"
    bench.microscope.got = 0
    bench.look(0.05)
    assert bench.microscope.got == 0
    bench.look(0.06)
    assert bench.microscope.got > 0


def test_a_request_that_was_done_before_the_controller_was_lost_stays_a_success(bench: Any) -> None:
    def lost_afterwards(values: Any) -> None:
        type(bench.microscope).set(bench.microscope, values)
        bench.microscope.confused = ValueError("0x1f")

    bench.microscope.set = lost_afterwards
    replies = len(bench.port.replies)
    assert bench.ask(POSITION, ProbePosition((1e-6, 0.0)), request_id="one").code == OK
    assert len(bench.port.replies) == replies + 1
    assert bench.heard()[-1] == "UNDEFINED"
    bench.microscope.confused = None
    assert bench.ask(POSITION, ProbePosition((1e-6, 0.0)), request_id="one").code == OK


def test_impossible_gain_is_left_out_and_the_controller_kept(bench: Any) -> None:
    bench.microscope.values["P"] = math.inf
    bench.look()
    ((name, feedback, _),) = bench.port.packets
    assert (name, feedback.proportional_gain) == ("ZCtrlParameters", None)
    assert feedback.on is not None


@pytest.mark.parametrize(("vendor", "value"), [("X", math.nan), ("Loop", math.nan), ("W", "wide")])
def test_impossible_value_is_never_published(bench: Any, vendor: str, value: Any) -> None:
    bench.microscope.values[vendor] = value
    bench.look()
    assert bench.heard() == ["UNDEFINED"]


def test_settings_that_prevent_any_connection_end_the_process(make_bench: Any) -> None:
    bench = make_bench()
    bench.microscope.connect = lambda: (_ for _ in ()).throw(ConfigError("no such release"))
    with pytest.raises(ConfigError):
        bench.start()


def test_the_end_of_a_scan_is_looked_for_eagerly_by_its_state_alone(bench: Any, scan: Any) -> None:
    def measure(number: int) -> list[float]:
        # returns the pauses between the looks
        bench.ask(ACTION, names.START_SCAN)
        waits = []
        for _ in range(4000):
            waits.append(bench.translator.wait_s())
            if bench.clock.t_s >= bench.began_s + 30.0 and bench.microscope.state is ScopeState.SCANNING:
                bench.microscope.files[f"{number}"] = [scan()]
                bench.microscope.state = ScopeState.FREE
                bench.late_s = bench.clock.t_s - bench.began_s - 30.0
            bench.look(waits[-1])
            if bench.heard()[-1:] == ["FREE"]:
                return waits
        raise AssertionError("it is never over")

    bench.began_s = bench.clock.t_s
    measure(1)
    for number in (2, 3):
        bench.began_s, bench.microscope.got = bench.clock.t_s, 0
        waits = measure(number)
        assert bench.late_s <= 0.02
        assert max(waits) == pytest.approx(0.1)
        assert len(waits) < 400
        # 14 values at every tenth of a second, as at rest
        assert bench.microscope.got < 15 * 320


def test_actions_and_parameters_of_the_experiment_file(make_bench: Any) -> None:
    bench = make_bench(
        {
            "parameters": {"x-gate": {"vendor": "Bias", "unit": "mV", "range": ["-1 V", "1 V"]}},
            "actions": {
                "x-to-force": {"set": {"x-mode": "force", "scan-speed": "2 um/s"}},
                "x-beep": {"command": "BEEP 3"},
            },
        }
    )
    assert told(bench.ask(PARAM, Parameter("x-gate", "0.5", "V"))) == ("0.5", "V")
    assert bench.ask(ACTION, "x-to-force").code == OK
    assert (bench.microscope.values["Mode"], bench.microscope.values["Speed"]) == ("force", 2.0)
    assert bench.ask(ACTION, "x-beep").code == OK
    assert bench.microscope.done == ["BEEP 3"]


def test_settings_of_an_action_are_published_before_its_answer(make_bench: Any) -> None:
    bench = make_bench({"actions": {"x-soft": {"set": {"zctrl-setpoint": "2 nA"}}, "x-beep": {"command": "BEEP"}}})
    bench.heard()
    order: list[str] = []
    publish, reply = bench.port.publish, bench.port.reply
    bench.port.publish = lambda envelope, *rest, **kept: (order.append(envelope), publish(envelope, *rest, **kept))
    bench.port.reply = lambda frames: (order.append("answer"), reply(frames))
    assert bench.ask(ACTION, "x-soft").code == OK
    assert order == ["ZCtrlParameters", "answer"]
    assert bench.ask(ACTION, "x-beep").code == OK
    assert order[2:] == ["answer"], "nothing has changed"


BEEP = {"set": {"tip-bias-voltage": "4 V", "x-mode": "force"}, "command": "BEEP 3", "for": "50 ms"}


def test_action_may_set_values_for_a_limited_time(make_bench: Any) -> None:
    bench = make_bench({"actions": {"x-pulse": BEEP}})
    microscope, before = bench.microscope, dict(bench.microscope.values)
    assert bench.ask(ACTION, "x-pulse").code == OK
    assert (microscope.values["Bias"], microscope.values["Mode"]) == (4000.0, "force")
    assert microscope.done == ["BEEP 3"]
    assert bench.heard()[-1] == "BUSY_PARAM"
    assert bench.ask(ACTION, names.START_SCAN).code == NOT_FREE
    assert bench.translator.wait_s() <= 0.05
    bench.clock.t_s += 0.049
    bench.translator.look()
    assert microscope.values["Bias"] == 4000.0
    bench.clock.t_s += 0.002
    bench.translator.look()
    assert microscope.values == before
    assert bench.heard() == ["FREE"]


@pytest.mark.parametrize("how", ["killed", "lost", "ended", "orphaned"])
def test_temporary_values_are_restored_after_a_kill_a_loss_or_the_end(make_bench: Any, how: str) -> None:
    bench = make_bench({"actions": {"x-pulse": BEEP}})
    microscope, before = bench.microscope, dict(bench.microscope.values)
    assert bench.ask(ACTION, "x-pulse").code == OK
    if how == "killed":
        bench.start()
    elif how == "lost":
        microscope.lost = True
        bench.look(10.0)
        assert microscope.values["Bias"] == 4000.0
        microscope.lost = False
        bench.look(10.0)
    elif how == "ended":
        bench.run_to_the_end(RequestReceived([wire.CLOSE]))
    else:
        bench.run_to_the_end(ParentGone())
    assert microscope.values == before


def test_temporary_value_that_a_person_has_changed_meanwhile_stays(
    make_bench: Any, caplog: pytest.LogCaptureFixture
) -> None:
    bench = make_bench({"actions": {"x-pulse": BEEP}})
    assert bench.ask(ACTION, "x-pulse").code == OK
    bench.microscope.lost = True
    bench.look(10.0)
    bench.microscope.values["Bias"] = 2000.0
    bench.microscope.lost = False
    bench.look(10.0)
    assert bench.microscope.values["Bias"] == 2000.0
    assert "not set back, since others have set it meanwhile" in caplog.text


def test_an_action_that_can_not_be_set_changes_nothing_and_is_over(make_bench: Any) -> None:
    bench = make_bench({"actions": {"x-pulse": BEEP}})
    before = dict(bench.microscope.values)
    bench.microscope.stuck = {"Bias": 100.0}
    assert bench.ask(ACTION, "x-pulse").code == ControlResponse.PARAM_ERROR
    assert bench.microscope.values == before
    assert bench.microscope.done == []
    assert bench.ask(ACTION, names.START_SCAN).code == OK


@pytest.mark.parametrize(("name", "value"), [("x-serial", "007"), ("zctrl-pgain", "1000"), ("x-mode", "of the panel")])
def test_an_unchanged_value_that_can_not_be_set_is_no_change(bench: Any, name: str, value: str) -> None:
    """The value is read-only, or was set at the panel beyond the limits for requests."""
    vendor = {"x-serial": "Serial", "zctrl-pgain": "P", "x-mode": "Mode"}[name]
    bench.microscope.values[vendor] = value if vendor != "P" else 1000.0
    calls = bench.microscope.set_calls
    assert told(bench.ask(PARAM, Parameter(name, value)))[0] == value
    assert bench.microscope.set_calls == calls
    assert bench.ask(PARAM, Parameter(name, value + "1")).code == ControlResponse.PARAM_ERROR


def test_a_whole_message_may_be_sent_back_with_one_field_changed(make_bench: Any) -> None:
    bench = make_bench({"parameters": {"x-feedback-on": {"read_only": True}}})
    wanted = Feedback(on=True, proportional_gain=7.0, setpoint=1e-9)
    bench.microscope.values |= {"Loop": True, "Setpoint": 1.0}
    assert bench.ask(ControlRequest.SET_ZCTRL_PARAMS, wanted).code == OK
    assert bench.microscope.values["P"] == 7.0
    assert bench.ask(ControlRequest.SET_ZCTRL_PARAMS, replace(wanted, on=False)).code == ControlResponse.PARAM_ERROR


@pytest.mark.parametrize(
    "settings",
    [
        {"actions": {"x-a": {"set": {"scan-sped": 1}}}},
        {"actions": {"x-a": {"set": {"scan-speed": "1 V"}}}},
        {"actions": {"x-a": {"do": "it"}}},
        {"actions": {"x-a": {"for": "1 s"}}},
        {"actions": {"x-a": {"set": {"scan-speed": "1 um/s"}, "for": "1 V"}}},
        {"actions": {"x-a": {"set": {"scan-speed": "1 um/s"}, "for": 0}}},
        {"parameters": {"scan-speed": {"rang": [1, 2]}}},
        {"parameters": {"scan-speed": {"range": [2, 1]}}},
        {"parameters": {"scan-speed": {"unit": "V"}}},
        {"parameters": {"scan-speed": {"type": "complex"}}},
    ],
)
def test_impossible_settings_are_found_at_the_start(make_bench: Any, settings: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        make_bench(settings)


def test_a_repeated_id_is_answered_and_not_carried_out_again(bench: Any) -> None:
    first = bench.ask(PARAM, Parameter("scan-speed", "2", "um/s"), "me/1/1")
    assert bench.microscope.set_calls == 1
    again = bench.ask(PARAM, Parameter("scan-speed", "2", "um/s"), "me/1/1")
    assert bench.microscope.set_calls == 1
    assert again == first
    other = bench.ask(PARAM, Parameter("scan-speed", "3", "um/s"), "me/1/1")
    assert other.code == ControlResponse.FAILURE
    assert bench.microscope.set_calls == 1


def test_forgotten_id_is_not_carried_out_again(bench: Any) -> None:
    assert bench.ask(ACTION, names.RETRACT, "me/1/1").code == OK
    assert bench.ask(ACTION, names.RETRACT, "me/key/tip/0").code == OK
    for n in range(2, 332):
        assert bench.ask(PARAM, Parameter("scan-speed", "2", "um/s"), f"me/1/{n}").code == OK
    for _ in range(2):
        response = bench.ask(ACTION, names.RETRACT, "me/1/1")
        assert (response.code, response.detail) == (ControlResponse.NO_RESPONSE, ResponseDetail.OUTCOME_UNKNOWN)
        assert "not above one that was forgotten" in response.reason
        assert bench.ask(ACTION, names.RETRACT, "me/key/tip/0").code == OK
        bench.start()
    assert bench.microscope.done == ["retract", "retract"]
    assert bench.ask(ACTION, names.RETRACT, "me/1/332").code == OK


def test_a_request_that_was_refused_may_be_asked_again(bench: Any) -> None:
    bench.microscope.state = ScopeState.MOVING
    assert bench.ask(ACTION, names.START_SCAN, "me/1/1").code == NOT_FREE
    bench.microscope.state = ScopeState.FREE
    assert bench.ask(ACTION, names.START_SCAN, "me/1/1").code == OK
    assert bench.microscope.done == ["scan"]


def test_setting_lost_with_its_controller_is_carried_out_when_it_is_repeated(bench: Any) -> None:
    bench.microscope.fails = ControllerLost("reset by peer")
    lost = bench.ask(PARAM, Parameter("scan-speed", "2", "um/s"), "me/1/1")
    assert (lost.code, lost.detail) == (ControlResponse.NO_RESPONSE, ResponseDetail.OUTCOME_UNKNOWN)
    bench.microscope.fails = None
    bench.look(after_s=1.0)
    assert bench.ask(PARAM, Parameter("scan-speed", "2", "um/s"), "me/1/1").code == OK
    assert bench.ask(PARAM, Parameter("scan-speed"), "me/1/2").payload


def test_repeated_action_lost_with_its_controller_is_unknown_and_not_unreachable(bench: Any) -> None:
    bench.microscope.fails = ControllerLost("reset by peer")
    lost = bench.ask(ACTION, names.START_SCAN, "me/1/1")
    assert lost.code == ControlResponse.NO_RESPONSE
    bench.microscope.fails = None
    bench.look(after_s=1.0)
    again = bench.ask(ACTION, names.START_SCAN, "me/1/1")
    assert (again.code, again.detail) == (ControlResponse.NO_RESPONSE, ResponseDetail.NONE)
    assert again.reason.startswith(
        "the controller was lost during this request: it may or may not have been carried out"
    )
    assert bench.microscope.done == []


def test_scan_that_does_not_end_is_logged_once(bench: Any, scan: Any, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    bench.microscope.values["Speed"] = 0.01
    bench.look(after_s=1.0)
    assert bench.ask(ACTION, names.START_SCAN).code == OK
    lasts_s = 2.0 * 1e-6 * 4 / 0.01e-6  # trace and retrace of four lines, 1 µm wide, at 0.01 µm/s
    bench.look(after_s=OVERDUE_RATIO * lasts_s + OVERDUE_S - 1.0)
    bench.microscope.state = ScopeState.FREE
    bench.microscope.files["a"] = [scan()]
    bench.look()
    assert not [one for one in caplog.records if one.levelno == logging.CRITICAL]
    assert bench.ask(ACTION, names.START_SCAN).code == OK
    for _ in range(4):
        bench.look(after_s=OVERDUE_RATIO * lasts_s + OVERDUE_S)
    (logged,) = [one for one in caplog.records if one.levelno == logging.CRITICAL]
    assert "does the controller hang?" in logged.message
    bench.microscope.state = ScopeState.FREE
    bench.microscope.files["b"] = [scan()]
    bench.look()
    (over,) = [one for one in caplog.records if NO_LONGER_TRUE in one.message]
    critical, info = (LogLine(1, "microscope", one.levelname, one.message) for one in (logged, over))
    assert info.ends(critical)


def test_restarted_translator_does_not_repeat_requests(bench: Any) -> None:
    bench.ask(ACTION, names.START_SCAN, "me/1/1")
    bench.start()
    assert bench.ask(ACTION, names.START_SCAN, "me/1/1").code == OK
    assert bench.microscope.done == ["scan"]


def test_request_interrupted_by_a_kill_is_not_repeated(bench: Any) -> None:
    bench.microscope.fails = KeyboardInterrupt()  # killed right within the action
    with pytest.raises(KeyboardInterrupt):
        bench.ask(ACTION, names.START_SCAN, "me/1/1")
    bench.microscope.fails = None
    bench.start()
    response = bench.ask(ACTION, names.START_SCAN, "me/1/1")
    assert response.code == ControlResponse.NO_RESPONSE
    assert "restarted" in response.reason
    assert bench.microscope.done == []


def test_a_scan_that_ended_while_the_translator_was_down_is_delivered_once(bench: Any, scan: Any) -> None:
    bench.ask(ACTION, names.START_SCAN)
    bench.microscope.files["a"] = [scan()]
    bench.microscope.state = ScopeState.FREE
    bench.start()
    assert bench.heard() == [
        "ScanParameters2d", "ZCtrlParameters", "ProbePosition", "SCANNING", "Scan2d", "FREE",
    ]  # fmt: skip


def test_after_a_kill_the_last_results_are_published_again_at_the_same_times(bench: Any, scan: Any) -> None:
    bench.ask(ACTION, names.START_SCAN)
    bench.microscope.files["a"] = [scan("Height"), scan("Phase")]
    bench.microscope.state = ScopeState.FREE
    bench.look()
    before = [time_ns for name, _, time_ns in bench.port.packets if name == "Scan2d"]
    bench.clock.t_s += 5
    bench.start()
    after = [time_ns for name, _, time_ns in bench.port.packets if name == "Scan2d"]
    assert len(before) == 2
    assert after == before


POINTS_TO_DIE_AT = 5
"""One write and three packets; it is killed no more at the point after."""


@pytest.mark.parametrize("at", range(POINTS_TO_DIE_AT + 1))
def test_finished_scan_is_complete_and_once_wherever_the_translator_is_killed(
    bench: Any, scan: Any, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    """The kill comes after each write to the disk and before each packet of the scan."""
    cycle, published = Cycle(ScopeState.SCANNING, lambda result: True), dict[int, str]()
    reached = itertools.count()

    def take_in() -> None:
        for name, thing, time_ns in bench.port.packets:
            if isinstance(thing, ScopeStatus):
                cycle.on_state(thing.state, time_ns)
            elif name == "Scan2d" and time_ns not in published:
                published[time_ns] = thing.channel
                cycle.on_result(thing, time_ns)
        bench.port.packets.clear()

    def die_here(*_: Any, **__: Any) -> None:
        if next(reached) == at:
            raise Killed

    bench.ask(ACTION, names.START_SCAN, "me/key/tile-1/1")
    take_in()
    bench.microscope.files["a"] = [scan("Height"), scan("Phase")]
    bench.microscope.state = ScopeState.FREE
    with monkeypatch.context() as patched:
        save, publish = Memory.save, bench.port.publish
        patched.setattr(Memory, "save", lambda self: (save(self), die_here())[0])
        patched.setattr(bench.port, "publish", lambda *packet, **how: (die_here(), publish(*packet, **how))[1])
        with contextlib.suppress(Killed):
            bench.look()
    take_in()
    bench.clock.t_s += 5.0
    bench.start()
    bench.look()
    take_in()
    assert cycle.outcome is CycleOutcome.COMPLETED
    assert sorted(published.values()) == ["Height", "Phase"]
    assert (next(reached) > at) is (at < POINTS_TO_DIE_AT), "there are other points than those tried"


@pytest.mark.parametrize("is_full", [True, False])
def test_scan_without_a_file_is_logged_with_a_disk_that_is_full(
    bench: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, is_full: bool
) -> None:
    monkeypatch.setattr("afspm.translator.observer.is_full", lambda folder: is_full)
    bench.ask(ACTION, names.START_SCAN)
    bench.microscope.state = ScopeState.FREE
    bench.look()
    bench.look(after_s=20)
    assert "ended without a result" in caplog.text
    assert ("is full" in caplog.text) is is_full


def test_scan_of_nothing_but_nan_is_published_and_logged(
    bench: Any, scan: Any, caplog: pytest.LogCaptureFixture
) -> None:
    bench.ask(ACTION, names.START_SCAN)
    blank = replace(scan("Phase"), values=np.full((2, 3), np.nan))
    bench.microscope.files["a"] = [scan("Height"), blank]
    bench.microscope.state = ScopeState.FREE
    bench.look()
    assert bench.heard()[-3:] == ["Scan2d", "Scan2d", "FREE"]
    assert "a has no value in Phase: NaN alone" in caplog.text


def test_scan_lost_in_a_kill_is_published_as_interrupted(bench: Any) -> None:
    bench.ask(ACTION, names.START_SCAN)
    bench.microscope.state = ScopeState.FREE
    bench.start()
    bench.look(after_s=20)
    assert bench.heard()[-3:] == ["SCANNING", "INTERRUPTED", "FREE"]


def test_files_from_before_the_experiment_are_none_of_its_results(make_bench: Any, scan: Any, tmp_path: Any) -> None:
    bench = make_bench()
    (tmp_path / "translator.json").unlink()
    bench.microscope.files["yesterday"] = [scan()]
    bench.start()
    assert "Scan2d" not in bench.heard()


def test_times_of_packets_increase_strictly(bench: Any, scan: Any) -> None:
    bench.ask(ACTION, names.START_SCAN)
    bench.microscope.files["a"] = [scan("Height"), scan("Phase")]
    bench.microscope.state = ScopeState.FREE
    bench.look(after_s=0.0)
    times = [time_ns for _, _, time_ns in bench.port.packets]
    assert times == sorted(set(times))
    assert len(times) == 5
