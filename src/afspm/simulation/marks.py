"""What the tip has done to the sample: craters of crashes and what pulses left behind."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from afspm.simulation.fields import Array
from afspm.simulation.surfaces.relief import Relief, around


@dataclass(frozen=True)
class Mark:
    """A round crater with a rim, or with negative depth a mound.

    Attributes:
        sample_xy_m: its centre, in sample coordinates.
        depth_m, radius_m: of the hole.
        t_s: since when it is there.
        kind: "crash" or "pulse".
    """

    sample_xy_m: tuple[float, float]
    depth_m: float
    radius_m: float
    t_s: float
    kind: str


def draw(mark: Mark, relief: Relief, x_m: Array, y_m: Array) -> None:
    """Changes the relief at positions (x, y) in place."""
    reach = 3.0 * mark.radius_m
    for index, dx, dy in around(x_m, y_m, *mark.sample_xy_m, reach):
        r = np.hypot(dx, dy) / mark.radius_m
        hole = np.exp(-(r**4))
        # The rim is higher on one side, where the tip pushed the material.
        rim = 0.35 * np.exp(-(((r - 1.25) / 0.3) ** 2)) * (1.0 + 0.5 * dx / (np.hypot(dx, dy) + 0.1 * mark.radius_m))
        relief.height_m[index] += mark.depth_m * (rim - hole if mark.depth_m > 0 else -hole)
        relief.material[index] += (1.0 - relief.material[index]) * np.clip(hole + 0.5 * rim, 0.0, 1.0)
