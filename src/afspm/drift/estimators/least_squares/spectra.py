"""Power spectra of images, and the filter that the fine alignment sees them through."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MEDIAN_POWER = 0.4549  # median of the square of a normal value of unit variance
BLUR_PX = 0.45  # takes what interpolation would alias


def cosine_frequencies(shape: tuple[int, ...]) -> Array:
    """Length of the frequency of each coefficient of a cosine transform, cycles per pixel."""
    fy, fx = (np.arange(n) / (2.0 * n) for n in shape)
    length: Array = np.hypot(fy[:, None], fx[None, :])
    return length


@dataclass(frozen=True, eq=False)
class FineFilter:
    """The radial filter H = sqrt(2 S / (2 S + N)) exp(-2 pi² f² 0.45²) through which the fine alignment sees both.

    Applied to both of two noisy images, H² weighs each frequency as the maximum-likelihood processor does (Hannan and
    Thomson, Biometrika 58, 77, 1971; Knapp and Carter, IEEE Trans. ASSP 24, 320, 1976). S and N come from the radial
    mean of both spectra: N is its floor in the top octave, and S, the rest, is taken flat below its peak: a filter
    that whitens low frequencies would have a long impulse response, and the borders would leak across the image.

    Attributes:
        frequency: per pixel, ascending.
        gain: sqrt(2 S / (2 S + N)) there.
    """

    frequency: Array
    gain: Array

    @classmethod
    def of(cls, first: Array, second: Array) -> FineFilter:
        """For two images."""
        from scipy.fft import dctn

        shapes = [first.shape, second.shape]
        squares = np.concatenate([dctn(values, norm="ortho").ravel() ** 2 for values in (first, second)])
        length = np.concatenate([cosine_frequencies(shape).ravel() for shape in shapes])
        width = max(1.0 / min(*first.shape, *second.shape), 1.0 / 64)
        index = (length / width).astype(np.intp)
        power = np.bincount(index, squares) / np.maximum(np.bincount(index), 1)
        floor = float(np.median(squares[length > 0.35])) / MEDIAN_POWER
        signal = np.maximum(power - floor, 0.0)
        signal[: np.argmax(signal)] = signal.max()
        gain = np.sqrt(2.0 * signal / (2.0 * signal + floor + 1e-300))
        return cls((np.arange(power.size) + 0.5) * width, gain)

    def at(self, frequency: Array) -> Array:
        """H"""
        h: Array = np.interp(frequency, self.frequency, self.gain) * np.exp(-2.0 * (np.pi * frequency * BLUR_PX) ** 2)
        return h

    def applied(self, values: Array) -> Array:
        """An image, filtered."""
        from scipy.fft import dctn, idctn

        filtered: Array = idctn(dctn(values, norm="ortho") * self.at(cosine_frequencies(values.shape)), norm="ortho")
        return filtered

    def along_rows(self, frequency: Array) -> Array:
        """What it makes of the power of noise that each row has by itself, at frequencies along the rows."""
        across = (np.arange(64) + 0.5) / 128
        power: Array = np.mean(self.at(np.hypot(frequency[:, None], across)) ** 2, axis=1)
        return power


def independent_values(first: Array, second: Array) -> float:
    """How many independent values each pixel brings to the correlation of two images: S(P1) S(P2) / S(P1 P2) / n, with
    the sums S over all n frequencies of their power spectra (Bartlett, J. R. Stat. Soc. Suppl. 8, 27, 1946)."""
    from scipy.fft import fft2

    shape = tuple(np.maximum(first.shape, second.shape).tolist())
    p1, p2 = (np.abs(fft2(v - v.mean(), shape)) ** 2 for v in (first, second))
    return float(p1.mean() * p2.mean() / max(float(np.mean(p1 * p2)), 1e-300))


def shared_information(one: Array, two: Array) -> float:
    """Mutual information of two aligned images of the same box, nats: -1/2 sum of n ln(1 - coherence²) over rings of
    frequencies, less what noise alone would give."""
    from scipy.fft import dctn

    a, b = dctn(one, norm="ortho"), dctn(two, norm="ortho")
    index = np.minimum((cosine_frequencies(a.shape) * 48).astype(int), 24).ravel()
    aa, bb, ab, n = (
        np.bincount(index, v, 25) for v in ((a * a).ravel(), (b * b).ravel(), (a * b).ravel(), np.ones(a.size))
    )
    coherence2 = ab**2 / np.maximum(aa * bb, 1e-300)
    return float(np.sum(-0.5 * n * np.log1p(-np.minimum(coherence2, 1.0 - 1e-12)) - 0.5 * (n > 0)))
