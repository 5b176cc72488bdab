"""Plans: regions, keys and times."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.basics.errors import ConfigError, InvalidValue
from afspm.components.planned_scans import RegionGrid, ScanList, ScanSeries
from afspm.components.scan_plan import PlanRest, PlanStep, RoundSchedule, ScanPlan, grid_centers, rounds_within
from afspm.components.spectroscopy_grid import SpectroscopyGrid
from afspm.model import Region

HERE = Region((0.0, 0.0), (1e-6, 1e-6))
THERE = Region((2e-6, 0.0), (1e-6, 1e-6))


@pytest.mark.parametrize("regions", [(HERE,), (HERE, THERE)])
def test_every_step_has_a_key_of_its_own(regions: tuple[Region, ...]) -> None:
    plan = ScanPlan(regions, (64, 64), rounds=5)
    keys = [step.key for step in plan.steps()]
    assert len(keys) == len(set(keys)) == plan.total == 5 * len(regions)


def test_continued_plan_has_the_same_steps() -> None:
    plan = ScanPlan((HERE, THERE), (64, 64), rounds=3)
    assert list(plan.steps(4)) == list(plan.steps())[4:]


def test_only_the_first_region_of_a_round_waits_for_the_beat() -> None:
    assert [step.starts_round for step in ScanPlan((HERE, THERE), rounds=2).steps()] == [True, False, True, False]


def test_endless_plan_goes_on() -> None:
    plan = ScanPlan((HERE,), rounds=None)
    assert plan.total is None
    assert next(plan.steps(10_000)).key == "scan-10000"


@pytest.mark.parametrize(("regions", "rounds"), [((), 1), ((HERE,), 0)])
def test_an_empty_plan_is_refused(regions: tuple[Region, ...], rounds: int) -> None:
    with pytest.raises(InvalidValue):
        ScanPlan(regions, rounds=rounds)


def test_rounds_are_due_at_multiples_of_the_period() -> None:
    rhythm = RoundSchedule(start_s=100.0, period_s=900.0)
    assert rhythm.next_due_s(None) == 100.0
    assert rhythm.next_due_s(100.0) == 1000.0
    assert rhythm.next_due_s(1000.02) == 1900.0


def test_round_after_a_long_one_is_due_on_the_old_beat_without_catching_up() -> None:
    rhythm = RoundSchedule(start_s=0.0, period_s=900.0)
    assert rhythm.next_due_s(3700.0) == 4500.0
    assert rhythm.left_out(1800.0, 4500.0) == 2
    assert rhythm.left_out(900.0, 1800.0) == 0


@given(st.floats(0, 1e6), st.floats(1, 1e5))
def test_the_next_round_is_always_later_than_the_last_by_no_more_than_a_period(last_s: float, period_s: float) -> None:
    due_s = RoundSchedule(0.0, period_s).next_due_s(last_s)
    assert last_s < due_s <= last_s + period_s * (1 + 1e-9)


def test_without_a_period_everything_is_due_at_once() -> None:
    rhythm = RoundSchedule(5.0)
    assert rhythm.next_due_s(7.0) == 5.0
    assert rhythm.left_out(5.0, 5.0) == 0


def test_grid_is_scanned_back_and_forth() -> None:
    points = grid_centers((0.0, 0.0), (3, 2), (1.0, 2.0))
    assert points == ((-1, -1), (0, -1), (1, -1), (1, 1), (0, 1), (-1, 1))


def test_a_turned_grid_is_turned_counter_clockwise_about_its_middle() -> None:
    (x0, y0), (x1, y1) = grid_centers((5.0, 0.0), (2, 1), (2.0, 1.0), math.pi / 2)
    assert (x0, y0, x1, y1) == pytest.approx((5.0, -1.0, 5.0, 1.0))


def test_regions_of_a_grid_touch_by_default() -> None:
    grid = RegionGrid(size=(1e-6, 1e-6), counts=(2, 2))
    assert [region.center_m for region in grid.plan.regions] == [
        (-0.5e-6, -0.5e-6),
        (0.5e-6, -0.5e-6),
        (0.5e-6, 0.5e-6),
        (-0.5e-6, 0.5e-6),
    ]


def test_a_series_of_eight_hours_every_fifteen_minutes_has_a_scan_at_both_ends() -> None:
    assert rounds_within(8 * 3600.0, 900.0) == 33
    series = ScanSeries(size=(2e-6, 2e-6), every=900.0, duration=8 * 3600.0, pixels=(64, 32))
    assert series.plan.total == 33
    assert series.plan.shape == (32, 64)  # pixels are (columns, rows), a shape is (rows, columns)


def test_series_with_two_ends_or_an_unreachable_end_is_refused() -> None:
    with pytest.raises(ConfigError):
        ScanSeries(size=(1e-6, 1e-6), every=60.0, scans=3, duration=3600.0)
    with pytest.raises(ConfigError):
        ScanSeries(size=(1e-6, 1e-6), end_when_done=True)
    with pytest.raises(InvalidValue):
        ScanSeries(size=(1e-6, 1e-6), duration=60.0)


def test_a_list_takes_the_tables_of_an_experiment_file() -> None:
    scans = ScanList(regions=[{"center": [1e-6, 0.0], "size": [1e-6, 2e-6]}], rounds=2)  # type: ignore[list-item]
    assert scans.plan.regions == (Region((1e-6, 0.0), (1e-6, 2e-6)),)
    assert scans.plan.total == 2


def test_spectra_need_either_a_grid_or_positions() -> None:
    assert SpectroscopyGrid(positions=[(1.0, 2.0)]).positions == ((1.0, 2.0),)
    assert len(SpectroscopyGrid(counts=(2, 3), spacing=(1.0, 1.0)).positions) == 6
    listed: dict[str, Any] = {"positions": [(0.0, 0.0)]}
    refused: tuple[dict[str, Any], ...] = (
        {},
        {"positions": []},
        {"counts": (2, 2)},
        {"counts": (1, 1), **listed},
        {"center": (1e-6, 0.0), **listed},
        {"angle": 0.1, **listed},
        {"spacing": (1e-6, 1e-6), **listed},
    )
    for settings in refused:
        with pytest.raises(ConfigError):
            SpectroscopyGrid(**settings)


STEP = PlanStep(0, "scan-0", Region((1e-6, 2e-6), (1e-6, 2e-6), math.pi / 2), (101, 51), starts_round=True)


def test_rest_of_a_scan_covers_its_last_rows_with_some_overlap() -> None:
    part = PlanRest(0, 100).since(52, downwards=False).of(STEP)
    assert part.key == "scan-0-rows-50-100"
    assert part.shape == (51, 51)
    assert part.region.size_m == pytest.approx((1e-6, 1e-6))
    # turned by 90 degrees, later rows lie at smaller x
    assert part.region.center_m == pytest.approx((0.5e-6, 2e-6))


def test_rest_of_a_downward_scan_covers_its_first_rows() -> None:
    part = PlanRest(0, 100).since(48, downwards=True).of(STEP)
    assert (part.key, part.shape) == ("scan-0-rows-0-50", (51, 51))


def test_rest_of_a_rest_counts_rows_of_the_whole_scan() -> None:
    rest = PlanRest(50, 100).since(22, downwards=False)
    assert (rest.first, rest.last) == (70, 100)


def test_rest_has_rows_enough_to_be_judged() -> None:
    rest = PlanRest(0, 100).since(100, downwards=False)
    assert (rest.first, rest.last) == (93, 100)


def test_whole_rest_is_the_step_itself() -> None:
    assert PlanRest(0, 100).of(STEP) is STEP
