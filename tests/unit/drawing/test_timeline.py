from __future__ import annotations

import itertools
import re
from datetime import UTC

from afspm.drawing.timeline import (
    COLUMNS,
    DrawnBand,
    TimelineCurve,
    TimelineRow,
    stretches,
    time_ticks,
    timeline_html,
)
from afspm.night.timeline import Span

S = 1_000_000_000


def test_interval_lies_at_its_time() -> None:
    found = stretches([Span("a", 0, 50 * S), Span("b", 50 * S, None)], 0, 100 * S)
    assert [(one.label, one.begin, one.end) for one in found] == [("a", 0, COLUMNS // 2), ("b", COLUMNS // 2, COLUMNS)]


def test_intervals_are_merged_to_the_columns_of_the_picture() -> None:
    spans = [Span("scanning" if i % 2 else "free", i * S, (i + 1) * S) for i in range(20_000)]
    found = stretches(spans, 0, 20_000 * S)
    assert len(found) <= COLUMNS
    assert all(a.end <= b.begin for a, b in itertools.pairwise(found))
    assert sum(one.count for one in found) == 20_000


def test_longest_interval_of_a_column_is_shown() -> None:
    spans = [Span("short", 0, S // 1000), Span("long", S // 1000, S // 4), Span("rest", S // 4, None)]
    assert stretches(spans, 0, 1000 * S)[0].label == "long"


def test_time_in_the_far_future_makes_no_millions_of_ticks() -> None:
    assert 3 <= len(time_ticks(0.0, 3600.0)) <= 8
    assert len(time_ticks(0.0, 1e12)) <= 8


def test_times_at_the_ends_of_a_row_stay_within_it() -> None:
    row = TimelineRow("control", (Span("series", 0, 60 * S),), lambda _: "")
    drawn = timeline_html([row], 0, 60 * S, UTC)
    ticks = re.findall(r'<span style="left:([\d.]+)%(;transform:translateX\((-?\d+)%\))?">', drawn)
    assert [(at, shift) for at, _, shift in ticks][:2] == [("0.00", "0"), ("16.67", "")]
    assert (ticks[-1][0], ticks[-1][2]) == ("100.00", "-100")


def test_curve_lies_below_the_rows_with_a_gap_where_it_is_unknown() -> None:
    row = TimelineRow("control", (Span("series", 0, 60 * S),), lambda _: "")
    curve = TimelineCurve("cryo.t", "K", [0, 15 * S, 30 * S, 45 * S, 60 * S], [4.0, 5.0, float("nan"), 4.5, 4.0])
    drawn = timeline_html([row], 0, 60 * S, UTC, curves=[curve])
    lines = re.findall(r'<polyline points="([^"]+)"', drawn)
    assert lines == ["0.0,96.0 180.0,4.0", "540.0,50.0 720.0,96.0"]
    assert "4 K to 5 K, now 4 K" in drawn
    assert drawn.index("control") < drawn.index("cryo.t") < drawn.index("lane-axis")


def test_curve_whose_newest_value_is_unknown_says_so() -> None:
    row = TimelineRow("control", (Span("series", 0, 60 * S),), lambda _: "")
    curve = TimelineCurve("cryo.t", "K", [0, 15 * S, 30 * S], [4.0, 5.0, float("nan")])
    assert "4 K to 5 K, now unknown" in timeline_html([row], 0, 60 * S, UTC, curves=[curve])


COLD = DrawnBand("cold", 4.15, 4.25)


def test_allowed_band_is_drawn_with_its_limits_and_marks_the_times_outside() -> None:
    curve = TimelineCurve("cryo.t", "K", [0, 10 * S, 20 * S, 30 * S, 40 * S], [4.2, 4.2, 4.3, 4.2, 4.2], (COLD,))
    assert curve.outside() == [(15 * S, 25 * S)]
    drawn = timeline_html([TimelineRow("control", [Span("series", 0, 40 * S)], str)], 0, 40 * S, UTC, curves=[curve])
    assert 'class="allowed"' in drawn
    assert drawn.count("<line ") == 2
    (mark,) = re.findall(r'class="outside" x="([\d.]+)" y="0" width="([\d.]+)"', drawn)
    assert mark == (f"{COLUMNS * 15 / 40:.1f}", f"{COLUMNS * 10 / 40:.1f}")
    assert "cold allows 4.15 K to 4.25 K" in drawn
    assert "outside for 10 s" in drawn


def test_time_outside_ends_where_the_value_becomes_unknown() -> None:
    nan = float("nan")
    curve = TimelineCurve("cryo.t", "K", [0, 10 * S, 20 * S, 30 * S, 40 * S], [4.3, 4.3, nan, 4.0, 4.2], (COLD,))
    assert curve.outside() == [(0, 10 * S), (30 * S, 37_500_000_000)]


def test_one_sided_band_has_one_limit() -> None:
    curve = TimelineCurve("magnet.b", "T", [0, 10 * S], [1.0, 2.0], (DrawnBand("field", 1.5, float("inf")),))
    assert curve.outside() == [(0, 5 * S)]
    drawn = timeline_html([TimelineRow("control", [Span("series", 0, 10 * S)], str)], 0, 10 * S, UTC, curves=[curve])
    assert drawn.count("<line ") == 1
    assert "field allows at least 1.5 T" in drawn


def test_value_between_two_gaps_is_a_dot() -> None:
    nan = float("nan")
    curve = TimelineCurve("cryo.t", "K", [0, 10 * S, 20 * S], [nan, 4.2, nan])
    drawn = timeline_html([TimelineRow("control", [Span("series", 0, 20 * S)], str)], 0, 20 * S, UTC, curves=[curve])
    assert 'class="dot"' in drawn
