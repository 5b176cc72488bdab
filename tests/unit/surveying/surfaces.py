"""Surfaces with particles of known places and heights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from afspm.model import Region, Scan
from afspm.model.arrays import Array

SIDE_M = 5e-6
REGION = Region((0.0, 0.0), (SIDE_M, SIDE_M))


@dataclass(frozen=True)
class Ground:
    """Ground of particles: slope, rms of hills, of line offsets and of noise in m, and scars."""

    slope: float = 0.0
    hills_m: float = 0.0
    lines_m: float = 0.0
    noise_m: float = 0.2e-9
    scars: int = 0


def strewn(seed: int, count: int = 60) -> tuple[Array, Array]:
    """Return places (n, 2) of particles that don't hide each other, and radii."""
    chance = np.random.default_rng(seed)
    places: list[Array] = []
    while len(places) < count:
        place = chance.uniform(-SIDE_M / 2, SIDE_M / 2, 2)
        if all(np.hypot(*(place - other)) > 250e-9 for other in places):
            places.append(place)
    return np.array(places), 45e-9 * np.exp(0.28 * chance.normal(size=count))


def scanned(
    places_m: Array, radii_m: Array, ground: Ground = Ground(), *, pixels: int = 128, seed: int = 0,
    region: Region = REGION,
) -> Scan:  # fmt: skip
    """Return the heights of spheres on their ground, dilated by a tip."""
    chance = np.random.default_rng(seed)
    x_m, y_m = region.pixels_m((pixels, pixels))
    values = np.zeros((pixels, pixels))
    for (x, y), radius in zip(places_m, radii_m, strict=True):
        inside = 1.0 - ((x_m - x) ** 2 + (y_m - y) ** 2) / (1.6 * radius) ** 2
        values = np.maximum(values, 2.0 * radius * np.sqrt(np.maximum(inside, 0.0)))
    hills = ndimage.gaussian_filter(chance.normal(size=values.shape), pixels / 20)
    values += ground.hills_m * hills / hills.std()
    values += ground.slope * x_m - 0.5 * ground.slope * y_m
    values += chance.normal(0.0, 1.0, (pixels, 1)) * ground.lines_m + chance.normal(size=values.shape) * ground.noise_m
    for row in chance.integers(1, pixels - 1, ground.scars):
        values[row, 20:60] += 6e-9
    return Scan(region, "Height", "m", values)
