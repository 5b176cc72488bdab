"""Drift as a function of time."""

from __future__ import annotations

import numpy as np
import pytest

from afspm.basics.errors import InvalidValue
from afspm.simulation.drift import Drift, DriftSettings, Relaxation, ScannerCompensation, random_walk

START = 1.75e9


def test_drift_is_zero_at_the_start_and_adds_up() -> None:
    settings = DriftSettings(
        velocity_m_per_s=(1e-10, 0.0, 2e-11), relaxing=(Relaxation((1e-6, -2e-6, 0.0), 1000.0),) * 2
    )
    drift = Drift(settings, 3, START)
    np.testing.assert_array_equal(drift.at(START), np.zeros(3))
    left = 1 - np.exp(-0.5)
    np.testing.assert_allclose(drift.at(START + 500), [5e-8 + 2e-6 * left, -4e-6 * left, 1e-8], rtol=1e-6)
    assert drift.at(np.full((4, 5), START)).shape == (4, 5, 3)


def test_walk_does_not_depend_on_the_order_of_calls() -> None:
    drift = Drift(DriftSettings(walk_m_per_sqrt_hour=100e-9), 3, START)
    times = START + np.random.default_rng(0).uniform(0, 2e6, 300)
    together = drift.at(times)
    one_by_one = np.array([drift.at(t) for t in times[::-1]])[::-1]
    np.testing.assert_array_equal(together, one_by_one)
    other = Drift(DriftSettings(walk_m_per_sqrt_hour=100e-9), 4, START).at(times)
    assert not np.allclose(together[:, :2], other[:, :2])


def test_walk_spreads_as_the_square_root_of_time() -> None:
    ends = np.array([random_walk(seed, np.array([100.0, 3600.0, 3600.0 * 40])) for seed in range(600)])
    np.testing.assert_allclose(ends.std(axis=0), np.sqrt([100.0, 3600.0, 3600.0 * 40]), rtol=0.12)
    steps = np.diff(random_walk(5, np.arange(0.0, 20000.0, 10.0)))
    assert np.std(steps) == pytest.approx(np.sqrt(10.0), rel=0.06)
    assert abs(np.corrcoef(steps[1:], steps[:-1])[0, 1]) < 0.08


def test_walk_is_continuous_across_its_longest_interval() -> None:
    edge = 2.0**20
    near = random_walk(1, np.array([edge - 1e-3, edge, edge + 1e-3]))
    assert np.ptp(near) < 0.05


def test_time_before_the_start_is_refused() -> None:
    with pytest.raises(InvalidValue):
        Drift(DriftSettings(), 1, START).at(START - 5)
    with pytest.raises(InvalidValue):
        Drift(DriftSettings(), 1, START).at(float("nan"))


def test_scanner_that_follows_with_the_right_velocity_sees_no_drift() -> None:
    from afspm.simulation import World

    world = World.from_settings({"drift": {"velocity_m_per_s": [1e-9, -2e-9, 0.0]}}, 1, 0.0)
    world.compensate((5e-10, 0.0), 100.0)
    world.compensate((1e-9, -2e-9), 300.0)
    seen = world.sample.seen_drift_m(np.array([0.0, 100.0, 300.0, 1e4]))
    expected = [[0.0, 0.0], [1e-7, -2e-7], [3e-7 - 1e-7, -6e-7], [2e-7, -6e-7]]
    np.testing.assert_allclose(seen[:, :2], expected, atol=1e-18)
    np.testing.assert_allclose(world.drift_m(1e4)[:2], [1e-5, -2e-5])  # what the sample does is another matter
    again = World.from_settings({"drift": {"velocity_m_per_s": [1e-9, -2e-9, 0.0]}}, 1, 0.0)
    again.restore(world.state())
    np.testing.assert_array_equal(again.sample.seen_drift_m(5e3), world.sample.seen_drift_m(5e3))


def test_scanner_compensation_does_not_depend_on_the_order_of_calls() -> None:
    compensation = ScannerCompensation()
    turns = [(10.0, 1e-9), (20.0, 3e-9), (20.0, -2e-9), (35.0, 0.0)]
    for since_s, velocity in turns:
        compensation.set((velocity, -velocity), since_s)
    times = np.linspace(0.0, 50.0, 101)
    expected = np.interp(times, [0.0, 10.0, 20.0, 35.0, 50.0], [0.0, 0.0, 10e-9, -20e-9, -20e-9])
    for part in (times, times[::-1], times[60:], times[:5], times[:0]):
        follows = np.interp(part, times, expected)
        np.testing.assert_allclose(compensation.at(part)[:, :2], np.stack([follows, -follows], axis=1), atol=1e-20)
    np.testing.assert_allclose([compensation.at(t)[0] for t in times], expected, atol=1e-20)
