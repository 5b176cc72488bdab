"""The difference of two aligned scans."""

from __future__ import annotations

import numpy as np
import pytest

from afspm.basics import InvalidValue
from afspm.components import Levelling
from afspm.model import Region
from afspm.plugins.web.dashboard.night_page import difference
from afspm.plugins.web.frames import ChannelFrame

SIDE = 96
SIZE_M = (1e-6, 0.5e-6)


def surface(x_px: int = 0, y_px: int = 0) -> np.ndarray:
    """A rough surface of 40 nm, seen through a window."""
    rough = np.random.default_rng(3).normal(size=(3 * SIDE, 3 * SIDE))
    for axis in (0, 1):
        rough = np.sum([np.roll(rough, step, axis) for step in range(7)], axis=0)
    return 1e-9 * rough[SIDE + y_px : 2 * SIDE + y_px, SIDE + x_px : 2 * SIDE + x_px]


def frame(values: np.ndarray, size_m: tuple[float, float] = SIZE_M, unit: str = "m") -> ChannelFrame:
    return ChannelFrame(-5, "Height", unit, Region((1e-6, 2e-6), size_m, 0.3), values, 7, None, len(values))


@pytest.mark.parametrize(("x_px", "y_px"), [(0, 0), (5, -3), (-8, 6)])
def test_a_mere_displacement_is_no_difference(x_px: int, y_px: int) -> None:
    found, words = difference(frame(surface()), frame(surface(x_px, y_px)), Levelling.NONE)
    assert words.startswith("registered")
    rough = np.std(surface())
    assert np.nanstd(found.values) < 0.05 * rough
    if x_px or y_px:
        assert np.nanstd(surface(x_px, y_px) - surface()) > 0.5 * rough
    assert found.region == frame(surface()).region


def test_a_new_particle_is_shown_at_its_place() -> None:
    second = surface(4, 2)
    second[50:56, 30:36] += 100e-9
    found, _ = difference(frame(surface()), frame(second), Levelling.PLANE)
    row, column = np.unravel_index(np.nanargmax(found.values), found.values.shape)
    assert (abs(row - (52 + 2)) < 4, abs(column - (32 + 4)) < 4) == (True, True)


def test_scans_of_other_sizes_or_without_registration_are_compared_pixel_by_pixel() -> None:
    _, words = difference(frame(surface()), frame(surface(), (2e-6, 1e-6)), Levelling.NONE)
    assert "sizes differ" in words
    found, words = difference(frame(surface()), frame(np.zeros((SIDE, SIDE))), Levelling.NONE)
    assert words.startswith("not registered")
    assert np.isfinite(found.values).all()


def test_other_pixels_or_units_have_no_difference() -> None:
    with pytest.raises(InvalidValue, match="pixels"):
        difference(frame(surface()), frame(surface()[:-1]), Levelling.NONE)
    with pytest.raises(InvalidValue, match="values in m and V"):
        difference(frame(surface()), frame(surface(), unit="V"), Levelling.NONE)
