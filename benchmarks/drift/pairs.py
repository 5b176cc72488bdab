"""Pairs of scans whose drift is known exactly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.registration import DriftScan, Prior
from benchmarks.drift.conditions import CONDITIONS, Condition, measured, wandered
from benchmarks.drift.families import HALVES, Half, Relief, drawn_condition, drawn_surface, source
from benchmarks.drift.surfaces import SURFACES, Grid, imaged

PIXEL_M = 2e-6 / 128
HEIGHT_M = 5e-9  # rms of the images
ROW_S = 2.0
MARGIN_PX = 4.0
ELSEWHERE_PX = 60.0


@dataclass(frozen=True)
class Frame:
    """The place of one scan on the sample: pixel offsets `q` from its middle show the sample at `origin + matrix @ q`.

    All in standard pixels. At the start of a line, on the left, the tip creeps: the image there is displaced by
    `creep_px`, less by 1/e every `creep_length_px`.
    """

    shape: tuple[int, int]
    step_px: tuple[float, float]
    origin_px: Array
    matrix: Array
    creep_px: float = 0.0
    creep_length_px: float = 1.0

    @property
    def width_px(self) -> Array:
        """(x, y) from the first to the last pixel."""
        ny, nx = self.shape
        return np.array([(nx - 1) * self.step_px[0], (ny - 1) * self.step_px[1]])

    def offsets_px(self) -> Array:
        """q of all pixels, shape (2, ny, nx)."""
        ny, nx = self.shape
        x = (np.arange(nx) - (nx - 1) / 2) * self.step_px[0]
        y = (np.arange(ny) - (ny - 1) / 2) * self.step_px[1]
        return np.stack(np.meshgrid(x, y))

    def sample_px(self, q_px: Array) -> Array:
        """Return the places in the sample of offsets, shape (2, …)."""
        middle: Array = self.origin_px.reshape(2, *[1] * (q_px.ndim - 1))
        moved: Array = middle + np.einsum("ij,j...->i...", self.matrix, q_px + self._crept_px(q_px))
        return moved

    def wandered_px(self, how: Condition, random: np.random.Generator) -> Array:
        """Return the displacement of each line by its wander, shape (2, ny)."""
        if how.wander_px or any(how.slow_creep_px):
            return wandered(self.shape[0], how, random)
        return np.zeros((2, self.shape[0]))

    def seen_px(self, sample_px: Array) -> Array:
        """Return the offset (2,) at which a place (2,) of the sample appears."""
        straight = np.asarray(np.linalg.solve(self.matrix, sample_px - self.origin_px), dtype=np.float64)
        q = straight
        for _ in range(20):
            q = straight - self._crept_px(q)
        return q

    def _crept_px(self, q_px: Array) -> Array:
        crept = np.zeros_like(q_px)
        if self.creep_px:
            along = np.maximum(q_px[0] + self.width_px[0] / 2, 0.0)
            crept[0] = self.creep_px * np.exp(-along / self.creep_length_px)
        return crept


@dataclass(frozen=True)
class View:
    """A tip's image of a sample at any position (cubic B-spline on a fine grid)."""

    grid: Grid
    coefficients: Array

    @classmethod
    def of(cls, grid: Grid, image: Array) -> View:
        return cls(grid, ndimage.spline_filter(image, order=3, mode="nearest"))

    def at(self, sample_px: Array) -> Array:
        """Return values at positions (2, …) in the sample."""
        where = self.grid.index(sample_px)
        return np.asarray(ndimage.map_coordinates(self.coefficients, where, order=3, mode="nearest", prefilter=False))

    def gradient(self, sample_px: Array) -> Array:
        """Return derivatives along x and y at positions (2, …): shape (2, …), per standard pixel."""
        h = 0.02
        shifts = h * np.eye(2).reshape(2, 2, *[1] * (sample_px.ndim - 1))
        return np.stack([(self.at(sample_px + s) - self.at(sample_px - s)) / (2 * h) for s in shifts])


@dataclass(frozen=True)
class Truth:
    """A feature at `x` of the reference is at `x + displacement_m + linear @ (x - center_m)` in the scan.

    Attributes:
        displacement_m, linear, center_m: as in `plugins.drift.registration.Registration`; the centre of the overlap.
        overlap: area in common over the smaller area.
    """

    displacement_m: Array
    linear: Array
    center_m: Array
    overlap: float

    def at(self, xy_m: Array) -> Array:
        """Return the displacement of a feature at a position of the reference."""
        return np.asarray(self.displacement_m + self.linear @ (xy_m - self.center_m))


@dataclass(frozen=True)
class Pair:
    """Two scans and their truth.

    Attributes:
        truth: None for unrelated scans.
        prior: the prior of an ideal tracker: set by `pair(prior_sd_px=…)`.
        frames, view: the place of the scans in the ideal image of the sample, which has unit rms in the reference (of a
            pair without truth: the image of the reference alone).
        gain: of the second scan.
    """

    surface: str
    condition: Condition
    reference: DriftScan
    scan: DriftScan
    truth: Truth | None
    prior: Prior | None
    frames: tuple[Frame, Frame]
    view: View
    gain: float

    @cached_property
    def overlap(self) -> float:
        """Area in common over the smaller area; 0 for unrelated scans."""
        return 0.0 if self.truth is None else self.truth.overlap


@dataclass(frozen=True)
class Sampling:
    """Pixels of one scan, (ny, nx), and their distance along x and y in standard pixels."""

    shape: tuple[int, int] = (128, 128)
    step_px: tuple[float, float] = (1.0, 1.0)

    @classmethod
    def square(cls, size: int, step_px: float = 1.0) -> Sampling:
        return cls((size, size), (step_px, step_px))


def pair(
    surface: str,
    condition: str,
    seed: int,
    size: int = 128,
    *,
    samplings: tuple[Sampling, Sampling] | None = None,
    prior_sd_px: float | None = None,
    half: Half | None = None,
    overlap: float | None = None,
) -> Pair:
    """Return a pair that depends only on the arguments.

    Args:
        surface: one of `SURFACES`.
        condition: one of `CONDITIONS`.
        size: pixels of both scans in each direction.
        samplings: of both scans, in place of `size`.
        prior_sd_px: give a prior about the true displacement with this standard deviation (for unrelated scans: about
            the displacement that they would have with an overlap).
        half: draw the parameters of surface and condition, too; see `families`.
        overlap: of the scans, in place of the condition's.
    """
    numbers = (seed, list(SURFACES).index(surface), list(CONDITIONS).index(condition))
    if half is None:
        how, relief, random = CONDITIONS[condition], SURFACES[surface], np.random.default_rng(numbers)
    else:
        random = source(half, *numbers)
        how, relief = drawn_condition(condition, random), drawn_surface(surface, random)
    if overlap is not None:
        how = replace(how, overlap=(overlap, overlap))
    first, second = samplings or (Sampling((size, size), (1.0, how.aspect)),) * 2
    frames = framed(first, second, how, random)
    views = _views(relief, frames, how, [*numbers[:2], *([] if half is None else [HALVES.index(half)])], random)
    wanders = [f.wandered_px(how, random) for f in frames]
    scale = 1.0 / float(views[0].at(frames[0].sample_px(frames[0].offsets_px())).std())
    gain = math.exp(random.uniform(-1.0, 1.0) * math.log(how.gain))
    centers_m = [random.uniform(-20.0, 20.0, 2) * PIXEL_M for _ in frames]
    scans = [
        DriftScan(
            values=HEIGHT_M
            * measured(scale * view.at(f.sample_px(f.offsets_px() + w[:, :, None])), how, random, k_gain),
            region=Region(tuple(center_m), tuple(f.width_px * PIXEL_M)),
            start_s=k * 900.0,
            end_s=k * 900.0 + ROW_S * f.shape[0],
            upwards=not (k and how.turned_round),
            key=f"{surface}-{condition}-{seed}-{k}",
        )
        for k, (f, view, center_m, k_gain, w) in enumerate(
            zip(frames, views, centers_m, (1.0, gain), wanders, strict=True)
        )
    ]
    truth = truth_of(frames, centers_m, wanders)
    known = None if prior_sd_px is None else prior_of(truth, prior_sd_px, how, first.shape[0], random)
    unit_view = replace(views[0], coefficients=scale * views[0].coefficients)
    return Pair(surface, how, scans[0], scans[1], None if how.elsewhere else truth, known, frames, unit_view, gain)


def framed(first: Sampling, second: Sampling, how: Condition, random: np.random.Generator) -> tuple[Frame, Frame]:
    """Return two frames with the overlap of the condition, its middle at the origin of the sample."""
    widths = [np.array([(n - 1) * s for n, s in zip(g.shape[::-1], g.step_px, strict=True)]) for g in (first, second)]
    smaller, larger = np.minimum(*widths), np.maximum(*widths)
    overlap, share = random.uniform(*how.overlap), random.random()
    shift = smaller * (1.0 - overlap ** np.array([share, 1.0 - share]))
    shift = (shift + random.random(2) * (larger - smaller) / 2) * random.choice((-1.0, 1.0), 2)
    low, high = np.maximum(-widths[0] / 2, -widths[1] / 2 + shift), np.minimum(widths[0] / 2, widths[1] / 2 + shift)
    middle = (low + high) / 2
    angles = (0.0, math.radians(how.rotation_deg) * random.uniform(-1.0, 1.0))
    frames: list[Frame] = []
    for sampling, origin, angle in zip((first, second), (-middle, shift - middle), angles, strict=True):
        # The sample moves by `drift` while the rows are scanned: a row at q_y sees what lies drift q_y / height before.
        # A zoom is scanned in less time, or more slowly when the sample has come to rest.
        drift_px = how.drift_px * min(1.0, (sampling.shape[0] - 1) * sampling.step_px[1] / widths[0][1])
        drift = drift_px * random.standard_normal(2) * (-1.0 if frames and how.turned_round else 1.0)
        shear = np.eye(2) - np.outer(drift, (0.0, 1.0 / ((sampling.shape[0] - 1) * sampling.step_px[1])))
        turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        if frames and how.calibration:
            shear = shear @ np.diag(1.0 + how.calibration * random.standard_normal(2))
        frames.append(Frame(sampling.shape, sampling.step_px, origin, turn @ shear, how.creep_px, how.creep_length_px))
    return frames[0], frames[1]


def _views(
    surface: Relief, frames: tuple[Frame, Frame], how: Condition, seeds: list[int], random: np.random.Generator
) -> tuple[View, View]:
    # one view if the tip is the same in both scans
    corners = np.array([[-0.5, -0.5, 0.5, 0.5], [-0.5, 0.5, -0.5, 0.5]])
    reach = max(np.abs(f.sample_px(corners * f.width_px[:, None])).max() for f in frames)
    grid = Grid(reach + MARGIN_PX)
    double, second_tip = (_apart(far_px, random) for far_px in (how.double_px, how.second_tip_px))

    def relief(grid: Grid, place: int) -> Array:
        specimen = np.random.default_rng([*seeds, 1])
        height = surface(grid, specimen, np.random.default_rng([*seeds, 2, place]))
        level: Array = (height - height.mean()) / height.std()
        return level

    height = relief(grid, 0)
    first = View.of(grid, imaged(height, double, how.blunt))
    if how.elsewhere:  # and not the same distance from what every place has near its origin
        x, y = random.uniform(-ELSEWHERE_PX, ELSEWHERE_PX, 2)
        return first, View.of(grid, imaged(relief(Grid(grid.half_px, (x, y)), 1), double, how.blunt))
    return first, View.of(grid, imaged(height, second_tip, how.blunt)) if second_tip else first


def _apart(far_px: float, random: np.random.Generator) -> tuple[float, float] | None:
    # (x, y) in a random direction; None for a distance of zero
    if not far_px:
        return None
    direction = random.uniform(0.0, 2 * math.pi)
    return far_px * math.cos(direction), far_px * math.sin(direction)


def truth_of(frames: tuple[Frame, Frame], centers_m: list[Array], wanders_px: Sequence[Array] = ()) -> Truth:
    """Return the truth of a pair: the mean displacement over the rows of the overlap, with the wander of its lines."""
    first, second = frames
    back = np.linalg.inv(second.matrix)
    middle = first.seen_px(np.zeros(2))  # of the overlap, which is the origin of the sample
    there = second.seen_px(np.zeros(2))
    low = np.maximum(-first.width_px / 2, -second.width_px / 2 - (there - middle))
    high = np.minimum(first.width_px / 2, second.width_px / 2 - (there - middle))
    area = np.prod(np.maximum(high - low, 0.0)) / min(np.prod(first.width_px), np.prod(second.width_px))
    shown = low[1], high[1]
    moved = [  # a line displaced by w shows at q a feature of q + w
        _mean_between(one, frame, shown[0] + way, shown[1] + way)
        for one, frame, way in zip(wanders_px, frames, (0.0, (there - middle)[1]), strict=bool(wanders_px))
    ]
    wander = moved[0] - moved[1] if moved else np.zeros(2)
    return Truth(
        displacement_m=centers_m[1] - centers_m[0] + (there - middle + wander) * PIXEL_M,
        linear=back @ first.matrix - np.eye(2),
        center_m=centers_m[0] + middle * PIXEL_M,
        overlap=float(area),
    )


def _mean_between(wander_px: Array, frame: Frame, low_px: float, high_px: float) -> Array:
    # of the lines between two positions along the slow axis
    y = (np.arange(frame.shape[0]) - (frame.shape[0] - 1) / 2) * frame.step_px[1]
    return np.asarray(wander_px[:, (y >= low_px - 0.5) & (y <= high_px + 0.5)].mean(axis=1))


def prior_of(truth: Truth, sd_px: float, how: Condition, rows: int, random: np.random.Generator) -> Prior:
    sd_m = sd_px * PIXEL_M
    return Prior(
        mean_m=truth.displacement_m + sd_m * random.standard_normal(2),
        covariance_m2=sd_m**2 * np.eye(2),
        velocity_sd_m_s=math.sqrt(2) * how.drift_px * PIXEL_M / (rows * ROW_S),
    )
