"""Decisions of a shadow beside the acts of the person."""

from __future__ import annotations

import csv

import pytest

from afspm.record.report.markup import PageTimes
from afspm.record.report.shadow import (
    SOON_S,
    Agreement,
    PersonAct,
    ShadowKind,
    ShadowNight,
    ShadowRow,
    compare,
    csv_text,
    html,
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


@pytest.mark.parametrize(("after_s", "is_answered"), [(0.0, True), (SOON_S, True), (SOON_S + 0.001, False)])
def test_late_act_answers_nothing(after_s: float, is_answered: bool) -> None:
    night = compare([decision(100.0)], [act(100.0 + after_s)])
    assert counted(night, ShadowKind.LINES) == (1, int(is_answered))
    assert counted(night, ShadowKind.PERSON) == (1, int(is_answered))


def test_begun_scan_is_listed_and_answers_nothing() -> None:
    night = compare([decision(100.0, ShadowKind.SCAN)], [act(101.0, answers=False)])
    assert counted(night, ShadowKind.SCAN) == (1, 0)
    assert counted(night, ShadowKind.PERSON) == (0, 0)
    assert [row.did for row in night.rows] == ["", "act at 101 s"]


def test_limit_row_is_listed_and_not_counted() -> None:
    refused = ShadowRow(100 * S, ShadowKind.LIMIT, "would have refused this", "set at the microscope")
    night = compare([], [act(100.0)], [refused])
    assert refused in night.rows
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
