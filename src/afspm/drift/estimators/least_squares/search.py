"""Where the scans may match: peaks of the correlation of what both know, in three channels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.expected import Expected
from afspm.drift.estimators.least_squares.prepare import Mask
from afspm.drift.estimators.least_squares.scene import Scene

Array = NDArray[np.float64]
Spectrum = NDArray[np.complexfloating[Any, Any]]

LEAST_OVERLAP = 0.2  # of the smaller image
PEAKS = 4  # of each channel
APART_PX = 1.5  # nearer peaks are one


def candidates(scene: Scene, prior: Expected | None) -> list[Array]:
    """Shifts (x, y) px worth a closer look, the best first, and the one that is expected."""
    correlation = Correlation(scene.first.known, scene.second.known)
    peaks: list[tuple[float, Array]] = []
    for one, two in (scene.smooth, scene.slope, scene.band):
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

    def __init__(self, known1: Mask, known2: Mask, reach_px: int | None = None):
        """Args:
        reach_px: of the largest shift, for images of one shape; None: as long as they overlap.
        """
        from scipy.fft import next_fast_len, rfft2

        (ny1, nx1), (ny2, nx2) = known1.shape, known2.shape
        reach = max(ny1, nx1, ny2, nx2) if reach_px is None else reach_px
        self.origin = np.minimum([ny1 - 1, nx1 - 1], reach)
        self._full = tuple((self.origin + np.minimum([ny2, nx2], reach + 1)).tolist())
        enough = [min(max(n1, n2) + reach, n1 + n2 - 1) for n1, n2 in zip(known1.shape, known2.shape, strict=True)]
        self._fft = tuple(next_fast_len(n, real=True) for n in enough)
        self._masks = known1.astype(np.float64), known2.astype(np.float64)
        self._center = np.array([(nx2 - nx1) / 2, (ny2 - ny1) / 2])
        exact = rfft2(self._masks[0], self._fft), rfft2(self._masks[1], self._fft)
        self.overlap = np.maximum(np.rint(self._correlate(*exact)), 0.0)
        self._spectra = exact[0].astype(np.complex64), exact[1].astype(np.complex64)

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
        least = 1e-5 * np.sqrt(max(var1.max(), 0.0) * max(var2.max(), 0.0)) + 1e-300
        norm = np.sqrt(np.maximum(var1, 0.0) * np.maximum(var2, 0.0))
        coefficient: Array = np.where(norm > least, covariance / np.maximum(norm, least), 0.0)
        return np.clip(coefficient, -0.9999, 0.9999)

    def shifts_px(self, index: Array) -> Array:
        """Shifts (x, y) between centres that pixels (y, x) of the coefficients stand for, shape (n, 2)."""
        shifts: Array = (index - self.origin)[..., ::-1] - self._center
        return shifts

    def peaks(self, one: Array, two: Array, prior: Expected | None) -> list[tuple[float, Array]]:
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

    def _transform(self, values: Array) -> Spectrum:
        """In 32 bits: half the time, and a coefficient is known to five digits."""
        from scipy.fft import rfft2

        return rfft2(values.astype(np.float32), self._fft)

    def _correlate(self, first: Spectrum, second: Spectrum) -> Array:
        """sum over p of first(p) second(p + s), s from minus the size of the first up."""
        from scipy.fft import irfft2

        product = irfft2(np.conj(first) * second, self._fft)
        rolled: Array = np.roll(product, tuple(self.origin), axis=(0, 1))[: self._full[0], : self._full[1]]
        return rolled
