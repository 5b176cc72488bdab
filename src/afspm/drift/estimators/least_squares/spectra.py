"""Power spectra of images, and the filter that the fine alignment sees them through."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLUR_PX = 0.7  # takes what interpolation would alias


def cosine_frequencies(shape: tuple[int, int]) -> Array:
    """Length of the frequency of each coefficient of a cosine transform, cycles per pixel."""
    fy, fx = (np.arange(n) / (2.0 * n) for n in shape)
    length: Array = np.hypot(fy[:, None], fx[None, :])
    return length


def fine_filtered(first: Array, second: Array) -> tuple[Array, Array]:
    """Both images through the same radial filter H = sqrt(2 S / (2 S + N)) exp(-2 pi² f² 0.7²).

    Applied to both of two noisy images, H² weighs each frequency as the maximum-likelihood processor does (Hannan and
    Thomson, Biometrika 58, 77, 1971; Knapp and Carter, IEEE Trans. ASSP 24, 320, 1976). S and N come from the radial
    mean of both spectra: N is its floor in the top octave, and S, the rest, is taken flat below its peak: a filter
    that whitens low frequencies would have a long impulse response, and the borders would leak across the image.
    """
    from scipy.fft import dctn, idctn

    transforms = [dctn(values, norm="ortho") for values in (first, second)]
    bins = np.arange(0.0, 0.72, max(1.0 / min(t.shape[0] for t in transforms), 1.0 / 64))
    power, count = np.zeros(bins.size + 1), np.zeros(bins.size + 1)
    where = [np.digitize(cosine_frequencies(t.shape), bins) for t in transforms]
    for transform, index in zip(transforms, where, strict=True):
        power += np.bincount(index.ravel(), (transform**2).ravel(), bins.size + 1)
        count += np.bincount(index.ravel(), minlength=bins.size + 1)
    power = power[1:] / np.maximum(count[1:], 1.0)
    floor = float(np.median(np.concatenate([t[cosine_frequencies(t.shape) > 0.35] ** 2 for t in transforms]))) / 0.4549
    signal = np.maximum(power - floor, 0.0)
    peak = int(np.argmax(signal))
    signal[:peak] = signal[peak]
    gain = np.sqrt(2.0 * signal / (2.0 * signal + floor + 1e-300))
    out = []
    for transform in transforms:
        f = cosine_frequencies(transform.shape)
        h = np.interp(f, bins + (bins[1] - bins[0]) / 2, gain) * np.exp(-2.0 * (np.pi * f * BLUR_PX) ** 2)
        out.append(idctn(transform * h, norm="ortho"))
    return out[0], out[1]


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
