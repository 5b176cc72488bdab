"""Search for the displacement: candidates from normalised cross-correlation, and the most likely candidate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.components import Array
from afspm.plugins.drift.pairs.images import CommonGrid, Mask
from afspm.plugins.drift.pairs.noise import independent_values, without_lines
from afspm.plugins.drift.pairs.warp import COUNT, OverlapBox, Scene, WarpedPair
from afspm.plugins.drift.registration import DriftScan, Prior
from afspm.plugins.drift.registration.alignment import COARSE, SHIFT, Believed, least_squares

GATE = 25.0  # chi² of an expected shift, the limit of the search


@dataclass(frozen=True, eq=False)
class ExpectedShift:
    """Expected shift in px, with its covariance in px²."""

    mean: Array
    covariance: Array

    @classmethod
    def of(cls, prior: Prior, grid: CommonGrid) -> ExpectedShift:
        inverse = np.linalg.inv(grid.to_m)
        return cls(grid.shift_px(prior.mean_m), inverse @ prior.covariance_m2 @ inverse.T)

    def chi2(self, shift_px: Array) -> Array:
        """Return chi² of shifts relative to the expectation; shifts have shape (..., 2)."""
        off = shift_px - self.mean
        chi2: Array = np.einsum("...i,ij,...j", off, np.linalg.inv(self.covariance), off)
        return chi2

    @property
    def area_px2(self) -> float:
        """Area of the searched ellipse, in px²."""
        return float(GATE * math.pi * np.sqrt(np.linalg.det(self.covariance)))

    def surprise(self, shift_px: Array, covariance: Array) -> float:
        """Return chi² of an estimate relative to the expectation, including the estimate's covariance."""
        off = shift_px - self.mean
        return float(off @ np.linalg.solve(self.covariance + covariance, off))

    def on_smaller(self, factor: int, offset_px: Array) -> ExpectedShift:
        """Return the expectation for images with pixels `factor` times as large, and centres `offset_px` apart."""
        mean: Array = (self.mean - offset_px) / factor
        return ExpectedShift(mean, self.covariance / factor**2 + 0.3 * np.eye(2))


def shear_by_drift(prior: Prior | None, reference: DriftScan, scan: DriftScan) -> tuple[Array, float | None]:
    """Return the displacement of rows by drift, in m per m along the slow axis, and its standard deviation.

    Drift displaces a row by v t, and t increases along the slow axis. The result is (zero, None) unless the prior knows
    the velocity and both scans have the same direction, angle and pace: the prior contains only the difference of
    their velocities.
    """
    nothing = np.zeros(2), None
    if prior is None or prior.velocity_sd_m_s is None or reference.upwards is None:
        return nothing
    slow = [scan.duration_s / scan.region.size_m[1] for scan in (reference, scan)]
    turned = math.remainder(scan.region.angle_rad - reference.region.angle_rad, 2.0 * math.pi)
    if reference.upwards != scan.upwards or abs(turned) > 0.1 or not max(slow) <= 1.1 * min(slow):
        return nothing
    pace_s_m = (slow[0] + slow[1]) / 2 * (1.0 if scan.upwards else -1.0)
    return prior.velocity_difference_m_s * pace_s_m, prior.velocity_sd_m_s * abs(pace_s_m)


Spectrum = NDArray[np.complexfloating]

LEAST_OVERLAP = 0.2  # share of the smaller image
PEAKS = 4  # number of peaks kept for each channel (smooth, band)
APART_PX = 1.5  # nearer peaks count as the same peak


def candidates(scene: Scene, prior: ExpectedShift | None) -> list[Array]:
    """Return candidate shifts (x, y) in px: the expected shift, if any, then the best correlation peaks, best first."""
    correlation = MaskedCorrelation(scene.first.known, scene.second.known)
    peaks: list[tuple[float, Array]] = []
    for one, two in (scene.smooth, scene.band):
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


class MaskedCorrelation:
    """Normalised cross-correlation of two images with unknown pixels, for all shifts at once.

    Source: Padfield, IEEE Trans. Image Process. 21, 2706, 2012.
    """

    def __init__(self, known1: Mask, known2: Mask, reach_px: int | None = None):
        """Prepare the parts that depend only on the masks.

        Args:
            reach_px: largest shift, for images of one shape; None: any shift with overlap.
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
        """Return the correlation coefficients [y, x]; `shifts_px` converts indices to shifts."""
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
        """Return the shifts (x, y) between centres at pixels (y, x) of the coefficients, shape (n, 2)."""
        shifts: Array = (index - self.origin)[..., ::-1] - self._center
        return shifts

    def peaks(self, one: Array, two: Array, prior: ExpectedShift | None) -> list[tuple[float, Array]]:
        """Return the highest peaks as (height, shift in px), best first.

        The height is atanh(c) sqrt(n), which has the same variance for every overlap n (Fisher).
        """
        from scipy.ndimage import maximum_filter

        enough = self.overlap >= LEAST_OVERLAP * min(mask.sum() for mask in self._masks)
        if prior is not None:
            at = np.stack(np.meshgrid(*(np.arange(n) for n in self._full), indexing="ij"), axis=-1)
            enough &= prior.chi2(self.shifts_px(at)) < GATE
        height = np.where(enough, np.arctanh(self.of(one, two)) * np.sqrt(self.overlap), -np.inf)
        top = (height == maximum_filter(height, 3)) & (height > 0.0)
        index = np.argwhere(top)
        best = np.argsort(-height[top])[:PEAKS]
        shifts = self.shifts_px(index[best].astype(np.float64))
        return list(zip(height[top][best].tolist(), shifts, strict=True))

    def _transform(self, values: Array) -> Spectrum:
        # 32 bits: half the time, and a coefficient is known to five digits
        from scipy.fft import rfft2

        return rfft2(values.astype(np.float32), self._fft)

    def _correlate(self, first: Spectrum, second: Spectrum) -> Array:
        # sum over p of first(p) second(p + s), s from minus the size of the first up
        from scipy.fft import irfft2

        product = irfft2(np.conj(first) * second, self._fft)
        rolled: Array = np.roll(product, tuple(self.origin), axis=(0, 1))[: self._full[0], : self._full[1]]
        return rolled


NOTHING_BELIEVED = Believed(np.zeros(COUNT), np.zeros((COUNT, COUNT)))
OTHER_PX = 2.0  # a second-best shift nearer than this is the same match
LEFT_PX = 4.0  # steps beyond this have left the peak of their candidate
REPEATS = 0.65
"""Share of the best likelihood, from which a rival makes the search fit the distortion of every candidate.

Above it afterwards, too, a match that was not expected is refused.

Where a sample relaxes, likelihoods without distortion compare how well each period happens to fit the relaxation. Of 24
relaxing gratings (1.5 to 6 px) 7 had their best match a period off, and none after each candidate had its own linear
map: it raised the likelihood of right matches by up to 130 %, of others by some 10 %."""


@dataclass(frozen=True, eq=False)
class Scored:
    """A shift in px, with its log-likelihood in nats."""

    shift_px: Array
    likelihood: float


class Scorer:
    """Scorer of shifts: L = sum over channels of -n/2 ln(1 - rho²), plus the prior, with n independent values."""

    def __init__(self, scene: Scene, expected: ExpectedShift | None):
        self._scene = scene
        self._expected = expected
        self._channels = [
            (splines, independent_values(*values))
            for splines, values in ((scene.smooth_splines, scene.smooth), (scene.band_splines, scene.band))
        ]

    def best(self, shifts: list[Array], believed: Believed) -> tuple[Scored, float] | None:
        """Return the most likely shift and the log-likelihood of its best rival; None without enough overlap.

        Where a rival explains more than `REPEATS` as much, each candidate is scored with its own fit of the distortion.
        """
        scored = [s for s in map(self._score, shifts) if s is not None]
        if not scored:
            return None
        best, rival = _ranked(scored)
        if rival > REPEATS * best.likelihood:
            best, rival = _ranked([self._score_distorted(s, believed) for s in scored])
        return best, rival

    def _score(self, shift: Array) -> Scored | None:
        box = self._scene.box(shift)
        if box is None:
            return None
        theta = np.concatenate([shift, np.zeros(COUNT - 2)])
        theta = least_squares(WarpedPair(*self._scene.smooth_splines, box), theta, NOTHING_BELIEVED, SHIFT, steps=2)
        if np.hypot(*(theta[:2] - shift)) > LEFT_PX:
            theta[:2] = shift
        surprise = 0.0 if self._expected is None else float(self._expected.chi2(theta[:2]))
        return Scored(theta[:2], self._likelihood(box, theta) - surprise / 2)

    def _score_distorted(self, scored: Scored, believed: Believed) -> Scored:
        box = self._scene.box(scored.shift_px)
        theta = None if box is None else distorted(self._scene, box, scored.shift_px, believed)
        if box is None or theta is None or not np.hypot(*(theta[:2] - scored.shift_px)) < LEFT_PX:
            return scored
        off = theta - believed.mean
        likelihood = self._likelihood(box, theta) - float(off @ believed.precision @ off) / 2
        return Scored(scored.shift_px, max(likelihood, scored.likelihood))

    def _likelihood(self, box: OverlapBox, theta: Array) -> float:
        likelihood = 0.0
        for splines, density in self._channels:
            one, two, known = WarpedPair(*splines, box).warped(theta)
            rho = max(_correlated(without_lines(one, known).ravel(), without_lines(two, known).ravel()), 0.0)
            likelihood -= 0.5 * density * known.sum() * np.log1p(-(min(rho, 0.99999) ** 2))
        return likelihood


def distorted(scene: Scene, box: OverlapBox, shift: Array, believed: Believed) -> Array:
    """Return theta of the coarse fit from a shift: first the shift alone, then linear map and contrast as well."""
    pair = WarpedPair(*scene.smooth_splines, box)
    theta = np.concatenate([shift, np.zeros(COUNT - 2)])
    theta = least_squares(pair, theta, believed, SHIFT, steps=4)
    return least_squares(pair, theta, believed, COARSE, steps=4)


def _ranked(scored: list[Scored]) -> tuple[Scored, float]:
    best = max(scored, key=lambda s: s.likelihood)
    rest = [s.likelihood for s in scored if np.hypot(*(s.shift_px - best.shift_px)) > OTHER_PX]
    return best, max(rest, default=0.0)


def _correlated(one: Array, two: Array) -> float:
    a, b = one - one.mean(), two - two.mean()
    return float(a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-300))
