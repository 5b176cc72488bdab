"""Curves at a point: physical, and dependent on position and tip."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from afspm.basics.errors import InvalidValue
from afspm.model import Feedback
from afspm.simulation import TipShape, World
from afspm.simulation.feedback import FeedbackSettings, Loop
from afspm.simulation.spectra import ForceSettings, IVSettings, current_voltage, force_distance

TAPPING = Loop.of(FeedbackSettings(), None)
SHARP = TipShape(10e-9, 18.0)


def iv(material: float, tip: TipShape = SHARP, **settings: Any) -> np.ndarray:
    quiet = IVSettings(**{"noise_a": 0.0, "relative_noise": 0.0, **settings})
    return current_voltage(quiet, tip, material, 0.1, TAPPING, np.random.default_rng(0))[2]


def force(material: float, tip: TipShape = SHARP, **settings: Any) -> np.ndarray:
    quiet = ForceSettings(**{"noise_m": 0.0, "points": 4000, **settings})
    return force_distance(quiet, tip, material, np.random.default_rng(0))[2]


def test_current_is_what_the_feedback_held_and_zero_without_bias() -> None:
    for material in (0.0, 0.5, 1.0):
        curve = iv(material)
        assert np.interp(1.0, curve[:, 0], curve[:, 1]) == pytest.approx(100e-12, rel=0.01)
        assert np.interp(0.0, curve[:, 0], curve[:, 1]) == pytest.approx(0.0, abs=1e-13)
        assert (np.diff(curve[:, 1]) > 0).all()


def test_semiconductor_has_a_gap_where_a_metal_has_none() -> None:
    def in_gap(curve: np.ndarray) -> float:
        return float(np.interp(0.3, curve[:, 0], curve[:, 3]) / np.interp(1.2, curve[:, 0], curve[:, 3]))

    assert in_gap(iv(0.0)) < 0.1
    assert in_gap(iv(1.0)) > 0.5


def test_tip_shows_in_the_curve() -> None:
    dirty = TipShape(10e-9, 18.0, debris_m=5e-9, flaws=("contaminated",))
    clean, odd = iv(1.0), iv(1.0, dirty)
    state = np.abs(clean[:, 0] - 0.62).argmin()
    assert odd[state, 3] / odd[-1, 3] > 1.5 * clean[state, 3] / clean[-1, 3]


def test_tunnelling_the_setpoint_is_the_current_at_the_bias_in_force() -> None:
    tunnelling = Loop.of(FeedbackSettings(mode="current"), Feedback(setpoint=2e-10))
    quiet = IVSettings(noise_a=0.0, relative_noise=0.0)
    curve = current_voltage(quiet, SHARP, 1.0, -0.5, tunnelling, np.random.default_rng(0))[2]
    assert np.interp(-0.5, curve[:, 0], curve[:, 1]) == pytest.approx(-2e-10, rel=0.01)


def test_noise_and_saturation_of_the_amplifier() -> None:
    noisy = current_voltage(IVSettings(noise_a=5e-12), SHARP, 1.0, 0.1, TAPPING, np.random.default_rng(0))[2]
    assert np.std(noisy[:, 1] - noisy[:, 2]) == pytest.approx(5e-12 * math.sqrt(2), rel=0.2)
    assert np.abs(iv(1.0, preamplifier_a=50e-12)[:, 1]).max() == 50e-12


def test_pulling_off_takes_the_adhesion_of_the_radius() -> None:
    for radius in (10e-9, 40e-9):
        curve = force(1.0, TipShape(radius, 18.0), range_m=400e-9)
        assert curve[:, 4].min() == pytest.approx(-2 * math.pi * radius * 0.03, rel=0.03)


def test_approach_and_retract_differ_by_the_jumps() -> None:
    curve = force(0.0)
    z, there, back = curve[:, 0], curve[:, 3], curve[:, 4]
    assert back.min() < there.min() < 0.0  # adhesion after contact is stronger
    snap_in, pull_off = z[there < 0.3 * there.min()].max(), z[back < 0.3 * back.min()].max()
    assert 0.0 < snap_in < pull_off
    assert np.abs(there[z > 100e-9]).max() < 0.1e-9
    assert np.all(back <= there + 1e-12)


def test_contact_slope_is_nearly_one_on_a_stiff_sample() -> None:
    slopes = []
    for material in (0.0, 1.0):
        curve = force(material)
        pressed = curve[:, 3] > 8e-9
        slopes.append(-np.polyfit(curve[pressed, 0], curve[pressed, 1], 1)[0])
        assert curve[0, 3] == pytest.approx(15e-9, rel=0.05)  # the trigger
    assert slopes[0] < slopes[1] < 1.0
    assert slopes[1] > 0.95
    np.testing.assert_allclose(force(1.0)[:, 3], 0.4 * force(1.0)[:, 1])


def test_curves_depend_on_the_position() -> None:
    world = World.from_settings({"surface": "rough"}, seed=2, start_s=0.0)
    places = [(x * 1e-6, y * 1e-6) for x in range(4) for y in range(3)]
    lowest = [world.spectrum("force", place, 0.0)[2][:, 4].min() for place in places]
    assert np.ptp(lowest) > 0.3 * abs(np.mean(lowest))
    names, units, values = world.spectrum("IV", places[0], 0.0)
    assert names == ("Bias", "Current", "Current Retrace", "dI/dV")
    assert units == ("V", "A", "A", "S")
    assert values.shape == (256, 4)


def test_unknown_kind_is_refused() -> None:
    world = World.from_settings({}, seed=2, start_s=0.0)
    with pytest.raises(InvalidValue, match="IV"):
        world.spectrum("VI", (0.0, 0.0), 0.0)
