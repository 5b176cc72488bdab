"""Five kinds of surface, on a grid four times finer than the pixels of a scan, as imaged by a tip.

Lengths are in pixels of the standard scan (128 of them are 2 µm). A surface has two random sources: `specimen` for the
properties common to all places of one sample (the direction of a lattice), `place` for this place.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from afspm.components import Array

Random = np.random.Generator

OVERSAMPLING = 4
TIP_PX = 1.5  # so far from its apex the parabolic tip is one rms height of the sample above it
ROUGH_PX = 40.0  # above this length `rough` is not any rougher
BAND_PX = 0.5  # Gaussian that limits the band, as feedback and probe do
_ROWS = 16  # dilated at a time, so that they stay in the processor's cache


@dataclass(frozen=True)
class Grid:
    """A square of fine points, at least `half_px` from its middle in each direction; positions are relative to it.

    Attributes:
        middle_px: (x, y) of its middle, for surfaces with something special at their origin.
    """

    half_px: float
    middle_px: tuple[float, float] = (0.0, 0.0)

    @property
    def count(self) -> int:
        return 2 * math.ceil(self.half_px * OVERSAMPLING) + 1

    @property
    def axis_px(self) -> Array:
        return (np.arange(self.count) - self.count // 2) / OVERSAMPLING

    def index(self, xy_px: Array) -> Array:
        """Return indices (2, …) as (row, column) in an array over the grid of positions, shape (2, …) as (x, y)."""
        return xy_px[::-1] * OVERSAMPLING + self.count // 2


def stamper(
    grid: Grid,
    specimen: Random,
    place: Random,
    *,
    pitch: float = 102.0,
    half_width: float = 16.0,
    bit: float = 17.8,
    flank: float = 6.0,
    turned_deg: float = 15.0,
    texture: float = 0.01,
    texture_px: float = 6.0,
) -> Array:
    """Return bumps on tracks 102 px apart, 32 px wide, 3 to 11 bits of 17.8 px long; one ends near the origin."""
    x, y = grid.axis_px[None, :] + grid.middle_px[0], grid.axis_px[:, None] + grid.middle_px[1]
    angle = math.radians(specimen.uniform(-turned_deg, turned_deg))
    along = x * math.cos(angle) + y * math.sin(angle) + place.uniform(-15.0, 15.0)
    across = y * math.cos(angle) - x * math.sin(angle) + place.uniform(-20.0, 20.0)
    track = np.round(across / pitch)
    height = np.zeros(along.shape)
    for number in np.unique(track):
        enough = 2 * math.ceil((1.5 * (grid.half_px + max(map(abs, grid.middle_px))) + 200.0) / (3 * bit))
        runs = bit * np.minimum(3 + place.geometric(0.33, enough) - 1, 11)
        edges = np.cumsum(runs)
        edges -= edges[len(edges) // 2] + (0.0 if number == 0 else place.uniform(0.0, 8 * bit))
        here = track == number
        run = np.clip(np.searchsorted(edges, along[here]), 1, len(edges) - 1)
        to_end = np.minimum(along[here] - edges[run - 1], edges[run] - along[here]) * np.where(run % 2, 1.0, -1.0)
        past = np.maximum(half_width - to_end, 0.0)
        inside = half_width - np.hypot(past, across[here] - number * pitch)
        height[here] = _smooth_step(inside / flank + 0.5)
    return height + texture * _self_affine(grid, place, longest_px=texture_px)


def rough(grid: Grid, specimen: Random, place: Random, *, longest_px: float = ROUGH_PX, hurst: float = 0.8) -> Array:
    """Return self-affine ground of Hurst exponent 0.8 up to 40 px."""
    return _self_affine(grid, place, longest_px=longest_px, hurst=hurst)


def rough_power(f2: Array) -> Array:
    """Return the spectral density, up to a factor, of a sharp tip's image of `rough`.

    Args:
        f2: squared frequencies, 1/px².
    """
    return self_affine_amplitude(f2, longest_px=ROUGH_PX) ** 2 * np.exp(-f2 * (2 * math.pi * BAND_PX) ** 2)


def particles(
    grid: Grid,
    specimen: Random,
    place: Random,
    *,
    area_px2: float = 400.0,
    radius_px: float = 4.5,
    spread: float = 0.35,
    ground: float = 0.15,
    ground_px: float = 10.0,
) -> Array:
    """Return spheres of 2 to 9 px radius, one per 400 square px, on almost flat ground."""
    height = ground * _self_affine(grid, place, longest_px=ground_px)
    count = place.poisson((2 * grid.half_px) ** 2 / area_px2)
    radii = np.clip(radius_px * np.exp(spread * place.standard_normal(count)), radius_px * 0.44, radius_px * 2.0)
    for radius, center in zip(radii, place.uniform(-grid.half_px, grid.half_px, (count, 2)), strict=True):
        for window, square in _around(grid, center, radius):
            np.maximum(height[window], radius + np.sqrt(np.maximum(radius**2 - square, 0.0)), out=height[window],
                       where=square < radius**2)  # fmt: skip
    return height


def lattice(
    grid: Grid,
    specimen: Random,
    place: Random,
    *,
    spacing: float = 8.0,
    defects: float = 7.0,
    depth: float = 4.0,
    texture: float = 0.0,
    stretch: float = 1.0,
) -> Array:
    """Return atoms 8 px apart in a hexagonal lattice, with about seven vacancies and adatoms per 128 x 128 px.

    Each seventh of that area has one: a view without a defect would have no determinable displacement. The lattice is
    stretched along one axis of the grid.
    """
    angle = specimen.uniform(0.0, math.pi / 3)
    x, y = grid.axis_px[None, :], grid.axis_px[:, None]
    shift = place.uniform(0.0, spacing, 2)
    height = np.zeros((grid.count, grid.count))
    wave = 4 * math.pi / (math.sqrt(3) * spacing)
    x = x / stretch
    for k in range(3):
        cos, sin = math.cos(angle + k * math.pi / 3), math.sin(angle + k * math.pi / 3)
        # cos(a + b) of a column and a row, without a cosine for every point
        column, row = wave * sin * (y - shift[1]), wave * cos * (x - shift[0])
        height += np.cos(column) * np.cos(row) - np.sin(column) * np.sin(row)
    cell = spacing * np.array([[1.0, 0.5], [0.0, math.sqrt(0.75)]])
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    # the rows of atoms are at right angles to the waves
    axes = turn @ np.array([[math.cos(math.pi / 6), -0.5], [0.5, math.cos(math.pi / 6)]]) @ cell
    apart = 128.0 / math.sqrt(defects)
    corners = np.arange(-grid.half_px - place.uniform(0.0, apart), grid.half_px, apart)
    for corner in itertools.product(corners, repeat=2):
        wanted = corner + place.uniform(0.0, apart, 2)
        site = axes @ np.round(np.linalg.solve(axes, wanted / (stretch, 1.0) - shift)) + shift
        sign, width = (-1.0, 2.6) if place.random() < 0.6 else (1.0, 3.0)
        for window, square in _around(grid, site * (stretch, 1.0), 5 * width):
            height[window] += sign * depth * np.exp(-square / (2 * width**2))
    return height + texture * _self_affine(grid, place, longest_px=spacing) if texture else height


def steps(
    grid: Grid,
    specimen: Random,
    place: Random,
    *,
    terrace: float = 60.0,
    edge: float = 3.0,
    wander: float = 0.4,
    wander_px: float = 40.0,
    kinks: float = 0.08,
    texture: float = 0.0,
) -> Array:
    """Return terraces about 60 px wide between meandering steps, levelled as a whole."""
    angle = math.radians(specimen.uniform(0.0, 360.0))
    x, y = grid.axis_px[None, :], grid.axis_px[:, None]
    plane = (x * math.cos(angle) + y * math.sin(angle)) / terrace
    meander = _smooth(grid, place, wander_px) + kinks * _smooth(grid, place, 5.0)
    height = plane + wander * meander + place.random()
    step = np.round(height)
    stairs = step - 0.5 + _smooth_step((height - step) * terrace / edge + 0.5) - plane
    return stairs + texture * _self_affine(grid, place, longest_px=10.0) if texture else stairs


SURFACES: dict[str, Callable[..., Array]] = {
    "stamper": stamper,
    "rough": rough,
    "particles": particles,
    "lattice": lattice,
    "steps": steps,
}


def imaged(height: Array, second_tip_px: tuple[float, float] | None = None, blunt: float = 1.0) -> Array:
    """Return a tip's image of a surface of unit rms: dilated by a parabola, and of limited band.

    Args:
        blunt: radius of the tip, over the usual one.
        second_tip_px: (x, y) of a second apex as sharp as the first, one rms height shorter.
    """
    width = TIP_PX * OVERSAMPLING * math.sqrt(blunt)
    reach = min(math.ceil(width * math.sqrt(max(np.ptp(height), 1e-9))), 6 * OVERSAMPLING)
    tip = -((np.arange(-reach, reach + 1) / width) ** 2)
    touched = height
    for axis in (0, 1):  # the dilation by a parabola of revolution is that along x after that along y
        touched = _dilated(touched, tip, axis)
    if second_tip_px is not None:
        dx, dy = (round(d * OVERSAMPLING) for d in second_tip_px)
        touched = np.maximum(touched, np.roll(touched, (dy, dx), axis=(0, 1)) - 1.0)
    return np.asarray(ndimage.gaussian_filter(touched, BAND_PX * OVERSAMPLING, mode="nearest", truncate=5.0))


def _dilated(height: Array, tip: Array, axis: int) -> Array:
    # grey dilation of one axis by an even function
    reach = len(tip) // 2
    padded = np.ascontiguousarray(np.pad(np.moveaxis(height, axis, 0), ((reach, reach), (0, 0)), mode="edge"))
    highest = padded[reach:-reach].copy()
    for first in range(0, len(highest), _ROWS):
        here = highest[first : first + _ROWS]
        either = np.empty_like(here)
        for far in range(1, reach + 1):
            before, after = (padded[first + reach + k :][: len(here)] for k in (-far, far))
            np.maximum(before, after, out=either)
            either += tip[reach + far]
            np.maximum(here, either, out=here)
    return np.moveaxis(highest, 0, axis)


def _smooth_step(t: Array) -> Array:
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _around(grid: Grid, center: Array, reach_px: float) -> Iterator[tuple[tuple[slice, slice], Array]]:
    # the window of the grid within reach of a point, if there is one, and the squared distances in it
    axis = grid.axis_px
    (x0, x1), (y0, y1) = (np.searchsorted(axis, (c - reach_px, c + reach_px)) for c in center)
    if x0 < x1 and y0 < y1:
        yield (
            (slice(y0, y1), slice(x0, x1)),
            ((axis[None, x0:x1] - center[0]) ** 2 + (axis[y0:y1, None] - center[1]) ** 2),
        )


def self_affine_amplitude(f2: Array, *, longest_px: float, hurst: float = 0.8) -> Array:
    """Return an amplitude as f^-(hurst + 1), constant below 1 / longest_px; by the squared frequency in 1/px²."""
    return np.asarray(np.maximum(f2, longest_px**-2) ** (-(hurst + 1) / 2))


def contaminated(height: Array, grid: Grid, place: Random, *, blobs: float) -> Array:
    """Add `blobs` drops of 2 to 6 px per 128 x 128 px, each up to three times the rms height."""
    height, unit = height.copy(), height.std()
    count = place.poisson(blobs * (2 * grid.half_px / 128) ** 2)
    for center in place.uniform(-grid.half_px, grid.half_px, (count, 2)):
        width, high = place.uniform(2.0, 6.0), unit * place.uniform(0.5, 3.0)
        for window, square in _around(grid, center, 4 * width):
            height[window] += high * np.exp(-square / (2 * width**2))
    return height


def _self_affine(grid: Grid, random: Random, *, longest_px: float, hurst: float = 0.8) -> Array:
    # a Gaussian field of unit rms
    return _field(grid, random, lambda f2: self_affine_amplitude(f2, longest_px=longest_px, hurst=hurst))


def _smooth(grid: Grid, random: Random, length_px: float) -> Array:
    # a Gaussian field of unit rms and correlation length
    return _field(grid, random, lambda f2: np.exp(-f2 * (math.pi * length_px) ** 2 / 2))


def _field(grid: Grid, random: Random, amplitude: Callable[[Array], Array]) -> Array:
    # periodic and Gaussian, of unit rms; the amplitude is a function of the squared frequency in 1/px²
    count = fft.next_fast_len(grid.count, real=True)
    fx, fy = fft.rfftfreq(count, 1 / OVERSAMPLING), fft.fftfreq(count, 1 / OVERSAMPLING)
    shape = amplitude(fx[None, :] ** 2 + fy[:, None] ** 2)
    shape[0, 0] = 0.0
    noise = random.standard_normal((count, len(fx))) + 1j * random.standard_normal((count, len(fx)))
    field = fft.irfft2(noise * shape, s=(count, count))[: grid.count, : grid.count]
    return np.asarray(field / field.std())
