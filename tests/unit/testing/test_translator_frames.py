from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.model import Region
from afspm.testing.translators.measuring import FrameSettings, difference

REGION = Region((1e-6, -2e-6), (4e-7, 2e-7), 0.3)


@given(st.floats(-3.1, 3.1), st.floats(1e-8, 1e-4), st.floats(0.2, 5.0), st.floats(-1e-4, 1e-4))
def test_frames_stay_within_the_set_frame(angle: float, side_m: float, ratio: float, x_m: float) -> None:
    whole = Region((x_m, -x_m), (side_m, side_m * ratio), angle)
    frames = FrameSettings(whole)
    grown = Region(whole.center_m, tuple(1.0001 * size for size in whole.size_m), angle)  # type: ignore[arg-type]
    for frame in (frames.plain, frames.other, frames.wide, frames.turned):
        assert all(grown.contains((float(x), float(y))) for x, y in frame.region.corners_m())
        assert frame.shape[1] % 16 == 0


def test_frames_differ_from_each_other_in_place() -> None:
    frames = FrameSettings(REGION)
    centers = [frame.region.center_m for frame in (frames.plain, frames.other, frames.wide, frames.turned)]
    apart = [math.dist(a, b) for i, a in enumerate(centers) for b in centers[:i]]
    assert min(apart) > 0.05 * min(REGION.size_m)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (REGION, ""),
        (Region(REGION.center_m, REGION.size_m, REGION.angle_rad + math.tau), ""),
        (Region((1e-6 + 1e-11, -2e-6), REGION.size_m, 0.3), ""),
        (Region((1.2e-6, -1.9e-6), REGION.size_m, 0.3), "off by (+0.50, +0.50) frames"),
        (Region(REGION.center_m, (2e-7, 4e-7), 0.3), "a size of (200, 400) nm instead of (400, 200) nm"),
        (Region(REGION.center_m, REGION.size_m, -0.3), "an angle of -17.19° instead of 17.19°"),
    ],
)
def test_difference_is_described_in_words(other: Region, said: str) -> None:
    found = difference(REGION, other)
    assert found.endswith(said)
    assert bool(found) is bool(said)


def test_half_a_pixel_of_the_largest_frame_is_a_difference() -> None:
    pixel_m = REGION.size_m[0] / 95
    assert difference(REGION, REGION.moved_to((REGION.center_m[0] + pixel_m / 2, REGION.center_m[1])))
