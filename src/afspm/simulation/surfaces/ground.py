"""Irregular surfaces: terraces between meandering steps, rough and flat ground, scattered nanoparticles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from afspm.model.arrays import Array
from afspm.simulation import chance
from afspm.simulation.fields import is_separable, rough_field, smooth_field
from afspm.simulation.settings import check
from afspm.simulation.surfaces.relief import Relief, Sites, around, grain, patches, smooth_step, turned


@dataclass(frozen=True)
class Steps:
    """Terraces of height `step_m` that rise along one direction, with meandering edges and a few islands.

    Attributes:
        angle_deg: direction of the rise, counter-clockwise from x.
        meander: amplitude of the edges' meandering, in terrace widths.
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
    """A self-affine surface: sputtered, etched or fractured.

    Attributes:
        rms_m: root mean square of the heights over areas far larger than `largest_m`.
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
    """A flat surface, for noise measurements."""

    roughness_rms_m: float = 0.0

    def __post_init__(self) -> None:
        check(self, from_zero="roughness_rms_m")

    def relief(self, x_m: Array, y_m: Array, resolution_m: float, seed: int) -> Relief:
        zeros = np.zeros(np.broadcast_shapes(x_m.shape, y_m.shape))
        return Relief(zeros + grain(seed, x_m, y_m, self.roughness_rms_m, 30e-9, resolution_m), zeros + 0.5)


_LARGEST = 2.5  # no particle is larger than this many mean radii


@dataclass(frozen=True)
class Particles:
    """Spheres on a slightly rough substrate, unevenly distributed.

    Attributes:
        spacing_m: mean distance: on average one particle on an area of spacing squared, before crowding.
        spread: standard deviation of ln(radius).
        crowding: 0: distributed evenly; 1: gathered in clusters.
    """

    radius_m: float = 22e-9
    spread: float = 0.28
    spacing_m: float = 160e-9
    crowding: float = 0.6
    roughness_rms_m: float = 0.5e-9

    def __post_init__(self) -> None:
        check(self, above_zero="radius_m spacing_m", from_zero="spread roughness_rms_m", fraction="crowding")

    def relief(self, x_m: Array, y_m: Array, resolution_m: float, seed: int) -> Relief:
        shape = np.broadcast_shapes(x_m.shape, y_m.shape)
        ground = np.zeros(shape) + grain(seed, x_m, y_m, self.roughness_rms_m, 60e-9, resolution_m)
        height_m, material = ground.copy(), np.zeros(shape)
        if self.radius_m * _LARGEST < resolution_m / 4:
            return Relief(height_m, material)  # far below the resolution
        sites = self._present(seed + 10, x_m, y_m)
        radii = self.radius_m * np.exp(self.spread * chance.normal(seed + 11, sites.key))
        radii = np.minimum(radii, _LARGEST * self.radius_m)
        if is_separable(x_m, y_m):
            small = radii < 0.75 * resolution_m
            _strew(Relief(height_m, material), x_m, y_m, sites, np.where(small, radii, 0.0), resolution_m)
        else:
            small = np.zeros(len(radii), dtype=bool)
        for x0, y0, radius in zip(sites.x_m[~small], sites.y_m[~small], radii[~small], strict=True):
            _rest(height_m, material, ground, x_m, y_m, (x0, y0, radius), resolution_m)
        return Relief(height_m, material)

    def _present(self, seed: int, x_m: Array, y_m: Array) -> Sites:
        sites = Sites.within(seed, x_m, y_m, _LARGEST * self.radius_m, self.spacing_m)
        density = 1.0 - self.crowding * (0.5 + 0.6 * smooth_field(seed, sites.x_m, sites.y_m, 6.0 * self.spacing_m))
        there = chance.uniform(seed + 5, sites.key) < density
        return Sites(sites.x_m[there], sites.y_m[there], sites.key[there])


def _rest(
    height_m: Array, material: Array, ground: Array, x_m: Array, y_m: Array,
    sphere: tuple[float, float, float], resolution_m: float,
) -> None:  # fmt: skip
    # a sphere is (x, y, radius); one below the resolution is spread at constant volume
    x0, y0, radius = sphere
    seen = max(radius, 0.75 * resolution_m)
    for index, dx, dy in around(x_m, y_m, x0, y0, seen):
        inside = 1.0 - (dx * dx + dy * dy) / seen**2
        top = ground[index] + np.where(
            inside > 0, radius * (radius / seen) ** 2 * (1.0 + np.sqrt(np.maximum(inside, 0))), 0.0
        )
        height_m[index] = np.maximum(height_m[index], top)
        material[index] = np.maximum(material[index], inside > 0)


def _strew(relief: Relief, x_m: Array, y_m: Array, sites: Sites, radii_m: Array, resolution_m: float) -> None:
    # for particles smaller than a step of the grid: each adds its volume to the nearest point
    column, row = np.searchsorted(x_m[0], sites.x_m), np.searchsorted(y_m[:, 0], sites.y_m)
    inside = (radii_m > 0) & (column < x_m.size) & (row < y_m.size) & (column > 0) & (row > 0)
    radii_m = radii_m[inside]
    share = np.minimum(np.pi * (radii_m / (resolution_m or 1.0)) ** 2, 1.0)
    np.add.at(relief.height_m, (row[inside], column[inside]), 5 / 3 * radii_m * share)
    np.maximum.at(relief.material, (row[inside], column[inside]), share)
