"""The work that the ready-made components plan."""

from __future__ import annotations

from typing import Any

import pytest

from afspm.components.planned_scans import ListedRegion, RegionGrid, ScanList, ScanSeries
from afspm.components.spectroscopy_grid import SpectroscopyGrid
from afspm.components.survey import Survey
from afspm.components.sweep import Sweep
from afspm.model.planned_work import SPEED_UNKNOWN, PlannedWork, planned_end_s
from afspm.testing import Bench
from afspm.testing.components.simulated_time import START_S

SPEED_M_S = 4e-6


def series(**settings: object) -> PlannedWork:
    made = ScanSeries(size=(2e-6, 1e-6), pixels=(64, 100), **settings)  # type: ignore[arg-type]
    work = made.planned_work(SPEED_M_S)
    assert work is not None
    return work


def test_series_without_a_pause_takes_trace_and_retrace_of_each_row() -> None:
    work = series(scans=3)  # 100 rows of 2 × 2 µm at 4 µm/s: 100 s a scan
    assert (work.scans, work.pixels, work.bytes_a_channel) == (3, 3 * 6400, 3 * 6400 * 8)
    assert work.duration_s == pytest.approx(300.0)
    assert work.path_m == pytest.approx(1.2e-3)


def test_series_with_a_period_ends_with_its_last_scan() -> None:
    assert series(scans=3, every=600.0).duration_s == pytest.approx(1300.0)


def test_series_with_a_short_period_scans_at_its_multiples() -> None:
    assert series(scans=3, every=80.0).duration_s == pytest.approx(2 * 160.0 + 100.0)


def test_series_with_a_duration_plans_fewer_scans_where_they_are_slow() -> None:
    assert series(duration=800.0, every=100.0).scans == 9
    assert series(duration=800.0, every=80.0).scans == 6  # at 0, 160, … 800 s
    assert series(duration=800.0, every=80.0).duration_s == pytest.approx(900.0)


def test_parameters_of_a_series_set_its_speed() -> None:
    assert series(scans=3, parameters={"scan-speed": "2 um/s"}).duration_s == pytest.approx(600.0)


def test_series_without_a_known_speed_has_no_duration_and_a_reason() -> None:
    work = ScanSeries(size=(2e-6, 1e-6), scans=3).planned_work(None)
    assert work is not None
    assert (work.scans, work.duration_s, work.why) == (3, None, SPEED_UNKNOWN)


def test_series_without_end_has_no_number_of_scans() -> None:
    assert (series().scans, series().path_m, series().end_s) == (None, None, None)


def test_list_adds_up_its_regions_and_rounds() -> None:
    regions = [ListedRegion((0.0, 0.0), (width, 1e-6)) for width in (2e-6, 1e-6)]
    work = ScanList(regions, pixels=(10, 100), rounds=2).planned_work(SPEED_M_S)
    assert work is not None
    assert (work.scans, work.duration_s) == (4, pytest.approx(300.0))


def test_region_grid_plans_each_of_its_regions() -> None:
    work = RegionGrid((2e-6, 2e-6), (4, 3), pixels=(96, 100)).planned_work(SPEED_M_S)
    assert work is not None
    assert (work.scans, work.duration_s) == (12, pytest.approx(1200.0))


def test_spectroscopy_grid_plans_spectra_of_unknown_duration() -> None:
    work = SpectroscopyGrid((5, 4), (1e-9, 1e-9), repeats=2).planned_work(SPEED_M_S)
    assert (work.scans, work.spectra, work.end_s) == (0, 40, None)
    assert "duration of a spectrum" in work.why


def test_survey_plans_an_upper_bound_at_both_of_its_speeds() -> None:
    survey = Survey(
        4e-6, 1e-6, count=5, pixels=(100, 100), zoom_pixels=(100, 100), zoom_parameters={"scan-speed": "2 um/s"}
    )
    work = survey.planned_work(SPEED_M_S)
    assert (work.scans, work.spectra, work.at_most) == (6, 0, True)
    assert work.duration_s == pytest.approx(200.0 + 5 * 100.0)
    assert "targets" in work.why


def test_curves_of_a_survey_are_counted_and_leave_its_end_unknown() -> None:
    work = Survey(4e-6, 1e-6, curves={"top": 0.0, "beside": 2e-7}, count=5).planned_work(SPEED_M_S)
    assert (work.spectra, work.end_s) == (10, None)


def test_work_that_ends_the_experiment_decides_the_end() -> None:
    endless, ending = PlannedWork(scans=None), PlannedWork(duration_s=300.0, ends_experiment=True)
    assert planned_end_s([endless, None, ending]) == 300.0


def test_end_is_unknown_beside_work_without_an_estimate() -> None:
    assert planned_end_s([PlannedWork(duration_s=300.0), PlannedWork(duration_s=400.0)]) == 400.0
    assert planned_end_s([PlannedWork(duration_s=300.0), None]) is None
    assert planned_end_s([]) is None


def test_work_is_the_same_after_a_file() -> None:
    work = series(scans=3)
    assert PlannedWork.from_dict({**work.as_dict(), "of_a_later_version": 1}) == work


def test_simulated_night_takes_as_long_as_planned() -> None:
    for component in (
        ScanSeries(size=(2e-6, 1e-6), pixels=(8, 16), scans=3, every=60.0),
        ScanList([ListedRegion((0.0, 0.0), (width, 1e-6)) for width in (2e-6, 1e-6)], pixels=(8, 16), rounds=2),
    ):
        planned = component.planned_work(SPEED_M_S)
        assert planned is not None
        assert planned.duration_s is not None
        bench = Bench(component, microscope={"initial": {"scan-speed": "4 um/s"}})
        bench.run(until="10 min")
        assert len(bench.scans) == planned.scans
        end_ns = bench.scans[-1].first.time_ns
        assert end_ns is not None
        took_s = end_ns / 1e9 - START_S
        assert planned.duration_s <= took_s < 1.05 * planned.duration_s + 5.0


def test_sweep_plans_each_of_its_speeds_and_names_unknown_parts() -> None:
    swept: dict[str, Any] = {"zctrl-igain": [100, 200, 300], "scan-speed": ["2 um/s", "4 um/s"]}
    work = Sweep(swept, size=(2e-6, 1e-6), pixels=(64, 100)).planned_work(SPEED_M_S)
    assert (work.scans, work.pixels) == (6, 6 * 6400)
    assert work.duration_s == pytest.approx(3 * 200.0 + 3 * 100.0)
    present = Sweep(swept).planned_work(SPEED_M_S)
    assert (present.scans, present.path_m, present.duration_s) == (6, None, None)
    assert "size" in present.why
    warming: dict[str, Any] = {"cryo.temperature": ["4 K", "6 K"]}
    cold = Sweep(warming, size=(2e-6, 1e-6), pixels=(64, 100)).planned_work(SPEED_M_S)
    assert (cold.scans, cold.end_s) == (2, None)
    assert "cryo.temperature" in cold.why
    assert Sweep(swept, measure="spectrum").planned_work(None).spectra == 6


@pytest.mark.parametrize(
    ("curve", "why"),
    [
        ({"points": 201, "point_time": "50 ms"}, "the points of the curves take 1 min 30 s"),
        ({"points": 201}, "the controller sets the duration of a spectrum"),
    ],
)
def test_time_of_curves_is_known_from_points_and_the_time_of_each(curve: dict[str, Any], why: str) -> None:
    work = SpectroscopyGrid(counts=(3, 3), spacing=(1e-8, 1e-8), curve=curve).planned_work(None)
    assert (work.spectra, work.why) == (9, why)
