"""Noise models of images: power spectra and a filter from them, noise along rows, shrinkage of noisy gradients."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from afspm.components import Array

Real = TypeVar("Real", np.float32, np.float64)

MEDIAN_POWER = 0.4549  # median of the square of a normal value of unit variance
TOP = 0.35  # cycles per pixel: the upper half of the top octave
BLUR_PX = 0.45  # removes frequencies that interpolation would alias


def cosine_frequencies(shape: tuple[int, ...]) -> Array:
    """Return the frequency of each coefficient of a cosine transform, in cycles per pixel."""
    fy, fx = (np.arange(n) / (2.0 * n) for n in shape)
    length: Array = np.hypot(fy[:, None], fx[None, :])
    return length


@dataclass(frozen=True, eq=False)
class FineFilter:
    """Radial filter H = sqrt(2 S / (2 S + N)) exp(-2 pi² f² 0.45²), applied to both images in the fine alignment.

    Applied to two noisy images, H² weighs each frequency as the maximum-likelihood processor does (Hannan and Thomson,
    Biometrika 58, 77, 1971; Knapp and Carter, IEEE Trans. ASSP 24, 320, 1976). S comes from the radial
    mean of both spectra, N from the median power in the top octave. S is the mean minus N, taken flat below its peak:
    a filter that whitens low frequencies would have a long impulse response, and the borders would leak across the
    image.

    Attributes:
        frequency: frequencies in cycles per pixel, ascending.
        gain: sqrt(2 S / (2 S + N)) at each frequency.
        sharpness: share of the gradients, as power, in the upper half of the top octave; 1 for features of single
            pixels.
    """

    frequency: Array
    gain: Array
    sharpness: float

    @classmethod
    def of(cls, first: Array, second: Array) -> FineFilter:
        """Return the filter estimated from two images."""
        from scipy.fft import dctn

        shapes = [first.shape, second.shape]
        squares = np.concatenate([dctn(values, norm="ortho").ravel() ** 2 for values in (first, second)])
        length = np.concatenate([cosine_frequencies(shape).ravel() for shape in shapes])
        width = max(1.0 / min(*first.shape, *second.shape), 1.0 / 64)
        index = (length / width).astype(np.intp)
        count = np.bincount(index)
        power = np.bincount(index, squares) / np.maximum(count, 1)
        floor = float(np.median(squares[length > TOP])) / MEDIAN_POWER
        signal = np.maximum(power - floor, 0.0)
        frequency = (np.arange(power.size) + 0.5) * width
        gradients = np.where(frequency < 0.5, signal * count * frequency**2, 0.0)
        sharpness = float(gradients[frequency > TOP].sum() / max(gradients.sum(), 1e-300))
        signal[: np.argmax(signal)] = signal.max()
        gain = np.sqrt(2.0 * signal / (2.0 * signal + floor + 1e-300))
        return cls(frequency, gain, sharpness)

    def at(self, frequency: Array) -> Array:
        h: Array = np.interp(frequency, self.frequency, self.gain) * np.exp(-2.0 * (np.pi * frequency * BLUR_PX) ** 2)
        return h

    def applied(self, values: Array) -> Array:
        from scipy.fft import dctn, idctn

        filtered: Array = idctn(dctn(values, norm="ortho") * self.at(cosine_frequencies(values.shape)), norm="ortho")
        return filtered

    def along_rows(self, frequency: Array) -> Array:
        """Return the power spectrum along rows of unit white noise after the filter, at given frequencies."""
        across = (np.arange(64) + 0.5) / 128
        power: Array = np.mean(self.at(np.hypot(frequency[:, None], across)) ** 2, axis=1)
        return power


def independent_values(first: Array, second: Array) -> float:
    """Return the number of independent values per pixel in the correlation of two images.

    S(P1) S(P2) / S(P1 P2) / n, with the sums S over all n frequencies of their power spectra (Bartlett,
    J. R. Stat. Soc. Suppl. 8, 27, 1946).
    """
    from scipy.fft import fft2

    shape = tuple(np.maximum(first.shape, second.shape).tolist())
    p1, p2 = (np.abs(fft2(v - v.mean(), shape)) ** 2 for v in (first, second))
    return float(p1.mean() * p2.mean() / max(float(np.mean(p1 * p2)), 1e-300))


BLOCK_ROWS = 8
BLOCKS = 8  # least number of blocks if rows are few, each of two rows or more
CACHED = 1 << 15  # numbers that fit into the processor's cache
ROWS_AT_ONCE = 16
"""Number of rows, about, that are multiplied by the metric at once. Each product reads the whole metric, 4 MB for 1024
columns: with two rows at once (as many as fit into the cache) reading took two thirds of the time."""
LEAST_NOISE = 1e-8
"""Least variance, with the scan's variance 1: scans have a few digits, and agreement beyond them means nothing."""
HIGHEST_FREQUENCY = 0.22  # per pixel; above this frequency the filter leaves little of the residuals


@dataclass(frozen=True, eq=False)
class CrossingLines:
    """The lines of a scan that is rotated against the grid; each line has its own unknown parabola.

    Attributes:
        number: [y, x], number of the line nearest to each pixel of the grid, in half lines from 0.
        along: [y, x], position of the pixel along its line, about -1 to 1.
    """

    number: NDArray[np.intp]
    along: Array

    @classmethod
    def of(cls, x: Array, y: Array) -> CrossingLines:
        """Return the lines, from the scan's own pixel coordinates (x, y) at each grid point, [y, x].

        Lines are numbered in half steps, since a pixel between two lines shows both in part.
        """
        half = np.rint(2.0 * y).astype(np.intp)
        return cls(half - half.min(), 2.0 * (x - x.min()) / max(float(np.ptp(x)), 1.0) - 1.0)

    def seen(self, columns: NDArray[Real], weight: Array) -> NDArray[Real]:
        """Return the result of the function `seen` for white noise, also without the parabolas of the crossing lines.

        Both sets of parabolas are projected away in turn (von Neumann, Functional Operators II, 1950).
        """
        root = np.sqrt(weight)
        left = (columns * root[:, None, :]).astype(columns.dtype)
        basis, inverse = self._basis(root)
        shape = left.transpose(0, 2, 1).shape
        for _ in range(PROJECTIONS):
            left = _less_lines(left, root.astype(columns.dtype)[:, None, :])
            pixels = left.transpose(0, 2, 1).reshape(-1, columns.shape[1])
            sums = (basis.T @ pixels).reshape(len(inverse), 3, -1)
            pixels = pixels - basis @ (inverse @ sums).reshape(3 * len(inverse), -1)
            left = pixels.reshape(shape).transpose(0, 2, 1).astype(columns.dtype)
        return np.asarray(left * root[:, None, :], dtype=columns.dtype)

    def _basis(self, root: Array) -> tuple[Any, Array]:
        # 1, x, x² of each line as (pixel, 3 lines), sparse, and the inverse of their products
        from scipy.sparse import csr_array

        number, count = self.number.ravel(), int(self.number.max()) + 1
        powers = root.ravel()[:, None] * self.along.ravel()[:, None] ** np.arange(3)
        places = 3 * number[:, None] + np.arange(3)
        basis = csr_array((powers.ravel(), places.ravel(), np.arange(0, powers.size + 1, 3)), (number.size, 3 * count))
        gram = np.stack([
            [np.bincount(number, powers[:, k] * powers[:, m], count) for m in range(3)] for k in range(3)
        ])  # fmt: skip
        return basis, np.asarray(np.linalg.inv(gram.transpose(2, 0, 1) + 1e-5 * np.eye(3)), dtype=np.float64)


PROJECTIONS = 4


def seen(
    columns: NDArray[Real], weight: Array, metric: Array | None, crossing: CrossingLines | None = None
) -> NDArray[Real]:
    """Return Q f with parabolas removed: its product with another image g is f'Qg without the parabolas of both.

    Generalised least squares row by row: each row has its own parabola, and correlated noise. A row takes seconds, and
    the next row has new offsets (feedback, flattening by up to the second order, drift of the z piezo). So nothing is
    assumed about the parabola of a row, and the noise within a row is white plus 1/f, with covariance C and Q = C^-1.
    The rest of a row f after a fit of the nuisance B = [1, x, x²] in this metric, f - B (B'QB)^-1 B'Q f, carries all
    information of the row (Frisch and Waugh, Econometrica 1, 387, 1933; Aitken, Proc. R. Soc. Edinb. 55, 42, 1936).

    Args:
        columns: [y, column, x].
        weight: [y, x] of each pixel; 0 for unknown pixels. f and g are multiplied by its root.
        metric: Q, (x, x); None: white noise.
        crossing: lines of the other scan, if they lie across the rows; the noise is then taken as white.

    Returns:
        Like `columns`; the root of the weight of g is included.
    """
    if crossing is not None:
        return crossing.seen(columns, weight)
    if metric is None and weight.min() == 1.0 == weight.max():
        parabolas: NDArray[Real] = _parabolas(columns.shape[2]).astype(columns.dtype)
        return np.asarray(columns - (columns @ parabolas) @ parabolas.T, dtype=columns.dtype)
    found = np.empty_like(columns)
    metric_there = None if metric is None else metric.astype(columns.dtype)
    few: int = max(1, CACHED // columns[0].size)
    at_once: int = few if metric is None else few * max(1, ROWS_AT_ONCE // few)
    # the last rows stay apart: products of very few rows are summed in another order, and results would differ
    whole: int = len(columns) - len(columns) % few
    for first, last in pairwise((*range(0, whole, at_once), whole, len(columns))):
        some = slice(first, last)
        found[some] = _seen(columns[some], weight[some], metric_there)
    return found


@cache
def _parabolas(width: int) -> Array:
    x = np.linspace(-1.0, 1.0, width)
    return np.linalg.qr(np.stack([np.ones(width), x, x**2], axis=1))[0]


def _seen(columns: NDArray[Real], weight: Array, metric: NDArray[Real] | None) -> NDArray[Real]:
    # rows in blocks that fit into the processor's cache: half the time
    root = np.sqrt(weight).astype(columns.dtype)[:, None, :]
    x = np.linspace(-1.0, 1.0, columns.shape[2], dtype=columns.dtype)
    rows, lines = columns * root, np.concatenate([root, root * x, root * x**2], axis=1)
    rows_q, lines_q = (rows, lines) if metric is None else (_along_rows(rows, metric), _along_rows(lines, metric))
    # some rows have fewer known pixels than a parabola has parameters
    gram = lines @ lines_q.transpose(0, 2, 1) + 1e-5 * np.eye(3, dtype=columns.dtype)
    fitted = np.linalg.solve(gram, lines_q @ rows.transpose(0, 2, 1)).transpose(0, 2, 1)
    rows_q -= fitted @ lines_q
    rows_q *= root
    return np.asarray(rows_q, dtype=columns.dtype)


def _along_rows(columns: NDArray[Real], metric: NDArray[Real]) -> NDArray[Real]:
    # one large product takes a quarter of the time of a product for each row
    return (columns.reshape(-1, metric.shape[0]) @ metric).reshape(columns.shape)


def _less_lines(rows: NDArray[Real], root: NDArray[Real]) -> NDArray[Real]:
    x = np.linspace(-1.0, 1.0, rows.shape[2], dtype=rows.dtype)
    lines = np.concatenate([root, root * x, root * x**2], axis=1)
    gram = lines @ lines.transpose(0, 2, 1) + 1e-5 * np.eye(3, dtype=rows.dtype)
    fitted = np.linalg.solve(gram, lines @ rows.transpose(0, 2, 1)).transpose(0, 2, 1)
    return np.asarray(rows - fitted @ lines, dtype=rows.dtype)


def without_lines(values: Array, known: NDArray[np.bool_], crossing: CrossingLines | None = None) -> Array:
    """Subtract a fitted parabola from each row of [y, x], and from each crossing line; unknown pixels become 0."""
    return seen(values[:, None], known.astype(np.float64), None, crossing)[:, 0]


def products(one: NDArray[Real], two: NDArray[Real]) -> Array:
    """Return the sums of products of columns, [y, column, x], over blocks of rows: (block, columns of one, of two).

    If `one` comes from `seen`, the parabolas of `two` cancel, but only in whole rows.
    """
    starts = np.arange(0, one.shape[0], min(max(one.shape[0] // BLOCKS, 2), BLOCK_ROWS))
    sums: Array = np.add.reduceat(one @ two.transpose(0, 2, 1), starts, axis=0, dtype=np.float64)
    return sums


def noise_metric(residual: Array, known: NDArray[np.bool_], seen_through: FineFilter) -> Array | None:
    """Return the metric Q of white and 1/f noise; None if the noise is nearly white (b W <= 0.3 a, with W the width).

    The result is also None for small images and for a residual without noise. N(f) = a + b / f is fitted to the median
    row spectrum of a residual, corrected for the filter.
    """
    from scipy.linalg import inv, toeplitz
    from scipy.optimize import nnls

    width = residual.shape[1]
    whole = known.all(axis=1)
    if whole.sum() < 16 or width < 24:
        return None
    spectrum = np.abs(np.fft.rfft(residual[whole], axis=1)) ** 2 / width
    f = np.arange(spectrum.shape[1]) / width
    used = (f < HIGHEST_FREQUENCY) & (f > 1.5 / width)
    power = np.median(spectrum[:, used], axis=0) / np.log(2.0) / seen_through.along_rows(f[used])
    if not power.max() > LEAST_NOISE:
        return None
    model = np.stack([np.ones(used.sum()), 1.0 / f[used]], axis=1)
    expected = power
    for _ in range(3):  # the scatter of a spectrum is proportional to its expectation
        (a, b), _ = nnls(model / expected[:, None], power / expected)
        expected = np.maximum(model @ (a, b), 1e-3 * power.max())
    if not b * width > 0.3 * a:
        return None
    dense = np.arange(1, 2 * width + 1) / (4.0 * width)
    covariance = b * (np.cos(2.0 * np.pi * np.outer(np.arange(width), dense)) @ (1.0 / dense)) / (2.0 * width)
    covariance[0] += max(a, 0.02 * covariance[0])
    return np.asarray(inv(toeplitz(covariance / covariance[0])), dtype=np.float64)


Small = NDArray[np.float32]

PATCH_PX, STEP_PX = 8, 4
TINY = np.finfo(np.float32).tiny
ENOUGH_PATCHES = 1500
CERTAIN = 9.0  # ratio to the noise power from which a coefficient is kept on its own


def denoised(image: Array, noise: Array) -> tuple[Array, Array]:
    """Shrink the coefficients of the cosine transforms of an image's patches by their noise.

    On a flat surface the gradient is noise. Its product with the noise of the residual biases the estimate and makes it
    look too certain, most of all in images with few edges; a bound with the true gradient has no such term.
    Coefficients c of overlapping patches are shrunk by the larger of two gains: the garrote 1 - k N / c² (Breiman,
    Technometrics 37, 373, 1995), which keeps features, and Wiener's S / (S + N), which keeps the texture common to all
    patches. The power of noise N and texture S of each coefficient are medians over the patches; this allows for
    features, and for rows, which have more noise across than along.

    Args:
        noise: an image of independent noise, as strong as the noise in `image`.

    Returns:
        The shrunk image, and its derivative in the direction of the noise. The product of the derivative with the noise
        is on average the product of the shrunk image with the noise in `image` (Stein, Ann. Stat. 9, 1135, 1981; with
        generated noise: Ramani, Blu and Unser, IEEE Trans. Image Process. 17, 1540, 2008).
    """
    c, n = _coefficients(image), _coefficients(noise)  # in 32 bits: half the time, and precise enough for a weight
    # patches without overlap hold as much information, and some of many are enough
    apart = max(PATCH_PX // STEP_PX, math.isqrt(c[..., 0].size // ENOUGH_PATCHES))
    power = _typical(n[::apart, ::apart] ** 2) + TINY
    texture = np.maximum(_typical(c[::apart, ::apart] ** 2) - power, 0.0)
    # below the power of the noise the garrote is not the larger gain, and c² may be too small to divide by
    garrote, wiener = 1.0 - CERTAIN * power / np.maximum(c**2, power), texture / (texture + power)
    gain = np.maximum(garrote, wiener)
    change = np.where(garrote > wiener, 2.0 - gain, wiener)  # derivative of c times its gain
    return _image(c * gain, image.shape), _image(n * change, image.shape)


def _typical(squares: Small) -> Small:
    # variance from the median over the patches
    by_coefficient = np.ascontiguousarray(squares.reshape(-1, squares.shape[2]).T)
    return np.asarray(np.median(by_coefficient, axis=1, overwrite_input=True) / MEDIAN_POWER, dtype=np.float32)


@cache
def _basis() -> Small:
    from scipy.fft import dct

    one = dct(np.eye(PATCH_PX), norm="ortho", axis=0)
    both = np.asarray(np.kron(one, one), dtype=np.float32)
    both.flags.writeable = False
    return both


def _coefficients(image: Array) -> Small:
    padded = np.pad(image.astype(np.float32), [(PATCH_PX, PATCH_PX + STEP_PX)] * 2, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (PATCH_PX, PATCH_PX))[::STEP_PX, ::STEP_PX]
    found: Small = windows.reshape(*windows.shape[:2], -1) @ _basis().T
    return found


def _image(coefficients: Small, shape: tuple[int, ...]) -> Array:
    ny, nx = coefficients.shape[:2]
    times = PATCH_PX // STEP_PX
    patches = (coefficients @ _basis()).reshape(ny, nx, times, STEP_PX, times, STEP_PX)
    total = np.zeros((ny + times - 1, STEP_PX, nx + times - 1, STEP_PX), dtype=np.float32)
    for dy in range(times):
        for dx in range(times):
            total[dy : dy + ny, :, dx : dx + nx, :] += patches[:, :, dy, :, dx, :].transpose(0, 2, 1, 3)
    inner = np.s_[PATCH_PX : PATCH_PX + shape[0], PATCH_PX : PATCH_PX + shape[1]]
    return total.reshape(total.shape[0] * STEP_PX, -1)[inner].astype(np.float64) / times**2
