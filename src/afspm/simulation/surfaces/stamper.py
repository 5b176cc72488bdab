"""The surface of a CD stamper: the nickel negative that discs are pressed with, bumps on spiral tracks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from afspm.simulation import chance
from afspm.simulation.fields import Array
from afspm.simulation.settings import check
from afspm.simulation.surfaces.relief import Relief, grain, smooth_step, turned

_FRAME = 588  # channel bits of an EFM frame of a compact disc; lengths of bumps and gaps are 3 to 11 bits


@dataclass(frozen=True)
class Stamper:
    """Bumps of 3 to 11 channel bits' length on straight tracks (at 20 mm radius they look straight).

    Attributes:
        angle_deg: direction of the tracks, counter-clockwise from x.
        bit_m: length of a channel bit on the disc.
        flank_m: width of the bumps' sides, seen from above.
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
        """How far inside a bump of this track each position lies; negative outside. Ends are round."""
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
    """Where runs begin in one frame, in bits: an even number of runs of 3 to 11 bits that fill it, bump first."""
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
    """Four runs of 3 to 11 bits (two, when few bits are left) that sum to `bits`."""
    count = 2 if bits <= 18 else 4
    runs = [3] * count
    for _ in range(bits - sum(runs)):
        free = [k for k in range(count) if runs[k] < 11]
        runs[free[int(random.integers(len(free)))]] += 1
    return runs
