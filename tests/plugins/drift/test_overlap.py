"""The shared area of two rotated rectangles, and the ratio of their resolutions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.basics import InvalidValue
from afspm.model import Frame, Region
from afspm.plugins.drift.pairs.overlap import (
    intersection_area_m2,
    intersection_center_m,
    intersection_m,
    intersection_ratio,
    overlap_center_m,
    overlap_ratio,
    sr_norm,
)

UM = 1e-6
lengths = st.floats(-3.0, 3.0)
sizes = st.floats(0.1, 4.0)
angles = st.floats(-7.0, 7.0)


@st.composite
def regions(draw: st.DrawFn, angle: st.SearchStrategy[float] = angles) -> Region:
    center = (draw(lengths) * UM, draw(lengths) * UM)
    return Region(center, (draw(sizes) * UM, draw(sizes) * UM), draw(angle))


def found(center_m: np.ndarray | None) -> np.ndarray:
    assert center_m is not None
    return center_m


@given(regions(), regions())
def test_the_order_of_two_regions_does_not_matter(a: Region, b: Region) -> None:
    assert intersection_area_m2(a, b) == pytest.approx(intersection_area_m2(b, a), rel=1e-9, abs=1e-12 * UM**2)
    assert 0.0 <= intersection_ratio(a, b) <= 1.0


@given(regions(), regions(), lengths, lengths)
def test_the_origin_does_not_matter(a: Region, b: Region, x: float, y: float) -> None:
    away = [r.moved_to((r.center_m[0] + x * 1e-3, r.center_m[1] + y * 1e-3)) for r in (a, b)]
    assert intersection_area_m2(*away) == pytest.approx(intersection_area_m2(a, b), rel=1e-6, abs=1e-8 * UM**2)


@given(regions(), st.integers(0, 3))
def test_a_region_shares_all_with_itself_rotated_by_full_turns(region: Region, turns: int) -> None:
    again = Region(region.center_m, region.size_m, region.angle_rad + turns * 2 * math.pi)
    assert intersection_ratio(region, again) == pytest.approx(1.0, rel=1e-9)
    np.testing.assert_allclose(found(intersection_center_m(region, again)), region.center_m, atol=1e-9 * UM)


@given(regions(st.just(0.0)), regions(st.just(0.0)))
def test_upright_regions_share_the_product_of_their_shared_sides(a: Region, b: Region) -> None:
    shared = [
        max(0.0, min(c + s / 2, d + t / 2) - max(c - s / 2, d - t / 2))
        for c, s, d, t in zip(a.center_m, a.size_m, b.center_m, b.size_m, strict=True)
    ]
    assert intersection_area_m2(a, b) == pytest.approx(shared[0] * shared[1], rel=1e-9, abs=1e-12 * UM**2)


@given(regions(), regions())
def test_the_shared_polygon_lies_in_both_regions(a: Region, b: Region) -> None:
    for region in (a, b):
        wider = Region(region.center_m, (region.size_m[0] + 1e-8 * UM, region.size_m[1] + 1e-8 * UM), region.angle_rad)
        assert all(wider.contains((x, y)) for x, y in intersection_m(a, b))


@given(regions(), regions())
def test_the_shared_area_matches_a_monte_carlo_estimate(a: Region, b: Region) -> None:
    points = np.stack([np.ravel(axis) for axis in a.pixels_m((60, 60))], axis=1)
    inside = np.array([b.contains((x, y)) for x, y in points])
    area_m2 = a.size_m[0] * a.size_m[1]
    # a border crosses at most some 4 x 60 of the 3600 cells
    assert intersection_area_m2(a, b) == pytest.approx(inside.mean() * area_m2, abs=0.07 * area_m2)
    if inside.sum() > 1000:
        expected = points[inside].mean(axis=0)
        np.testing.assert_allclose(found(intersection_center_m(a, b)), expected, atol=0.03 * max(a.size_m))


def test_two_squares_at_45_degrees_share_an_octagon() -> None:
    square = Region((1 * UM, 2 * UM), (2 * UM, 2 * UM))
    turned = Region((1 * UM, 2 * UM), (2 * UM, 2 * UM), math.pi / 4)
    assert len(intersection_m(square, turned)) == 8
    assert intersection_area_m2(square, turned) == pytest.approx(8 * (math.sqrt(2) - 1) * UM**2)


def test_neighbours_share_nothing() -> None:
    a, b = Region((0, 0), (1, 1)), Region((1, 0), (1, 1))
    assert intersection_ratio(a, b) == 0.0
    assert intersection_center_m(a, b) is None
    assert overlap_center_m(a, b, (-0.5, 0.0)) is None
    assert intersection_m(a, b).shape == (0, 2)


def test_regions_of_different_frames_are_not_compared() -> None:
    with pytest.raises(InvalidValue, match="sample"):
        intersection_ratio(Region((0, 0), (1, 1)), Region((0, 0), (1, 1), frame=Frame.SAMPLE))


@given(regions(), lengths, lengths)
def test_a_region_that_moves_with_the_sample_overlaps_completely(region: Region, x: float, y: float) -> None:
    displacement = np.array([x, y]) * UM
    after = region.moved_to((region.center_m[0] + x * UM, region.center_m[1] + y * UM))
    assert overlap_ratio(region, after, displacement) == pytest.approx(1.0, rel=1e-9)
    np.testing.assert_allclose(found(overlap_center_m(region, after, displacement)), region.center_m, atol=1e-9 * UM)


def test_the_middle_of_the_overlap_is_in_the_reference_s_coordinates() -> None:
    region = Region((0, 0), (2 * UM, 2 * UM))
    np.testing.assert_allclose(
        found(overlap_center_m(region, region, (0.5 * UM, 0.0))), (-0.25 * UM, 0.0), atol=1e-12 * UM
    )


@given(regions(), regions(), st.tuples(*[st.integers(2, 600)] * 2), st.tuples(*[st.integers(2, 600)] * 2))
def test_the_ratio_of_resolutions_is_symmetric(
    a: Region, b: Region, shape_a: tuple[int, int], shape_b: tuple[int, int]
) -> None:
    assert sr_norm(a, shape_a, b, shape_b) == sr_norm(b, shape_b, a, shape_a)
    assert 0.0 < sr_norm(a, shape_a, b, shape_b) <= 1.0
    assert sr_norm(a, shape_a, a, shape_a) == 1.0


@given(regions())
def test_the_axis_that_differs_most_counts(region: Region) -> None:
    assert sr_norm(region, (128, 128), region, (128, 64)) == pytest.approx(0.5)
    assert sr_norm(region, (96, 128), region, (128, 128)) == pytest.approx(0.75)


def test_twice_the_size_at_twice_the_pixels_is_the_same_resolution() -> None:
    a, b = Region((0, 0), (1, 1)), Region((0, 0), (2, 2), 0.3)
    assert sr_norm(a, (128, 128), b, (256, 256)) == 1.0
