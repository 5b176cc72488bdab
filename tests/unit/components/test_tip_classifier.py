"""The classifier in the in-memory laboratory: flags, verdicts, and saved state."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from client_lab import Lab, run
from tests.unit.components.tip_scans_lab import channels

from afspm import wire
from afspm.basics.exit_codes import ExitCode
from afspm.components.tip_classifier import TipClassifier
from afspm.components.tip_verdict import BAD, GOOD, MESSAGE, UNCLEAR, read_verdict
from afspm.model import ControlRequest, Problem, Region, Scan
from afspm.scheduler.control.arbitration import ArbitrationEvent

TIP = Problem.TIP_SHAPE_CHANGED


def publish_at(lab: Lab, at_s: float, pair: tuple[Scan, ...]) -> None:
    for scan in pair:
        lab.at(at_s, partial(lab.publish, scan))


def night(lab: Lab) -> tuple[tuple[Scan, ...], ...]:
    """Take three scans to learn from, two of a double tip, and one of a good tip again."""
    pairs = channels(1, "double", 5)
    time_ns = pairs[6][0].time_ns
    assert time_ns is not None
    good_again = tuple(Scan(s.region, s.channel, s.unit, s.values, time_ns + 1) for s in pairs[3])
    story = (*pairs[:3], *pairs[5:7], good_again)
    for number, pair in enumerate(story):
        publish_at(lab, 100.0 * (number + 1), pair)
    return story


def classifier(**settings: int) -> TipClassifier:
    return TipClassifier(reference_scans=3, **settings)  # type: ignore[arg-type]


def asked(lab: Lab, kind: ControlRequest) -> int:
    return sum(request.kind == kind for request in lab.requests)


def verdicts_of(lab: Lab) -> list[tuple[int, float]]:
    found = [read_verdict(wire.decode(MESSAGE, p)) for e, p in lab.published if e == f"{MESSAGE}_{lab.name}"]
    return [verdict for verdict in found if verdict is not None]


def test_a_changed_tip_is_flagged_once_by_the_second_scan_and_a_good_one_clears_it() -> None:
    lab = Lab("tip_classifier")
    night(lab)
    for at_s in (450.0, 550.0):
        lab.at(at_s, lambda: flagged.append(lab.control.published().problems))
    lab.at(700.0, lab.kill)
    flagged: list[tuple[int, ...]] = []
    assert run(classifier(), lab) == ExitCode.ENDED
    assert flagged == [(), (TIP,)], "one bad scan may show a slower feedback (tip T2)"
    assert lab.control.published().problems == ()
    assert asked(lab, ControlRequest.ADD_EXP_PRBLM) == 1
    assert asked(lab, ControlRequest.RMV_EXP_PRBLM) == 1


def test_verdict_is_published_with_the_time_of_its_scan() -> None:
    lab = Lab("tip_classifier")
    story = night(lab)
    lab.at(700.0, lab.kill)
    run(classifier(), lab)
    assert verdicts_of(lab) == [(story[3][0].time_ns, BAD), (story[4][0].time_ns, BAD), (story[5][0].time_ns, GOOD)]


def test_single_bad_scan_is_flagged_if_one_is_enough() -> None:
    lab = Lab("tip_classifier")
    pairs = channels(1, "double", 5)
    for number, pair in enumerate((*pairs[:3], pairs[5])):
        publish_at(lab, 100.0 * (number + 1), pair)
    lab.at(500.0, lab.kill)
    run(classifier(flag_after=1), lab)
    assert asked(lab, ControlRequest.ADD_EXP_PRBLM) == 1


def test_reference_and_counts_survive_a_kill(tmp_path: Path) -> None:
    lab = Lab("tip_classifier")
    pairs = channels(1, "double", 5)
    for number, pair in enumerate(pairs[:3]):
        publish_at(lab, 100.0 * (number + 1), pair)
    lab.at(350.0, lab.parent_goes)
    assert run(classifier(), lab, tmp_path) == ExitCode.ORPHAN
    lab.restart_component()  # the last scan is sent again, and must not be learnt from twice
    publish_at(lab, 100.0, pairs[5])
    publish_at(lab, 200.0, pairs[6])
    lab.at(300.0, lab.kill)
    again = classifier()
    run(again, lab, tmp_path)
    (kind,) = again.judge.kinds
    assert len(kind.first) == 3
    assert lab.control.published().problems == (TIP,)


def test_nothing_is_learnt_while_a_problem_is_flagged() -> None:
    lab = Lab("tip_classifier")
    lab.flag(Problem.THERMAL_DRIFT)
    publish_at(lab, 100.0, channels(1, "double", 5)[0])
    lab.at(200.0, lab.kill)
    component = classifier()
    run(component, lab)
    assert component.judge.kinds == ()


def test_treated_tip_is_flagged_by_later_bad_scans_only() -> None:
    lab = Lab("tip_classifier")
    pairs = channels(1, "double", 5)
    for number, pair in enumerate((*pairs[:3], *pairs[5:7])):
        publish_at(lab, 100.0 * (number + 1), pair)
    lab.at(550.0, lambda: lab.clear(TIP))
    elsewhere = Region((0.0, 0.0), (5e-6, 5e-6))  # an overview, without a reference
    for scan in pairs[3]:
        overview = Scan(elsewhere, scan.channel, scan.unit, scan.values, (pairs[6][0].time_ns or 0) + 10**9)
        lab.at(600.0, partial(lab.publish, overview))
    lab.at(800.0, lab.kill)
    run(classifier(), lab)
    assert lab.control.published().problems == ()
    assert asked(lab, ControlRequest.ADD_EXP_PRBLM) == 1


@pytest.mark.parametrize(("ended_s", "left"), [(440.0, (TIP,)), (460.0, ())])
def test_flag_of_a_person_is_cleared_by_no_scan_that_ended_before(ended_s: float, left: tuple[int, ...]) -> None:
    lab = Lab("tip_classifier")
    pairs = channels(1, "double", 5)
    start_ns = lab.clock.now_ns()
    for number, pair in enumerate(pairs[:4]):
        time_ns = start_ns + round((ended_s if number == 3 else 100.0 * number) * 1e9)
        publish_at(lab, 100.0 * number + 170.0, tuple(replace(one, time_ns=time_ns) for one in pair))
    lab.at(450.0, lambda: lab.flag(TIP))
    lab.at(700.0, lab.kill)
    run(classifier(), lab)
    assert lab.control.published().problems == left


def test_a_kind_of_scan_that_is_new_while_a_problem_is_flagged_is_unclear_and_not_learnt_from() -> None:
    lab = Lab("tip_classifier")
    pairs = channels(1, "double", 5)
    for number, pair in enumerate((*pairs[:3], pairs[5])):
        publish_at(lab, 100.0 * (number + 1), pair)
    time_ns = (pairs[5][0].time_ns or 0) + 10**9
    zoom = tuple(replace(s, region=Region((0.0, 0.0), (5e-7, 5e-7)), time_ns=time_ns) for s in pairs[6])
    publish_at(lab, 500.0, zoom)
    lab.at(700.0, lab.kill)
    component = classifier()
    run(component, lab)
    assert verdicts_of(lab)[-1] == (time_ns, UNCLEAR)
    assert len(component.judge.kinds) == 1


def test_scans_excluded_from_learning_stay_excluded_after_a_restart(tmp_path: Path) -> None:
    lab = Lab("tip_classifier")
    lab.at(50.0, lambda: lab.flag(TIP))
    publish_at(lab, 100.0, channels(1, "double", 5)[5])
    # the holder of control is published after it
    lab.at(120.0, lambda: lab.does(ArbitrationEvent.REQUEST_CONTROL, "tip_corrector", TIP))
    lab.at(200.0, lab.parent_goes)
    run(classifier(), lab, tmp_path)
    lab.restart_component()
    lab.at(50.0, lab.kill)
    again = classifier()
    run(again, lab, tmp_path)
    assert again.judge.kinds == ()


def test_channels_of_two_scans_are_not_taken_for_one() -> None:
    lab = Lab("tip_classifier")
    (first, _), (_, second) = channels(1, "double", 5)[:2]
    publish_at(lab, 100.0, (first, second))
    lab.at(200.0, lab.kill)
    component = classifier()
    run(component, lab)
    assert component.judge.kinds == ()


def test_missing_channel_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    lab = Lab("tip_classifier")
    for number, (trace, retrace) in enumerate(channels(1, "double", 5)):
        named = replace(trace, channel="Z Forward"), replace(retrace, channel="Z Backward")
        publish_at(lab, 100.0 * (number + 1), named)
    lab.at(2000.0, lab.kill)
    run(classifier(), lab)
    (told,) = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert "no channel height and height, retrace" in told
    assert "They have Z Forward, Z Backward" in told
