"""Imaging by the tip: grey dilation against the definition, and the effect of each flaw of a tip."""

from __future__ import annotations

import math

import numpy as np
import pytest

from afspm.simulation.imaging import SampleGrid, Sampler, felt
from afspm.simulation.tip import TipShape

STEP = 1e-9


def felt_of(height: np.ndarray, tip: TipShape, blur: float = 0.0) -> np.ndarray:
    grid = SampleGrid(0.0, 0.0, STEP, STEP, (height.shape[0], height.shape[1]))
    path, offset = felt(height, grid, tip, (blur, blur))
    return path + offset


def by_definition(height: np.ndarray, shape_m: np.ndarray) -> np.ndarray:
    """Return max over (i, j) of height[r + i, c + j] - tip[i, j], tip given on an odd square about its apex."""
    reach = shape_m.shape[0] // 2
    padded = np.pad(height, reach, constant_values=-1.0)
    ny, nx = height.shape
    stack = [
        padded[i : i + ny, j : j + nx] - shape_m[i, j] for i in range(shape_m.shape[0]) for j in range(shape_m.shape[1])
    ]
    highest: np.ndarray = np.max(stack, axis=0)
    return highest


def test_parabolic_tip_dilates_as_defined() -> None:
    height = np.random.default_rng(1).uniform(0.0, 4e-9, (40, 50))
    tip = TipShape(radius_m=10e-9, half_angle_deg=5.0)  # so slim that the cone never touches
    i = np.arange(-12, 13) * STEP
    shape = (i[:, None] ** 2 + i[None, :] ** 2) / (2 * 10e-9)
    np.testing.assert_allclose(felt_of(height, tip), by_definition(height, shape), atol=1e-14)


def test_wide_cone_is_felt_beside_a_tall_wall() -> None:
    height = np.zeros((121, 121))
    height[60, 60] = 60e-9  # a needle draws the tip
    tip = TipShape(radius_m=5e-9, half_angle_deg=30.0)
    seen = felt_of(height, tip)
    slope = 1.0 / math.tan(math.radians(30.0))
    corner = 5e-9 * slope

    def tip_at(r: float) -> float:
        return r * r / 10e-9 if r < corner else corner * slope / 2 + (r - corner) * slope

    for away in (3, 8, 15, 25):
        assert seen[60, 60 + away] == pytest.approx(max(60e-9 - tip_at(away * STEP), 0.0), abs=0.6e-9)
        diagonal = max(60e-9 - tip_at(away * math.sqrt(2.0) * STEP), 0.0)
        assert seen[60 + away, 60 + away] == pytest.approx(diagonal, abs=0.6e-9)


def test_tip_is_never_inside_the_sample() -> None:
    height = np.random.default_rng(2).normal(0.0, 5e-9, (60, 60))
    for tip in (TipShape(3e-9, 20.0), TipShape(40e-9, 25.0), TipShape(3e-9, 20.0, second_apex_m=(9e-9, 4e-9, -1e-9))):
        assert (felt_of(height, tip) >= height - 1e-13).all()


def test_second_apex_shows_a_lower_copy_on_the_other_side() -> None:
    height = np.zeros((101, 101))
    height[50, 50] = 20e-9
    seen = felt_of(height, TipShape(1e-9, 5.0, second_apex_m=(20e-9, -12e-9, -3e-9)))
    # The second apex meets the needle when the first stands before it by the offset.
    assert seen[50, 50] == pytest.approx(20e-9, abs=1e-12)
    assert seen[62, 30] == pytest.approx(17e-9, abs=1e-12)
    assert seen[38, 70] == pytest.approx(0.0, abs=1e-12)


def test_spline_at_points_has_the_requested_blur() -> None:
    x = np.arange(200) * STEP
    wave = 2 * np.pi / (16 * STEP)
    height = np.broadcast_to(1e-9 * np.sin(wave * x), (200, 200))
    grid = SampleGrid(0.0, 0.0, STEP, STEP, (200, 200))
    path, offset = felt(np.array(height), grid, TipShape(1e-15, 1.0), (2.0, 2.0))
    at = np.random.default_rng(3).uniform(50 * STEP, 150 * STEP, (2, 5, 40))
    seen = Sampler(grid, at[0], at[1]).spline(path) + offset
    left = math.exp(-0.5 * (wave * 2.0 * STEP) ** 2)
    np.testing.assert_allclose(seen, left * 1e-9 * np.sin(wave * at[0]), atol=0.004e-9)
