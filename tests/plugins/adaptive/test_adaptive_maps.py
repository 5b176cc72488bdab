"""Optimisers of a map, by measuring known maps without processes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from benchmarks.adaptive import GOAL, Case, course

from afspm.basics import InvalidValue
from afspm.model import Region
from afspm.plugins.adaptive.gaussian_process import GaussianProcess, Parameters, fitted
from afspm.plugins.adaptive.map_picture import draw_map
from afspm.plugins.adaptive.mapping import MapProgress, MeasuredPoint, Until
from afspm.plugins.adaptive.quantities import evaluation
from afspm.plugins.adaptive.refinement import (
    AdaptiveMap,
    LatticeMap,
    NestedGrid,
    NestedLattices,
    Optimizer,
    learnt_cost,
)

REGION = Region((0.0, 0.0), (1e-6, 1e-6))
SPOT_M = np.array([0.2e-6, -0.1e-6])


def spot(xy_m: np.ndarray) -> np.ndarray:
    """Return the values of one round spot on even ground."""
    return np.asarray(np.exp(-0.5 * ((xy_m - SPOT_M) ** 2).sum(axis=-1) / 40e-9**2))


def measure(planned: LatticeMap, count: int, *, move_s_per_m: float = 0.0) -> list[tuple[float, float]]:
    """Measure the spot at the suggested positions, one second each."""
    at, now_s, positions = (0.0, 0.0), 0.0, []
    for _ in range(count):
        (point,) = planned.suggest()
        xy = (point["x"], point["y"])
        took_s = 1.0 + move_s_per_m * math.dist(at, xy)
        at, now_s = xy, now_s + took_s
        planned.ingest([{**point, "height": float(spot(np.array(xy))), "time_s": now_s, "seconds": took_s}])
        positions.append(xy)
    return positions


def test_refinement_measures_beside_the_spot_and_leaves_even_ground_out() -> None:
    near = {}
    for planner in (AdaptiveMap, NestedGrid):
        positions = np.array(measure(planner(REGION, "height", velocity_m_s=(0.0, 0.0)), 150))
        near[planner] = int((np.hypot(*(positions - SPOT_M).T) < 0.1e-6).sum())
    assert near[AdaptiveMap] > 3 * near[NestedGrid] > 0


def test_nested_grid_completes_each_lattice_before_the_next() -> None:
    positions = measure(NestedGrid(REGION, "height", velocity_m_s=(0.0, 0.0)), 81)
    assert len(set(positions)) == 81
    axis = np.linspace(-0.5e-6, 0.5e-6, 9)
    assert np.array(sorted(positions)) == pytest.approx(np.array([(x, y) for x in axis for y in axis]), abs=1e-12)


@pytest.mark.parametrize("move_s_per_m", [0.0, 1e8])
def test_next_position_has_the_largest_variance_per_second(move_s_per_m: float) -> None:
    planned = AdaptiveMap(REGION, "height", velocity_m_s=(0.0, 0.0))
    at = np.array(measure(planned, 60, move_s_per_m=move_s_per_m)[-1])
    (point,) = planned.suggest()
    axis = np.linspace(-0.5e-6, 0.5e-6, 33)
    lattice = np.stack([along.ravel() for along in np.meshgrid(axis, axis)], axis=1)
    apart = np.hypot(*(lattice[:, None] - planned.measurements[None, :, :2]).transpose(2, 0, 1))
    left = lattice[apart.min(axis=1) > 1e-9]
    x, y, values, times_s = planned.measurements.T
    afresh = GaussianProcess(np.stack([x, y], axis=1), values, times_s, planned.parameters)
    per_s = afresh.variance(left) / (1.0 + move_s_per_m * np.hypot(*(left - at).T))
    (chosen,) = np.flatnonzero(np.hypot(*(left - (point["x"], point["y"])).T) < 1e-12)
    assert per_s[chosen] == pytest.approx(per_s.max(), rel=1e-6)


@pytest.mark.parametrize("moves", ["fast", "slow"])
def test_a_spotty_map_takes_clearly_less_time_than_a_nested_grid(moves: str) -> None:
    case = Case("spotty", moves, "off", 20)
    assert course(AdaptiveMap, case).until(GOAL) < 0.85 * course(NestedGrid, case).until(GOAL)


def test_the_expected_error_is_about_the_true_one() -> None:
    found = course(AdaptiveMap, Case("smooth", "fast", "off", 1), 0.15)
    assert found.expected == pytest.approx(found.errors[-1], rel=0.6)


def test_drift_is_found_from_the_values_alone() -> None:
    drift = np.array([20e-12, -12e-12])
    random = np.random.default_rng(1)
    times_s = np.arange(300.0) * 20.0
    # every place at several times, in no order
    tip_m = random.uniform(-0.5e-6, 0.5e-6, (300, 2))
    on_sample = tip_m - np.outer(times_s - times_s[0], drift)
    values = np.sin(on_sample[:, 0] / 70e-9) + np.cos(on_sample[:, 1] / 60e-9)
    found = fitted(tip_m, values, times_s, Parameters(150e-9, 0.01), 20e-9, drifts=True)
    assert found.velocity_m_s == pytest.approx(tuple(drift), abs=2e-12)
    still = fitted(tip_m, np.sin(tip_m[:, 0] / 70e-9), times_s, Parameters(150e-9, 0.01), 20e-9, drifts=True)
    assert np.hypot(*still.velocity_m_s) < 2e-12


def test_few_contradicting_values_make_no_drift() -> None:
    # by the values at these edges alone, the likelihood gains more than 4 with a drift of 132 pm/s
    planned = AdaptiveMap(REGION, "side", levels=4)
    random = np.random.default_rng(6)
    for number in range(110):
        (point,) = planned.suggest()
        side = float(math.sin(point["x"] / 60e-9) + math.cos(point["y"] / 80e-9 + 6.0) > 0.0)
        value = side + 0.05 * random.standard_normal()
        planned.ingest([{**point, "side": value, "time_s": 12.0 * number, "seconds": 12.0}])
        assert planned.parameters.velocity_m_s == (0.0, 0.0)


def test_a_clear_drift_is_followed_while_the_map_is_measured() -> None:
    found = course(AdaptiveMap, Case("smooth", "slow", "on", 20), 0.0, 170)
    assert found.followed
    assert found.velocity_m_s == pytest.approx((15e-12, -10e-12), abs=4e-12)


def test_values_that_are_not_predicted_are_measured_on_a_grid_until_they_are() -> None:
    planned = AdaptiveMap(REGION, "height", coarsest=3, levels=3, velocity_m_s=(0.0, 0.0))
    random = np.random.default_rng(4)
    were_grids = []
    for number in range(200):
        (point,) = planned.suggest()
        value = random.standard_normal() if number < 70 else 0.0
        planned.ingest([{**point, "height": value, "time_s": float(number), "seconds": 1.0}])
        were_grids.append(planned.is_grid)
    assert not any(were_grids[:50])
    assert were_grids[69]
    assert not were_grids[-1]
    # the lattice that was begun is complete before positions are chosen again
    first, last = were_grids.index(True), 200 - were_grids[::-1].index(True)
    xy = planned.measurements[:last, :2]
    lattice = planned.lattice.xy_m(planned.lattice.cells(2))
    assert np.hypot(*(lattice[:, None] - xy[None]).transpose(2, 0, 1)).min(axis=1).max() < 1e-12
    assert first < 81 < last


def test_expected_error_contains_the_noise() -> None:
    planned = NestedGrid(REGION, "height", levels=2, velocity_m_s=(0.0, 0.0))
    random = np.random.default_rng(5)
    points = planned.suggest(25)
    while points:
        planned.ingest([{**point, "height": 0.3 * random.standard_normal(), "time_s": 0.0} for point in points])
        points = planned.suggest(400)
    planned.fit()
    assert planned.expected_error() == pytest.approx(0.3, rel=0.2)


def test_suggested_positions_follow_the_drift() -> None:
    planned = AdaptiveMap(REGION, "height", velocity_m_s=(1e-9, 0.0))
    (first,) = planned.suggest()
    planned.ingest([{**first, "height": 0.0, "time_s": 100.0}])
    (second,) = planned.suggest()
    planned.ingest([{**second, "height": 0.0, "time_s": 150.0, "seconds": 50.0}])
    (third,) = planned.suggest()
    home = planned.lattice.xy_m([tuple(map(int, third["_id"].split("-")))])[0]  # type: ignore[list-item]
    assert third["x"] - home[0] == pytest.approx(100e-9, rel=0.05)  # 50 s have passed, and 50 s it will take
    assert third["y"] == pytest.approx(home[1])


def test_prediction_passes_through_values_and_its_variance_grows_with_the_distance() -> None:
    xy_m = np.random.default_rng(2).uniform(-0.5e-6, 0.5e-6, (60, 2))
    model = GaussianProcess(xy_m, spot(xy_m), np.zeros(60), Parameters(100e-9, 1e-4))
    assert model.predict(xy_m) == pytest.approx(spot(xy_m), abs=0.01)
    near, far = model.variance(np.array([xy_m[0] + 2e-9, [3e-6, 3e-6]]))
    assert near < 0.05 * far


def test_cost_is_learnt_from_ways_and_seconds_without_interruptions() -> None:
    ways_m = [1e-7 * k for k in range(1, 20)]
    seconds = [2.5 + way / 20e-9 for way in ways_m]
    seconds[4] += 3000.0  # a person took control
    cost = learnt_cost(ways_m, seconds)
    assert cost.fixed_s == pytest.approx(2.5, rel=0.01)
    assert cost.per_m_s == pytest.approx(1 / 20e-9, rel=0.01)


def test_each_cell_is_new_in_one_level_and_its_parents_are_in_a_coarser_one() -> None:
    lattice = NestedLattices(Region((0.0, 0.0), (2e-6, 1e-6), 0.3), coarsest=5, levels=3)
    cells = [cell for level in range(4) for cell in lattice.new(level)]
    assert sorted(cells) == sorted(lattice.cells(3))
    for level in (1, 2, 3):
        for cell in lattice.new(level):
            assert set(lattice.parents(cell, level)) <= set(lattice.cells(level - 1))
    corners = {tuple(np.round(xy, 12)) for xy in lattice.xy_m([(0, 0), (lattice.counts[0] - 1, lattice.counts[1] - 1)])}
    assert corners <= {tuple(np.round(xy, 12)) for xy in lattice.region.corners_m()}


def test_optimisers_fit_the_protocol_and_refuse_incomplete_measurements() -> None:
    planned = AdaptiveMap(REGION, "height")
    assert isinstance(planned, Optimizer)
    (point,) = planned.suggest()
    with pytest.raises(InvalidValue, match="height"):
        planned.ingest([point])
    with pytest.raises(InvalidValue, match="not finite"):
        planned.ingest([{**point, "height": math.nan}])
    with pytest.raises(InvalidValue, match="no _id"):
        planned.ingest([{**point, "_id": "somewhere", "height": 1.0}])
    assert len(planned.measurements) == 0
    planned.ingest([{"x": 1e-8, "y": 0.0, "height": 1.0}])  # one of the user's own
    assert len(planned.measurements) == 1
    assert planned.get_best_points()[0][2] == {"height": 1.0}


def test_a_batch_is_suggested_once_and_a_failed_position_is_left_out() -> None:
    planned = AdaptiveMap(REGION, "height")
    batch = planned.suggest(25)
    assert len({point["_id"] for point in batch}) == 25
    assert planned.suggest(1) == []  # the next position follows from values, which are not there yet
    planned.ingest([{**point, "height": float(spot(np.array([point["x"], point["y"]])))} for point in batch[:-1]])
    planned.register_failures(batch[-1:])
    later = []
    for _ in range(5):
        (point,) = planned.suggest(1)
        later.append(point["_id"])
        planned.ingest([{**point, "height": 0.0}])
    assert batch[-1]["_id"] not in later


def test_finer_positions_are_measured_only_between_measured_ones() -> None:
    planned = AdaptiveMap(REGION, "height", coarsest=3, levels=4, velocity_m_s=(0.0, 0.0))
    measure(planned, 9)
    finest: list[tuple[float, float]] = []
    while len(finest) < 20:
        (point,) = planned.suggest()
        cell = (int(point["_id"].split("-")[0]), int(point["_id"].split("-")[1]))
        if planned.lattice.level(cell) == 4:
            finest.append((point["x"], point["y"]))
            parents = planned.lattice.xy_m(planned.lattice.parents(cell, 4))
            apart = np.hypot(*(parents[:, None] - planned.measurements[None, :, :2]).transpose(2, 0, 1))
            assert apart.min(axis=1).max() < 1e-9
        planned.ingest([{**point, "height": float(spot(np.array([point["x"], point["y"]]))), "seconds": 1.0}])
    assert np.median(np.hypot(*(np.array(finest) - SPOT_M).T)) < 0.15e-6


@pytest.mark.parametrize("size_m", [1e-6, 5e-9])
def test_map_of_equal_values_goes_on(size_m: float) -> None:
    planned = AdaptiveMap(Region((0.0, 0.0), (size_m, size_m)), "peaks")
    for second in range(60):
        (point,) = planned.suggest()
        planned.ingest([{**point, "peaks": 0.0, "time_s": float(second), "seconds": 1.0}])
    assert len(planned.measurements) == 60


def test_map_goes_on_when_the_whole_first_lattice_has_failed() -> None:
    planned = AdaptiveMap(REGION, "height", coarsest=3)
    for _ in range(9):
        planned.register_failures(planned.suggest())
    assert len(measure(planned, 20)) == 20


def test_picture_of_a_map_names_its_quantity_in_words() -> None:
    planned = NestedGrid(REGION, "contact_potential")
    points = enumerate(planned.suggest(9))
    found = MapProgress(planned, REGION, evaluation("contact_potential"), Until())
    found.restore([MeasuredPoint(one["_id"], one["x"], one["y"], 0.1 * n, float(n), 1.0) for n, one in points], [])
    figure = draw_map(found, REGION, title="map")
    assert [axes.get_ylabel() for axes in figure.axes[2:]] == ["contact potential / mV", "expected error / mV"]
    assert figure.texts[0].get_text() == "map, contact potential, 9 spectra"
