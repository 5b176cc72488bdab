"""Two images and what the search and the tests see of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.prepare import Image
from afspm.drift.estimators.least_squares.warp import Box, Order, Spline

Array = NDArray[np.float64]

Both = tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class Scene:
    """Two images with one pixel size."""

    first: Image
    second: Image

    @cached_property
    def smooth(self) -> Both:
        """Without most of the noise."""
        return self._filtered(1.0)

    @cached_property
    def slope(self) -> Both:
        """Along the rows: their offsets don't touch it."""
        return self._filtered(1.5, order=(0, 1))

    @cached_property
    def band(self) -> Both:
        """Edges rather than areas."""
        fine, coarse = self._filtered(0.8), self._filtered(3.0)
        return fine[0] - coarse[0], fine[1] - coarse[1]

    @cached_property
    def smooth_splines(self) -> tuple[Spline, Spline]:
        return self.splines(self.smooth)

    @cached_property
    def band_splines(self) -> tuple[Spline, Spline]:
        return self.splines(self.band)

    def splines(self, values: Both, order: Order = 3) -> tuple[Spline, Spline]:
        """Of values that are known where the images are."""
        return Spline.of(values[0], self.first.known, order), Spline.of(values[1], self.second.known, order)

    def box(self, shift_px: Array) -> Box | None:
        """Where they overlap; see `Box.of_overlap`."""
        return Box.of_overlap(self.first.values.shape, self.second.values.shape, shift_px)

    @property
    def least_known(self) -> int:
        """Pixels of that of which less is known."""
        return min(int(self.first.known.sum()), int(self.second.known.sum()))

    def _filtered(self, sigma_px: float, order: tuple[int, int] = (0, 0)) -> Both:
        from scipy.ndimage import gaussian_filter

        one, two = (
            gaussian_filter(image.values, sigma_px, order=order, mode="nearest") for image in (self.first, self.second)
        )
        return one, two

    def smaller(self) -> tuple[Scene, int, Array]:
        """For the search: with `factor` times larger pixels where the images are large, that factor, and by how much,
        px, the centres have been moved apart (only whole blocks of pixels are kept)."""
        largest = max(*self.first.values.shape, *self.second.values.shape)
        factor = 1 if largest <= 160 else 2 if largest <= 640 else 4
        if factor == 1:
            return self, 1, np.zeros(2)
        cut = [np.array(image.values.shape[::-1]) % factor / 2 for image in (self.first, self.second)]
        return Scene(_decimated(self.first, factor), _decimated(self.second, factor)), factor, cut[0] - cut[1]


def _decimated(image: Image, factor: int) -> Image:
    """Means of `factor` x `factor` pixels."""
    ny, nx = (n // factor for n in image.values.shape)
    kept, blocks = np.s_[: ny * factor, : nx * factor], (ny, factor, nx, factor)
    known = np.asarray(image.known[kept].reshape(blocks).all(axis=(1, 3)))
    return Image(image.values[kept].reshape(blocks).mean(axis=(1, 3)), known)
