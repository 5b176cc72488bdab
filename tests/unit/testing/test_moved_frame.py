"""The move of a frame, as two pictures show it (users U15)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from afspm.testing.commissioning.moved_frame import LIKE, displacement, faults


def test_move_of_a_frame_is_found_within_a_tenth_of_a_pixel() -> None:
    random = np.random.default_rng(1)
    sample = gaussian_filter(random.normal(size=(400, 400)), 8.0)
    tilt = np.add.outer(0.01 * np.arange(64), 0.02 * np.arange(64))
    before, after = sample[20:276:4, 20:276:4], sample[58:314:4, 121:377:4] + tilt
    found = displacement(before, after)
    assert found.move == pytest.approx([25.25, 9.5], abs=0.1)
    assert found.likeness > LIKE
    assert not found.is_ambiguous


def test_lattice_is_ambiguous_and_noise_shows_nothing() -> None:
    y, x = np.indices((64, 64))
    lattice = np.cos(x / 1.5) + np.cos(y / 1.5)
    assert displacement(lattice, lattice).is_ambiguous
    one, other = np.random.default_rng(2).normal(size=(2, 64, 64))
    assert displacement(one, other).likeness < LIKE
    assert displacement(np.zeros((64, 64)), np.zeros((64, 64))).likeness < LIKE


@pytest.mark.parametrize("angle_deg", [0.0, 30.0])
def test_right_frame_has_no_fault_and_creep_of_some_percent_is_none(angle_deg: float) -> None:
    x, y = np.array([1.03, 0.02]), np.array([-0.02, 0.98])
    assert faults(x, y, np.array([1.0, 0.03]), angle_deg) == []
