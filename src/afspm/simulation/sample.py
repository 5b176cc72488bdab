"""The sample: its surface, marks left by the tip, and its position under the tip."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from afspm.model.arrays import Array
from afspm.simulation import chance
from afspm.simulation.drift import Drift, DriftSettings, ScannerCompensation
from afspm.simulation.surfaces import surface_from
from afspm.simulation.surfaces.relief import Relief, around


@dataclass(frozen=True)
class SurfaceMark:
    """A round crater with a rim, or a mound if its depth is negative.

    Attributes:
        sample_xy_m: its centre, in sample coordinates.
        depth_m, radius_m: depth and radius of the crater.
        t_s: the time of its creation.
        kind: "crash" or "pulse".
    """

    sample_xy_m: tuple[float, float]
    depth_m: float
    radius_m: float
    t_s: float
    kind: str


def _draw(mark: SurfaceMark, relief: Relief, x_m: Array, y_m: Array) -> None:
    reach = 3.0 * mark.radius_m
    for index, dx, dy in around(x_m, y_m, *mark.sample_xy_m, reach):
        r = np.hypot(dx, dy) / mark.radius_m
        hole = np.exp(-(r**4))
        # The rim is higher on one side, where the tip pushed the material.
        rim = 0.35 * np.exp(-(((r - 1.25) / 0.3) ** 2)) * (1.0 + 0.5 * dx / (np.hypot(dx, dy) + 0.1 * mark.radius_m))
        relief.height_m[index] += mark.depth_m * (rim - hole if mark.depth_m > 0 else -hole)
        relief.material[index] += (1.0 - relief.material[index]) * np.clip(hole + 0.5 * rim, 0.0, 1.0)


class Sample:
    """A surface that drifts under the tip.

    Attributes:
        table: the settings of the surface.
        marks: craters of crashes and mounds of pulses.
        compensation: displacement of the scanner by its own drift compensation.
    """

    def __init__(self, surface: object, drift: DriftSettings, seed: int, start_s: float) -> None:
        self.table = dict(surface) if isinstance(surface, Mapping) else {"kind": surface}
        self.marks: list[SurfaceMark] = []
        self.compensation = ScannerCompensation()
        self.drift = Drift(drift, seed, start_s)
        self._surface = surface_from(self.table)
        self._seed = chance.subseed(seed, "surface") % 2**62
        self._about_m = drift.about_m

    def seen_drift_m(self, t_s: ArrayLike) -> Array:
        """Return the drift minus the scanner's own compensation; shape t.shape + (3,)."""
        return self.drift.at(t_s) - self.compensation.at(t_s)

    def to_sample(self, xy_m: ArrayLike, t_s: ArrayLike) -> Array:
        """Map positions (..., 2) at experiment times (...) from tip to sample coordinates.

        Tip coordinates are those of a scanner without its own drift compensation.
        """
        at = np.asarray(xy_m, dtype=np.float64) - self.drift.at(t_s)[..., :2]
        return np.stack(self.drift.unturned(at[..., 0], at[..., 1], t_s), axis=-1)

    def to_tip(self, xy_m: ArrayLike, t_s: ArrayLike) -> Array:
        """Map positions (..., 2) at experiment times (...) from sample to tip coordinates: inverse of `to_sample`."""
        at = np.asarray(xy_m, dtype=np.float64)
        turned = np.stack(self.drift.turned(at[..., 0], at[..., 1], t_s), axis=-1)
        return np.asarray(turned + self.drift.at(t_s)[..., :2])

    def under(self, position_m: tuple[float, float], t_s: float) -> tuple[float, float]:
        """Return the sample coordinates under a position of the scanner."""
        x, y = self.to_sample(np.add(position_m, self.compensation.at(t_s)[:2]), t_s)
        return float(x), float(y)

    def mark(self, kind: str, position_m: tuple[float, float], t_s: float, depth_m: float, radius_m: float) -> None:
        """Leave a mark under a position of the scanner."""
        self.marks.append(SurfaceMark(self.under(position_m, t_s), depth_m, radius_m, t_s, kind))

    def turn(self, t_s: float) -> dict[str, object]:
        """Return rotation and scale of the sample at a time, JSON-able."""
        turn = complex(self.drift.turn(t_s))
        return {"angle_rad": cmath.phase(turn), "scale": abs(turn), "about_m": list(self._about_m)}

    def relief(self, x_m: Array, y_m: Array, resolution_m: float, t_s: float) -> Relief:
        """Return the surface at sample coordinates with the marks made up to a time; see `Surface.relief`."""
        relief = self._surface.relief(x_m, y_m, resolution_m, self._seed)
        for mark in self.marks:
            if mark.t_s <= t_s:
                _draw(mark, relief, x_m, y_m)
        return relief

    def surface_m(self, x_m: ArrayLike, y_m: ArrayLike, t_s: float = math.inf) -> Array:
        """Return the true heights at sample coordinates, in the broadcast shape of x and y; see `relief`."""
        x, y = np.asarray(x_m, dtype=np.float64), np.asarray(y_m, dtype=np.float64)
        shape = np.broadcast_shapes(x.shape, y.shape)
        x, y = (a if a.ndim == 2 else a.reshape((1,) * (2 - a.ndim) + a.shape) if a.ndim < 2 else a for a in (x, y))
        return self.relief(x, y, 0.0, t_s).height_m.reshape(shape)
