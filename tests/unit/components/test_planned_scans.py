"""Scans by plan in the in-memory laboratory: each exactly once, over kills and lost control."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client_lab import EPOCH_S, SCAN_S, Kill9, Lab, LabPort, context_of, run

from afspm import wire
from afspm.basics.errors import ConfigError, Refused
from afspm.basics.exit_codes import ExitCode
from afspm.client.component import Component
from afspm.components.planned_scans import ScanList, ScanSeries
from afspm.components.spectroscopy_grid import SpectroscopyGrid
from afspm.components.tip_verdict import BAD, GOOD, MESSAGE, LineVerdict, line_verdict_message, verdict_message
from afspm.model import (
    RELAY_REQUEST,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Note,
    Parameter,
    Problem,
    Progress,
    Region,
    Request,
    Response,
    Scan,
    ScanParameters,
)
from afspm.model.requests import LEND_REQUEST, RETURN_REQUEST


def series(scans: int = 3, *, keep_control: bool = False, end_when_done: bool = True, **planned: Any) -> ScanSeries:
    return ScanSeries(
        size=(1e-6, 1e-6),
        pixels=(8, 8),
        every=900.0,
        scans=scans,
        keep_control=keep_control,
        end_when_done=end_when_done,
        **planned,
    )


def test_a_series_is_taken_on_its_beat_and_ends_the_experiment() -> None:
    lab = Lab("series")
    assert run(series(), lab) == ExitCode.ENDED
    assert len(lab.finished) == 3
    assert lab.control.ended
    assert 1800.0 < lab.clock.passed_s < 1800.0 + 2 * SCAN_S


def test_a_series_that_need_not_end_the_experiment_leaves_it_running() -> None:
    lab = Lab("series")
    assert run(series(end_when_done=False), lab) == ExitCode.DONE
    assert not lab.control.ended


def test_control_is_released_between_scans_unless_kept() -> None:
    given_back, kept = Lab("series"), Lab("series")
    run(series(), given_back)
    run(series(keep_control=True), kept)
    assert given_back.count(ControlRequest.RELEASE_CTRL) >= 3
    assert kept.count(ControlRequest.RELEASE_CTRL) <= 2  # after setting parameters, and at the end


def test_scan_interrupted_by_a_problem_is_repeated_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("series")
    lab.at(40.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(400.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    with caplog.at_level("WARNING"):
        assert run(series(keep_control=True), lab) == ExitCode.ENDED
    assert len(lab.finished) == 3
    assert "was interrupted, and taken again" in caplog.text


def lasting(duration_s: float, every_s: float, **planned: Any) -> ScanSeries:
    return ScanSeries(
        size=(1e-6, 1e-6), pixels=(8, 8), every=every_s, duration=duration_s, end_when_done=True, **planned
    )


def at_times(series: ScanSeries, lab: Lab) -> list[int]:
    """Return when each scan began, in periods of 900 s; control is lost from 150 s to 3000 s."""
    begun: list[int] = []

    def note(request: Request) -> str:
        if request.subject == "start-scan":
            begun.append(int(lab.clock.passed_s // 900.0))
        return "go on"

    lab.intercept = note
    lab.at(150.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(3000.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    assert run(series, lab) == ExitCode.ENDED
    return begun


@pytest.mark.parametrize(
    ("missed", "begun", "told"),
    [
        ("extend", [0, 3, 4, 5, 6], "2 scans could not begin in time; to be taken at the end"),
        ("catch-up", [0, 3, 3, 3, 4], "2 scans could not begin in time; to be taken now, one after the other"),
        ("skip", [0, 3, 4], "2 scans could not begin in time; skipped"),
    ],
)
@pytest.mark.parametrize("make", [lambda **p: series(5, **p), lambda **p: lasting(4 * 900.0, 900.0, **p)])
def test_setting_missed_decides_on_scans_missed_while_control_was_lost(
    make: Callable[..., ScanSeries], missed: str, begun: list[int], told: str, caplog: pytest.LogCaptureFixture
) -> None:
    lab = Lab("series")
    assert at_times(make(missed=missed), lab) == begun
    assert told in caplog.messages
    assert [note.text for note in notes_of(lab)] == [told]


@pytest.mark.parametrize(("missed", "taken"), [("extend", 3), ("skip", 2)])
def test_no_more_scans_are_missed_than_are_left(missed: str, taken: int) -> None:
    lab = Lab("series")
    assert len(at_times(series(3, missed=missed), lab)) == taken
    (note,) = notes_of(lab)
    assert note.text.startswith("1 scan could not begin in time")


def notes_of(lab: Lab) -> list[Note]:
    relayed = [request.subject for request in lab.requests if request.kind == RELAY_REQUEST]
    return [wire.decode(one.message, one.payload) for one in relayed if one.message == "Note"]


def test_by_default_no_scan_is_lost() -> None:
    assert len(at_times(lasting(4 * 900.0, 900.0), Lab("series"))) == 5


def test_series_with_a_duration_ends_on_time_however_long_a_scan_takes(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("series")
    with caplog.at_level("INFO"):
        assert run(lasting(600.0, every_s=60.0), lab) == ExitCode.ENDED  # each takes longer than that
    assert len(lab.finished) == 6  # at 0, 120, 240 … 600 s
    assert lab.clock.passed_s < 600.0 + 2 * SCAN_S
    assert "6 of 11 scans are taken; the time of 5 had passed" in caplog.messages
    assert caplog.messages.count("a round takes 101 s, longer than its period of 60 s") == 1


def test_time_without_a_running_process_does_not_count_for_the_duration_of_a_series(tmp_path: Path) -> None:
    lab = Lab("series")
    lab.at(1000.0, lab.parent_goes)
    lasting(4 * 900.0, every_s=900.0).run_process(context_of(lab, tmp_path))
    lab.clock.passed_s += 20_000.0
    lab.restart_component()
    run(lasting(4 * 900.0, every_s=900.0), lab, tmp_path)
    assert len(lab.finished) == 5


def test_missed_scan_is_logged_in_the_singular(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("series")
    lab.at(150.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(2000.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    with caplog.at_level("WARNING"):
        run(series(), lab)
    assert "1 scan could not begin in time; to be taken at the end" in caplog.text


def _killed_at(
    call: int, make: type[Component] | object, state_dir: Path, *, is_late: bool, lab: Lab | None = None
) -> Lab:
    lab = lab or Lab("series")
    context = context_of(lab, state_dir)
    context.open_port, context.session = lambda: LabPort(lab, call, is_late=is_late), "killed"
    try:
        make().run_process(context)  # type: ignore[operator]
    except Kill9:
        lab.restart_component()
        run(make(), lab, state_dir)  # type: ignore[operator]
    return lab


@pytest.mark.parametrize("is_late", [False, True])
@pytest.mark.parametrize("keep_control", [False, True])
def test_no_scan_is_missing_or_repeated_after_a_kill_anywhere(
    tmp_path: Path, is_late: bool, keep_control: bool
) -> None:
    for call in range(1, 150, 7):
        folder = tmp_path / str(call)
        lab = _killed_at(call, lambda: series(keep_control=keep_control), folder, is_late=is_late)
        assert len(lab.finished) == 3, f"killed at call {call}"


def test_scan_that_runs_over_a_restart_is_still_stopped_by_a_problem(tmp_path: Path) -> None:
    lab = Lab("series")
    port = LabPort(lab)

    def die() -> None:
        port.is_dead = True
        lab.wake_up()

    lab.at(30.0, die)
    context = context_of(lab, tmp_path)
    context.open_port, context.session = lambda: port, "killed"
    with pytest.raises(Kill9):
        series().run_process(context)
    lab.restart_component()
    lab.at(20.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(300.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    run(series(), lab, tmp_path)
    assert lab.begun_scans == 4
    assert len(lab.finished) == 3


def test_saved_state_of_a_series_does_not_grow(tmp_path: Path) -> None:
    """Otherwise a night of a thousand scans would keep each of them twice."""
    kept: list[int] = []
    lab = Lab("series")
    for number in range(1, 6):
        lab.at(900.0 * number - 100.0, lambda: kept.append(len(list(tmp_path.rglob("scan-*")))))
    run(series(scans=6), lab, tmp_path)
    assert len(lab.finished) == 6
    assert kept == [0] * 5


def test_restarted_plan_logs_where_it_continues_unless_nothing_is_left(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO"):
        _killed_at(40, lambda: series(scans=9), tmp_path / "killed", is_late=False)
        assert "going on with scan" in caplog.text
        caplog.clear()
        run(series(end_when_done=False), Lab("series"), tmp_path)
        run(series(), Lab("series"), tmp_path)
    assert "going on with" not in caplog.text
    assert caplog.text.count("all 3 scans are taken") == 2


def test_list_is_scanned_in_order_round_after_round() -> None:
    lab = Lab("list")
    places = [{"center": [x, 0.0], "size": [1e-6, 1e-6]} for x in (1e-6, 2e-6)]
    run(ScanList(regions=places, pixels=(8, 8), rounds=2), lab)  # type: ignore[arg-type]
    assert [region.center_m[0] for region in lab.finished] == [1e-6, 2e-6, 1e-6, 2e-6]


def test_each_scan_carries_the_parameters_of_its_plan() -> None:
    lab = Lab("series")
    plan = ScanSeries(size=(1e-6, 1e-6), pixels=(8, 8), scans=2, parameters={"tip-bias-voltage": "250 mV"})
    run(plan, lab)
    wanted = Parameter("tip-bias-voltage", "250.0", "mV")
    assert [one.subject.parameters for one in lab.requests if one.kind == LEND_REQUEST] == [(wanted,)] * 2
    kinds = [one.kind for one in lab.requests if one.kind in (LEND_REQUEST, ControlRequest.ACTION, RETURN_REQUEST)]
    assert kinds[:5] == [*2 * [LEND_REQUEST, ControlRequest.ACTION], RETURN_REQUEST]


def test_a_spectrum_is_taken_at_each_point_of_a_grid() -> None:
    lab = Lab("grid")
    run(SpectroscopyGrid(counts=(2, 2), spacing=(1e-7, 1e-7), repeats=2, end_when_done=True), lab)
    assert lab.begun_scans == 8
    assert lab.control.ended


def test_a_large_grid_of_spectra_does_not_flood_the_log(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"):
        run(SpectroscopyGrid(counts=(10, 5), spacing=(1e-8, 1e-8), end_when_done=True), Lab("grid"))
    lines = [message for message in caplog.messages if message.startswith("spectrum ")]
    assert len(lines) == 20
    assert lines[-1] == "spectrum 50 of 50"


def progress_of(lab: Lab) -> list[Progress]:
    told = [request.subject for request in lab.requests if request.kind == RELAY_REQUEST]
    return [wire.decode(one.message, one.payload) for one in told]


def told_progress(lab: Lab) -> list[tuple[str, int, int]]:
    return [(one.name, one.done, one.of) for one in progress_of(lab)]


def test_progress_is_published() -> None:
    lab = Lab("series")
    run(series(), lab)
    assert told_progress(lab) == [("series", 1, 3), ("series", 2, 3), ("series", 3, 3)]


def test_remaining_time_of_a_series_follows_its_period() -> None:
    lab = Lab("series")
    run(series(), lab)
    assert [one.left_s for one in progress_of(lab)] == pytest.approx([1800.0, 900.0, 0.0])


def test_remaining_time_of_a_list_follows_its_pace() -> None:
    lab = Lab("list")
    place = {"center": (0.0, 0.0), "size": (1e-6, 1e-6)}
    run(ScanList([place, place, place], pixels=(8, 8), end_when_done=True), lab)  # type: ignore[list-item]
    first, second, last = (one.left_s for one in progress_of(lab))
    assert first == pytest.approx(2 * SCAN_S, rel=0.1)
    assert second == pytest.approx(SCAN_S, rel=0.1)
    assert last == 0.0


def list_of(number: int) -> ScanList:
    place = {"center": (0.0, 0.0), "size": (1e-6, 1e-6)}
    return ScanList([place] * number, pixels=(8, 8), end_when_done=True)  # type: ignore[list-item]


def test_remaining_time_leaves_out_the_pause_of_a_person() -> None:
    lab = Lab("list")
    lab.at(1.5 * SCAN_S, lambda: lab.set_mode(ControlMode.MANUAL))
    lab.at(100 * SCAN_S, lambda: lab.set_mode(ControlMode.AUTOMATED))
    run(list_of(4), lab)
    # the second scan was interrupted after half of it, and taken again
    assert progress_of(lab)[1].left_s == pytest.approx(2 * 2.5 / 2 * SCAN_S, rel=0.1)


def test_remaining_time_includes_repairs() -> None:
    lab = Lab("list")
    lab.at(1.5 * SCAN_S, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(11 * SCAN_S, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    run(list_of(4), lab)
    assert progress_of(lab)[1].left_s == pytest.approx(2 * 12 / 2 * SCAN_S, rel=0.1)


def test_remaining_time_leaves_out_the_time_before_a_restart(tmp_path: Path) -> None:
    lab = Lab("list")
    port = LabPort(lab)

    def die() -> None:
        port.is_dead = True
        lab.wake_up()

    lab.at(1.5 * SCAN_S, die)
    context = context_of(lab, tmp_path)
    context.open_port, context.session = lambda: port, "killed"
    with pytest.raises(Kill9):
        list_of(4).run_process(context)
    lab.clock.passed_s += 1000 * SCAN_S
    lab.restart_component()
    run(list_of(4), lab, tmp_path)
    assert progress_of(lab)[-1].left_s == 0.0
    # the second scan ended while no component ran
    assert progress_of(lab)[-2].left_s == pytest.approx(2 / 3 * SCAN_S, rel=0.1)


def test_remaining_time_is_estimated_from_the_pace_by_default() -> None:
    class Script(Component):
        def run(self) -> None:
            self.scope.set("tip-bias-voltage", 1.0)  # the scheduler is known then
            for done in range(3):
                self.scope.progress(done, 4)
                self.scope.sleep(60.0)

    lab = Lab("script")
    run(Script(), lab)
    assert [one.left_s for one in progress_of(lab)] == [None, pytest.approx(180.0), pytest.approx(120.0)]


def test_endless_series_publishes_no_progress() -> None:
    lab = Lab("series")
    lab.at(2000.0, lab.kill)
    run(ScanSeries(size=(1e-6, 1e-6), pixels=(8, 8), every=900.0), lab)
    assert len(lab.finished) == 3
    assert told_progress(lab) == []


def test_spectroscopy_grid_publishes_its_progress() -> None:
    lab = Lab("grid")
    run(SpectroscopyGrid(counts=(2, 1), spacing=(1e-9, 1e-9), end_when_done=True), lab)
    assert told_progress(lab) == [("grid", 1, 2), ("grid", 2, 2)]


@pytest.mark.parametrize("every", [-1.0, float("inf"), float("nan")])
def test_a_series_without_a_sensible_period_is_refused(every: float) -> None:
    with pytest.raises(ConfigError, match="a period of"):
        ScanSeries(size=(1e-6, 1e-6), every=every)


def line_verdict(shape: tuple[int, int], row: int, *, stops: bool, began_ns: int | None = None) -> LineVerdict:
    where = Region((0.0, 0.0), (1e-6, 1e-6))
    return LineVerdict(where, shape, "Height", began_ns, row + 3, row, downwards=False, confidence=0.99, stops=stops)


def stop_at_row(lab: Lab, row: int, shape: tuple[int, int] = (32, 8), *, began_s: float | None = None) -> None:
    """Publish a verdict on the running scan, or on the scan that began at `began_s`, and flag the tip."""
    began_ns = None if began_s is None else round((EPOCH_S + began_s) * 1e9)
    verdict = line_verdict(shape, row, stops=True, began_ns=began_ns)
    lab.publish(line_verdict_message(verdict), "TipVerdict_line_watch")
    lab.flag(Problem.TIP_SHAPE_CHANGED)


def rest_series() -> ScanSeries:
    return ScanSeries(size=(1e-6, 1e-6), pixels=(8, 32), every=900.0, scans=2, end_when_done=True, missed="rest")


def test_rest_of_a_scan_is_taken_from_the_row_of_the_alarm(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("series")
    lab.at(40.0, lambda: stop_at_row(lab, 20))
    lab.at(400.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    with caplog.at_level("INFO"):
        assert run(rest_series(), lab) == ExitCode.ENDED
    assert "rows 18 to 31 are left" in caplog.text
    rest, whole = lab.finished
    assert rest.size_m == pytest.approx((1e-6, 13 / 31 * 1e-6))
    assert rest.center_m == pytest.approx((0.0, (24.5 / 31 - 0.5) * 1e-6))
    assert whole.size_m == pytest.approx((1e-6, 1e-6))


def test_whole_scan_is_taken_again_after_an_interruption_without_a_row() -> None:
    lab = Lab("series")
    lab.at(40.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(400.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    assert run(rest_series(), lab) == ExitCode.ENDED
    assert [region.size_m for region in lab.finished] == [pytest.approx((1e-6, 1e-6))] * 2


@pytest.mark.parametrize(("began_s", "rest_nm"), [(2.0, 1000), (110.0, 419)])
def test_only_a_verdict_on_the_stopped_scan_shortens_it(began_s: float, rest_nm: int) -> None:
    lab = Lab("series")
    # the second scan is running: a verdict on the first one came late
    lab.at(140.0, lambda: stop_at_row(lab, 20, began_s=began_s))
    lab.at(400.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    series = ScanSeries(size=(1e-6, 1e-6), pixels=(8, 32), scans=2, end_when_done=True, missed="rest")
    assert run(series, lab) == ExitCode.ENDED
    assert [round(region.size_m[1] * 1e9) for region in lab.finished] == [1000, rest_nm]


def test_rest_begins_at_the_first_change_of_several_verdicts() -> None:
    lab = Lab("series")
    lab.at(35.0, lambda: lab.publish(line_verdict_message(line_verdict((32, 8), 12, stops=True)), "TipVerdict_second"))
    lab.at(40.0, lambda: stop_at_row(lab, 20))
    lab.at(400.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    assert run(rest_series(), lab) == ExitCode.ENDED
    assert lab.finished[0].size_m == pytest.approx((1e-6, 21 / 31 * 1e-6))


def test_verdict_for_a_person_does_not_shorten_a_scan() -> None:
    lab = Lab("series")
    look = line_verdict((32, 8), 18, stops=False)
    lab.at(30.0, lambda: lab.publish(line_verdict_message(look), "TipVerdict_line_watch"))
    lab.at(40.0, lambda: lab.flag(Problem.TIP_SHAPE_CHANGED))
    lab.at(400.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    assert run(rest_series(), lab) == ExitCode.ENDED
    assert [region.size_m for region in lab.finished] == [pytest.approx((1e-6, 1e-6))] * 2


def test_refused_rest_is_replaced_by_the_whole_scan(tmp_path: Path) -> None:
    lab = Lab("series")

    def no_fewer_rows(request: Request) -> Response | str:
        parameters = request.subject
        if isinstance(parameters, ScanParameters) and parameters.shape not in (None, (32, 8)):
            return Response(ControlResponse.PARAM_ERROR, reason="rows must be 32")
        return "go on"

    lab.intercept = no_fewer_rows
    lab.at(40.0, lambda: stop_at_row(lab, 20))
    lab.at(400.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    assert run(rest_series(), lab, tmp_path) == ExitCode.ENDED
    assert [region.size_m for region in lab.finished] == [pytest.approx((1e-6, 1e-6))] * 2
    assert not list(tmp_path.rglob("scan-*")), "no result is kept"


def test_rest_is_taken_once_over_a_kill(tmp_path: Path) -> None:
    lab = Lab("series")
    lab.at(40.0, lambda: stop_at_row(lab, 20))
    lab.at(400.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    port = LabPort(lab)
    lab.at(430.0, lambda: setattr(port, "is_dead", True))
    context = context_of(lab, tmp_path)
    context.open_port, context.session = lambda: port, "killed"
    with pytest.raises(Kill9):
        rest_series().run_process(context)
    lab.restart_component()
    assert run(rest_series(), lab, tmp_path) == ExitCode.ENDED
    assert [round(region.size_m[1] * 1e9) for region in lab.finished] == [419, 1000]


PLACES_M = (1e-6, 2e-6, 3e-6)


def places(**planned: Any) -> ScanList:
    regions = [{"center": [x, 0.0], "size": [1e-6, 1e-6]} for x in PLACES_M]
    return ScanList(regions=regions, pixels=(8, 8), end_when_done=True, **planned)  # type: ignore[arg-type]


def judged(lab: Lab, *bad: int, in_s: float = 5.0) -> Lab:
    """Publish a verdict on each scan `in_s` after its end; bad ones on the scans of these numbers, from 1."""
    publish_scan = lab.publish_scan

    def publish_and_judge(region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        publish_scan(region, shape)
        score = BAD if len(lab.finished) in bad else GOOD
        scan = Scan(region, "Height", "m", np.zeros(shape), lab.clock.now_ns())
        lab.at(in_s, lambda: lab.publish(verdict_message(scan, score), f"{MESSAGE}_tip_classifier"))

    lab.publish_scan = publish_and_judge  # type: ignore[method-assign]
    return lab


def taken(lab: Lab) -> list[float]:
    return [round(region.center_m[0] * 1e6) for region in lab.finished]


def test_bad_scan_is_taken_again_before_the_next() -> None:
    lab = judged(Lab("list"), 1, in_s=0.0)
    assert run(places(retakes=1), lab) == ExitCode.ENDED
    assert taken(lab) == [1, 1, 2, 3]


def test_verdict_that_comes_during_the_next_scan_counts() -> None:
    lab = judged(Lab("list"), 1, in_s=50.0)
    assert run(places(retakes=1), lab) == ExitCode.ENDED
    assert taken(lab) == [1, 2, 1, 3]


def test_verdict_on_the_last_scan_is_awaited() -> None:
    lab = judged(Lab("list"), 3, 4)
    assert run(places(retakes=2), lab) == ExitCode.ENDED
    assert taken(lab) == [1, 2, 3, 3, 3]


def test_scan_is_not_taken_again_for_ever(caplog: pytest.LogCaptureFixture) -> None:
    lab = judged(Lab("list"), *range(1, 20), in_s=0.0)
    with caplog.at_level("WARNING"):
        assert run(places(retakes=2), lab) == ExitCode.ENDED
    assert taken(lab) == [1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert caplog.text.count("showed a bad tip again, and is left so") == 3


def test_without_retakes_a_verdict_changes_nothing() -> None:
    lab = judged(Lab("list"), 1, 2, 3)
    assert run(places(), lab) == ExitCode.ENDED
    assert taken(lab) == [1, 2, 3]


def test_retakes_without_any_verdict_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("list")
    with caplog.at_level("WARNING"):
        assert run(places(retakes=1), lab) == ExitCode.ENDED
    assert taken(lab) == [1, 2, 3]
    assert "does a component judge scans?" in caplog.text


@pytest.mark.parametrize("in_s", [0.0, 50.0])
@pytest.mark.parametrize("is_late", [False, True])
def test_bad_scan_is_taken_again_once_over_a_kill_anywhere(tmp_path: Path, in_s: float, is_late: bool) -> None:
    for call in range(1, 90, 7):
        lab = judged(Lab("list"), 2, in_s=in_s)
        _killed_at(call, lambda: places(retakes=1), tmp_path / str(call), is_late=is_late, lab=lab)
        assert sorted(taken(lab)) == [1, 2, 2, 3], f"killed at call {call}"


def test_rest_of_an_interrupted_scan_is_kept_while_another_is_taken_again(tmp_path: Path) -> None:
    lab = judged(Lab("series"), 1, in_s=20.0)
    lab.at(150.0, lambda: stop_at_row(lab, 20))
    lab.at(400.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    series = ScanSeries(size=(1e-6, 1e-6), pixels=(8, 32), scans=2, end_when_done=True, missed="rest", retakes=1)
    assert run(series, lab, tmp_path) == ExitCode.ENDED
    assert [round(region.size_m[1] * 1e9) for region in lab.finished] == [1000, 419, 1000]


def refuse(lab: Lab, *x_m: float) -> None:
    """Refuse scans and positions at these x, as a limit does."""

    def intercepted(request: Request) -> Response | str:
        asked = lab.parameters if request.subject == "start-scan" else request.subject
        place = asked.region if isinstance(asked, ScanParameters) else asked
        x = place.center_m[0] if isinstance(place, Region) else getattr(place, "xy_m", (None,))[0]
        return Response(ControlResponse.PARAM_ERROR, reason="outside of [limits] region") if x in x_m else "go on"

    lab.intercept = intercepted


def test_refused_place_is_left_out_and_the_others_are_scanned(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("list")
    refuse(lab, PLACES_M[1])
    with caplog.at_level("INFO"):
        assert run(places(rounds=2), lab) == ExitCode.ENDED
    assert taken(lab) == [1, 3, 1, 3]
    assert "scan 2 is left out: the region or shape of the scan was refused: outside of [limits] region" in caplog.text
    assert "4 of 6 scans are taken" in caplog.text
    assert [note.text.split(":")[0] for note in notes_of(lab)] == ["scan 2 is left out", "scan 5 is left out"]


def test_plan_ends_if_all_its_places_are_refused() -> None:
    lab = Lab("list")
    refuse(lab, *PLACES_M)
    with pytest.raises(Refused, match="limits"):
        places().run_process(context_of(lab))
    assert not lab.begun_scans


def test_refused_retake_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    lab = judged(Lab("list"), 1, in_s=0.0)
    lab.at(50.0, lambda: refuse(lab, PLACES_M[0]))
    assert run(places(retakes=2), lab) == ExitCode.ENDED
    assert taken(lab) == [1, 2, 3]
    assert "scan 1 is left out" in caplog.text


@pytest.mark.parametrize("call", range(1, 60, 9))
def test_refused_place_is_left_out_once_over_a_kill(tmp_path: Path, call: int) -> None:
    lab = Lab("list")
    refuse(lab, PLACES_M[1])
    _killed_at(call, places, tmp_path, is_late=True, lab=lab)
    assert taken(lab) == [1, 3]


def test_refused_position_of_a_grid_is_left_out_with_its_repeats(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("grid")
    refuse(lab, 2e-7)
    positions = [(x, 0.0) for x in (1e-7, 2e-7, 3e-7)]
    run(SpectroscopyGrid(positions=positions, repeats=2, end_when_done=True), lab)
    assert lab.begun_scans == 4
    assert lab.control.ended
    assert "the position (200, 0) nm is left out: the position of the probe was refused: outside" in caplog.text
    assert "2 of 6 spectra were refused" in caplog.text


def test_grid_ends_if_its_only_position_is_refused() -> None:
    lab = Lab("grid")
    refuse(lab, 5e-7)
    with pytest.raises(Refused, match="limits"):
        SpectroscopyGrid(positions=[(5e-7, 0.0)]).run_process(context_of(lab))


def test_number_of_retakes_below_zero_is_refused() -> None:
    with pytest.raises(ConfigError, match="-1 retakes"):
        places(retakes=-1)
