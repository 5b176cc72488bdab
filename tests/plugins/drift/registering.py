"""Scans of a surface that is known everywhere exactly, for tests of estimators."""

from __future__ import annotations

import numpy as np

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.registration import DriftScan

PIXEL_M = 10e-9


class Waves:
    """A rough surface, as a sum of waves: its height at any position without interpolation."""

    def __init__(self, seed: int, count: int = 150) -> None:
        random = np.random.default_rng(seed)
        length_m = PIXEL_M * np.exp(random.uniform(np.log(5.0), np.log(60.0), count))
        direction = random.uniform(0.0, 2 * np.pi, count)
        self._k = 2 * np.pi / length_m * np.array([np.cos(direction), np.sin(direction)])
        self._phase = random.uniform(0.0, 2 * np.pi, count)
        self._height_m = 1e-9 * length_m / length_m.max()

    def at(self, x_m: Array, y_m: Array) -> Array:
        """Return heights at the pixels of a scan: phases are sums of those along its first column and first row."""
        column = self._k.T @ [x_m[:, 0], y_m[:, 0]] + self._phase[:, None]
        row = self._k.T @ [x_m[0] - x_m[0, 0], y_m[0] - y_m[0, 0]]
        height = self._height_m[:, None]
        there: Array = (height * np.cos(column)).T @ np.cos(row) - (height * np.sin(column)).T @ np.sin(row)
        return there

    def at_points(self, xy_m: Array) -> Array:
        """Return heights at any points (..., 2)."""
        phase = xy_m @ self._k + self._phase
        height: Array = np.cos(phase) @ self._height_m
        return height


def scanned(
    surface: Waves,
    region: Region,
    shape: tuple[int, int],
    drift_m: tuple[float, float] = (0.0, 0.0),
    *,
    turned_rad: float = 0.0,
    noise: float = 0.02,
    seed: int = 0,
) -> DriftScan:
    """Return a scan of `region`: a feature at `x` is found at `drift_m + R x`, R a rotation about the origin."""
    x, y = region.pixels_m(shape)
    x, y = x - drift_m[0], y - drift_m[1]
    cos, sin = np.cos(turned_rad), np.sin(turned_rad)
    values = surface.at(cos * x + sin * y, -sin * x + cos * y)
    values = values + noise * values.std() * np.random.default_rng(seed).standard_normal(shape)
    return DriftScan(values, region, 0.0, 100.0)
