"""All invariants of a scheduler hold for the drift compensated one, also when its worker fails."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from rotation import ALL, rotated

from tests.simulation.drift_night import DriftNight
from tests.simulation.night import Plan, plan

SEEDS: Sequence[int] = range(12) if ALL else rotated((2, 3, 4, 7, 9), 5)
"""Each of the five finds limits that are decided when a request arrives, not when it is sent."""


@pytest.mark.parametrize("seed", SEEDS)
def test_every_invariant_holds_in_many_nights(seed: int) -> None:
    DriftNight(plan(seed), trouble=(0.0, 0.1, 0.5)[seed % 3]).run()


def test_a_quiet_night_s_scans_lie_where_they_were_taken_on_the_sample() -> None:
    night = DriftNight(Plan(seed=3, hours=4.0))
    outcome = night.run()
    assert outcome.scans > 4.0 * 3600.0 / night.microscope.habits.scan_s / 2.0
    assert night.published >= 2 * (outcome.scans - 2)
    assert np.median(night.misplaced_m) < 0.5e-9
    # the microscope followed the sample, by what was known before each scan
    assert abs(night.microscope.region.center_m[0]) > 1e-6


def test_a_worker_in_trouble_costs_no_scan() -> None:
    calm, troubled = DriftNight(Plan(seed=5, hours=4.0)), DriftNight(Plan(seed=5, hours=4.0), trouble=0.3)
    scans = calm.run().scans
    assert troubled.run().scans > 0.7 * scans
    assert troubled.worker.failed > 5


def test_a_night_replays_exactly() -> None:
    first, second = (DriftNight(plan(7, hours=3.0), trouble=0.3) for _ in range(2))
    assert first.run() == second.run()
    assert first.scheduler.disk == second.scheduler.disk
    assert first.misplaced_m == second.misplaced_m
