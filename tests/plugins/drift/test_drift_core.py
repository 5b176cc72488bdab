"""Scans wait for their registration, also if the worker fails or hangs; and the responses to its reports."""

from __future__ import annotations

import json
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from tests.plugins.drift.drift_lab import HERE, NS, SHAPE, START_S, Lab, forecast, registered

from afspm import wire
from afspm.model import (
    ControlMode,
    ControlRequest,
    ControlResponse,
    Packet,
    Parameter,
    Problem,
    Region,
    RegistrationOutcome,
    Request,
    RescanKind,
    Scan,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    names,
)
from afspm.plugins.drift.frame.messages import NotRegistered, WorkerGone
from afspm.plugins.drift.frame.sample_frame import SampleFrame
from afspm.plugins.drift.frame.settings import Compensate, DriftCompensationSettings
from afspm.plugins.drift.frame.state import SavedDrift
from afspm.scheduler import ExperimentLimits, Log, PacketIn, RequestIn, Tick, TranslatorCaughtUp
from afspm.scheduler.events import Publish
from afspm.scheduler.safety.limits import Limit

DRIFT = (100e-9, -50e-9)
BACK = (-100e-9, 50e-9)
MOST_ENDS = 4


@pytest.fixture
def lab() -> Lab:
    made = Lab()
    made.in_force()
    return made


def centers(lab: Lab) -> list[tuple[float, float]]:
    return [scan.region.center_m for scan in lab.published("Scan2d")]


def logged(lab: Lab, level: str) -> list[str]:
    return [effect.text for effect in lab.effects if isinstance(effect, Log) and effect.level == level]


def test_all_channels_of_a_scan_wait_for_it_and_get_the_same_mapping(lab: Lab) -> None:
    lab.scan(channels=("Amplitude", "Height", "Height Retrace"))
    assert lab.envelopes() == ["ScopeStateMsg"]  # SCANNING
    (job,) = lab.worker.jobs
    assert job.scan.channel == "Height"
    lab.says(registered(job, forecast(DRIFT)))
    assert centers(lab) == [pytest.approx(BACK, abs=1e-16)] * 3
    assert [e.split("_")[0] for e in lab.envelopes()[1:]] == ["DriftMapping", *["Scan2d"] * 3, "ScopeStateMsg"]
    np.testing.assert_array_equal(lab.published("Scan2d")[0].values, np.ones(SHAPE))


@pytest.mark.parametrize("channels", [("ADC", "Topo", "Topo Retrace"), ("Topo", "Topo Retrace", "ADC", "ADC Retrace")])
def test_channels_in_separate_files_belong_to_one_scan(lab: Lab, channels: tuple[str, ...]) -> None:
    """GXSM writes each channel into its own file."""
    lab.take_control()
    lab.scope_is(ScopeState.SCANNING)
    lab.now_s += 256.0
    end_ns = lab.now_ns
    for channel in channels:
        unit = "m" if channel.startswith("Topo") else "V"
        lab.publish(Scan(HERE, channel, unit, np.ones(SHAPE), end_ns, f"scan001-{channel}.nc"))
    lab.scope_is(ScopeState.FREE)
    (job,) = lab.worker.jobs
    lab.says(registered(job, forecast(DRIFT)))
    assert centers(lab) == [pytest.approx(BACK, abs=1e-16)] * len(channels)
    assert not rescans(lab), "none of them counts as a scan without a height"
    assert not problems(lab)


def test_heights_without_values_are_not_registered(lab: Lab) -> None:
    lab.scope_is(ScopeState.SCANNING)
    lab.publish(Scan(HERE, "Amplitude", "V", np.ones(SHAPE), lab.now_ns, "a.nc"))
    lab.publish(Scan(HERE, "Height", "m", np.empty((0, 0)), lab.now_ns, "a.nc", SHAPE))
    assert not lab.worker.jobs
    lab.scope_is(ScopeState.FREE)
    assert [scan.shape for scan in lab.published("Scan2d")] == [SHAPE] * 2


def test_the_middle_of_a_scan_is_between_its_beginning_and_its_own_end(lab: Lab) -> None:
    """A late file does not move the middle."""
    lab.scope_is(ScopeState.SCANNING)
    began_s = lab.now_s
    end_s = began_s + 200.0
    lab.now_s += 500.0
    lab.publish(Scan(HERE, "Height", "m", np.ones(SHAPE), round(end_s * NS), "late.nc"))
    (job,) = lab.worker.jobs
    assert (job.start_s, job.end_s) == pytest.approx((began_s, end_s), abs=1e-6)


def test_packets_after_a_waiting_scan_wait_in_order(lab: Lab) -> None:
    lab.scan()
    lab.scan()
    assert len(lab.worker.jobs) == 1  # one after the other
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT)))
    assert len(lab.worker.jobs) == 2
    lab.says(registered(lab.worker.jobs[1], forecast(DRIFT)))
    states = [told.state for told in lab.published("ScopeStateMsg")]
    assert states == [ScopeState.SCANNING, ScopeState.FREE] * 2
    assert len(lab.published("Scan2d")) == 2


def test_requests_do_not_wait_for_a_scan(lab: Lab) -> None:
    lab.scan()
    lab.take_control()
    assert lab.replies()[-1].code == ControlResponse.SUCCESS


def test_a_scan_without_the_channel_is_published_as_predicted_at_its_end(lab: Lab) -> None:
    lab.knows(forecast(DRIFT))
    lab.scan(channels=("Amplitude", "Phase"))
    assert centers(lab) == [pytest.approx(BACK, abs=1e-16)] * 2
    assert not lab.worker.jobs
    assert "can't be used for drift" in logged(lab, "WARNING")[0]


def test_the_channel_may_be_set() -> None:
    lab = Lab(DriftCompensationSettings(channel="Amplitude"))
    lab.in_force()
    lab.scan(channels=("Height", "Amplitude"))
    assert lab.worker.jobs[0].scan.channel == "Amplitude"


def test_a_scan_that_takes_too_long_is_published_as_predicted_and_the_worker_restarted(lab: Lab) -> None:
    lab.knows(forecast(DRIFT))
    lab.scan()
    for _ in range(2):  # that the scheduler was started is written down first
        lab.now_s = lab.core.deadline_s() or 0.0
        lab.step(Tick())
    assert centers(lab) == [pytest.approx(BACK, abs=1e-16)]
    assert lab.worker.starts == 2
    assert "30 s" in logged(lab, "ERROR")[0]
    # and what that worker still says of the scan is of no use
    lab.says(registered(lab.worker.jobs[0], forecast((1e-6, 0.0))))
    assert len(centers(lab)) == 1


def test_before_its_deadline_nothing_is_given_up(lab: Lab) -> None:
    lab.scan()
    lab.now_s += 29.0
    lab.step(Tick())
    assert not centers(lab)


def test_a_worker_that_ends_during_a_scan_is_restarted_and_retries_it_once(lab: Lab) -> None:
    lab.scan()
    lab.says(WorkerGone("killed"))
    assert lab.worker.starts == 2
    assert [job.key for job in lab.worker.jobs] == [lab.worker.jobs[0].key] * 2
    assert not centers(lab)
    lab.says(WorkerGone("killed again"))
    assert len(centers(lab)) == 1


def test_a_worker_that_always_ends_is_not_restarted_and_no_scan_waits_for_it(lab: Lab) -> None:
    for _ in range(MOST_ENDS):
        lab.says(WorkerGone("no such estimator"))
    assert lab.worker.starts == MOST_ENDS
    assert "no such estimator" in logged(lab, "CRITICAL")[0]
    lab.scan()
    assert len(centers(lab)) == 1


def test_an_unregistered_scan_is_published_as_predicted(lab: Lab) -> None:
    lab.knows(forecast(DRIFT))
    lab.scan()
    lab.says(NotRegistered(lab.worker.jobs[0].key, "ZeroDivisionError: oh"))
    assert centers(lab) == [pytest.approx(BACK, abs=1e-16)]
    assert "oh" in logged(lab, "ERROR")[0]


def test_a_repeated_scan_has_the_same_mapping_and_is_not_registered_again(lab: Lab) -> None:
    lab.scan()
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT)))
    published = lab.published("Scan2d")[0]
    again = Lab(state=lab.saved())
    again.knows(forecast((1e-6, 1e-6)))
    again.effects.clear()
    name, payload = wire.encode(lab.worker.jobs[0].scan)
    time_ns = next(
        e.source_ns for e in lab.effects if isinstance(e, Publish) and e.packet.envelope.startswith("Scan2d")
    )
    again.step(PacketIn(Packet(name, payload, time_ns), wire.header(name, payload)))
    assert again.published("Scan2d")[0].region == published.region
    assert not again.worker.jobs


def test_a_mapping_is_saved_before_its_scan_is_published(lab: Lab) -> None:
    lab.scan()
    lab.effects.clear()
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT)))
    kinds = [type(effect).__name__ for effect in lab.effects]
    assert kinds.index("SaveState") < kinds.index("Publish")
    saved = lab.saved().frame
    assert isinstance(saved, SavedDrift)
    assert json.loads(saved.forecast.text or "") == forecast(DRIFT)
    assert list(saved.settled) == [lab.worker.jobs[0].key]


def test_step_changes_neither_the_state_before_it_nor_its_input(lab: Lab) -> None:
    lab.take_control()
    lab.scan()
    before = lab.core.state
    assert isinstance(before.frame, SampleFrame)
    parts = [*vars(before).values(), *vars(before.frame.state).values(), *vars(before.frame.state.places).values()]
    shown = [repr(part) for part in parts]
    report = registered(lab.worker.jobs[0], forecast(DRIFT), rescan="too far")
    lab.says(report)
    lab.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(HERE))
    assert lab.core.state is not before
    assert [repr(part) for part in parts] == shown
    with pytest.raises(FrozenInstanceError):
        RequestIn(1, "series", Request(1, None)).heard_s = 1.0  # type: ignore[misc]


def test_a_restarted_scheduler_announces_itself_after_the_scans_that_wait(lab: Lab) -> None:
    lab.take_control()
    state = lab.saved()
    again = Lab(state=state, translator=False)
    again.effects.clear()
    again.scan()
    again.step(TranslatorCaughtUp())
    assert "ControlState" not in again.envelopes()
    again.says(registered(again.worker.jobs[0], forecast()))
    assert [e.split("_")[0] for e in again.envelopes()][-3:] == ["Scan2d", "ScopeStateMsg", "ControlState"]


def test_a_waiting_scan_is_published_before_the_end(lab: Lab) -> None:
    lab.scan()
    lab.ask(ControlRequest.END_EXPERIMENT)
    kinds = [type(effect).__name__ for effect in lab.effects]
    assert len(centers(lab)) == 1
    assert kinds.index("Kill") > max(i for i, kind in enumerate(kinds) if kind == "Publish")


def test_late_report_after_the_end_announces_no_scan_twice(lab: Lab) -> None:
    lab.scan()
    lab.ask(ControlRequest.END_EXPERIMENT)
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT)))
    assert [told.outcome for told in lab.published("DriftMapping")] == [RegistrationOutcome.FAILED]


def test_a_mapping_is_published_with_uncertainty_rate_and_references(lab: Lab) -> None:
    lab.scan()
    (job,) = lab.worker.jobs
    lab.says(registered(job, forecast(DRIFT, (1e-12, 2e-12)), rescan="too far"))
    (told,) = lab.published("DriftMapping")
    assert told.timestamp.ToNanoseconds() == pytest.approx((job.start_s + job.end_s) / 2 * NS, abs=NS / 1000)
    assert (told.filename, told.matched, told.lost, told.correcting) == (job.scan.filename, True, False, True)
    assert told.rescan == "too far"
    assert list(told.rate) == pytest.approx([1e-12, 2e-12])
    matrix = np.array(told.matrix).reshape(2, 3)
    np.testing.assert_array_equal(matrix[:, :2], np.eye(2))
    assert [len(part) for part in (told.covariance, told.rate_covariance, told.residual, told.center)] == [4, 4, 2, 2]


# --- directions ---


def set_direction(lab: Lab, direction: str) -> None:
    lab.take_control()
    lab.forwards()
    lab.ask(ControlRequest.PARAM, Parameter(names.SCAN_DIRECTION, direction))
    lab.answer(lab.sent(), told=Parameter(names.SCAN_DIRECTION, direction))


@pytest.mark.parametrize(("direction", "upwards"), [("up", True), ("down", False), ("sideways", None)])
def test_the_direction_of_a_scan_is_the_one_in_force_at_its_start(
    lab: Lab, direction: str, upwards: bool | None
) -> None:
    set_direction(lab, direction)
    lab.scope_is(ScopeState.SCANNING)
    set_direction(lab, "down" if upwards else "up")
    lab.now_s += 100.0
    lab.publish(Scan(HERE, "Height", "m", np.ones(SHAPE), lab.now_ns, "a.nc"))
    assert lab.worker.jobs[0].upwards is upwards


def test_a_repeated_scanning_state_does_not_move_the_start_of_a_scan(lab: Lab) -> None:
    """For example to a restarted scheduler."""
    set_direction(lab, "up")
    lab.scope_is(ScopeState.SCANNING)
    began_s = lab.now_s
    lab.now_s += 200.0
    lab.scope_is(ScopeState.SCANNING)
    lab.now_s += 56.0
    lab.publish(Scan(HERE, "Height", "m", np.ones(SHAPE), lab.now_ns, "a.nc"))
    (job,) = lab.worker.jobs
    assert job.start_s == pytest.approx(began_s, abs=1e-6)
    assert job.upwards is True


def test_a_paused_scan_has_no_known_direction(lab: Lab) -> None:
    set_direction(lab, "up")
    lab.scope_is(ScopeState.SCANNING)
    began_s = lab.now_s
    for paused in (True, False):
        lab.now_s += 100.0
        lab.publish(ScopeStatus(ScopeState.SCANNING, paused=paused))
    lab.now_s += 100.0
    lab.publish(Scan(HERE, "Height", "m", np.ones(SHAPE), lab.now_ns, "a.nc"))
    (job,) = lab.worker.jobs
    assert (job.start_s, job.upwards) == (pytest.approx(began_s, abs=1e-6), None)


def test_scan_that_was_broken_off_has_no_known_direction_and_teaches_no_duration(lab: Lab) -> None:
    set_direction(lab, "up")
    lab.scope_is(ScopeState.SCANNING)
    lab.now_s += 25.6
    values = np.full(SHAPE, np.nan)
    values[:12] = 1.0
    lab.publish(Scan(HERE, "Height", "m", values, lab.now_ns, "a.nc"))
    assert lab.worker.jobs[0].upwards is None
    assert lab.drift.places.durations.expected_s(SHAPE, HERE.size_m) == 0.0


def test_a_continuous_scan_begins_with_its_scanning_state(lab: Lab) -> None:
    lab.scope_is(ScopeState.SCANNING)
    lab.now_s += 100.0
    lab.publish(Scan(HERE, "Height", "m", np.ones(SHAPE), lab.now_ns, "a.nc"))
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT)))
    lab.scope_is(ScopeState.SCANNING)
    began_s = lab.now_s
    lab.now_s += 100.0
    lab.publish(Scan(HERE, "Height", "m", np.ones(SHAPE), lab.now_ns, "b.nc"))
    assert lab.worker.jobs[1].start_s == pytest.approx(began_s, abs=1e-6)


# --- what follows ---


def rescans(lab: Lab) -> list[tuple[int, str]]:
    return [(told.kind, told.reason) for told in lab.published("DriftRescan")]


def problems(lab: Lab) -> tuple[int, ...]:
    return lab.core.control_state.problems


def test_a_scan_too_far_off_is_requested_again_at_its_requested_region(lab: Lab) -> None:
    lab.scan()
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT), rescan="too far off"))
    assert rescans(lab) == [(1, "too far off")]
    told = lab.published("DriftRescan")[0]
    wanted = wire.decode("ScanParameters2d", told.params.SerializeToString())
    assert wanted.region == HERE
    assert wanted.shape == SHAPE
    assert lab.envelopes()[-1] == "DriftRescan"  # after the scan itself
    assert not problems(lab)


@pytest.mark.parametrize("lost", [False, True])
def test_rescan_is_of_the_region_of_its_scan_though_another_is_set_meanwhile(lab: Lab, lost: bool) -> None:
    lab.take_control()
    lab.scan()
    elsewhere = Region((5e-6, 0.0), (1e-7, 1e-7))
    lab.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(elsewhere, (32, 32)))
    lab.answer(lab.sent())
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT), rescan="too far off", lost=lost))
    wanted = wire.decode("ScanParameters2d", lab.published("DriftRescan")[0].params.SerializeToString())
    assert (wanted.region, wanted.shape) == (HERE, SHAPE)


def test_a_lost_sample_is_flagged_and_searched_and_a_found_one_cleared(lab: Lab) -> None:
    lab.take_control()
    lab.scan()
    lab.effects.clear()
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT), lost=True))
    assert problems(lab) == (Problem.THERMAL_DRIFT,)
    assert lab.core.control.holder is None
    assert rescans(lab)[0][0] == 3
    assert not [f.request.subject for f in lab.forwards() if f.request.kind == ControlRequest.ACTION]  # none to stop
    lab.scan()
    lab.says(registered(lab.worker.jobs[1], forecast(DRIFT)))
    assert not problems(lab)


def test_a_searching_component_restores_its_region_before_the_flag_is_cleared(lab: Lab) -> None:
    lab.scan()
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT), lost=True))
    lab.ask(ControlRequest.REQUEST_CTRL, int(Problem.THERMAL_DRIFT), name="rescanner")
    assert lab.core.control.holder == "rescanner"
    lab.scan()
    lab.says(registered(lab.worker.jobs[1], forecast(DRIFT)))
    assert problems(lab) == (Problem.THERMAL_DRIFT,)
    lab.ask(ControlRequest.RMV_EXP_PRBLM, int(Problem.THERMAL_DRIFT), name="rescanner")
    assert not problems(lab)


def test_a_searching_component_gets_no_request_for_its_own_widened_region(lab: Lab) -> None:
    lab.scan()
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT), lost=True))
    lab.ask(ControlRequest.REQUEST_CTRL, int(Problem.THERMAL_DRIFT), name="rescanner")
    lab.scan()
    lab.says(registered(lab.worker.jobs[1], forecast(DRIFT), lost=True))
    assert len(rescans(lab)) == 1


def fail(lab: Lab, why: str = "clocks were set back") -> None:
    lab.scan()
    lab.says(NotRegistered(lab.worker.jobs[-1].key, why))


def test_three_unregistered_scans_in_a_row_mean_a_lost_sample(lab: Lab) -> None:
    lab.take_control()
    for _ in range(2):
        fail(lab)
    lab.scan()
    lab.says(registered(lab.worker.jobs[-1], forecast(DRIFT)))
    for _ in range(2):
        fail(lab)
    assert not problems(lab)
    fail(lab)
    assert problems(lab) == (Problem.THERMAL_DRIFT,)
    assert lab.core.control.holder is None
    assert rescans(lab) == [(3, "3 scans in a row could not be registered: clocks were set back")]


def test_scans_without_the_channel_count_as_unregistered() -> None:
    lab = Lab(DriftCompensationSettings(channel="Heigth"))
    lab.in_force()
    for _ in range(3):
        assert not problems(lab)
        lab.scan()
    assert problems(lab) == (Problem.THERMAL_DRIFT,)
    assert "Heigth" in rescans(lab)[0][1]


def test_the_count_of_unregistered_scans_survives_a_kill(lab: Lab) -> None:
    for _ in range(2):
        fail(lab)
    again = Lab(state=lab.saved(), now_s=lab.now_s)
    fail(again)
    assert problems(again) == (Problem.THERMAL_DRIFT,)


def test_without_correction_failed_registrations_flag_nothing() -> None:
    lab = Lab(DriftCompensationSettings(correct=False))
    lab.in_force()
    for _ in range(4):
        fail(lab)
    for _ in range(MOST_ENDS):
        lab.says(WorkerGone("no memory"))
    assert not problems(lab)


def test_a_person_is_called_though_correction_has_not_begun_yet() -> None:
    """When correction begins, no worker would do it."""
    lab = Lab(DriftCompensationSettings(correct_after=1000.0))
    lab.in_force()
    for _ in range(MOST_ENDS):
        lab.says(WorkerGone("another tracker's state"))
    assert problems(lab) == (Problem.DEVICE_MALFUNCTION,)


def test_a_scan_by_a_person_is_followed_and_not_requested_again(lab: Lab) -> None:
    lab.ask(ControlRequest.SET_CONTROL_MODE, int(ControlMode.MANUAL), name="dashboard:Ada")
    lab.scan()
    lab.says(registered(lab.worker.jobs[-1], forecast(DRIFT), rescan="it is 400 nm off"))
    lab.scan()
    lab.says(registered(lab.worker.jobs[-1], forecast(DRIFT), lost=True))
    for _ in range(5):
        fail(lab)
    assert not lab.published("DriftRescan")
    assert not problems(lab)
    assert lab.published("DriftMapping")


def test_a_sample_found_by_a_person_is_no_longer_lost(lab: Lab) -> None:
    lab.scan()
    lab.says(registered(lab.worker.jobs[-1], forecast(DRIFT), lost=True))
    assert problems(lab) == (Problem.THERMAL_DRIFT,)
    lab.ask(ControlRequest.SET_CONTROL_MODE, int(ControlMode.MANUAL), name="dashboard:Ada")
    lab.scan()
    lab.says(registered(lab.worker.jobs[-1], forecast(DRIFT)))
    assert not problems(lab)


def test_a_microscope_lost_for_a_moment_continues_its_scan(lab: Lab) -> None:
    lab.scope_is(ScopeState.SCANNING)
    began_s = lab.now_s
    lab.now_s += 128.0
    lab.scope_is(ScopeState.UNDEFINED)
    lab.now_s += 10.0
    lab.scope_is(ScopeState.SCANNING)
    lab.now_s += 118.0
    lab.publish(Scan(HERE, "Height", "m", np.ones(SHAPE), lab.now_ns, "1.nc"))
    (job,) = lab.worker.jobs
    assert job.start_s == pytest.approx(began_s, abs=0.01)


def test_a_dead_worker_calls_a_person_and_is_restarted_once_the_problem_is_cleared(
    lab: Lab,
) -> None:
    for _ in range(MOST_ENDS):
        lab.says(WorkerGone("the state can't be read"))
    assert problems(lab) == (Problem.DEVICE_MALFUNCTION,)
    starts = lab.worker.starts
    lab.step(Tick())
    assert lab.worker.starts == starts
    lab.ask(ControlRequest.RMV_EXP_PRBLM, int(Problem.DEVICE_MALFUNCTION), name="dashboard:Ada")
    assert not problems(lab)
    assert lab.worker.starts == starts + 1
    lab.scan()
    lab.says(registered(lab.worker.jobs[-1], forecast(DRIFT)))
    assert centers(lab)[-1] == pytest.approx(BACK, abs=1e-16)


def test_a_slow_registration_is_logged_before_it_takes_too_long(lab: Lab) -> None:
    for _ in range(2):
        lab.scan()
        lab.now_s += 12.0
        lab.says(registered(lab.worker.jobs[-1], forecast(DRIFT)))
    (told,) = logged(lab, "WARNING")
    assert "12.0 s" in told
    assert "longest_registration = 30 s" in told


def test_the_flag_of_another_client_is_not_touched(lab: Lab) -> None:
    lab.ask(ControlRequest.ADD_EXP_PRBLM, int(Problem.THERMAL_DRIFT), name="somebody")
    lab.scan()
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT)))
    assert problems(lab) == (Problem.THERMAL_DRIFT,)


def test_at_the_start_the_first_scan_is_requested_in_the_other_direction() -> None:
    lab = Lab(DriftCompensationSettings())
    lab.in_force()
    set_direction(lab, "up")
    lab.scan()
    lab.effects.clear()
    lab.says(registered(lab.worker.jobs[0], forecast()))
    (told,) = lab.published("DriftRescan")
    assert (told.kind, told.upwards) == (2, False)
    assert any("requesting a rescan" in text for text in logged(lab, "INFO"))
    assert not logged(lab, "WARNING")  # nothing is wrong
    assert problems(lab) == (Problem.THERMAL_DRIFT,)
    again = Lab(DriftCompensationSettings(), state=lab.saved())
    again.scan()
    again.effects.clear()
    again.says(registered(again.worker.jobs[0], forecast()))
    assert not again.published("DriftRescan")  # once in an experiment


def test_scan_that_was_broken_off_does_not_replace_the_first_scan_in_both_directions() -> None:
    lab = Lab(DriftCompensationSettings())
    lab.in_force()
    set_direction(lab, "up")
    values = np.ones(SHAPE)
    values[9:] = np.nan
    lab.scope_is(ScopeState.SCANNING)
    lab.now_s += 20.0
    lab.publish(Scan(HERE, "Height", "m", values, lab.now_ns, "a.nc"))
    lab.scope_is(ScopeState.FREE)
    lab.says(registered(lab.worker.jobs[0], forecast()))
    assert not lab.published("DriftRescan")
    lab.scan()
    lab.says(registered(lab.worker.jobs[1], forecast()))
    assert [told.upwards for told in lab.published("DriftRescan")] == [False]


def test_a_microscope_without_a_direction_is_not_waited_for() -> None:
    lab = Lab(DriftCompensationSettings())
    lab.in_force()
    lab.scan()
    lab.says(registered(lab.worker.jobs[0], forecast()))
    assert not problems(lab)
    assert any(names.SCAN_DIRECTION in text for text in logged(lab, "INFO"))


def test_without_correction_drift_is_published_without_a_response() -> None:
    lab = Lab(DriftCompensationSettings(correct=False))
    lab.in_force()
    lab.scan()
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT), lost=True, rescan="far off"))
    assert centers(lab) == [HERE.center_m]
    assert not lab.published("DriftMapping")[0].correcting
    assert not lab.published("DriftRescan")
    assert not problems(lab)


# --- a controller that compensates by itself ---


def test_the_controller_is_set_to_the_compensation_in_force_at_the_start() -> None:
    """At first nothing, whichever rate an earlier night has left; after a restart the rate before it."""
    drift = DriftCompensationSettings(compensate=Compensate("x-rate-x", "x-rate-y"))
    lab = Lab(drift, answer_start=False)
    told = []
    while forwards := lab.forwards():
        for forward in forwards:
            if isinstance(forward.request.subject, Parameter) and forward.request.subject.value is not None:
                told.append(forward.request.subject)
            lab.answer(forward)
    assert told == [Parameter("x-rate-x", "0", "m/s"), Parameter("x-rate-y", "0", "m/s")]


def test_a_known_rate_is_handed_over_and_reported_to_the_worker_with_its_time() -> None:
    lab = Lab(DriftCompensationSettings(compensate=Compensate("x-rate-x", "x-rate-y")))
    lab.in_force()
    lab.scan()
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT, (1e-10, -2e-10), at_s=lab.now_s, rate_sd_m_s=1e-11)))
    first = lab.sent()
    assert first.request.subject == Parameter("x-rate-x", "1e-10", "m/s")
    lab.answer(first)
    second = lab.sent()
    assert second.request.subject == Parameter("x-rate-y", "-2e-10", "m/s")
    lab.answer(second)
    assert lab.worker.velocities == [
        (pytest.approx(lab.now_s), (1e-10, 0.0)),
        (pytest.approx(lab.now_s), (1e-10, -2e-10)),
    ]
    lab.scan()
    lab.says(registered(lab.worker.jobs[1], forecast(DRIFT, (1e-12, 0.0), at_s=lab.now_s, rate_sd_m_s=1e-11)))
    assert not lab.forwards()  # what is left is not known to be anything
    lab.scan()
    lab.says(registered(lab.worker.jobs[2], forecast(DRIFT, (5e-11, 0.0), at_s=lab.now_s, rate_sd_m_s=1e-11)))
    assert lab.sent().request.subject == Parameter("x-rate-x", "1.5e-10", "m/s")


def test_a_controller_that_refuses_the_rate_is_logged() -> None:
    lab = Lab(DriftCompensationSettings(compensate=Compensate("x-rate-x", "x-rate-y")))
    lab.in_force()
    lab.scan()
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT, (1e-10, -2e-10), at_s=lab.now_s)))
    lab.answer(lab.sent(), ControlResponse.PARAM_NOT_SUPPORTED)
    assert "x-rate-x" in logged(lab, "ERROR")[0]
    lab.answer(lab.sent())
    assert [velocity for _, velocity in lab.worker.velocities] == [(0.0, -2e-10)], "the other is as it was"


def test_rate_beyond_a_limit_of_the_experiment_is_not_sent() -> None:
    limits = ExperimentLimits({"x-rate-x": Limit(low=-5e-11, high=5e-11, unit="m/s")})
    lab = Lab(DriftCompensationSettings(compensate=Compensate("x-rate-x", "x-rate-y")), limits)
    lab.in_force()
    lab.scan()
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT, (1e-10, -2e-10), at_s=lab.now_s)))
    assert "x-rate-x = 100 pm/s is above the highest allowed, 50 pm/s" in logged(lab, "ERROR")[0]
    assert lab.sent().request.subject.name == "x-rate-y"
    assert not lab.worker.velocities


def test_the_rate_stays_while_a_person_is_in_control() -> None:
    lab = Lab(DriftCompensationSettings(compensate=Compensate("x-rate-x", "x-rate-y")))
    lab.in_force()
    lab.ask(ControlRequest.SET_CONTROL_MODE, int(ControlMode.MANUAL), name="dashboard:Ada")
    lab.scan()
    lab.says(registered(lab.worker.jobs[0], forecast(DRIFT, (1e-10, -2e-10), at_s=lab.now_s)))
    assert not lab.forwards()


def test_packets_other_than_scans_pass_unchanged(lab: Lab) -> None:
    lab.step(PacketIn(Packet("Scan2d", b"\x0a\x00", lab.now_ns), wire.header("Scan2d", b"\x0a\x00")))
    assert not lab.worker.jobs
    lab.publish(ScopeStatus(ScopeState.FREE))
    assert "ScopeStateMsg" in lab.envelopes()


def test_answers_equal_those_of_the_plain_scheduler(lab: Lab) -> None:
    """A drop-in: requests without places are decided by the same core."""
    lab.step(RequestIn(99, "stranger", Request(int(ControlRequest.ACTION), names.START_SCAN, b"", "stranger/1/1")))
    assert lab.replies()[-1].code == ControlResponse.NOT_IN_CONTROL


def test_mapping_is_correcting_exactly_if_its_scan_is_published_in_sample_coordinates() -> None:
    lab = Lab(DriftCompensationSettings(correct_after=1000.0, at_start="nothing"))
    lab.in_force()
    for begins_s, corrected in ((900.0, False), (1100.0, True)):
        lab.now_s = START_S + begins_s
        lab.scan(duration_s=150.0)
        lab.now_s = START_S + begins_s + 160.0
        lab.effects.clear()
        lab.says(registered(lab.worker.jobs[-1], forecast(DRIFT)))
        assert centers(lab) == [pytest.approx(BACK if corrected else (0.0, 0.0), abs=1e-16)]
        assert [told.correcting for told in lab.published("DriftMapping")] == [corrected]


def test_correction_that_begins_later_needs_no_scan_in_the_other_direction() -> None:
    lab = Lab(DriftCompensationSettings(correct_after=1000.0))
    lab.in_force()
    set_direction(lab, "up")
    for number in range(2):
        lab.scan()
        lab.says(registered(lab.worker.jobs[number], forecast()))
        lab.now_s += 1000.0
    assert not lab.published("DriftRescan")
    assert not problems(lab)


# --- how the position of each scan is known ---

SEEN, BADLY = RegistrationOutcome.REGISTERED, RegistrationOutcome.REFUSED


def taken(lab: Lab, outcome: RegistrationOutcome, *failures: str) -> None:
    """Publish a scan, registered with this outcome."""
    lab.scan()
    lab.says(registered(lab.worker.jobs[-1], forecast(DRIFT), outcome=outcome, failures=failures))


def test_an_unregistered_scan_has_a_mapping(lab: Lab) -> None:
    """Without it neither the table nor the counts would show the scan."""
    lab.knows(forecast(DRIFT, rate_sd_m_s=1e-12))
    lab.scan()
    (job,) = lab.worker.jobs
    lab.says(NotRegistered(job.key, "ZeroDivisionError: oh"))
    assert [e.split("_")[0] for e in lab.envelopes()][-3:] == ["DriftMapping", "Scan2d", "ScopeStateMsg"]
    (told,) = lab.published("DriftMapping")
    assert (told.outcome, told.matched, told.reason) == (RegistrationOutcome.FAILED, False, "ZeroDivisionError: oh")
    assert (told.filename, tuple(told.center)) == (job.scan.filename, HERE.center_m)
    assert told.covariance[0] > 0.0, "the uncertainty of a prediction"
    assert "registered 0 of 1 scan, 1 failed" in logged(lab, "ERROR")[0]


def test_a_scan_before_any_registration_has_no_uncertainty(lab: Lab) -> None:
    lab.scan()
    lab.says(NotRegistered(lab.worker.jobs[0].key, "oh"))
    (told,) = lab.published("DriftMapping")
    assert list(told.covariance) == []
    assert "(unknown)" in logged(lab, "ERROR")[0]


def test_each_error_of_the_estimator_is_logged_with_its_pair_and_counted(lab: Lab) -> None:
    taken(lab, RegistrationOutcome.COARSE, "numbers failed to register b.nc with a.nc: oh")
    assert logged(lab, "ERROR") == ["numbers failed to register b.nc with a.nc: oh"]
    (told,) = lab.published("DriftMapping")
    assert (told.outcome, told.failures, told.matched) == (RegistrationOutcome.COARSE, 1, True)
    assert "is registered coarsely" in logged(lab, "WARNING")[0]


def test_the_tally_survives_a_restart_and_is_logged_at_the_end(lab: Lab) -> None:
    for outcome in (SEEN, BADLY, RegistrationOutcome.NEW):
        taken(lab, outcome)
    assert "registered 1 of 2 scans, 1 not recognised" in logged(lab, "WARNING")[0]
    again = Lab(state=lab.saved(), now_s=lab.now_s + 100.0)
    again.in_force()
    taken(again, SEEN)
    again.ask(ControlRequest.END_EXPERIMENT)
    assert "drift: registered 2 of 4 scans, 1 not recognised, 1 of a new place" in logged(again, "INFO")
    kinds = [type(effect).__name__ for effect in again.effects]
    assert kinds.index("Log") < kinds.index("Kill")


@pytest.mark.parametrize(("share", "flagged_after"), [(0.5, 6), (0.2, 3), (1.0, None)])
def test_too_many_unregistered_scans_flag_thermal_drift(share: float, flagged_after: int | None) -> None:
    lab = Lab(DriftCompensationSettings(at_start="nothing", most_unregistered=share))
    lab.in_force()
    taken(lab, SEEN)
    flagged = []
    for _ in range(11):
        taken(lab, BADLY)
        flagged.append(bool(problems(lab)))
        if flagged[-1]:
            break
        taken(lab, RegistrationOutcome.NEW)  # says nothing about drift
    assert (len(flagged) if any(flagged) else None) == flagged_after
    if flagged_after is not None:
        ((kind, reason),) = rescans(lab)
        assert kind == RescanKind.SEARCH
        assert f"more than {share:.0%} of the last 10 scans were not registered: registered 1 of" in reason
        taken(lab, BADLY)
        assert problems(lab) == (Problem.THERMAL_DRIFT,), "an unregistered scan removes no flag"
        taken(lab, SEEN)
        assert not problems(lab)


def test_some_unregistered_scans_between_others_flag_nothing(lab: Lab) -> None:
    for outcome in (SEEN, BADLY) * 10:
        taken(lab, outcome)
    assert not problems(lab)


def test_the_first_flag_of_a_run_is_logged_as_normal() -> None:
    lab = Lab(DriftCompensationSettings())
    lab.in_force()
    set_direction(lab, "up")
    taken(lab, SEEN)
    assert any("thermal-drift is flagged" in text and "normal at the start" in text for text in logged(lab, "INFO"))
