"""Nights of components with settings of their own: each measurement has those of its plan, and else the base."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.simulation.shared_nights import LASTS_S, MUTANTS, OF_SCANS, decided, decider, events, night, plans

SEEDS = (0, 1, 4, 8)
FINDERS = (1, 0, 2, 3, 4, 5, *range(6, 30))
"""Nights that are tried until one sees a mutant."""


@pytest.mark.parametrize("seed", SEEDS)
def test_each_measurement_has_the_settings_of_its_plan(seed: int, tmp_path: Path) -> None:
    found = night(seed, tmp_path)
    assert [str(one) for one in found.faults] == []
    assert found.measured > 4


@pytest.mark.slow
@pytest.mark.parametrize("mutant", MUTANTS)
def test_part_of_the_book_that_is_left_out_is_seen(mutant: str, tmp_path: Path) -> None:
    assert any(night(seed, tmp_path / str(seed), mutant).faults for seed in FINDERS)


def test_first_nights_meet_each_kind_of_component_and_event() -> None:
    casts = [plans(seed, setpoint=0.7) for seed in range(60)]
    kinds = {one.kind for cast in casts for one in cast}
    measuring = {"scan_series", "scan_list", "bare", "sweep", "sweep_at", "grid", "curves"}
    assert kinds == {*measuring, "own", "foreign", "solver", "flagger"}
    met = Counter(one.does for seed, cast in enumerate(casts) for one in events(seed, cast, setpoint=0.7))
    assert met.keys() == {"manual", "continue", "panel", "flag", "clear", "kill", "give up"}
    assert all(one.at_s < LASTS_S for seed, cast in enumerate(casts) for one in events(seed, cast, setpoint=0.7))


@pytest.mark.parametrize("setpoint", [0.7, 100e-12])
def test_value_of_a_decision_names_its_decider_alone(setpoint: float) -> None:
    for name in OF_SCANS:
        for by in ("person", "foreign", "solver"):
            values = {decided(by, number, name, setpoint) for number in range(99)}
            assert len(values) == 99
            assert {decider(name, value, setpoint) for value in values} == {by}
    stated = [
        (name, value) for one in plans(3, setpoint) for values in one.states.values() for name, value in values.items()
    ]
    assert {decider(name, value, setpoint) for name, value in stated} == {""}
