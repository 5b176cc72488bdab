"""The time between two looks at a controller."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from afspm.model import LogLine
from afspm.translator.polling import EAGER_S, OVERDUE_RATIO, OVERDUE_S, AdaptivePolling, OverdueScan

IDLE_S = 0.25


def looks(pace: AdaptivePolling, began_s: float, end_s: float) -> tuple[int, float]:
    """Return the number of looks during a measurement, and the delay in noticing its end."""
    now_s, count = began_s, 0
    while now_s < end_s:
        now_s += pace.wait_s(now_s)
        count += 1
    return count, now_s - end_s


def test_polling_is_rare_at_rest() -> None:
    assert AdaptivePolling(IDLE_S).wait_s(5.0) == IDLE_S


@pytest.mark.parametrize("error_s", [-0.3, -0.04, 0.0, 0.04, 0.3])
def test_end_of_the_second_equal_scan_is_noticed_at_once_with_few_looks(error_s: float) -> None:
    pace = AdaptivePolling(IDLE_S)
    pace.began("a", 0.0)
    pace.ended(100.0, as_expected=True)
    pace.began("a", 200.0)
    count, late_s = looks(pace, 200.0, 300.0 + error_s)
    assert late_s <= 0.020
    assert count < 550  # at the eager rate all along it would be 10000


def test_duration_of_another_frame_is_predicted_from_settings_and_earlier_errors() -> None:
    pace = AdaptivePolling(IDLE_S)
    pace.began("a", 0.0, guess_s=100.0)
    pace.ended(125.0, as_expected=True)  # this controller turns round slowly
    pace.began("b", 200.0, guess_s=40.0)
    count, late_s = looks(pace, 200.0, 250.3)
    assert late_s <= 0.020
    assert count < 450


@pytest.mark.parametrize("lasts_s", [70.0, 100.0, 130.0])
def test_first_scan_is_polled_eagerly_within_the_uncertainty_of_the_guess(lasts_s: float) -> None:
    pace = AdaptivePolling(IDLE_S)
    pace.began("a", 0.0, guess_s=100.0)
    assert pace.wait_s(1.0) == IDLE_S
    assert looks(pace, 0.0, lasts_s)[1] <= EAGER_S + 1e-9


def test_measurement_with_reported_end_is_polled_as_at_rest_until_its_file_is_awaited() -> None:
    pace = AdaptivePolling(IDLE_S)
    pace.began("a", 0.0)
    assert {pace.wait_s(t_s, end_is_reported=True) for t_s in (0.0, 10.0)} == {IDLE_S}
    pace.over(10.0)
    assert pace.wait_s(10.0, end_is_reported=True) == EAGER_S


def test_unknown_measurement_is_polled_eagerly() -> None:
    pace = AdaptivePolling(IDLE_S)
    pace.began("a", 0.0)
    assert {pace.wait_s(t_s) for t_s in (0.0, 10.0, 1000.0)} == {EAGER_S}


def test_overdue_measurement_is_polled_ever_less() -> None:
    pace = AdaptivePolling(IDLE_S)
    pace.began("a", 0.0)
    pace.ended(10.0, as_expected=True)
    pace.began("a", 20.0)
    waits = [pace.wait_s(t_s) for t_s in (30.0, 30.5, 31.0, 60.0)]
    assert waits == sorted(waits)
    assert (waits[0], waits[-1]) == (EAGER_S, IDLE_S)


def test_interrupted_measurement_is_not_learned_from() -> None:
    pace = AdaptivePolling(IDLE_S)
    pace.began("a", 0.0)
    pace.ended(1.0, as_expected=False)
    pace.began("a", 10.0)
    assert pace.wait_s(11.0) == EAGER_S


def test_late_file_is_polled_eagerly_and_does_not_count_as_scan_time() -> None:
    pace = AdaptivePolling(IDLE_S)
    pace.began("a", 0.0)
    pace.over(100.0)
    assert [pace.wait_s(t_s) for t_s in (100.0, 110.0)] == [EAGER_S, IDLE_S]
    pace.over(102.0)  # it is still waited for
    pace.ended(104.0, as_expected=True)
    pace.began("a", 200.0)
    assert pace.wait_s(300.0) == EAGER_S
    assert pace.wait_s(304.0) == IDLE_S


def test_move_is_polled_eagerly_at_first() -> None:
    pace = AdaptivePolling(IDLE_S)
    pace.moved(10.0)
    assert [pace.wait_s(t_s) for t_s in (10.0, 11.0, 20.0)] == [EAGER_S, pytest.approx(0.1), IDLE_S]
    pace.ended(12.0, as_expected=True)
    assert pace.wait_s(12.0) == IDLE_S


@pytest.mark.parametrize("change", [lambda pace: pace.began("a", 0.0), lambda pace: pace.moved(0.0)])
def test_polling_is_never_faster_than_the_period(change: Callable[[AdaptivePolling], None]) -> None:
    pace = AdaptivePolling(0.001)
    change(pace)
    assert pace.wait_s(0.0) == 0.001


def test_overdue_scan_is_reported_once_and_then_its_end() -> None:
    watch, lasts_s = OverdueScan(), 60.0
    late_s = OVERDUE_RATIO * lasts_s + OVERDUE_S
    watch.state_changed(100.0, is_scanning=True)
    told = [watch.look(100.0 + passed_s, lambda: lasts_s) for passed_s in (late_s, late_s + OVERDUE_S, 9 * late_s)]
    assert told == ["", "the scan has lasted for 23 min, 1 min 00 s was expected: does the controller hang?", ""]
    critical = LogLine(1, "microscope", "CRITICAL", told[1])
    assert LogLine(2, "microscope", "INFO", watch.state_changed(9e4, is_scanning=False)).ends(critical)
    assert watch.state_changed(9e4, is_scanning=True) == ""
