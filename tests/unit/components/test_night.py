"""The picture of the night, and the record for it."""

from __future__ import annotations

import json
import re
import threading
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client_lab import REGION, Lab, context_of, run
from deadlines import DEADLINE_S
from numpy.typing import NDArray

from afspm import wire
from afspm.basics.exit_codes import ExitCode
from afspm.components.night_picture import NightPicture
from afspm.components.tip_verdict import BAD, MESSAGE, verdict_message
from afspm.drawing.palette import LEVELS, NEUTRAL, UNMEASURED
from afspm.model import (
    ControlEvent,
    ControlMode,
    ControlState,
    JournalEntries,
    JournalEntry,
    Problem,
    Region,
    RescanKind,
    Scan,
    ScopeState,
    ScopeStatus,
)
from afspm.model.problems import CONDITIONS
from afspm.night.night_record import (
    THUMBNAIL_PX,
    NightRecord,
    control_entry,
    mark_entry,
    scan_entry,
    thumbnail,
)

pytest.importorskip("matplotlib")
from afspm.report import night_figure
from afspm.report.night_figure import MOST_SHOTS, _chosen, _episodes, draw, figure_of, flagged_by

MINUTE_NS = 60_000_000_000
TIP = int(Problem.TIP_SHAPE_CHANGED)


def scan(time_ns: int = 0) -> Scan:
    return Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.random.default_rng(1).random((128, 128)), time_ns)


def thumb(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    return thumbnail(Scan(REGION, "Height", "m", values, 0)).levels


def night(scans: int = 12) -> NightRecord:
    """A series, a problem in the middle, its repair."""
    record = NightRecord()
    middle = scans * 10 * MINUTE_NS // 2
    record.add(control_entry(ControlState(holder="series"), 0))
    entry = scan_entry(scan(), 0, 0, "series")
    for number in range(scans):
        end = (10 * number + 2) * MINUTE_NS
        record.add({**entry, "time_ns": end, "start_ns": end - MINUTE_NS})
    record.add(mark_entry("tip_classifier", "verdict", middle, BAD, 12 * MINUTE_NS))
    record.add(control_entry(ControlState(problems=(TIP,)), middle))
    record.add(control_entry(ControlState(holder="tip_corrector", problems=(TIP,)), middle + MINUTE_NS))
    record.add(mark_entry("tip_corrector", "x-pulse", middle + 2 * MINUTE_NS))
    record.add(control_entry(ControlState(), middle + 5 * MINUTE_NS))
    record.add(control_entry(ControlState(holder="series"), middle + 6 * MINUTE_NS))
    return record


def test_thermal_drift_until_the_first_scan_was_taken_both_ways_is_left_out_of_the_picture(tmp_path: Path) -> None:
    drift = int(Problem.THERMAL_DRIFT)
    asked: Any = wire.message_type("DriftRescan")(kind=int(RescanKind.OPPOSITE))
    lab = Lab()
    asked.timestamp.FromNanoseconds(lab.clock.now_ns())
    lab.publish(ControlState(holder="rescanner", problems=(drift,)))
    lab.publish(asked)
    lab.at(60.0, lambda: lab.publish(ControlState(holder="series")))
    lab.at(120.0, lambda: lab.publish(ControlState(problems=(drift,))))
    lab.at(180.0, lab.kill)
    picture = NightPicture()
    assert run(picture, lab, tmp_path / "state", run_dir=str(tmp_path)) == ExitCode.ENDED
    (span,) = picture.record.problem_spans(drift)
    assert span.start_ns == lab.clock.now_ns() - 60 * 10**9
    assert picture.record.problems == [drift]


def test_scan_before_the_problem_of_a_condition_is_not_framed(tmp_path: Path) -> None:
    lab = Lab()
    warm = 11
    lab.at(10.0, lambda: lab.publish_scan(REGION))
    lab.at(20.0, lambda: lab.publish(ControlState(problems=(warm,))))
    entry = JournalEntry(
        lab.clock.now_ns(), "control", CONDITIONS, "", event=ControlEvent.PROBLEM_FLAGGED, problem=warm
    )
    lab.at(21.0, lambda: lab.publish(JournalEntries((entry,))))
    lab.at(60.0, lab.kill)
    picture = NightPicture()
    assert picture.listens == ("",), "by default a component does not get the journal"
    assert run(picture, lab, tmp_path / "state", run_dir=str(tmp_path)) == ExitCode.ENDED
    assert (len(picture.record.shots), picture.record.problems) == (1, [warm])
    assert picture.record.bad_ns() == frozenset()
    saved = (tmp_path / "state" / f"{picture.name}.night.jsonl").read_text(encoding="utf-8").splitlines()
    assert NightRecord.from_lines(saved).bad_ns() == frozenset(), "also after a restart"


def test_spans_of_control_and_problems_are_read_from_the_states() -> None:
    record = night()
    assert record.holders == ["series", "tip_corrector"]
    (first, second) = record.control_spans("series")
    assert (first.start_ns, first.end_ns) == (0, 60 * MINUTE_NS)
    assert second.end_ns is None
    (problem,) = record.problem_spans(TIP)
    assert (problem.start_ns, problem.end_ns) == (60 * MINUTE_NS, 65 * MINUTE_NS)
    assert flagged_by(record, problem) == "tip_classifier"


def test_record_round_trips_and_knows_its_contents() -> None:
    entries = [control_entry(ControlState(ControlMode.MANUAL, None, (TIP,)), 5), scan_entry(scan(7), 7, None, None)]
    lines = [json.dumps(entry) for entry in entries]
    record = NightRecord.from_lines([*lines, *lines, "{half a li", '{"kind": "unknown", "time_ns": 1}'])
    assert len(record.control) == len(record.shots) == 1
    assert record.control[0][1].mode is ControlMode.MANUAL
    assert record.shots[0].picture.levels.shape == (THUMBNAIL_PX, THUMBNAIL_PX)
    assert not record.add(entries[1])


def test_scan_with_a_missed_beginning_has_the_holder_of_control_at_its_end() -> None:
    record = NightRecord()
    record.add(control_entry(ControlState(holder="series"), 1))
    record.add(scan_entry(scan(9), 9, None, None))
    assert record.holder_of(record.shots[0]) == "series"


def test_a_thumbnail_is_small_and_shows_scans_of_any_shape_and_with_holes() -> None:
    values = np.arange(1000.0 * 300).reshape(1000, 300)  # a plane, which is taken off
    values[500:600, 100:200] += 1e5
    values[:100] = np.nan
    picture = thumb(values)
    assert max(picture.shape) <= THUMBNAIL_PX
    assert picture.dtype == np.uint8
    assert (picture[0] == UNMEASURED).all()
    assert picture[34, 30] == LEVELS - 1
    assert np.median(picture[10:]) < 30
    assert thumb(np.zeros((5, 5))).shape == (5, 5)


@pytest.mark.parametrize("shape", [(4, 512), (512, 4), (1, 300), (1, 1)])
def test_a_few_long_lines_have_a_thumbnail_too(shape: tuple[int, int]) -> None:
    picture = thumb(np.arange(float(np.prod(shape))).reshape(shape))
    assert min(picture.shape) == min(shape)
    assert max(picture.shape) <= THUMBNAIL_PX


def test_thinning_of_scans_keeps_scans_with_events() -> None:
    record = night(scans=300)
    record.add(scan_entry(scan(1), 1501 * MINUTE_NS, 1500 * MINUTE_NS, "tip_corrector"))
    chosen = _chosen(record)
    assert len(chosen) <= MOST_SHOTS
    assert any(shot.holder == "tip_corrector" for shot in chosen)
    assert record.bad_ns() <= {shot.time_ns for shot in chosen}


def test_problems_that_overlap_are_one_episode() -> None:
    record = NightRecord()
    for time_ns, problems in ((1, (1,)), (2, (1, 2)), (3, (2,)), (4, ()), (9, (1,))):
        record.add(control_entry(ControlState(problems=problems), time_ns))
    assert [(span.start_ns, span.end_ns) for span in _episodes(record)] == [(1, 4), (9, None)]


@pytest.mark.parametrize("scans", [12, 300, 1], ids=["usual", "long", "short"])
def test_a_picture_is_drawn(tmp_path: Path, scans: int) -> None:
    draw(night(scans), tmp_path / "night.png", {TIP: "tip-shape-changed"}, title="A night", simulated=True)
    assert (tmp_path / "night.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "night.png").stat().st_size > 10_000


def _lab() -> Lab:
    lab = Lab("night_picture")
    lab.channels = ("Height",)
    for number in range(3):
        at_s = 100.0 * (number + 1)
        lab.at(at_s, lambda: lab.go(ScopeState.SCANNING))
        lab.at(at_s + 50, lambda: lab.publish_scan(REGION, (64, 64)))
    told = verdict_message(scan(4), BAD)
    lab.at(320.0, lambda: lab.publish(told, f"{MESSAGE}_tip_classifier"))
    lab.at(330.0, lambda: lab.publish(wire.message_type("ActionMsg")(action="x-pulse"), "ActionMsg_tip_corrector"))
    return lab


def test_the_component_draws_when_the_experiment_ends(tmp_path: Path) -> None:
    lab = _lab()
    lab.at(500.0, lab.kill)
    component = NightPicture()
    assert run(component, lab, tmp_path / "state", run_dir=str(tmp_path), simulated=True) == ExitCode.ENDED
    assert len(component.record.shots) == 3
    assert {(mark.by, mark.what) for mark in component.record.marks} == {
        ("tip_classifier", "verdict"),
        ("tip_corrector", "x-pulse"),
    }
    assert (tmp_path / "night.png").exists()


def test_scans_are_taken_in_while_the_drawing_is_loaded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    is_seen, seen_while_loading = threading.Event(), list[bool]()

    class Observed(NightPicture):
        def on_scan(self, scan: Scan) -> None:
            super().on_scan(scan)
            is_seen.set()

    monkeypatch.setattr(night_figure, "prepare", lambda: seen_while_loading.append(is_seen.wait(DEADLINE_S)))
    lab = _lab()
    lab.at(500.0, lab.parent_goes)
    run(Observed(), lab, tmp_path / "state", run_dir=str(tmp_path))
    assert seen_while_loading == [True]
    assert (tmp_path / "night.png").exists()


def test_paused_scan_has_its_time_of_beginning_before_the_pause(tmp_path: Path) -> None:
    lab = _lab()
    for at_s, is_paused in ((110.0, True), (130.0, None)):
        lab.at(at_s, partial(lab.publish, ScopeStatus(ScopeState.SCANNING, is_paused)))
    lab.at(500.0, lab.kill)
    component = NightPicture()
    run(component, lab, tmp_path / "state", run_dir=str(tmp_path))
    lasted_s = [(shot.time_ns - (shot.start_ns or 0)) / 1e9 for shot in component.record.shots]
    assert lasted_s == pytest.approx([50.0] * 3, abs=0.1)


def test_a_restart_loses_nothing_and_doubles_nothing(tmp_path: Path) -> None:
    lab = _lab()
    lab.at(225.0, lab.parent_goes)
    NightPicture().run_process(context_of(lab, tmp_path / "state", run_dir=str(tmp_path)))
    lab.restart_component()
    lab.at(600.0, lab.kill)
    component = NightPicture()
    run(component, lab, tmp_path / "state", run_dir=str(tmp_path))
    times = [shot.time_ns for shot in component.record.shots]
    assert len(times) == len(set(times)) == 3


def test_picture_of_a_simulated_night_alone_is_marked() -> None:
    measured, simulated = (figure_of(night(), {}, simulated=one) for one in (False, True))
    assert not any("SIMULATED" in text.get_text() for text in measured.texts)
    assert "SIMULATED" in [text.get_text() for text in simulated.texts]


@pytest.mark.parametrize("far_ns", [2**62, 2**63 - 1, -(2**62)])
def test_time_that_is_centuries_off_makes_few_ticks(far_ns: int) -> None:
    record = night()
    record.add(scan_entry(scan(far_ns), far_ns, None, "series"))
    record.add(control_entry(ControlState(holder="series", problems=(TIP,)), far_ns))
    figure = figure_of(record, {TIP: "tip-shape-changed"})
    assert max(len(ax.get_xticks()) for ax in figure.axes) < 20


def test_scan_judged_bad_is_framed_and_a_test_scan_of_the_repair_is_not() -> None:
    record = night()
    assert record.bad_ns() == {12 * MINUTE_NS}
    record.add(mark_entry("tip_classifier", "verdict", 13 * MINUTE_NS, 1.0, 12 * MINUTE_NS))
    assert record.bad_ns() == frozenset()
    record.marks = [mark for mark in record.marks if mark.of_ns is None]
    assert record.bad_ns() == {52 * MINUTE_NS}, "without verdicts the scan before the flag"
    drifted = NightRecord()
    drifted.add(scan_entry(scan(5), 5, None, "series"))
    drifted.add(control_entry(ControlState(problems=(int(Problem.THERMAL_DRIFT),)), 9))
    assert drifted.bad_ns() == frozenset(), "drift says nothing about the scan before it"


def test_all_times_in_the_picture_are_times_of_day() -> None:
    figure = figure_of(night(), {TIP: "tip-shape-changed"})
    labels = [text for ax in figure.axes if ax.axison for label in ax.get_xticklabels() if (text := label.get_text())]
    assert len(labels) > 5
    assert all(re.fullmatch(r"\d\d:\d\d(:\d\d)?", label) for label in labels), labels


def test_scans_of_one_size_share_a_range_that_one_odd_scan_does_not_widen() -> None:
    noise = np.random.default_rng(1).normal(size=(128, 128))
    wide = Region((0.0, 0.0), (2e-6, 2e-6))
    record = NightRecord()
    for number in range(300):
        height_m = 1e-6 if number == 0 else 1e-9 * (1 + number % 2)
        record.add(scan_entry(Scan(REGION, "Height", "m", height_m * noise, number), number, None, None))
    record.add(scan_entry(Scan(wide, "Height", "m", 1e-7 * noise, 300), 300, None, None))
    spans = night_figure._spans(record.shots)
    narrow, other = spans["m", REGION.size_m[0]], spans["m", 2e-6]
    assert 2e-9 < narrow.high < 1e-8
    assert other.high > 1e-7
    low, high = record.shots[1].picture.span.low, record.shots[1].picture.span.high
    assert np.nanmax(record.shots[1].picture.values) == pytest.approx(high)
    assert np.nanmin(record.shots[1].picture.values) == pytest.approx(low)


def test_scale_bar_of_a_night_is_as_long_as_its_label() -> None:
    figure = figure_of(night(), {TIP: "tip-shape-changed"})
    sheet = next(ax for ax in figure.axes if any(text.get_text().endswith("nm") for text in ax.texts))
    length = next(text.get_text() for text in sheet.texts if text.get_text().endswith("nm"))
    canvas = np.asarray(sheet.images[0].get_array())
    row = canvas[night_figure.THUMB_PX - 6, : night_figure.THUMB_PX]  # through the bar of the first picture
    white = np.flatnonzero((row == 255).all(axis=1))
    pixels = white[(white >= night_figure.GAP_PX // 2 + 4) & (white < night_figure.THUMB_PX)]
    bar_px = int(np.argmax(np.diff(pixels, append=10**6) > 1)) + 1
    assert bar_px == pytest.approx(float(length.split()[0]) * 1e-9 / 1e-6 * night_figure.THUMB_PX, abs=1.0)


def test_tile_of_a_night_has_the_proportions_of_its_region() -> None:
    tall = Region((0.0, 0.0), (0.5e-6, 1e-6))
    values = np.random.default_rng(1).random((16, 128))  # few long lines, as of a fast overview
    record = NightRecord()
    record.add(control_entry(ControlState(holder="series"), 0))
    record.add(scan_entry(Scan(tall, "Height", "m", values, 0), 2 * MINUTE_NS, 0, "series"))
    figure = figure_of(record, {})
    sheet = next(ax for ax in figure.axes if any(text.get_text().endswith("nm") for text in ax.texts))
    side, left = night_figure.THUMB_PX, night_figure.GAP_PX // 2
    tile = np.asarray(sheet.images[0].get_array())[:side, left : left + side]
    grey = tuple(int(NEUTRAL[i : i + 2], 16) for i in (1, 3, 5))  # beside the scan
    measured = ~(tile == grey).all(axis=2)
    assert np.flatnonzero(measured[side // 4]).size == side // 2
    assert np.flatnonzero(measured[:, side // 2]).size == side
