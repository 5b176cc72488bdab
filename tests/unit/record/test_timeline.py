from __future__ import annotations

import itertools
import re
from datetime import UTC

from afspm.record.drawing.timeline import COLUMNS, TimelineCurve, TimelineRow, stretches, time_ticks, timeline_html
from afspm.record.timeline import Span

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
