"""Regions: a mirrored axis, a wrong turn or half a frame must be seen here."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.basics.errors import InvalidValue, UnitError
from afspm.model import Region, RegionChange, ScanParameters

lengths = st.floats(-1e-4, 1e-4)
sizes = st.floats(1e-10, 1e-4)
angles = st.floats(-math.pi, math.pi)


def test_top_left_is_the_corner_of_smallest_x_and_y() -> None:
    region = Region.from_top_left((1e-6, 2e-6), (4e-6, 2e-6))
    assert region.center_m == pytest.approx((3e-6, 3e-6))
    assert region.top_left_m == pytest.approx((1e-6, 2e-6))


def test_a_quarter_turn_is_counter_clockwise() -> None:
    region = Region((0.0, 0.0), (4.0, 2.0), math.pi / 2)
    np.testing.assert_allclose(region.corners_m(), [[1, -2], [1, 2], [-1, 2], [-1, -2]], atol=1e-12)


def test_pixels_begin_and_end_on_the_border_and_ascend() -> None:
    x, y = Region.from_top_left((10.0, 20.0), (4.0, 2.0)).pixels_m((3, 5))
    np.testing.assert_allclose(x, np.tile([10, 11, 12, 13, 14], (3, 1)))
    np.testing.assert_allclose(y, np.repeat([[20], [21], [22]], 5, axis=1))


def test_pixels_of_a_turned_region() -> None:
    """With a quarter turn the fast axis points up, the slow one to the left."""
    x, y = Region((0.0, 0.0), (4.0, 2.0), math.pi / 2).pixels_m((2, 3))
    np.testing.assert_allclose(x, [[1, 1, 1], [-1, -1, -1]], atol=1e-12)
    np.testing.assert_allclose(y, [[-2, 0, 2], [-2, 0, 2]], atol=1e-12)


@given(lengths, lengths, sizes, sizes, angles)
def test_corners_are_the_outer_pixels(x: float, y: float, width: float, height: float, angle: float) -> None:
    region = Region((x, y), (width, height), angle)
    px, py = region.pixels_m((4, 6))
    outer = [(px[r, c], py[r, c]) for r, c in ((0, 0), (0, -1), (-1, -1), (-1, 0))]
    np.testing.assert_allclose(region.corners_m(), outer, atol=1e-18, rtol=1e-9)


@given(sizes, sizes, angles, st.floats(-1, 1), st.floats(-1, 1))
def test_contains_follows_the_turn(width: float, height: float, angle: float, u: float, v: float) -> None:
    region = Region((1e-6, -1e-6), (width, height), angle)
    cos, sin = math.cos(angle), math.sin(angle)
    dx, dy = u * width, v * height
    point = (1e-6 + cos * dx - sin * dy, -1e-6 + sin * dx + cos * dy)
    if max(abs(u), abs(v)) < 0.499:
        assert region.contains(point)
    if max(abs(u), abs(v)) > 0.501 and min(width, height) > 1e-8:
        assert not region.contains(point)


@pytest.mark.parametrize("size", [(0.0, 1.0), (1.0, -1.0), (math.nan, 1.0), (math.inf, 1.0)])
def test_a_region_without_area_is_refused(size: tuple[float, float]) -> None:
    with pytest.raises(InvalidValue):
        Region((0.0, 0.0), size)


def test_a_change_keeps_the_corner_of_the_unturned_rectangle() -> None:
    region = Region.from_top_left((0.0, 0.0), (2.0, 2.0), 0.5)
    changed = RegionChange(width_m=4.0).onto(region)
    assert changed.top_left_m == pytest.approx((0.0, 0.0))
    assert (changed.size_m, changed.angle_rad) == ((4.0, 2.0), 0.5)


def test_part_of_a_region_needs_a_whole_region() -> None:
    with pytest.raises(InvalidValue, match="whole"):
        ScanParameters(RegionChange(width_m=1.0)).onto(ScanParameters())


def test_a_region_takes_text_with_units() -> None:
    region = Region(("1 um", 0), ("500 nm", "0.5 um"), "30 deg")  # type: ignore[arg-type]
    assert region == Region((1e-6, 0.0), (5e-7, 5e-7), math.radians(30.0))


@pytest.mark.parametrize("width", ["1e-6", "1 V", "wide", "1,5 um"])
def test_text_without_a_length_is_refused(width: str) -> None:
    with pytest.raises(UnitError, match=r"unit|V|number|comma"):
        Region((0.0, 0.0), (width, 1e-6))  # type: ignore[arg-type]


@pytest.mark.parametrize("shape", [(3, 5), (7, 4)])
def test_pixel_of_a_position_is_the_inverse_of_the_position_of_a_pixel(shape: tuple[int, int]) -> None:
    region = Region((1.0, -2.0), (4.0, 3.0), 0.7)
    row, column = region.pixel_at(*region.pixels_m(shape), shape)
    np.testing.assert_allclose(row, np.indices(shape)[0], atol=1e-12)
    np.testing.assert_allclose(column, np.indices(shape)[1], atol=1e-12)


@given(sizes, sizes, angles, st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.floats(-1.0, 1.0))
def test_difference_of_regions_is_along_the_sides(
    width: float, height: float, angle: float, along: float, across: float, turn: float
) -> None:
    # of similar sides, since the shorter one loses digits to the longer
    region = Region((0.0, 0.0), (width, max(height, width / 100.0)), angle)
    cos, sin = math.cos(region.angle_rad), math.sin(region.angle_rad)
    u, v = along * region.size_m[0], across * region.size_m[1]
    center = (region.center_m[0] + cos * u - sin * v, region.center_m[1] + sin * u + cos * v)
    by = region.compared(Region(center, region.size_m, region.angle_rad + turn))
    assert (by.along, by.across) == pytest.approx((along, across), abs=1e-6)
    assert (by.size, by.turned_rad) == pytest.approx((0.0, turn), abs=1e-9)


def test_a_wide_frame_turned_upright_overlaps_little_when_moved_across_its_short_side() -> None:
    # house: the offset is turned into the frame
    one = Region((0.0, 0.0), (2e-6, 1e-6), math.pi / 2)
    assert one.compared(one.moved_to((0.9e-6, 0.0))).apart == pytest.approx(0.9)
    assert one.compared(one.moved_to((0.0, 0.9e-6))).apart == pytest.approx(0.45)
