"""Nights in which a sample drifts and a microscope follows it by a tracker; the truth is known.

The drift: 1.5 µm decaying to 1/e in three hours, 300 nm in half an hour, a wave of 150 nm a day, a random walk of 1 nm
in a quarter of an hour, each in a direction of its own. The scans: 2 µm, 128 px, every 15 minutes, noise "real", every
row at the drift of its own time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.registration import DriftScan, Prior, Registration
from afspm.plugins.drift.track.shear import row_delay_s
from afspm.plugins.drift.track.tracking import Tracker, Update
from benchmarks.drift.conditions import CONDITIONS, Condition, measured, wandered
from benchmarks.drift.families import Half, drawn_condition, drawn_surface, source
from benchmarks.drift.pairs import HEIGHT_M, PIXEL_M, ROW_S, View
from benchmarks.drift.surfaces import SURFACES, Grid, imaged

PIXELS = 128
INTERVAL_S = 900.0
FRAME_S = (PIXELS - 1) * ROW_S
SIZE_M = (PIXELS - 1) * PIXEL_M
STRAY_PX = 24.0  # that a scan may be off; what lies further out is repeated from there
WALK_M = 1e-9
_WALK_STEP_S = 60.0


@dataclass
class Drift:
    """Displacement of the sample at any time of a night."""

    seed: int
    scans: int
    _directions: Array = field(init=False)
    _walk_m: Array = field(init=False)

    def __post_init__(self) -> None:
        random = np.random.default_rng([self.seed, 3])
        directions = random.standard_normal((3, 2))
        self._directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        steps = math.ceil((self.scans + 2) * INTERVAL_S / _WALK_STEP_S)
        step_m = WALK_M * math.sqrt(_WALK_STEP_S / INTERVAL_S)
        self._walk_m = np.cumsum(step_m * random.standard_normal((steps, 2)), axis=0)

    def at(self, time_s: Array) -> Array:
        """Return the displacement (…, 2) in m."""
        t = np.asarray(time_s, dtype=np.float64)[..., None]
        slow, fast, daily = self._directions
        smooth = -1.5e-6 * np.expm1(-t / 10800.0) * slow - 0.3e-6 * np.expm1(-t / 1800.0) * fast
        smooth = smooth + 0.15e-6 * np.sin(2 * np.pi * t / 86400.0) * daily
        at = np.arange(len(self._walk_m)) * _WALK_STEP_S
        walked = np.stack([np.interp(t[..., 0], at, self._walk_m[:, axis]) for axis in range(2)], axis=-1)
        return np.asarray(smooth + walked)

    def during_m(self, start_s: float) -> Array:
        """Return the mean displacement (2,) over the rows of a scan.

        It is the place at which the scan shows the sample; for a steady drift, the place at its middle.
        """
        rows_s = start_s + ROW_S * np.arange(PIXELS, dtype=np.float64)
        return np.asarray(self.at(np.asarray(rows_s)).mean(axis=0))


@dataclass
class Night:
    """A sample of one kind, and its drift; of a half of the families if one is named.

    Attributes:
        wander_px: standard deviation, in each direction, of the wander of the lines.
    """

    surface: str
    seed: int
    scans: int
    half: Half | None = None
    wander_px: float = 0.0
    drift: Drift = field(init=False)
    _view: View = field(init=False)
    _how: Condition = field(init=False)

    def __post_init__(self) -> None:
        self.drift = Drift(self.seed, self.scans)
        grid = Grid(PIXELS / 2 + STRAY_PX)
        number = list(SURFACES).index(self.surface)
        random = [np.random.default_rng([self.seed, number, k]) for k in (1, 2)]
        self._how, relief = CONDITIONS["real"], SURFACES[self.surface]
        if self.half is not None:
            drawn, random = (
                source(self.half, self.seed, number, 0),
                [source(self.half, self.seed, number, k) for k in (1, 2)],
            )
            self._how, relief = drawn_condition("real", drawn), drawn_surface(self.surface, drawn)
        image = imaged(_unit(relief(grid, *random)), blunt=self._how.blunt)
        self._view = View.of(grid, image / image[_middle(grid)].std())

    def scan(self, number: int, start_s: float, center_m: Array, *, upwards: bool = True) -> DriftScan:
        """Return a scan of a region of tip coordinates; its noise depends on its number."""
        q = np.stack(np.meshgrid(*[np.arange(PIXELS) - (PIXELS - 1) / 2] * 2))
        order = np.arange(PIXELS) if upwards else np.arange(PIXELS)[::-1]
        sample_m = np.asarray(center_m - self.drift.at(np.asarray(start_s + order * ROW_S, dtype=np.float64)))
        along = np.arange(PIXELS) / self._how.creep_length_px
        q[0] += self._how.creep_px * np.exp(-along)
        if self.wander_px:
            lines = np.random.default_rng([self.seed, 5, number])
            q = q + wandered(PIXELS, replace(self._how, wander_px=self.wander_px), lines)[:, order][:, :, None]
        heights = self._view.at(q + (sample_m / PIXEL_M).T[:, :, None])
        noise = np.random.default_rng([self.seed, 4, number])
        values = HEIGHT_M * measured(heights, self._how, noise)
        region = Region((float(center_m[0]), float(center_m[1])), (SIZE_M, SIZE_M))
        return DriftScan(values, region, start_s, start_s + FRAME_S, upwards, f"{number}")

    def followed(self, tracker: Tracker, *, up_and_down: bool = False) -> Iterator[tuple[Array, Update]]:
        """Yield the true displacement (2,) of each scan since the first, and the tracker's update.

        A second frame, downwards and right after the first one, is not yielded.
        """
        for number in range(self.scans):
            update = self._taken(tracker, number, number * INTERVAL_S)
            yield self.drift.during_m(number * INTERVAL_S) - self.drift.during_m(0.0), update
            if up_and_down and number == 0:
                self._taken(tracker, self.scans, FRAME_S + ROW_S, upwards=False)

    def _taken(self, tracker: Tracker, number: int, start_s: float, *, upwards: bool = True) -> Update:
        center_m = tracker.forecast.at(start_s + FRAME_S / 2).mapping.inverse.apply((0.0, 0.0))
        return tracker.add(self.scan(number, start_s, center_m, upwards=upwards))


@dataclass
class Oracle:
    """An estimator that knows the truth."""

    drift: Drift

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        there = np.array(scan.region.center_m)
        moved_m, later_m = self.drift.during_m(scan.start_s) - self.drift.during_m(reference.start_s), np.zeros(2)
        for _ in range(3):  # when the reference passed what is in the middle of the scan
            displacement = moved_m - later_m
            passed_s = reference.mid_s + (row_delay_s(reference, there - displacement) or 0.0)
            later_m = self.drift.at(np.array(passed_s)) - self.drift.at(np.array(reference.mid_s))
        return Registration(
            accepted=True,
            reason="",
            displacement_m=displacement,
            covariance_m2=np.eye(2) * (1e-4 * PIXEL_M) ** 2,
            linear=np.zeros((2, 2)),
            center_m=there - displacement,
        )


def _unit(height: Array) -> Array:
    return np.asarray((height - height.mean()) / height.std())


def _middle(grid: Grid) -> tuple[slice, slice]:
    inside = np.flatnonzero(np.abs(grid.axis_px) <= PIXELS / 2)
    part = slice(inside[0], inside[-1] + 1)
    return part, part
