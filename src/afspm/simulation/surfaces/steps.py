"""Flat terraces between meandering steps, as of graphite, calcite or strontium titanate; rough ground; a flat one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from afspm.simulation.fields import Array, rough_field, smooth_field
from afspm.simulation.settings import check
from afspm.simulation.surfaces.relief import Relief, grain, patches, smooth_step, turned


@dataclass(frozen=True)
class Steps:
    """Terraces that rise along a direction, one `step_m` each; meandering edges, here and there an island.

    Attributes:
        angle_deg: direction of the rise, counter-clockwise from x.
        meander: how far the edges wander, in terrace widths.
        edge_m: width of an edge.
    """

    step_m: float = 0.4e-9
    terrace_m: float = 180e-9
    angle_deg: float = 25.0
    meander: float = 0.45
    edge_m: float = 1e-9
    roughness_rms_m: float = 0.02e-9

    def __post_init__(self) -> None:
        check(self, above_zero="step_m terrace_m edge_m", from_zero="meander roughness_rms_m")

    def relief(self, x_m: Array, y_m: Array, resolution_m: float, seed: int) -> Relief:
        wide = smooth_field(seed + 1, x_m, y_m, 2.3 * self.terrace_m)
        narrow = rough_field(
            seed + 2, x_m, y_m, largest_m=0.45 * self.terrace_m, smallest_m=0.08 * self.terrace_m, hurst=0.8,
            resolution_m=resolution_m,
        )  # fmt: skip
        along, _ = turned(x_m, y_m, self.angle_deg)
        height = along / self.terrace_m + self.meander * (wide + 0.14 * narrow)
        terrace = np.round(height)
        edge = max(self.edge_m, resolution_m) / self.terrace_m
        height_m = self.step_m * (terrace - 0.5 + smooth_step((height - terrace) / edge + 0.5))
        height_m += grain(seed + 3, x_m, y_m, self.roughness_rms_m, 0.1 * self.terrace_m, resolution_m)
        odd = np.mod(np.floor(height + 0.5), 2.0)
        return Relief(height_m, 0.25 * odd + 0.75 * patches(seed + 4, x_m, y_m, 1.7 * self.terrace_m))


@dataclass(frozen=True)
class Rough:
    """Self-affine ground: sputtered, etched or fractured.

    Attributes:
        rms_m: of the heights over areas far larger than `largest_m`.
        hurst: 0 jagged to 1 smooth; heights over a distance L vary as L**hurst up to `largest_m`.
    """

    rms_m: float = 6e-9
    largest_m: float = 800e-9
    smallest_m: float = 2e-9
    hurst: float = 0.8

    def __post_init__(self) -> None:
        check(self, above_zero="largest_m smallest_m", from_zero="rms_m", fraction="hurst")

    def relief(self, x_m: Array, y_m: Array, resolution_m: float, seed: int) -> Relief:
        height = rough_field(
            seed, x_m, y_m, largest_m=self.largest_m, smallest_m=min(self.smallest_m, self.largest_m),
            hurst=self.hurst, resolution_m=resolution_m,
        )  # fmt: skip
        return Relief(self.rms_m * height, patches(seed + 5, x_m, y_m, 0.4 * self.largest_m))


@dataclass(frozen=True)
class Flat:
    """Nothing to see: for calibrating noise and drift."""

    roughness_rms_m: float = 0.0

    def __post_init__(self) -> None:
        check(self, from_zero="roughness_rms_m")

    def relief(self, x_m: Array, y_m: Array, resolution_m: float, seed: int) -> Relief:
        zeros = np.zeros(np.broadcast_shapes(x_m.shape, y_m.shape))
        return Relief(zeros + grain(seed, x_m, y_m, self.roughness_rms_m, 30e-9, resolution_m), zeros + 0.5)
