"""Nights of components with settings of their own: each measurement has those of its plan, and else the base."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.simulation.shared_nights import HAS_SETTINGS, LASTS_S, OF_SCANS, decided, decider, events, night, plans

SEEDS = (0, 1, 4, 8)
is_red = pytest.mark.skip(reason="a component measures with the settings that another has set: no loans yet")


@is_red
@pytest.mark.parametrize("seed", SEEDS)
def test_each_measurement_has_the_settings_of_its_plan(seed: int, tmp_path: Path) -> None:
    found = night(seed, tmp_path)
    assert [str(one) for one in found.faults] == []
    assert found.measured > 4


def test_first_nights_meet_each_kind_of_component_and_event() -> None:
    casts = [plans(seed, setpoint=0.7) for seed in range(60)]
    kinds = {one.kind for cast in casts for one in cast}
    measuring = {"scan_series", "scan_list", "bare", "sweep", "sweep_at", "grid", "curves"}
    assert kinds - {"own"} == {*measuring, "foreign", "solver", "flagger"}
    assert ("own" in kinds) == HAS_SETTINGS
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
