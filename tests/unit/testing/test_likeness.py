"""Images of one surface, reported with wrong axes: the idea of the axes that explains them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from afspm.model import Region
from afspm.testing.translators.checks.picture import CLEARLY, LIKE, Idea, ScanPicture, best_of, ideas, likenesses
from afspm.testing.translators.measuring import FrameSettings

WHOLE = Region((2e-6, -1e-6), (1e-6, 1e-6), math.radians(10.0))
TOLD = "as reported"


def surface_m(x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return bumps without any symmetry."""
    random = np.random.default_rng(3)
    places = random.uniform(-0.75e-6, 0.75e-6, (60, 2)) + WHOLE.center_m
    heights = random.uniform(0.2, 1.0, 60)
    bumps = (
        height * np.exp(-((x_m - x) ** 2 + (y_m - y) ** 2) / (40e-9) ** 2)
        for (x, y), height in zip(places, heights, strict=True)
    )
    return np.asarray(sum(bumps))


def picture_of(region: Region, shape: tuple[int, int], noise: float = 0.02, seed: int = 0) -> ScanPicture:
    values = surface_m(*region.pixels_m(shape))
    return ScanPicture(region, values + np.random.default_rng(seed).normal(0.0, noise, shape))


def all_pictures(noise: float = 0.02) -> tuple[ScanPicture, list[ScanPicture]]:
    frames = FrameSettings(WHOLE)
    details = [frames.plain, frames.wide, frames.turned]
    return (
        picture_of(WHOLE, (96, 96), noise),
        [picture_of(frame.region, frame.shape, noise, seed) for seed, frame in enumerate(details, 1)],
    )


def test_right_axes_fit_better_than_any_others() -> None:
    found = likenesses(*all_pictures())
    assert found[TOLD] > 0.95
    assert max(value for name, value in found.items() if name != TOLD) < found[TOLD] - CLEARLY


@pytest.mark.parametrize("name", [name for name in ideas(0.0) if not name.startswith((TOLD, "half", "with x and y s"))])
def test_wrong_axes_are_detected(name: str) -> None:
    wrong: Idea = ideas(WHOLE.angle_rad)[name]  # each is its own inverse
    larger, details = all_pictures()
    found = likenesses(wrong(larger), [wrong(detail) for detail in details])
    assert best_of(found)[0] == name
    assert found[name] > 0.95
    assert found[TOLD] < found[name] - CLEARLY


def test_swapped_axes_are_detected() -> None:
    larger, details = all_pictures()

    def swapped(picture: ScanPicture) -> ScanPicture:
        return replace(picture, values=picture.values.T.copy())

    square = [detail for detail in details if detail.values.shape[0] == detail.values.shape[1]]
    found = likenesses(swapped(larger), list(map(swapped, square)))
    assert best_of(found)[0] == "with x and y swapped"


def test_shift_of_half_a_frame_is_detected() -> None:
    # its centre is reported as its corner
    larger, details = all_pictures()

    def moved(picture: ScanPicture) -> ScanPicture:
        return ideas(WHOLE.angle_rad)["half a frame away (+0.5, +0.5)"](picture)

    found = likenesses(moved(larger), list(map(moved, details)))
    assert best_of(found)[0] == "half a frame away (-0.5, -0.5)"
    assert found[TOLD] < LIKE


def test_noise_resembles_nothing() -> None:
    assert max(likenesses(*all_pictures(noise=5.0)).values()) < LIKE
