"""The expected end of a running experiment."""

from __future__ import annotations

from afspm.model import Progress
from afspm.model.planned_work import PlannedWork
from afspm.night.expected_end import expected_end_ns, plans_of

S = 1_000_000_000
BEGAN = 1_700_000_000 * S
SERIES = PlannedWork(scans=10, duration_s=1000.0, ends_experiment=True)
GRID = PlannedWork(scans=10, duration_s=3000.0)


def report(name: str, done: int, left_s: float | None) -> dict[str, Progress]:
    return {name: Progress(BEGAN + 100 * S, name, done, 10, left_s)}


def end_s(
    plans: dict[str, PlannedWork | None], reports: dict[str, Progress], now_s: int = 100, began_ns: int | None = BEGAN
) -> float | None:
    """Return the end in s after the start."""
    found = expected_end_ns(plans, reports, began_ns, BEGAN + now_s * S)
    return None if found is None else (found - BEGAN) / S


def test_plan_counts_before_the_first_report() -> None:
    assert end_s({"series": SERIES}, {}) == 1000.0
    assert end_s({"series": SERIES}, {}, began_ns=None) is None


def test_reported_pace_counts_before_the_plan() -> None:
    assert end_s({"series": SERIES}, report("series", 1, 1700.0)) == 1800.0
    assert end_s({"series": SERIES}, report("series", 1, 1700.0), now_s=300) == 1800.0
    assert end_s({"series": None}, report("series", 1, 1700.0)) == 1800.0, "a sweep has no plan"


def test_end_is_never_in_the_past() -> None:
    assert end_s({"series": SERIES}, report("series", 9, 100.0), now_s=500) == 500.0
    assert end_s({"series": SERIES}, report("series", 10, None), now_s=500) == 500.0


def test_passed_plan_without_a_report_is_no_estimate() -> None:
    assert end_s({"series": SERIES}, {}, now_s=2000) is None


def test_first_component_that_ends_the_experiment_counts() -> None:
    assert end_s({"series": SERIES, "grid": GRID}, {}) == 1000.0
    assert end_s({"series": SERIES, "sharpness": None}, {}) == 1000.0


def test_longest_component_counts_where_no_component_ends_the_experiment() -> None:
    assert end_s({"short": PlannedWork(scans=1, duration_s=1000.0), "grid": GRID}, {}) == 3000.0
    assert end_s({"grid": GRID, "unknown": None}, {}) is None


def test_work_with_spectra_has_no_end_before_its_first_report() -> None:
    plans: dict[str, PlannedWork | None] = {"curves": PlannedWork(spectra=10)}
    assert end_s(plans, {}) is None
    assert end_s(plans, report("curves", 1, 90.0)) == 190.0


def test_nothing_is_known_without_plans() -> None:
    assert end_s({}, report("series", 1, 90.0)) is None


def test_plans_are_read_from_run_json() -> None:
    assert plans_of({"planned": {"series": SERIES.as_dict(), "tuner": None}}) == {"series": SERIES, "tuner": None}
    assert plans_of({}) == {}
