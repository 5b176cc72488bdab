"""Imaging by a tip of a given shape: grey dilation, band limit, and interpolation at any position.

The path of the tip's apex over a surface is the grey dilation of the surface by the reflected tip (Villarrubia 1997). A
convex tip, a paraboloid that continues as a cone, is the infimal convolution of both shapes. So a dilation by the
paraboloid (exact, axis by axis) is followed by a dilation by the cone, approximated by an eight-sided pyramid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from afspm.model.arrays import Array
from afspm.simulation.fields import bspline_weights
from afspm.simulation.tip import TipShape

Single = NDArray[np.float32]
_SPLINE_VARIANCE = 1.0 / 3.0  # of the cubic B-spline as a blur, in samples squared


@dataclass(frozen=True)
class SampleGrid:
    """A grid along the sample's axes on which the sample is computed, usually finer than the scan.

    Attributes:
        x0_m, y0_m: the first point.
        dx_m, dy_m: distance of the points.
        shape: (ny, nx).
    """

    x0_m: float
    y0_m: float
    dx_m: float
    dy_m: float
    shape: tuple[int, int]

    @classmethod
    def covering(cls, x_m: Array, y_m: Array, step_m: tuple[float, float], margin_m: float) -> SampleGrid:
        """Return a grid around all positions, with a margin for the reach of the tip."""
        # On multiples of the step, so that every scan of that resolution computes a position alike.
        first = [math.floor((a.min() - margin_m) / d) - 8 for a, d in zip((x_m, y_m), step_m, strict=True)]
        last = [math.ceil((a.max() + margin_m) / d) + 8 for a, d in zip((x_m, y_m), step_m, strict=True)]
        shape = (last[1] - first[1] + 1, last[0] - first[0] + 1)
        return cls(first[0] * step_m[0], first[1] * step_m[1], *step_m, shape)

    def axes_m(self) -> tuple[Array, Array]:
        """Return x as a single row and y as a single column, in m."""
        ny, nx = self.shape
        x: Array = self.x0_m + self.dx_m * np.arange(nx, dtype=np.float64)
        y: Array = self.y0_m + self.dy_m * np.arange(ny, dtype=np.float64)
        return x[None, :], y[:, None]

    def rows(self, start: int, stop: int) -> SampleGrid:
        return SampleGrid(self.x0_m, self.y0_m + start * self.dy_m, self.dx_m, self.dy_m, (stop - start, self.shape[1]))


@dataclass
class Sampler:
    """Positions on a grid, prepared for interpolating several images."""

    grid: SampleGrid
    x_m: Array
    y_m: Array
    _index: NDArray[np.intp] = field(init=False, repr=False)
    _u: Array = field(init=False, repr=False)
    _v: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        u = (self.x_m - self.grid.x0_m) / self.grid.dx_m
        v = (self.y_m - self.grid.y0_m) / self.grid.dy_m
        column, row = np.floor(u), np.floor(v)
        self._index = (row * self.grid.shape[1] + column).astype(np.intp)
        self._u, self._v = u - column, v - row

    def spline(self, picture: Single) -> Array:
        """Interpolate with a cubic B-spline whose coefficients are the image: smooth, with a slight blur."""
        flat, width = np.ravel(picture), self.grid.shape[1]
        total = np.zeros(self._u.shape)
        u_weights = bspline_weights(self._u)
        for i, v_weight in enumerate(bspline_weights(self._v)):
            start = self._index + ((i - 1) * width - 1)
            along = flat.take(start) * u_weights[0]
            for j in range(1, 4):
                along += flat.take(start + j) * u_weights[j]
            along *= v_weight
            total += along
        return total

    def linear(self, picture: Array) -> Array:
        """Interpolate linearly between the four points around each position."""
        flat, width = np.ravel(picture), self.grid.shape[1]
        lower = flat.take(self._index) * (1 - self._u) + flat.take(self._index + 1) * self._u
        upper = flat.take(self._index + width) * (1 - self._u) + flat.take(self._index + width + 1) * self._u
        return np.asarray(lower * (1 - self._v) + upper * self._v)


def across_m(tip: TipShape, height_range_m: float) -> float:
    """Return the lateral reach of the round part of a tip on a surface with this range of heights."""
    corner = tip.imaging_radius_m / math.tan(math.radians(tip.half_angle_deg))  # beyond, the cone touches
    return min(math.sqrt(2.0 * tip.imaging_radius_m * height_range_m), corner)


def reach_m(tip: TipShape, height_range_m: float) -> float:
    """Return the lateral reach of a tip on a surface with this range of heights."""
    across = across_m(tip, height_range_m)
    beyond = max(0.0, height_range_m - across**2 / (2.0 * tip.imaging_radius_m))
    reach = across + beyond * math.tan(math.radians(tip.half_angle_deg))
    return reach + (math.hypot(*tip.second_apex_m[:2]) if tip.second_apex_m else 0.0)


def felt(height_m: Array, grid: SampleGrid, tip: TipShape, blur_steps: tuple[float, float]) -> tuple[Single, float]:
    """Return the path of the tip's apex over a surface, on the same grid, band limited.

    Args:
        blur_steps: standard deviation of the total blur (y, x) in grid steps, including the blur of `Sampler.spline`.

    Returns:
        The path minus an offset (single precision then suffices), and the offset in m.
    """
    offset = float(height_m.mean())
    surface = (height_m - offset).astype(np.float32)
    path = _dilated(surface, grid, tip)
    if tip.second_apex_m:
        dx, dy, below = tip.second_apex_m
        path = np.maximum(path, _shifted(path, dx / grid.dx_m, dy / grid.dy_m) + np.float32(below))
    for axis, blur in enumerate(blur_steps):
        path = _blurred(path, math.sqrt(max(blur**2 - _SPLINE_VARIANCE, 0.0)), axis)
    return path, offset


def _dilated(surface: Single, grid: SampleGrid, tip: TipShape) -> Single:
    height_range = float(np.ptp(surface))
    slope = 1.0 / math.tan(math.radians(tip.half_angle_deg))
    radius = tip.imaging_radius_m
    across = across_m(tip, height_range)
    for axis, step in enumerate((grid.dy_m, grid.dx_m)):
        surface = _under_parabola(surface, axis, step, radius, across)
    if height_range > slope * across / 2:
        surface = _under_cone(surface, grid, slope, height_range / slope)
    return surface


def _under_parabola(surface: Single, axis: int, step_m: float, radius_m: float, reach_m: float) -> Single:
    taps = min(math.floor(reach_m / step_m), surface.shape[axis] - 1)
    result = surface.copy()
    lowered = np.empty_like(surface)
    for k in range(1, taps + 1):
        np.subtract(surface, np.float32((k * step_m) ** 2 / (2.0 * radius_m)), out=lowered)
        _raise_to(result, lowered, (k, 0) if axis == 0 else (0, k))
        _raise_to(result, lowered, (-k, 0) if axis == 0 else (0, -k))
    return result


def _under_cone(surface: Single, grid: SampleGrid, slope: float, reach_m: float) -> Single:
    # an eight-sided pyramid: lines of that slope along axes and diagonals, by doubling the stride
    directions = ((1, 0), (0, 1), (1, 1), (1, -1))
    for rows, columns in directions:
        length = math.hypot(rows * grid.dy_m, columns * grid.dx_m)
        stride = 1
        while stride * length <= reach_m and stride < min(surface.shape):
            lowered = surface - np.float32(slope * stride * length)
            surface = surface.copy()
            _raise_to(surface, lowered, (stride * rows, stride * columns))
            _raise_to(surface, lowered, (-stride * rows, -stride * columns))
            stride *= 2
    return surface


def _raise_to(result: Single, other: Single, offset: tuple[int, int]) -> None:
    # result[p] = max(result[p], other[p + offset]) where that exists
    here, there = [], []
    for shift, size in zip(offset, result.shape, strict=True):
        here.append(slice(max(-shift, 0), size - max(shift, 0)))
        there.append(slice(max(shift, 0), size + min(shift, 0)))
    view = result[tuple(here)]
    np.maximum(view, other[tuple(there)], out=view)


def _shifted(picture: Single, columns: float, rows: float) -> Single:
    # picture at (row + rows, column + columns), linear between points; the border is repeated
    for axis, shift in ((0, rows), (1, columns)):
        size = picture.shape[axis]
        position = np.clip(np.arange(size) + shift, 0, size - 1)
        first = np.minimum(position.astype(np.intp), size - 2)
        part = (position - first).astype(np.float32)
        part = part[:, None] if axis == 0 else part[None, :]
        picture = picture.take(first, axis) * (1 - part) + picture.take(first + 1, axis) * part
    return picture


def _blurred(picture: Single, sigma: float, axis: int) -> Single:
    # Gaussian; the border is repeated
    if sigma < 0.1:
        return picture
    taps = math.ceil(3.0 * sigma)
    weights = np.exp(-0.5 * (np.arange(taps + 1) / sigma) ** 2)
    weights /= weights[0] + 2.0 * weights[1:].sum()
    width = [(0, 0), (0, 0)]
    width[axis] = (taps, taps)
    padded = np.pad(picture, width, mode="edge")

    def part(k: int) -> Single:
        size = picture.shape[axis]
        return padded[k : k + size] if axis == 0 else padded[:, k : k + size]

    result = part(taps) * np.float32(weights[0])
    pair = np.empty_like(result)
    for k in range(1, taps + 1):
        np.add(part(taps - k), part(taps + k), out=pair)
        pair *= np.float32(weights[k])
        result += pair
    return result
