"""Decisions of a shadow beside the acts of the person."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from record_lab import REGION, Night

from afspm.basics.errors import InvalidValue
from afspm.basics.formatting import duration_text
from afspm.components.tip_verdict import OF_LINES, LineVerdict, line_verdict_message, verdict_message
from afspm.model import ActByHand, PanelAct, Region, Scan, ScopeState, names
from afspm.model.panel import ChangedValue
from afspm.night.bad_scans import BAD, VERDICT_MESSAGE
from afspm.night.measurement_history import DriftPoint
from afspm.night.run import open_run
from afspm.night.tables import NoteRow, ScanRow
from afspm.record.store import RecordStore
from afspm.report.markup import PageTimes
from afspm.report.shadow import (
    SOON_S,
    Agreement,
    PersonAct,
    ShadowKind,
    ShadowNight,
    ShadowRow,
    agreement_in_words,
    agreement_lines,
    compare,
    csv_text,
    html,
    mark_text,
    of_drift,
    read,
)

S = 1_000_000_000


def decision(at_s: float, kind: ShadowKind = ShadowKind.LINES) -> ShadowRow:
    return ShadowRow(round(at_s * S), kind, "would have stopped the scan")


def act(at_s: float, *, answers: bool = True) -> PersonAct:
    return PersonAct(round(at_s * S), f"act at {at_s:g} s", answers)


def counted(night: ShadowNight, kind: ShadowKind) -> tuple[int, int]:
    (one,) = [one for one in night.agreement if one.kind is kind]
    return one.count, one.agreed


def test_decision_is_answered_by_the_first_act_soon_after_it() -> None:
    night = compare([decision(100.0)], [act(50.0), act(130.0), act(140.0)])
    (row,) = [row for row in night.rows if row.would]
    assert (row.did, row.after_s) == ("act at 130 s", 30.0)
    assert counted(night, ShadowKind.LINES) == (1, 1)
    assert counted(night, ShadowKind.PERSON) == (3, 2)
    spoken = agreement_in_words(night)
    assert any(line.startswith("line alarm: 1, the person acted at 1 of them") for line in spoken)
    assert any(line.startswith("by hand: 3, afspm had decided before 2 of them") for line in spoken)


@pytest.mark.parametrize(("after_s", "is_answered"), [(0.0, True), (SOON_S, True), (SOON_S + 0.001, False)])
def test_late_act_answers_nothing(after_s: float, is_answered: bool) -> None:
    night = compare([decision(100.0)], [act(100.0 + after_s)])
    assert counted(night, ShadowKind.LINES) == (1, int(is_answered))
    assert counted(night, ShadowKind.PERSON) == (1, int(is_answered))


def test_no_act_answers_drift() -> None:
    row = decision(10.0, ShadowKind.DRIFT)
    night = compare([row], [act(11.0)], notes=[note(row, "right")])
    assert [(one.kind, one.did, one.after_s) for one in night.rows if one.would] == [(ShadowKind.DRIFT, "", None)]
    (line,) = [line for line in agreement_lines(night) if line[0] == ShadowKind.DRIFT]
    assert line[:5] == ("drift", "1", "", "", "1")


def test_kind_without_a_decision_has_no_share() -> None:
    night = compare([], [])
    assert f"{ShadowKind.LINES}: none seen" in agreement_in_words(night)
    assert not any("0 % to 100 %" in " ".join(line) for line in agreement_lines(night))


def test_begun_scan_is_listed_and_answers_nothing() -> None:
    night = compare([decision(100.0, ShadowKind.SCAN)], [act(101.0, answers=False)])
    assert counted(night, ShadowKind.SCAN) == (1, 0)
    assert counted(night, ShadowKind.PERSON) == (0, 0)
    assert [row.did for row in night.rows] == ["", "act at 101 s"]


def test_limit_row_is_listed_and_not_counted() -> None:
    refused = ShadowRow(100 * S, ShadowKind.LIMIT, "would have refused this", "set at the microscope")
    night = compare([], [act(100.0)], [refused])
    assert [(row.would, row.did) for row in night.rows if row.kind is ShadowKind.LIMIT] == [
        (refused.would, refused.did)
    ]
    assert ShadowKind.LIMIT not in {one.kind for one in night.agreement}


@pytest.mark.parametrize(
    ("agreed", "count", "low", "high"),
    [(0, 0, 0.0, 1.0), (1, 1, 0.2065, 1.0), (5, 10, 0.2366, 0.7634), (0, 10, 0.0, 0.2775)],
)
def test_interval_is_wilsons(agreed: int, count: int, low: float, high: float) -> None:
    assert Agreement(ShadowKind.LINES, count, agreed).interval == pytest.approx((low, high), abs=5e-5)


def test_table_and_page_have_all_rows_and_a_run_that_commands_has_none() -> None:
    night = compare([decision(100.0), decision(900.0)], [act(130.0)])
    rows = list(csv.DictReader(csv_text(night).splitlines()))
    assert [row["after_s"] for row in rows] == ["30.0", "", ""]
    page = html(night, PageTimes(0, 1000 * S))
    assert page.count("would have stopped the scan") == 2
    assert "went on" in page
    assert html(ShadowNight(), PageTimes(0, 1000 * S)) == ""


def note(row: ShadowRow, opinion: str, written_s: int = 1) -> NoteRow:
    return NoteRow(row.time_ns, "Ada", mark_text(row, opinion), None, written_s * S)


def test_marks_of_a_person_are_figures_and_the_last_written_counts() -> None:
    alarms = [
        ShadowRow(at_s * S, ShadowKind.LINES, "would have stopped the scan", left_s=left_s)
        for at_s, left_s in ((100, 60.0), (200, 30.0), (300, 5.0))
    ]
    notes = [
        note(alarms[0], "right, there was a double tip"),
        note(alarms[1], "right", written_s=1),
        note(alarms[1], "wrong: it was a step", written_s=2),
        NoteRow(300 * S, "Ada", "line alarm: rightly seen", None, S),  # a note, and no mark
    ]
    night = compare(alarms, [], notes=notes)
    assert [row.mark and (row.mark.right, row.mark.comment) for row in night.rows] == [
        (True, "there was a double tip"),
        (False, "it was a step"),
        None,
    ]
    (lines,) = [one for one in night.agreement if one.kind is ShadowKind.LINES]
    assert (lines.right, lines.wrong) == (1, 1)
    assert lines.interval_right == pytest.approx((0.0945, 0.9055), abs=5e-4)
    assert (night.left_s(right=True), night.left_s(right=False)) == (60.0, 30.0)
    assert f"would have saved {duration_text(60.0)} and lost {duration_text(30.0)}" in html(
        night, PageTimes(0, 1000 * S)
    )


def test_mark_without_right_or_wrong_is_refused() -> None:
    with pytest.raises(InvalidValue, match="neither right nor wrong"):
        mark_text(decision(100.0), "the door slammed")


def test_row_is_found_by_its_number() -> None:
    night = compare([decision(200.0), decision(100.0)], [])
    assert night.row(1).time_ns == 100 * S
    with pytest.raises(InvalidValue, match="no row 3"):
        night.row(3)


def night_of_frames(frames: Sequence[tuple[float, float]]) -> list[ScanRow]:
    return [
        ScanRow(n + 1, (n + 1) * S, n * S + 1, (), Region(center, (1e-7, 1e-7)), (8, 8), False, None, None, (), "", "")
        for n, center in enumerate(frames)
    ]


def test_frame_that_is_set_again_has_the_place_where_a_run_would_have_had_it() -> None:
    scans = night_of_frames([(0.0, 0.0), (1e-6, 0.0), (0.0, 0.0)])
    drifts = [(0.0, 0.0), (3e-9, 1e-9), (10e-9, -5e-9)]
    points = [DriftPoint((n + 1) * S, drift, (0.0, 0.0), sd_m=2e-10) for n, drift in enumerate(drifts)]
    second, third = of_drift(points, scans)
    assert second.would == "scan 2: the sample had moved by (3, 1) nm ± 200 pm"
    assert third.would.endswith("a run would have had the frame of scan 1 at (10, -5) nm instead of (0, 0) nm")


def test_drift_across_a_tip_change_is_marked() -> None:
    scans = night_of_frames([(0.0, 0.0)] * 4)
    points = [DriftPoint(scan.time_ns, (1e-9 * n, 0.0), (0.0, 0.0), sd_m=1e-10) for n, scan in enumerate(scans)]
    rows = list(of_drift(points, scans, changes=[scans[0].time_ns, scans[2].time_ns]))
    assert ["the tip changed meanwhile" in row.would for row in rows] == [False, True, True]


def test_verdicts_that_components_publish_are_rows(night: Night, store: RecordStore, tmp_path: Path) -> None:
    (tmp_path / "experiment.toml").write_text("[control]\nshadow = true\n", encoding="utf-8")
    store.take([night.state(ScopeState.FREE), *night.whole_scan(1)])
    (scan,) = open_run(tmp_path).scans
    assert scan.began_ns is not None
    bad = verdict_message(Scan(REGION, "Height", "m", np.zeros((6, 8)), scan.time_ns), BAD)
    lines = LineVerdict(REGION, (6, 8), "Height", scan.began_ns, 4, 2, True, 0.9, stops=False)
    repeated, stop = replace(lines, row=5, reason="twice the threshold"), replace(lines, stops=True)
    alarms = [(line_verdict_message(one), f"{OF_LINES}_watch") for one in (lines, repeated, stop)]
    for verdict, envelope in ((bad, f"{VERDICT_MESSAGE}_judge"), *alarms):
        packet, _ = night.packet(verdict, envelope)
        store.take([(packet, "tcp://127.0.0.1:1")])  # from their own address, not from the scheduler
    assert open_run(tmp_path).tip_changes_ns() == [scan.time_ns, packet.time_ns]
    rows = read(open_run(tmp_path)).rows
    assert {ShadowKind.SCAN, ShadowKind.LINES} <= {row.kind for row in rows if row.would}
    look, halt = (row.would for row in rows if row.kind is ShadowKind.LINES)
    assert "look at row 4" in look
    assert look.endswith("; again at row 5: twice the threshold")
    assert "would have stopped the scan at row 4" in halt
    assert "again" not in halt


@pytest.mark.parametrize(
    ("after", "kind"),
    [(ScopeState.FREE, ShadowKind.PERSON), (ScopeState.UNDEFINED, ShadowKind.CONTACT)],
    ids=["stopped", "contact lost"],
)
def test_scan_that_a_lost_contact_ends_is_no_act_of_the_person(
    night: Night, store: RecordStore, tmp_path: Path, after: ScopeState, kind: ShadowKind
) -> None:
    (tmp_path / "experiment.toml").write_text("[control]\nshadow = true\n", encoding="utf-8")
    states = [ScopeState.FREE, ScopeState.SCANNING, ScopeState.INTERRUPTED, after]
    if after is ScopeState.UNDEFINED:
        states.append(ScopeState.FREE)  # again in contact
    store.take([night.state(state) for state in states])
    found = read(open_run(tmp_path))
    (row,) = [row for row in found.rows if "scan 1" in row.would + row.did]
    assert row.kind is kind
    assert counted(found, ShadowKind.PERSON) == (int(kind is ShadowKind.PERSON), 0)


@pytest.mark.parametrize(
    ("changed", "row", "answers"),
    [
        (names.SCAN_TOP_LEFT_X, "scan 1 has no result: its frame was changed while it ran", 1),
        (names.TIP_BIAS_VOLTAGE, "scan 1 ended before its last line", 2),
    ],
    ids=["frame", "bias"],
)
def test_scan_whose_frame_a_person_changes_is_not_reported_as_stopped(
    night: Night, store: RecordStore, tmp_path: Path, changed: str, row: str, answers: int
) -> None:
    (tmp_path / "experiment.toml").write_text("[control]\nshadow = true\n", encoding="utf-8")
    store.take([night.state(state) for state in (ScopeState.FREE, ScopeState.SCANNING)])
    act = ActByHand(night.now_ns, PanelAct.VALUES, changes=(ChangedValue(changed, "0", "1e-7"),))
    store.take([night.packet(act, "ActByHand")])
    store.take([night.state(state) for state in (ScopeState.INTERRUPTED, ScopeState.FREE)])
    found = read(open_run(tmp_path))
    assert [one.did for one in found.rows if "scan 1" in one.did] == [row]
    assert counted(found, ShadowKind.PERSON) == (answers, 0)
