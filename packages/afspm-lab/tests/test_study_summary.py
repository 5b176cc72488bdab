"""Settings are ranked by the misplacement of scans, and the defaults are judged by the spread of the best."""

from __future__ import annotations

import math

from afspm_lab.study.summary import BY, summarised


def nights(*values: float, lost: int = 0) -> list[dict[str, float]]:
    return [{BY: value, "lost": float(k < lost)} for k, value in enumerate(values)]


def test_the_best_comes_first_and_the_defaults_hold_within_its_spread() -> None:
    metrics = {"defaults": nights(2.1, 2.2, 2.3), "queue=10": nights(1.9, 2.0, 2.4), "queue=3": nights(9, 9, 9)}
    rows = summarised(["defaults", "queue=10", "queue=3"], metrics, {})
    assert [row.label for row in rows] == ["queue=10", "defaults", "queue=3"]
    assert [row.is_best for row in rows] == [True, False, False]
    assert rows[1].is_default
    assert rows[1].holds
    assert rows[0].quartiles[BY] == (1.9, 2.0, 2.4)


def test_defaults_worse_than_the_spread_of_the_best_do_not_hold() -> None:
    rows = summarised(["defaults", "better"], {"defaults": nights(5, 5, 5), "better": nights(1, 2, 3)}, {})
    assert rows[-1].is_default
    assert not rows[-1].holds


def test_a_lost_night_counts_as_infinitely_bad_and_a_failed_one_is_reported() -> None:
    metrics = {"defaults": nights(1, 1, 1, lost=2), "other": nights(3, 3, 3)}
    rows = summarised(["defaults", "other", "none"], metrics, {"none": ["no such tracker"]})
    assert [row.label for row in rows] == ["other", "defaults", "none"]
    assert math.isinf(rows[1].median)
    assert rows[2].nights == 0
    assert rows[2].failed == ("no such tracker",)
