"""Whole experiments in simulation with all kinds of faults; the invariants hold at every step."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rotation import ALL, rotated

from afspm.model import ProcessCondition
from afspm.scheduler.control.holder_timeout import MOST_RESTARTS
from tests.simulation import long_run
from tests.simulation.behaviours import Experiment
from tests.simulation.night import CAST, FAULTS, FINDERS, PANEL_NIGHTS, Fault, Night, Plan, bad_night, panel_night, plan

_ALIVE = ProcessCondition.ALIVE
ALL_SEEDS = [range(first, first + 5) for first in range(0, 150, 5)]
"""A few thousand experiment hours, a thirtieth of them at each commit; more: python -m tests.simulation.long_run."""


@pytest.mark.parametrize("night", FINDERS, ids=lambda night: f"seed-{night.seed}-{len(night.faults)}-faults")
def test_every_invariant_holds_in_the_nights_that_find_every_mutant(night: Plan) -> None:
    Night(night).run()


@pytest.mark.parametrize("seeds", rotated(ALL_SEEDS, 30), ids=lambda seeds: f"seeds-{seeds.start}-{seeds.stop - 1}")
def test_every_invariant_holds_in_many_nights(seeds: range) -> None:
    for seed in seeds:
        Night(plan(seed)).run()


def test_the_nights_are_a_few_thousand_hours() -> None:
    assert sum(plan(seed).hours_to_the_end for seeds in ALL_SEEDS for seed in seeds) >= 2000.0


def test_nights_reach_the_protection_of_the_tip() -> None:
    """Otherwise its invariants would check nothing."""
    cast = ("experiment", "classifier", "corrector", "feedback", "person", "careless", "stranger")
    nights = [Night(Plan(seed, cast=cast, retracts=seed < 3, ends=seed % 2 == 0)) for seed in range(4)]
    for night in nights:
        night.run()
    assert all(night.invariants.tip.dangers for night in nights)
    assert all(night.invariants.tip.retractions for night in nights[:3])
    assert [night.scheduler.core.control.ended for night in nights] == [True, False, True, False]


def test_a_night_replays_exactly() -> None:
    first, second = Night(plan(7)), Night(plan(7))
    assert first.run() == second.run()
    assert first.timeline.happened == second.timeline.happened
    assert first.scheduler.disk == second.scheduler.disk


def test_a_quiet_night_is_full_of_scans() -> None:
    night = Night(Plan(seed=3, hours=8.0))
    outcome = night.run()
    assert outcome.scans > 8.0 * 3600.0 / night.microscope.habits.scan_s / 2.0
    assert outcome.given_up == []


def test_events_of_a_night_are_logged_and_orders_carried_out() -> None:
    night = Night(Plan(seed=4, hours=8.0, cast=("experiment", "stranger", "listener")))
    night.run()
    assert night.invariants.written.entries > 300
    assert 0 < night.teller.ordered <= night.components["experiment"].life // 2


def test_ended_component_loses_control_as_soon_as_its_supervisor_reports() -> None:
    night = Night(Plan(seed=5, cast=("crasher",)))
    crasher, over_s = night.components["crasher"], math.inf
    while night.timeline.monotonic_s() < night.plan.length_s:
        night.timeline.run_until(night.timeline.monotonic_s() + 0.25)
        is_over = "crasher" in (state.name for state in night.keeper.states() if state.condition is not _ALIVE)
        if is_over and night.scheduler.core.control.holder == crasher.name:
            over_s = min(over_s, night.timeline.monotonic_s())
            assert night.timeline.monotonic_s() - over_s < night.settings.control.grace_s / 2.0
    assert over_s < math.inf


def test_component_that_freezes_in_control_each_time_lets_another_measure() -> None:
    night = Night(Plan(seed=6, hours=5.0, cast=("experiment", "freezer"), lease_s=None))
    night.run()
    assert night.components["freezer"].starts > MOST_RESTARTS
    assert isinstance(experiment := night.components["experiment"], Experiment)
    assert experiment.done


def test_long_run_prints_its_outcome(capsys: pytest.CaptureFixture[str]) -> None:
    assert long_run.main(["--nights", "1", "--seed", "5"]) == 0
    assert "every invariant held" in capsys.readouterr().out


def test_two_changes_of_control_after_an_outage_are_published_one_by_one() -> None:
    """The scheduler comes back, publishes the holder, and finds at the same moment that its lease has run out."""
    faults = (Fault("outage", "scheduler", 0.6640625, 5.0), Fault("freeze", "scheduler", 0.84375, 5.0))
    cast = tuple(CAST)
    night = Plan(0, hours=2.0, speed=200.0, cast=cast, impostor=False, lease_s=900.0)
    Night(replace(night, faults=(*faults, Fault("cut", "scheduler", 0.0, 40.0)), dies_in_step=0.0, doubles=0.05)).run()


def test_packets_that_a_power_cut_took_may_be_published_at_other_times() -> None:
    """A life publishes four packets and dies before they are synced; the next life publishes a request before them."""
    Night(bad_night(36)).run()  # faults 16


_targets = st.sampled_from(["scheduler", "translator", *CAST])
_faults = st.builds(
    Fault,
    what=st.sampled_from(FAULTS),
    whom=_targets,
    when=st.floats(0.0, 1.0),
    for_s=st.sampled_from([0.01, 1.0, 5.0, 11.0, 40.0]),
)


@pytest.mark.slow
@settings(max_examples=40 if ALL else 10, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 2**32),
    faults=st.lists(_faults, max_size=12),
    impostor=st.booleans(),
    lease_s=st.sampled_from([None, 900.0]),
    dies_in_step=st.sampled_from([0.0, 0.002]),
    keys=st.booleans(),
)
def test_no_schedule_of_faults_breaks_an_invariant(
    seed: int, faults: list[Fault], impostor: bool, lease_s: float | None, dies_in_step: float, keys: bool
) -> None:
    cast = tuple(name for name in CAST if lease_s is not None or name != "greedy")
    faults = [fault for fault in faults if fault.whom in ("scheduler", "translator", *cast)]
    made = Plan(seed, hours=2.0, speed=200.0, cast=cast, impostor=impostor, lease_s=lease_s, keys=keys, garbles=0.01)
    Night(replace(made, faults=tuple(faults), dies_in_step=dies_in_step, doubles=0.05)).run()


@pytest.mark.parametrize("night", PANEL_NIGHTS, ids=lambda night: f"{night.panel}-{night.seed}")
def test_nothing_is_sent_to_a_microscope_at_whose_panel_a_person_works(night: Plan) -> None:
    made = Night(night)
    made.run()
    assert made.invariants.acts


@pytest.mark.slow
@pytest.mark.parametrize("seeds", rotated([range(first, first + 10) for first in range(0, 200, 10)], 10))
def test_nothing_is_sent_to_a_person_at_the_panel_in_nights_with_all_faults(seeds: range) -> None:
    for seed in seeds:
        Night(panel_night(seed)).run()
