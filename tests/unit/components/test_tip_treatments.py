"""Allowed treatments of a tip, and their places."""

from __future__ import annotations

import itertools
import math

import pytest

from afspm.basics.errors import ConfigError
from afspm.components.tip_treatments import Crash, Pulse, clearance_m, fresh_place, treatments
from afspm.model import Region


def test_gentle_treatments_come_first_and_only_listed_ones_are_made() -> None:
    assert treatments([3.0, -4.0], 0.05, [5e-9, 1e-8], 5e-8) == (
        Pulse(3.0, 0.05),
        Pulse(-4.0, 0.05),
        Crash(5e-9, 5e-8),
        Crash(1e-8, 5e-8),
    )


@pytest.mark.parametrize(
    ("voltages", "duration", "depths", "speed"),
    [
        ([], 0.1, [], 1e-8),
        ([0.0], 0.1, [], 1e-8),
        ([3.0], 0.0, [], 1e-8),
        ([], 0.1, [-1e-9], 1e-8),
        ([], 0.1, [1e-9], 0.0),
    ],
)
def test_invalid_treatment_is_refused(
    voltages: list[float], duration: float, depths: list[float], speed: float
) -> None:
    with pytest.raises(ConfigError):
        treatments(voltages, duration, depths, speed)


def test_no_two_treatments_of_a_night_hit_the_same_place() -> None:
    places = [fresh_place((1e-6, 0.0), 300e-9, number) for number in range(60)]
    nearest = min(math.dist(a, b) for a, b in itertools.combinations(places, 2))
    assert nearest >= 300e-9


def test_clearance_is_measured_from_the_border_of_the_turned_region() -> None:
    region = Region((0.0, 0.0), (2.0, 1.0), math.pi / 2)
    assert clearance_m((0.0, 0.9), region) == 0.0
    assert clearance_m((1.5, 0.0), region) == pytest.approx(1.0)
    assert clearance_m((3.5, 5.0), region) == pytest.approx(5.0)
