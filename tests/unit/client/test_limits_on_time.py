"""Limits by time let components wait (contributors K1): on the bench, with the scheduler's real decisions."""

from __future__ import annotations

import itertools
import logging
from pathlib import Path

import pytest

from afspm import Component
from afspm.basics.errors import Refused
from afspm.components.feedback_tuner import FeedbackTuner
from afspm.components.planned_scans import ScanSeries
from afspm.components.spectroscopy_grid import SpectroscopyGrid
from afspm.components.survey import Survey
from afspm.components.sweep import Sweep
from afspm.model import ControlMode, ControlRequest, JournalEntry, Region, names
from afspm.night import Overview
from afspm.scheduler.safety.limits import ExperimentLimits, Limit, RoleLimits
from afspm.testing import Bench

SAMPLE = Path(__file__).parents[3] / "experiments" / "tip_repair" / "experiment.toml"
SIZE = (1e-6, 1e-6)
MINUTE_NS = 60 * 10**9


def every(action: str, interval_s: float) -> ExperimentLimits:
    return ExperimentLimits(actions={action: Limit(interval_s=interval_s)})


def entries(bench: Bench) -> list[JournalEntry]:
    return [entry for batch in bench.published("JournalEntries") for entry in batch.entries]


def starts_ns(bench: Bench, action: str) -> list[int]:
    return [one.sent_ns for one in entries(bench) if one.subject == action and one.response == 0 and one.sent_ns]


def gaps_ns(times: list[int]) -> list[int]:
    return [after - before for before, after in itertools.pairwise(times)]


def test_series_waits_for_the_interval_of_scans_and_gives_control_back() -> None:
    bench = Bench(ScanSeries(SIZE, pixels=(8, 8), scans=4), limits=every(names.START_SCAN, 600.0))
    bench.run(until="2 h")
    assert bench.is_done
    assert len(bench.scans) == 4
    # each wait ends at once, and is no longer than the limit demands
    assert all(10 * MINUTE_NS <= gap < 11 * MINUTE_NS for gap in gaps_ns(starts_ns(bench, names.START_SCAN)))
    released = [one.time_ns for one in entries(bench) if one.what == "lost control"]
    gained = [one.time_ns for one in entries(bench) if one.what == "in control"]
    assert max(after - before for before, after in zip(released, gained[1:], strict=False)) > 9 * MINUTE_NS
    assert not [one for one in entries(bench) if one.refused]


def test_series_that_keeps_control_waits_in_control() -> None:
    series = ScanSeries(SIZE, pixels=(8, 8), scans=3, keep_control=True)
    bench = Bench(series, limits=every(names.START_SCAN, 600.0))
    bench.run(until="2 h")
    assert len(bench.scans) == 3
    assert [one.what for one in entries(bench) if one.kind == "control"].count("in control") == 1


def test_role_with_a_number_per_hour_waits_for_the_next_hour() -> None:
    role = RoleLimits(ExperimentLimits(), per_hour={names.START_SCAN: 2})
    series = ScanSeries(SIZE, pixels=(8, 8), scans=5)
    bench = Bench(series, limits=ExperimentLimits(roles={"scan_series": role}))
    bench.run(until="4 h")
    assert len(bench.scans) == 5
    times = starts_ns(bench, names.START_SCAN)
    assert all(later - earlier >= 60 * MINUTE_NS for earlier, later in zip(times, times[2:], strict=False))


def test_sweep_waits_for_a_rate_and_sets_back() -> None:
    sweep = Sweep(parameters={names.TIP_BIAS_VOLTAGE: ["0.1 V", "0.5 V", "0.9 V"]}, size=SIZE, pixels=(8, 8))
    limit = Limit(rate_per_s=1e-3, unit="V")
    bench = Bench(sweep, limits=ExperimentLimits(parameters={names.TIP_BIAS_VOLTAGE: limit}))
    bench.run(until="2 h")
    assert bench.is_done
    assert len(bench.scans) == 3
    sets = [one for one in entries(bench) if one.subject == names.TIP_BIAS_VOLTAGE and one.response == 0]
    # the first is in force; 400 s for each step of 0.4 V, and 800 s for the way back to the simulator's 0.1 V
    assert [float(one.value) for one in sets] == [0.5, 0.9, 0.1]
    gaps_s = [gap / 1e9 for gap in gaps_ns([one.time_ns for one in sets])]
    assert all(needed <= gap < needed + 30.0 for needed, gap in zip((400.0, 800.0), gaps_s, strict=True))


@pytest.mark.parametrize("swept", [names.MOVE_SPEED, names.SCAN_SIZE_X])
def test_sweep_of_what_can_not_be_lent_sets_it_back_at_its_end(swept: str) -> None:
    unit, size = (" m/s", SIZE) if swept == names.MOVE_SPEED else (" m", None)
    values: list[str | float | bool] = [f"{value}e-6{unit}" for value in (2, 3, 4)]
    bench = Bench(Sweep(parameters={swept: values}, pixels=(8, 8), size=size))
    bench.run(until="1 h")
    assert bench.is_done
    sets = [float(one.value) for one in entries(bench) if one.subject == swept and one.response == 0]
    assert sets[:3] == pytest.approx([2e-6, 3e-6, 4e-6])
    assert len(sets) == 4
    assert sets[3] not in sets[:3]


def test_grid_of_spectra_waits_between_its_spectra() -> None:
    grid = SpectroscopyGrid(counts=(2, 2), spacing=(1e-8, 1e-8))
    bench = Bench(grid, limits=every(names.START_SPEC, 60.0))
    bench.run(until="1 h")
    assert len(bench.published("Spec1d")) == 4


def test_survey_takes_all_of_its_targets_over_waits() -> None:
    survey = Survey(size=3e-6, zoom=6e-7, count=2, zoom_pixels=(16, 16))
    bench = Bench(survey, microscope={"surface": {"kind": "particles"}}, limits=every(names.START_SCAN, 1200.0))
    bench.run(until="3 h")
    assert bench.is_done
    assert len(bench.scans) == 3


def test_tuner_waits_for_the_interval_of_gains() -> None:
    tuner, limit = FeedbackTuner(1.0, 1000.0, most_tries=3), Limit(interval_s=300.0)
    bench = Bench(tuner, limits=ExperimentLimits(parameters={names.ZCTRL_IGAIN: limit}))
    bench.at("1 min", bench.flag, "feedback-non-optimal")
    bench.run(until="3 h")
    assert not bench.problems
    of_tuner = int(ControlRequest.SET_ZCTRL_PARAMS), int(ControlRequest.PARAM)
    is_gain = {int(ControlRequest.SET_ZCTRL_PARAMS): "", int(ControlRequest.PARAM): names.ZCTRL_IGAIN}
    gains = [one for one in entries(bench) if one.request in of_tuner and one.subject == is_gain[one.request]]
    accepted = [one.time_ns for one in gains if one.response == 0]
    assert len(accepted) >= 2
    assert all(gap >= 5 * MINUTE_NS for gap in gaps_ns(accepted))


class Waiting(Component):
    """Two scans, of which the second has to wait; `meets` is the outcome of a call with a time limit."""

    def __init__(self, within_s: float | None = None) -> None:
        self.within_s = within_s
        self.meets = ""

    def run(self) -> None:
        region = Region((0.0, 0.0), SIZE)
        self.scope.scan(region, shape=(8, 8))
        try:
            self.scope.scan(region, shape=(8, 8), timeout_s=self.within_s)
        except Refused as refused:
            self.log.warning("again in %.0f min", ((refused.again_ns or 0) - self.clock.now_ns()) / MINUTE_NS)


def test_call_with_a_time_limit_says_when_it_may_be_asked_again(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench(Waiting(within_s=120.0), limits=every(names.START_SCAN, 600.0))
    with caplog.at_level(logging.INFO):
        bench.run(until="1 h")
    assert bench.is_done
    assert len(bench.scans) == 1
    assert "again in 8 min" in caplog.text


def test_flagged_problem_and_manual_take_a_wait_over() -> None:
    bench = Bench(Waiting(), limits=every(names.START_SCAN, 600.0))
    bench.at("5 min", bench.flag, "tip-shape-changed")
    bench.at("20 min", bench.clear, "tip-shape-changed")
    bench.at("21 min", bench.set_mode, ControlMode.MANUAL)
    bench.at("22 min", bench.set_mode, ControlMode.AUTOMATED)
    bench.run(until="1 h")
    assert bench.is_done
    first, second = starts_ns(bench, names.START_SCAN)
    assert 19 * MINUTE_NS <= second - first < 21 * MINUTE_NS  # the limit has long passed when the problem is solved


def test_wait_is_shown_until_the_request_is_accepted() -> None:
    bench = Bench(Waiting(), limits=every(names.START_SCAN, 600.0))
    seen, shown = Overview(), list[list[str]]()

    def look() -> None:
        for entry in bench.published("JournalEntries"):
            seen.take("JournalEntries", entry, entry.entries[-1].time_ns)
        newest_ns = seen.entries[-1].time_ns
        shown.append([f"{one.who} {one.subject}" for one in seen.waits_at(newest_ns)])

    bench.at("5 min", look)
    bench.at("15 min", look)
    bench.run(until="1 h")
    assert shown == [["waiting start-scan"], []]
    assert not seen.refusals


def test_repair_waits_for_the_interval_of_crashes(tmp_path: Path) -> None:
    # the example of the reference: a crash every 10 min. Of 20 seeds 5 and more were given up, and none is lost
    overlay = tmp_path / "slow.toml"
    overlay.write_text('[microscope]\nseed = 4\n[limits.actions.x-crash]\nevery = "10 min"\n')
    bench = Bench.of(SAMPLE, overlay, component="series", without=("metadata", "night_picture"))
    bench.run(until="10 h")
    assert bench.is_done
    assert not bench.problems
    crashes = starts_ns(bench, names.CRASH)
    assert all(gap >= 10 * MINUTE_NS for gap in gaps_ns(crashes))
