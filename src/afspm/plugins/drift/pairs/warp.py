"""Warping of two images, each half-way towards the other."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from afspm.components import Array
from afspm.plugins.drift.pairs.images import Image
from afspm.plugins.drift.pairs.noise import CrossingLines

Columns = NDArray[np.float32]
Mask = NDArray[np.bool_]
Order = Literal[3, 5]


@dataclass(frozen=True, eq=False)
class Spline:
    """Spline interpolation of an image, at pixel coordinates (x, y) from its centre.

    Attributes:
        known: mask of pixels that are more than two pixels from unknown pixels, and not made up; None: all.
        order: 3; or 5, which takes longer. On clear lattices of 5 to 16 px, cubic splines double the error of a
            displacement.
    """

    coefficients: Array
    known: Mask | None
    order: Order = 3

    @classmethod
    def of(cls, values: Array, known: Mask, made_up: Mask | None = None, order: Order = 3) -> Spline:
        """Return a spline that interpolates values exactly at the pixels."""
        from scipy.ndimage import binary_erosion, spline_filter

        inner = None if known.all() else binary_erosion(known, iterations=2, border_value=1)
        if made_up is not None:
            inner = ~made_up if inner is None else inner & ~made_up
        return cls(spline_filter(values, order, mode="mirror"), inner, order)

    def at(self, x: Array, y: Array) -> tuple[Array, Mask]:
        """Return values at points, and the mask of known values."""
        from scipy.ndimage import map_coordinates

        ny, nx = self.coefficients.shape
        at = np.stack([y + (ny - 1) / 2, x + (nx - 1) / 2])
        values = map_coordinates(self.coefficients, at, order=self.order, mode="mirror", prefilter=False)
        known = (np.abs(x) <= (nx - 1) / 2 + 1e-6) & (np.abs(y) <= (ny - 1) / 2 + 1e-6)
        if self.known is not None:
            rows, columns = np.rint(at).astype(int)
            known &= self.known[np.clip(rows, 0, ny - 1), np.clip(columns, 0, nx - 1)]
        return values, known

    def on_grid(self, x: Array, y: Array) -> tuple[Array, Mask]:
        """Return values and mask like `at`, but on a grid with a spacing of one pixel, which is much faster."""
        values, known = self.coefficients, np.ones((y.size, x.size), dtype=bool)
        picked = []
        for axis, at in enumerate((y, x)):
            size = self.coefficients.shape[axis]
            start = np.floor(at[0] + (size - 1) / 2)
            weights = _basis(at[0] + (size - 1) / 2 - start, self.order)
            values = _combined(values, axis, int(start) - self.order // 2, at.size, weights)
            inside = np.abs(at) <= (size - 1) / 2 + 1e-6
            known &= inside[:, None] if axis == 0 else inside[None, :]
            picked.append(np.clip(np.rint(at + (size - 1) / 2).astype(int), 0, size - 1))
        if self.known is not None:
            known &= self.known[np.ix_(*picked)]
        return values, known


@cache
def _element(order: Order) -> Callable[[Array], Array]:
    from scipy.interpolate import BSpline

    element: Callable[[Array], Array] = BSpline.basis_element(np.arange(order + 2.0))
    return element


def _basis(t: float, order: Order) -> Array:
    # B-splines at the neighbours, t from 0 to 1 beyond the last one on the left
    return _element(order)(t + np.arange(order, -1.0, -1.0))


def _combined(values: Array, axis: int, first: int, count: int, weights: Array) -> Array:
    last, size = first + count + len(weights) - 1, values.shape[axis]
    if first >= 0 and last <= size:
        near = values[first:last] if axis == 0 else values[:, first:last]
    else:
        near = values.take(_mirrored(np.arange(first, last), size), axis)
    parts = (near[k : k + count] if axis == 0 else near[:, k : k + count] for k in range(len(weights)))
    total: Array = weights[0] * next(parts)
    for weight, part in zip(weights[1:], parts, strict=True):
        total += weight * part
    return total


def _mirrored(index: NDArray[np.intp], size: int) -> NDArray[np.intp]:
    period = 2 * (size - 1)
    folded: NDArray[np.intp] = (index % period).astype(np.intp)
    return np.where(folded < size, folded, period - folded)


@dataclass(frozen=True, eq=False)
class OverlapBox:
    """Rectangle in which two shifted images overlap: pixel coordinates (x, y) from half-way between their centres."""

    x: Array
    y: Array

    @classmethod
    def of_overlap(cls, shape1: tuple[int, int], shape2: tuple[int, int], shift_px: Array) -> OverlapBox | None:
        """Return the overlap of two shifted images; None for an overlap below 8 pixels on a side."""
        axes = []
        for axis, shift in ((1, shift_px[0]), (0, shift_px[1])):
            half1, half2 = (shape1[axis] - 1) / 2, (shape2[axis] - 1) / 2
            low, high = max(-half1 + shift / 2, -half2 - shift / 2), min(half1 + shift / 2, half2 - shift / 2)
            parity = half1 % 1.0
            axes.append(np.arange(np.ceil(low - parity - 1e-6), np.floor(high - parity + 1e-6) + 1) + parity)
        return cls(*axes) if min(axis.size for axis in axes) >= 8 else None

    def without_border(self, width: int) -> OverlapBox:
        """Return the box without `width` pixels on each side."""
        return OverlapBox(self.x[width:-width], self.y[width:-width])

    @property
    def shape(self) -> tuple[int, int]:
        return self.y.size, self.x.size

    @property
    def center(self) -> Array:
        return np.array([self.x.mean(), self.y.mean()])


LEAST_SEARCHED_PX = 32  # least side of the decimated smaller image: less may be too little to compare
CREEP_PX = (4.0, 9.0)  # lengths over which creep at the start of a line decays to 1/e
LINEAR = slice(2, 6)  # the linear map among the parameters theta of a pair
CREEP = slice(6, 6 + 2 * len(CREEP_PX))  # from the left and from the right, for each length
SLOPES = CREEP.stop  # number of the first parameters, which act through the gradient
GAIN, BEND, COUNT = SLOPES, SLOPES + 1, SLOPES + 2


@dataclass(frozen=True, eq=False)
class WarpedPair:
    """Two images on their overlap box, with the parameters of their alignment.

    Parameters are theta = (ux, uy, axx, axy, ayx, ayy, c.., g, h): shift u px and linear map A about the centre of the
    box, d(q) = u + A (q - centre); creep c at the start of the lines, in pixels of their own scan, the same in both;
    logarithm g of the gain of the second over the first; and excess curvature h of the second (heights z appear as z +
    h z² / 2, an effect of feedback and tip at edges).

    Attributes:
        shift_px: (2,) approximate u, for the distance between the line starts of both images.
        own_px: width of a pixel of each scan, in pixels of the grid. Creep lasts for some of a scan's own pixels, which
            is negligible in a zoom. 0: the lines are not along the rows of the grid, so creep is not modelled.
        crossing: the lines of the second scan, if they are not along the rows of the grid.
    """

    first: Spline
    second: Spline
    box: OverlapBox
    shift_px: Array = field(default_factory=lambda: np.zeros(2))
    own_px: tuple[float, float] = (1.0, 1.0)
    crossing: CrossingLines | None = None

    def warped(self, theta: Array) -> tuple[Array, Array, Mask]:
        """Return I1(q - d/2) and I2(q + d/2) with equal contrast, and the mask of pixels known in both.

        Each image is corrected by half of gain and curvature.

        Moving each image by half gives both the same interpolation noise. So the gradient of their mean is not
        correlated with the noise of their difference, and the shift is not biased towards whole pixels.
        """
        if theta[2:SLOPES].any():
            (one, known1), (two, known2) = self._both(theta)
        else:
            x, y, (dx, dy) = self.box.x, self.box.y, theta[:2]
            one, known1 = self.first.on_grid(x - dx / 2, y - dy / 2)
            two, known2 = self.second.on_grid(x + dx / 2, y + dy / 2)
        one, two = np.exp(theta[GAIN] / 2) * one, np.exp(-theta[GAIN] / 2) * two
        return one + theta[BEND] / 4 * one**2, two - theta[BEND] / 4 * two**2, known1 & known2

    def _both(self, theta: Array) -> tuple[tuple[Array, Mask], tuple[Array, Mask]]:
        cx, cy = self.box.center
        x, y = np.meshgrid(self.box.x, self.box.y)
        dx = theta[0] + theta[2] * (x - cx) + theta[3] * (y - cy) + theta[CREEP] @ self._creep
        dy = theta[1] + theta[4] * (x - cx) + theta[5] * (y - cy)
        return self.first.at(x - dx / 2, y - dy / 2), self.second.at(x + dx / 2, y + dy / 2)

    @cached_property
    def _creep(self) -> Array:
        # (creep, x): the displacement along the lines by creep of one pixel at their start, zero at the centre of the
        # box
        found = []
        at = np.append(self.box.x, self.box.center[0])
        for side in (1.0, -1.0):
            start1, start2 = (
                side * (at + sign * self.shift_px[0] / 2) + (spline.coefficients.shape[1] - 1) / 2
                for spline, sign in ((self.first, -1.0), (self.second, 1.0))
            )
            for length in CREEP_PX:
                row = sum(
                    (sign * own * np.exp(-np.maximum(start, 0.0) / (length * own))
                     for start, own, sign in ((start1, self.own_px[0], 1.0), (start2, self.own_px[1], -1.0)) if own),
                    np.zeros(at.size),
                )  # fmt: skip
                found.append(row[:-1] - row[-1])
        return np.array(found)

    def columns(
        self, gx: Array, gy: Array, mean: Array, residual: Array, free: Iterable[int] = range(COUNT)
    ) -> Columns:
        """Return the derivatives of the residual with respect to the free parameters, and the residual, [y, column, x].

        The result has 32-bit floats, exact to a millionth, since products of columns take most of the time.
        """
        by = (*self._by_slopes(gx, gy), -mean, (mean, -mean / 2))
        return np.stack([*(_product(by[i]) for i in free), residual], axis=1, dtype=np.float32)

    def slopes(self, gx: Array, gy: Array) -> Columns:
        """Return only the columns that contain the gradient, [y, column, x]."""
        return np.stack([_product(column) for column in self._by_slopes(gx, gy)], axis=1, dtype=np.float32)

    def _by_slopes(self, gx: Array, gy: Array) -> tuple[Array | tuple[Array, Array], ...]:
        cx, cy = self.box.center
        x, y = self.box.x[None, :] - cx, self.box.y[:, None] - cy
        return gx, gy, (gx, x), (gx, y), (gy, x), (gy, y), *((gx, row) for row in self._creep)


def _product(column: Array | tuple[Array, Array]) -> Array:
    return column[0] * column[1] if isinstance(column, tuple) else column


NINE_POINTS = (672.0 / 840.0, -168.0 / 840.0, 32.0 / 840.0, -3.0 / 840.0)  # on the difference of opposite neighbours


def derivative(values: Array, axis: int) -> Array:
    """Return the derivative per pixel, by a nine-point stencil.

    Five points would underestimate the slope of waves shorter than six pixels. The image is continued linearly beyond
    its borders.
    """

    def part(start: int | None, stop: int | None, step: int = 1, of: Array = values) -> Array:
        cut = slice(start, stop, step)
        return of[cut] if axis == 0 else of[:, cut]

    count = values.shape[axis]
    before, after = 2.0 * part(0, 1) - part(4, 0, -1), 2.0 * part(-1, None) - part(-2, -6, -1)
    padded = np.concatenate([before, values, after], axis)
    found = np.zeros_like(values)
    for far, weight in enumerate(NINE_POINTS, start=1):
        found += weight * (part(4 + far, 4 + far + count, of=padded) - part(4 - far, 4 - far + count, of=padded))
    return found


Both = tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class Scene:
    """Two images with the same pixel size."""

    first: Image
    second: Image

    @cached_property
    def smooth(self) -> Both:
        """Both images, smoothed to remove most of the noise."""
        return self._filtered(1.0)

    @cached_property
    def band(self) -> Both:
        """Both images, band-pass filtered to show edges rather than areas."""
        fine, coarse = self._filtered(0.8), self._filtered(3.0)
        return fine[0] - coarse[0], fine[1] - coarse[1]

    @cached_property
    def smooth_splines(self) -> tuple[Spline, Spline]:
        return self.splines(self.smooth)

    @cached_property
    def band_splines(self) -> tuple[Spline, Spline]:
        return self.splines(self.band)

    def splines(self, values: Both, order: Order = 3) -> tuple[Spline, Spline]:
        """Return splines of filtered values, with the masks of the images."""
        one, two = (
            Spline.of(each, image.known, image.made_up, order)
            for each, image in zip(values, (self.first, self.second), strict=True)
        )
        return one, two

    def box(self, shift_px: Array) -> OverlapBox | None:
        """Return the overlap box at a shift; see `OverlapBox.of_overlap`."""
        return OverlapBox.of_overlap(self.first.values.shape, self.second.values.shape, shift_px)

    @property
    def least_known(self) -> int:
        """Number of known pixels in the image with fewer of them."""
        return min(int(self.first.known.sum()), int(self.second.known.sum()))

    def _filtered(self, sigma_px: float) -> Both:
        from scipy.ndimage import gaussian_filter

        one, two = (gaussian_filter(image.values, sigma_px, mode="nearest") for image in (self.first, self.second))
        return one, two

    def smaller(self) -> tuple[Scene, int, Array]:
        """Return a decimated scene for the search, the decimation factor, and the shift of its centres in px.

        Large images are decimated. Only whole blocks of pixels are kept, which moves the centres apart.
        """
        sides = *self.first.values.shape, *self.second.values.shape
        factor = 1 if max(sides) <= 160 else 2 if max(sides) <= 640 else 4
        while factor > 1 and min(sides) < LEAST_SEARCHED_PX * factor:  # a zoom in its overview
            factor //= 2
        if factor == 1:
            return self, 1, np.zeros(2)
        (first, cut1), (second, cut2) = (_decimated(image, factor) for image in (self.first, self.second))
        return Scene(first, second), factor, cut1 - cut2


def in_whole_blocks(image: Image, factor: int) -> tuple[Array, Mask, Array]:
    """Return the values in whole blocks of pixels, the known blocks, and how far the centre moves back (x, y), px."""
    ny, nx = (n // factor for n in image.values.shape)
    kept = np.s_[: ny * factor, : nx * factor]
    known = np.asarray(image.known[kept].reshape(ny, factor, nx, factor).all(axis=(1, 3)))
    return image.values[kept], known, np.array(image.values.shape[::-1]) % factor / 2


def _decimated(image: Image, factor: int) -> tuple[Image, Array]:
    values, known, cut = in_whole_blocks(image, factor)
    ny, nx = known.shape
    return Image(values.reshape(ny, factor, nx, factor).mean(axis=(1, 3)), known), cut
