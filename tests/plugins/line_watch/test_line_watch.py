"""`LineWatch` in the in-memory laboratory: flag, verdict, and scans that are no measure."""

from __future__ import annotations

import heapq
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from client_lab import Lab, run
from tests.plugins.line_watch.line_scans_lab import (
    CHANGED_ROW,
    CHANNELS,
    HOME,
    LEARNT,
    LINE_S,
    PERIOD_S,
    ROWS,
    Picture,
    began_ns,
    night,
    publish_lines,
    publish_scan,
    scan_at,
    world_with,
)

from afspm import wire
from afspm.basics import ExitCode
from afspm.components.tip_verdict import BAD, LineVerdict, read_line_verdict, verdict_message
from afspm.model import ControlRequest, Feedback, Problem, Scan, ScanLines, ScopeState, ScopeStatus
from afspm.plugins.line_watch.line_watch import LineWatch

TIP = Problem.TIP_SHAPE_CHANGED


def tell(lab: Lab, number: int, picture: Picture, *, complete: bool = True) -> None:
    """Publish the lines of a scan, and its end."""
    at_s = 100.0 + number * PERIOD_S
    lab.at(at_s, partial(lab.publish, ScopeStatus(ScopeState.SCANNING)))
    publish_lines(lab, picture, number, range(ROWS), at_s)
    if complete:
        publish_scan(lab, picture, number, at_s + 30.0)


def whole_night(lab: Lab) -> None:
    for number, picture in enumerate(night()):
        tell(lab, number, picture, complete=number <= LEARNT)
    lab.at(900.0, lab.kill)


def verdicts(lab: Lab) -> list[LineVerdict]:
    found = [read_line_verdict(wire.decode("TipVerdict", p)) for e, p in lab.published if e == f"TipVerdict_{lab.name}"]
    return [one for one in found if one is not None]


def flags(lab: Lab) -> int:
    return sum(request.kind == ControlRequest.ADD_EXP_PRBLM for request in lab.requests)


def test_changed_tip_is_flagged_while_the_scan_is_running() -> None:
    lab = Lab("line_watch")
    whole_night(lab)
    assert run(LineWatch(action="stop"), lab) == ExitCode.ENDED
    assert flags(lab) == 1
    last = verdicts(lab)[-1]
    assert last.stops
    assert (last.began_ns, last.shape, last.downwards) == (began_ns(LEARNT + 1), (ROWS, ROWS), False)
    assert CHANGED_ROW <= last.row <= CHANGED_ROW + 20
    assert last.confidence > 0.98


def test_missing_lines_are_reported_after_three_scans(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("line_watch")
    for number, picture in enumerate(night()[:4]):
        at_s = 100.0 + number * PERIOD_S
        lab.at(at_s, partial(lab.publish, ScopeStatus(ScopeState.SCANNING)))
        publish_scan(lab, picture, number, at_s + 30.0)
        lab.at(at_s + 31.0, partial(lab.publish, ScopeStatus(ScopeState.FREE)))
    lab.at(900.0, lab.kill)
    run(LineWatch(), lab, envelopes=LineWatch.listens)
    [text] = caplog.messages
    assert "no lines came of the last 3 scans" in text


def test_cached_scans_are_not_missed_lines(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("line_watch")
    for number, picture in enumerate(night()[:4]):
        lab.publish(ScopeStatus(ScopeState.SCANNING))
        publish_scan(lab, picture, number, 0.0)
        while lab.happenings:
            heapq.heappop(lab.happenings)[2]()
        lab.publish(ScopeStatus(ScopeState.FREE))
    lab.clock.passed_s = 800.0
    lab.at(100.0, lab.kill)
    run(LineWatch(), lab, envelopes=LineWatch.listens)
    assert not caplog.messages


def test_look_publishes_the_row_and_flags_nothing() -> None:
    lab = Lab("line_watch")
    whole_night(lab)
    run(LineWatch(), lab)
    assert flags(lab) == 0
    assert verdicts(lab)
    assert not any(one.stops for one in verdicts(lab))


def test_adsorbate_that_stays_is_looked_at_twice_and_is_then_the_reference(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("line_watch")
    rows, columns = np.mgrid[0:ROWS, 0:ROWS]
    bump = 30e-9 * np.exp(-((columns - 20) ** 2 + (rows - 35) ** 2) / 1.5**2)
    world = world_with("double", 1e6)
    for number in range(LEARNT + 4):
        picture = scan_at(world, number, "up")
        adsorbate = {name: values + bump for name, values in picture.items()}
        tell(lab, number, picture if number < LEARNT else adsorbate)
    lab.at(900.0, lab.kill)
    with caplog.at_level("INFO"):
        run(LineWatch(action="stop"), lab)
    assert [one.began_ns for one in verdicts(lab)] == [began_ns(LEARNT), began_ns(LEARNT + 1)]
    assert flags(lab) == 0
    assert "4 of 7 complete scans were watched; 0 lines came after the end of their scan" in caplog.messages
    counted = [wire.decode("WatchCounts", data) for name, data in lab.published if name == "WatchCounts_line_watch"]
    assert [(one.complete, one.watched) for one in counted] == [(1, 0), (2, 0), (3, 0), (4, 1), (5, 2), (6, 3), (7, 4)]


def test_more_noise_is_reported_once_a_scan(caplog: pytest.LogCaptureFixture) -> None:
    lab, random = Lab("line_watch"), np.random.default_rng(7)
    for number, picture in enumerate(night()[: LEARNT + 1]):
        noise_m = 0.0 if number < LEARNT else 0.4e-9
        tell(lab, number, {name: v + noise_m * random.standard_normal(v.shape) for name, v in picture.items()})
    lab.at(900.0, lab.kill)
    run(LineWatch(action="stop"), lab)
    [text] = [text for text in caplog.messages if "the noise is" in text]
    assert "times the noise of earlier scans" in text
    assert verdicts(lab) == []


def test_strong_noise_is_looked_at_and_stops_nothing() -> None:
    lab, random = Lab("line_watch"), np.random.default_rng(7)
    for number, picture in enumerate(night()[: LEARNT + 1]):
        noise_m = 0.0 if number < LEARNT else 0.9e-9
        tell(lab, number, {name: v + noise_m * random.standard_normal(v.shape) for name, v in picture.items()})
    lab.at(900.0, lab.kill)
    run(LineWatch(action="stop"), lab)
    (verdict,) = verdicts(lab)
    assert "the noise is" in verdict.reason
    assert not verdict.stops
    assert not flags(lab)


def test_reason_why_nothing_is_judged_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("line_watch")
    for number, picture in enumerate(night()[: LEARNT + 1]):
        tell(lab, number, picture)
    lab.at(900.0, lab.kill)
    with caplog.at_level("INFO"):
        run(LineWatch(), lab)
    reasons = [one.getMessage() for one in caplog.records if "not judged" in one.getMessage()]
    assert [reason.partition(": ")[2] for reason in reasons] == [
        "no earlier scan of this size, angle, pixels and feedback shows the place",
        "1 of 3 good scans of its kind are known",
        "2 of 3 good scans of its kind are known",
    ]


def test_scan_during_which_the_setpoint_was_changed_is_not_judged() -> None:
    lab = Lab("line_watch")
    lab.at(50.0, lambda: lab.publish(Feedback(True, 1.0, 1.0, 0.7)))
    for number, picture in enumerate(night()[: LEARNT + 1]):
        tell(lab, number, picture)
    last, at_s = LEARNT + 1, 100.0 + (LEARNT + 1) * PERIOD_S
    publish_lines(lab, night()[-1], last, range(CHANGED_ROW - 2), at_s)
    lab.at(at_s + 10.0, lambda: lab.publish(Feedback(True, 1.0, 1.0, 0.5)))
    publish_lines(lab, night()[-1], last, range(CHANGED_ROW - 2, ROWS), at_s + 20.0)
    lab.at(900.0, lab.kill)
    run(LineWatch(action="stop"), lab)
    assert verdicts(lab) == []


def test_scan_that_the_classifier_calls_bad_is_no_measure() -> None:
    lab, watch = Lab("line_watch"), LineWatch(action="stop")
    for number, picture in enumerate(night()[:LEARNT]):
        tell(lab, number, picture)
        scan = Scan(HOME, "Height", "m", picture["Height"], began_ns(number) + round(ROWS * LINE_S * 1e9))
        lab.at(140.0 + number * PERIOD_S, partial(lab.publish, verdict_message(scan, BAD)))
    tell(lab, LEARNT, night()[-1], complete=False)
    lab.at(900.0, lab.kill)
    run(watch, lab)
    assert verdicts(lab) == []
    assert "learnt_ns" not in watch.memory


def test_lines_of_a_repair_are_not_judged() -> None:
    lab = Lab("line_watch")
    for number, picture in enumerate(night()[: LEARNT + 1]):
        tell(lab, number, picture)
    lab.at(100.0 + (LEARNT + 0.9) * PERIOD_S, lambda: lab.flag(TIP))
    tell(lab, LEARNT + 1, night()[-1], complete=False)
    lab.at(900.0, lab.kill)
    run(LineWatch(action="stop"), lab)
    assert verdicts(lab) == []


def test_restarted_watch_learns_no_scan_twice(tmp_path: Path) -> None:
    first = Lab("line_watch")
    for number, picture in enumerate(night()[: LEARNT + 1]):
        tell(first, number, picture)
    first.at(900.0, first.kill)
    watch = LineWatch(action="stop")
    run(watch, first, tmp_path)
    learnt = list(watch.memory["learnt_ns"])
    second, again = Lab("line_watch"), LineWatch(action="stop")
    for number, picture in enumerate(night()[:LEARNT]):
        publish_scan(second, picture, number, 10.0)
    tell(second, LEARNT + 1, night()[-1], complete=False)
    second.at(900.0, second.kill)
    run(again, second, tmp_path)
    assert again.memory["learnt_ns"] == learnt
    assert verdicts(second)[-1].stops, "judged with what the earlier life learnt"


def test_alarm_that_comes_after_the_scan_flags_nothing() -> None:
    lab = Lab("line_watch")
    for number, picture in enumerate(night()[: LEARNT + 1]):
        tell(lab, number, picture)
    at_s = 100.0 + (LEARNT + 1) * PERIOD_S
    lab.at(at_s - 1.0, partial(lab.publish, ScopeStatus(ScopeState.FREE)))
    publish_lines(lab, night()[-1], LEARNT + 1, range(ROWS), at_s)
    lab.at(900.0, lab.kill)
    run(LineWatch(action="stop"), lab)
    assert verdicts(lab)
    assert flags(lab) == 0


def test_alarm_that_comes_during_the_next_scan_does_not_stop_that() -> None:
    lab = Lab("line_watch")
    for number, picture in enumerate(night()[: LEARNT + 1]):
        tell(lab, number, picture)
    at_s = 100.0 + (LEARNT + 1) * PERIOD_S
    lab.at(at_s - 1.0, partial(lab.publish, ScopeStatus(ScopeState.SCANNING)))

    def arrive_together() -> None:
        for row in range(ROWS):
            for channel in CHANNELS:
                values = night()[-1][channel][row : row + 1]
                lab.publish(ScanLines(HOME, (ROWS, ROWS), channel, "m", row, values, began_ns(LEARNT + 1)))
        lab.publish(ScopeStatus(ScopeState.FREE))
        lab.publish(ScopeStatus(ScopeState.SCANNING))

    lab.at(at_s, arrive_together)
    lab.at(900.0, lab.kill)
    run(LineWatch(action="stop"), lab)
    assert verdicts(lab)
    assert not any(one.stops for one in verdicts(lab))
    assert flags(lab) == 0


@pytest.mark.parametrize("is_killed", [False, True])
def test_scans_before_a_repair_are_no_measure_of_those_after_it(tmp_path: Path, *, is_killed: bool) -> None:
    # the last scan before the repair is learnt from only when the next one begins
    lab = Lab("line_watch")
    for number, picture in enumerate(night()[: LEARNT + 1]):
        tell(lab, number, picture)
    repair_s = 100.0 + (LEARNT + 0.8) * PERIOD_S
    lab.at(repair_s, lambda: lab.flag(TIP))
    lab.at(repair_s + 5.0, lambda: lab.clear(TIP))
    if is_killed:
        lab.at(repair_s + 6.0, lab.kill)
        run(LineWatch(action="stop"), lab, tmp_path)
        lab = Lab("line_watch")
        for number, picture in enumerate(night()[: LEARNT + 1]):
            publish_scan(lab, picture, number, 10.0)
    changed = scan_at(world_with("double", (LEARNT + 0.5) * PERIOD_S), LEARNT + 1, "up")
    tell(lab, LEARNT + 1, changed, complete=False)
    lab.at(900.0, lab.kill)
    run(LineWatch(action="stop"), lab, tmp_path)
    assert verdicts(lab) == []


@pytest.mark.parametrize("at_once", [1, 30])
def test_row_of_a_downward_scan_does_not_depend_on_how_many_lines_come_at_once(at_once: int) -> None:
    lab = Lab("line_watch")
    changed = scan_at(world_with("double", (LEARNT + 1) * PERIOD_S + 8 * LINE_S), LEARNT + 1, "down")
    for number, picture in enumerate([*night("double", "down")[: LEARNT + 1], changed]):
        at_s = 100.0 + number * PERIOD_S
        lab.at(at_s, partial(lab.publish, ScopeStatus(ScopeState.SCANNING)))
        for stop in range(ROWS, 0, -at_once):
            first = max(0, stop - at_once)
            for channel in CHANNELS:
                values = picture[channel][first:stop]
                lines = ScanLines(HOME, (ROWS, ROWS), channel, "m", first, values, began_ns(number))
                lab.at(at_s, partial(lab.publish, lines))
        if number <= LEARNT:
            publish_scan(lab, picture, number, at_s + 30.0)
    lab.at(900.0, lab.kill)
    run(LineWatch(action="stop"), lab)
    last = verdicts(lab)[-1]
    assert last.stops
    assert last.downwards
    assert last.row < last.since_row <= ROWS - 8
