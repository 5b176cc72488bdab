"""Plans of sweeps: each combination once, in steps, and refusals of values without sense."""

from __future__ import annotations

import itertools
from collections import Counter
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.basics.errors import InvalidValue, UnitError
from afspm.model.requests import Parameter
from afspm.model.sweep_plan import SweepAxis, SweepOrder, SweepPlan

counts = st.lists(st.integers(1, 5), min_size=1, max_size=4)
orders: st.SearchStrategy[SweepOrder] = st.sampled_from(["snake", "listed", "random"])


def plan_of(counts: list[int], order: SweepOrder = "snake", seed: int = 0) -> SweepPlan:
    axes = tuple(SweepAxis(f"x-{n}", tuple(map(float, range(count)))) for n, count in enumerate(counts))
    return SweepPlan(axes, order, seed)


@given(counts, orders, st.integers())
def test_each_combination_is_measured_once(counts: list[int], order: SweepOrder, seed: int) -> None:
    plan = plan_of(counts, order, seed)
    every = Counter(itertools.product(*map(range, counts)))
    assert Counter(plan.places()) == every
    assert plan.total == len(every)


@given(counts, orders, st.integers(), st.integers(1, 3))
def test_repeated_points_follow_each_other(counts: list[int], order: SweepOrder, seed: int, repeat: int) -> None:
    once = plan_of(counts, order, seed)
    plan = SweepPlan(once.axes, order, seed, repeat)
    assert plan.places() == [place for place in once.places() for _ in range(repeat)]
    assert plan.total == repeat * once.total


LOOP = ["1 T", "0 T", "-1 T", "0 T", "1 T"]


def test_loop_is_measured_as_listed() -> None:
    plan = SweepPlan.of({"lab.field": LOOP, "zctrl-igain": [1, 2]}, "listed")
    fields = [plan.values(place)["lab.field"] for place in plan.places()]
    assert fields == [1.0, 1.0, 0.0, 0.0, -1.0, -1.0, 0.0, 0.0, 1.0, 1.0]


def test_value_twice_is_refused_where_the_order_sorts_the_values() -> None:
    with pytest.raises(InvalidValue, match="has a value twice") as caught:
        SweepPlan.of({"lab.field": LOOP})
    assert 'order = "listed"' in caught.value.hint


@given(counts)
def test_snake_moves_one_parameter_to_a_neighbouring_value(counts: list[int]) -> None:
    places = plan_of(counts).places()
    for before, after in itertools.pairwise(places):
        assert sum(abs(a - b) for a, b in zip(before, after, strict=True)) == 1


@given(counts)
def test_the_first_parameter_changes_least_often(counts: list[int]) -> None:
    places = plan_of(counts).places()
    changes = sum(before[0] != after[0] for before, after in itertools.pairwise(places))
    assert changes == counts[0] - 1


@given(counts, st.integers())
def test_a_random_order_is_the_same_for_the_same_seed(counts: list[int], seed: int) -> None:
    assert plan_of(counts, "random", seed).places() == plan_of(counts, "random", seed).places()


def test_another_seed_gives_another_order() -> None:
    assert plan_of([5, 5], "random", 1).places() != plan_of([5, 5], "random", 2).places()


@given(low=st.floats(1e-12, 1e3), ratio=st.floats(1.001, 1e6), points=st.integers(2, 50), falls=st.booleans())
def test_log_spaced_values_have_equal_ratios(low: float, ratio: float, points: int, *, falls: bool) -> None:
    ends = (low * ratio, low) if falls else (low, low * ratio)
    given: dict[str, Any] = {"from": ends[0], "to": ends[1], "points": points, "spacing": "log"}
    values: Any = SweepAxis.of("x-any", given).values
    assert len(values) == points
    assert (values[0], values[-1]) == pytest.approx(ends)
    ratios = [after / before for before, after in itertools.pairwise(values)]
    assert ratios == pytest.approx([ratios[0]] * len(ratios), rel=1e-9)


def test_values_become_si_and_keep_round_digits() -> None:
    axis = SweepAxis.of("scan-speed", {"from": "0.1 um/s", "to": "0.3 um/s", "points": 3})
    assert axis.values == (1e-7, 2e-7, 3e-7)
    assert axis.parameter(2) == Parameter("scan-speed", "3e-07", "m/s")


def test_a_unit_decides_where_the_parameter_does_not() -> None:
    axis = SweepAxis.of("zctrl-setpoint", ["50 pA", "0.1 nA"])
    assert axis == SweepAxis("zctrl-setpoint", (5e-11, 1e-10), "A")


def test_steps_reach_the_end_and_pixels_stay_whole() -> None:
    axis = SweepAxis.of("scan-resolution-x", {"from": 256, "to": 64, "step": 64})
    assert [axis.parameter(place).value for place in range(4)] == ["256", "192", "128", "64"]
    assert SweepAxis.of("zctrl-igain", {"from": 0, "to": 0.3, "step": 0.1}).values == (0.0, 0.1, 0.2, 0.3)


def test_switches_and_texts_are_swept() -> None:
    switch, text = SweepAxis.of("x-feedback-on", [True, False]), SweepAxis.of("x-scan-direction", ["up", "down"])
    assert switch.parameter(1) == Parameter("x-feedback-on", "false")
    assert text.parameter(1) == Parameter("x-scan-direction", "down")


def test_snake_sorts_numbers_in_the_direction_in_which_they_are_listed() -> None:
    plan = SweepPlan.of({"zctrl-igain": [5, 9, 7, 1]})
    assert plan.axes[0].values == (9.0, 7.0, 5.0, 1.0)
    assert SweepPlan.of({"zctrl-igain": [5, 9, 7, 1]}, "listed").axes[0].values == (5.0, 9.0, 7.0, 1.0)


@pytest.mark.parametrize(
    ("name", "given", "why"),
    [
        ("scan-speed", [], "no value"),
        ("scan-speed", "1 um/s", "list of values, or a range"),
        ("scan-speed", ["1 um/s", "fast"], "can't be 'fast'"),
        ("scan-speed", ["1 um/s", "1 V"], "V"),
        ("scan-speed", [5.0], "5 m/s"),
        ("zctrl-setpoint", ["50 pA", 60], "has no unit"),
        ("scan-speed", [float("nan")], "nan"),
        ("zctrl-igain", {"from": 1, "to": 9}, "`points` or `step`"),
        ("zctrl-igain", {"from": 1, "to": 9, "points": 3, "step": 1}, "`points` or `step`"),
        ("zctrl-igain", {"from": 1, "to": 9, "count": 3}, "'count'"),
        ("zctrl-igain", {"from": 1, "to": 1, "points": 3}, "empty"),
        ("zctrl-igain", {"from": 1, "to": 9, "points": 1}, "2 at least"),
        ("zctrl-igain", {"from": 1, "to": 9, "points": 2.5}, "2 at least"),
        ("zctrl-igain", {"from": 0, "to": 9, "points": 3, "spacing": "log"}, "above zero"),
        ("zctrl-igain", {"from": 1, "to": 9, "points": 3, "spacing": "cubic"}, "'cubic'"),
        ("zctrl-igain", {"from": 1, "to": 9, "step": 0}, "above zero"),
        ("zctrl-igain", {"from": 0, "to": 1, "step": 1e-9}, "at most"),
        ("x-scan-direction", {"from": "up", "to": "down", "points": 2}, "no end of a range"),
        ("magnet.field", ["up", "down"], "are numbers"),
    ],
)
def test_values_without_sense_are_refused(name: str, given: Any, why: str) -> None:
    with pytest.raises((InvalidValue, UnitError)) as caught:
        SweepAxis.of(name, given)
    assert why in str(caught.value)


def test_a_sweep_that_would_never_end_is_refused() -> None:
    with pytest.raises(InvalidValue, match="at most"):
        plan_of([400, 400])
    with pytest.raises(InvalidValue, match="a parameter at least"):
        SweepPlan.of({})
