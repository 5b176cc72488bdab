"""Regular surfaces: a hexagonal lattice with defects, and the stamper for pressing compact discs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from afspm.model.arrays import Array
from afspm.simulation import chance
from afspm.simulation.fields import smooth_field
from afspm.simulation.settings import check
from afspm.simulation.surfaces.relief import Relief, around, grain, patches, smooth_step, turned


@dataclass(frozen=True)
class Lattice:
    """A hexagonal lattice with vacancies and adatoms, slightly strained, so that the pattern never repeats exactly.

    Attributes:
        constant_m: distance of neighbours.
        corrugation_m: height difference from hollow to top.
        defect_fraction: fraction of defective sites; two of three defects are vacancies.
        strain_m: rms of the sites' displacement, over distances of about 30 constants.
    """

    constant_m: float = 0.246e-9
    corrugation_m: float = 0.06e-9
    defect_fraction: float = 0.012
    angle_deg: float = 12.0
    strain_m: float = 0.02e-9

    def __post_init__(self) -> None:
        check(self, above_zero="constant_m", from_zero="corrugation_m strain_m", fraction="defect_fraction")

    def relief(self, x_m: Array, y_m: Array, resolution_m: float, seed: int) -> Relief:
        shape = np.broadcast_shapes(x_m.shape, y_m.shape)
        seen = _contrast_left(resolution_m / self.constant_m)
        material = np.zeros(shape) + 0.3 * patches(seed + 4, x_m, y_m, 60 * self.constant_m)
        if seen == 0.0:
            return Relief(np.zeros(shape), material)
        size_m = 30 * self.constant_m
        u = x_m + self.strain_m * smooth_field(seed + 1, x_m, y_m, size_m)
        v = y_m + self.strain_m * smooth_field(seed + 2, x_m, y_m, size_m)
        height_m = self.corrugation_m * seen * self._atoms(u, v)
        self._draw_defects(height_m, material, x_m, y_m, seed + 3)
        return Relief(height_m, material)

    def _atoms(self, x_m: Array, y_m: Array) -> Array:
        # from 0 (hollow) to 1 (top): the first star of Fourier components
        wave = 4.0 * math.pi / (math.sqrt(3.0) * self.constant_m)
        total: Array = np.zeros(x_m.shape)
        for direction in (30.0, 90.0, 150.0):
            angle = math.radians(direction + self.angle_deg)
            total += np.cos(wave * (math.cos(angle) * x_m + math.sin(angle) * y_m))
        return total * (2.0 / 9.0) + 1.0 / 3.0

    def _draw_defects(self, height_m: Array, material: Array, x_m: Array, y_m: Array, seed: int) -> None:
        reach = 1.6 * self.constant_m
        for x0, y0, draw in self._defects(seed, x_m, y_m, reach):
            depth = -0.9 if draw < 2 / 3 else 1.3
            for index, dx, dy in around(x_m, y_m, x0, y0, reach):
                bump = np.exp(-(dx * dx + dy * dy) / (2 * (0.42 * self.constant_m) ** 2))
                height_m[index] += depth * self.corrugation_m * bump
                material[index] += (1.0 - material[index]) * smooth_step(1.5 * bump)

    def _defects(self, seed: int, x_m: Array, y_m: Array, margin_m: float) -> list[tuple[float, float, float]]:
        # (x, y, random number) of each defect in view
        angle = math.radians(self.angle_deg)
        first = self.constant_m * np.array([math.cos(angle), math.sin(angle)])
        second = self.constant_m * np.array([math.cos(angle + math.pi / 3), math.sin(angle + math.pi / 3)])
        low = np.array([x_m.min() - margin_m, y_m.min() - margin_m])
        high = np.array([x_m.max() + margin_m, y_m.max() + margin_m])
        corners = np.array([low, high, [low[0], high[1]], [high[0], low[1]]])
        indices = corners @ np.linalg.inv(np.stack([first, second]))
        i = np.arange(math.floor(indices[:, 0].min()), math.ceil(indices[:, 0].max()) + 1)
        j = np.arange(math.floor(indices[:, 1].min()), math.ceil(indices[:, 1].max()) + 1)
        row, column = np.nonzero(chance.uniform(seed, i[:, None], j[None, :]) < self.defect_fraction)
        sites = i[row][:, None] * first + j[column][:, None] * second
        inside = np.all((sites >= low) & (sites <= high), axis=1)
        draws = chance.uniform(seed + 1, i[row][inside], j[column][inside])
        return [(float(x), float(y), float(d)) for (x, y), d in zip(sites[inside], draws, strict=True)]


def _contrast_left(pixels_a_constant: float) -> float:
    # a pixel averages over this fraction of the lattice constant
    return float(np.clip(2.0 * (1.0 - pixels_a_constant), 0.0, 1.0))


_FRAME = 588  # channel bits of an EFM frame of a compact disc; lengths of bumps and gaps are 3 to 11 bits


@dataclass(frozen=True)
class Stamper:
    """Bumps on straight tracks, 3 to 11 channel bits long.

    Attributes:
        angle_deg: direction of the tracks, counter-clockwise from x.
        bit_m: length of a channel bit on the disc.
        flank_m: width of the bumps' flanks, seen from above.
    """

    pitch_m: float = 1.6e-6
    width_m: float = 0.5e-6
    height_m: float = 120e-9
    bit_m: float = 0.278e-6
    flank_m: float = 90e-9
    angle_deg: float = 7.0
    roughness_rms_m: float = 1.2e-9

    def __post_init__(self) -> None:
        check(self, above_zero="pitch_m width_m height_m bit_m flank_m", from_zero="roughness_rms_m")

    def relief(self, x_m: Array, y_m: Array, resolution_m: float, seed: int) -> Relief:
        along, across = turned(x_m, y_m, self.angle_deg)
        along, across = np.broadcast_arrays(along, across)
        # The tracks wander by nanometres, and no two are cut quite alike.
        track = np.floor(across / self.pitch_m + 0.5)
        offset = across - self.pitch_m * (track + 0.012 * (chance.uniform(seed + 1, np.unique(track)) - 0.5)[
            np.searchsorted(np.unique(track), track)])  # fmt: skip
        flank = max(self.flank_m, resolution_m)
        bump = np.zeros(along.shape)
        for number in np.unique(track):
            near = (track == number) & (np.abs(offset) < 0.6 * self.width_m + flank)
            if near.any():
                inside = self._inside_m(seed + 2, int(number), along[near], offset[near])
                bump[near] = smooth_step(inside / flank + 0.5)
        height_m = self.height_m * bump + grain(seed + 3, x_m, y_m, self.roughness_rms_m, 70e-9, resolution_m)
        return Relief(height_m, np.asarray(0.35 + 0.3 * bump))

    def _inside_m(self, seed: int, track: int, along: Array, offset: Array) -> Array:
        # the distance to the edge of the bump, negative outside; ends are round
        shift = float(chance.uniform(seed, track)[()]) * _FRAME
        bits = along / self.bit_m + shift
        first, last = int(np.floor(bits.min() / _FRAME)) - 1, int(np.floor(bits.max() / _FRAME)) + 1
        edges = np.concatenate([frame * _FRAME + _frame_edges(seed, track, frame) for frame in range(first, last + 1)])
        run = np.searchsorted(edges, bits, side="right")
        start, end = edges[run - 1], edges[run]
        is_bump = run % 2 == 1  # every frame starts with a bump and has as many bumps as gaps
        # Distance along the track to the nearer end of this run, positive inside a bump.
        to_end = np.where(is_bump, 1.0, -1.0) * np.minimum(bits - start, end - bits) * self.bit_m
        half = self.width_m / 2
        past = np.maximum(half - to_end, 0.0)  # beyond the centre of the round end
        return np.asarray(half - np.hypot(past, offset))


@lru_cache(maxsize=4096)
def _frame_edges(seed: int, track: int, frame: int) -> Array:
    # starts of runs in bits: an even number of runs of 3 to 11 bits that fill the frame, bump first
    random = chance.generator(seed, track, frame)
    runs: list[int] = [11, 11]  # the synchronisation pattern
    left = _FRAME - sum(runs)
    while left > 36:
        runs += [int(r) for r in np.minimum(3 + random.geometric(0.33, 2) - 1, 11)]
        left = _FRAME - sum(runs)
    tail = _fill(left, random)
    edges = np.concatenate([[0], np.cumsum(runs + tail)[:-1]]).astype(np.float64)
    edges.flags.writeable = False
    return edges


def _fill(bits: int, random: np.random.Generator) -> list[int]:
    # four runs of 3 to 11 bits that sum to `bits`; two when few bits remain
    count = 2 if bits <= 18 else 4
    runs = [3] * count
    for _ in range(bits - sum(runs)):
        free = [k for k in range(count) if runs[k] < 11]
        runs[free[int(random.integers(len(free)))]] += 1
    return runs
