"""Where the scans may match: peaks of the correlation of what both know, in three channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.prepare import Image, Mask

Array = NDArray[np.float64]

LEAST_OVERLAP = 0.2  # of the smaller image
PEAKS = 4  # of each channel
APART_PX = 1.5  # nearer peaks are one


@dataclass(frozen=True, eq=False)
class PixelPrior:
    """Expected shift, px, and its covariance, px²."""

    mean: Array
    covariance: Array

    def chi2(self, shift_px: Array) -> Array:
        """Of shifts, shape (..., 2)."""
        off = shift_px - self.mean
        chi2: Array = np.einsum("...i,ij,...j", off, np.linalg.inv(self.covariance), off)
        return chi2

    def surprise(self, shift_px: Array, covariance: Array) -> float:
        """chi² of an estimate, which has a covariance too."""
        off = shift_px - self.mean
        return float(off @ np.linalg.solve(self.covariance + covariance, off))


def channels(image: Image) -> tuple[Array, Array, Array]:
    """Smoothed; its slope along the rows, which the offset of a row does not touch; and a band, which favours edges."""
    from scipy.ndimage import gaussian_filter

    v = image.values
    smooth = gaussian_filter(v, 1.0, mode="nearest")
    slope = gaussian_filter(v, 1.5, order=(0, 1), mode="nearest")
    return smooth, slope, gaussian_filter(v, 0.8, mode="nearest") - gaussian_filter(v, 3.0, mode="nearest")


def candidates(first: Image, second: Image, prior: PixelPrior | None) -> list[Array]:
    """Shifts (x, y) px worth a closer look, the best first, and the prior mean."""
    correlation = Correlation(first.known, second.known)
    peaks: list[tuple[float, Array]] = []
    for one, two in zip(channels(first), channels(second), strict=True):
        peaks += correlation.peaks(one, two, prior)
    peaks.sort(key=lambda peak: -peak[0])
    shifts = [shift for _, shift in peaks]
    if prior is not None:
        shifts.insert(0, prior.mean)
    kept: list[Array] = []
    for shift in shifts:
        if all(np.hypot(*(shift - other)) >= APART_PX for other in kept):
            kept.append(shift)
    return kept


class Correlation:
    """Normalised cross-correlation of two images of which parts are known, for all shifts at once (Padfield, IEEE
    Trans. Image Process. 21, 2706, 2012)."""

    def __init__(self, known1: Mask, known2: Mask):
        from scipy.fft import next_fast_len

        (ny1, nx1), (ny2, nx2) = known1.shape, known2.shape
        self._full = (ny1 + ny2 - 1, nx1 + nx2 - 1)
        self._fft = tuple(next_fast_len(n, real=True) for n in self._full)
        self._masks = known1.astype(np.float64), known2.astype(np.float64)
        self._origin = np.array([ny1 - 1, nx1 - 1])
        self._center = np.array([(nx2 - nx1) / 2, (ny2 - ny1) / 2])
        self._spectra = self._transform(self._masks[0]), self._transform(self._masks[1])
        self.overlap = np.maximum(np.rint(self._correlate(*self._spectra)), 0.0)

    def of(self, one: Array, two: Array) -> Array:
        """[y, x] coefficients; see `shifts_px`."""
        m1, m2 = self._masks
        one, two = (one - one[m1 > 0].mean()) * m1, (two - two[m2 > 0].mean()) * m2
        f1, f2 = self._transform(one), self._transform(two)
        k1, k2 = self._spectra
        n = np.maximum(self.overlap, 1.0)
        s1, s2 = self._correlate(f1, k2), self._correlate(k1, f2)
        var1 = self._correlate(self._transform(one * one), k2) - s1 * s1 / n
        var2 = self._correlate(k1, self._transform(two * two)) - s2 * s2 / n
        covariance = self._correlate(f1, f2) - s1 * s2 / n
        least = 1e-6 * np.sqrt(max(var1.max(), 0.0) * max(var2.max(), 0.0)) + 1e-300
        norm = np.sqrt(np.maximum(var1, 0.0) * np.maximum(var2, 0.0))
        coefficient: Array = np.where(norm > least, covariance / np.maximum(norm, least), 0.0)
        return np.clip(coefficient, -0.9999, 0.9999)

    def shifts_px(self, index: Array) -> Array:
        """Shifts (x, y) between centres that pixels (y, x) of the coefficients stand for, shape (n, 2)."""
        shifts: Array = (index - self._origin)[..., ::-1] - self._center
        return shifts

    def peaks(self, one: Array, two: Array, prior: PixelPrior | None) -> list[tuple[float, Array]]:
        """The highest, by atanh(c) sqrt(n), which has the same variance for every overlap n (Fisher)."""
        from scipy.ndimage import maximum_filter

        enough = self.overlap >= LEAST_OVERLAP * min(mask.sum() for mask in self._masks)
        if prior is not None:
            at = np.stack(np.meshgrid(*(np.arange(n) for n in self._full), indexing="ij"), axis=-1)
            enough &= prior.chi2(self.shifts_px(at)) < 25.0
        height = np.where(enough, np.arctanh(self.of(one, two)) * np.sqrt(self.overlap), -np.inf)
        top = (height == maximum_filter(height, 3)) & (height > 0.0)
        index = np.argwhere(top)
        best = np.argsort(-height[top])[:PEAKS]
        shifts = self.shifts_px(index[best].astype(np.float64))
        return list(zip(height[top][best].tolist(), shifts, strict=True))

    def _transform(self, values: Array) -> NDArray[np.complex128]:
        from scipy.fft import rfft2

        return rfft2(values, self._fft)

    def _correlate(self, first: NDArray[np.complex128], second: NDArray[np.complex128]) -> Array:
        """sum over p of first(p) second(p + s), s from minus the size of the first up."""
        from scipy.fft import irfft2

        product = irfft2(np.conj(first) * second, self._fft)
        rolled: Array = np.roll(product, tuple(self._origin), axis=(0, 1))[: self._full[0], : self._full[1]]
        return rolled
