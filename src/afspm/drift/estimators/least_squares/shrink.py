"""What of an image is signal, patch by patch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.spectra import MEDIAN_POWER

Array = NDArray[np.float64]

PATCH_PX, STEP_PX = 8, 4
CERTAIN = 9.0  # times its noise power must a coefficient have to be kept for its own sake


def denoised(image: Array, noise: Array) -> Array:
    """An image with the coefficients of its patches' cosine transforms shrunk by what noise has in them.

    Where a surface is flat its gradient is noise. Multiplied with the noise of the residual it blurs the estimate and
    makes it look certain, the more the less of the image is edges; a bound knows the true gradient and has no such
    term. Coefficients c of overlapping patches are shrunk by the larger of two gains: the garrote 1 - k N / c²
    (Breiman, Technometrics 37, 373, 1995), which keeps features, and Wiener's S / (S + N), which keeps the texture that
    all patches have in common. The power of noise N and texture S of each coefficient are medians over the patches, so
    that rows, which have more noise across than along, and features are both allowed for.

    Args:
        noise: an image of noise alone, as strong as it is in `image`.
    """
    from scipy.fft import dct

    basis = dct(np.eye(PATCH_PX), norm="ortho", axis=0)
    padded = np.pad(image, [(PATCH_PX, PATCH_PX + STEP_PX)] * 2, mode="reflect")
    coefficients = basis @ _patches(padded) @ basis.T
    squares = coefficients**2
    apart = PATCH_PX // STEP_PX  # patches that don't overlap hold as much
    power = _typical((basis @ _patches(noise)[::apart, ::apart] @ basis.T) ** 2) + 1e-300
    texture = np.maximum(_typical(squares[::apart, ::apart]) - power, 0.0)
    gain = np.maximum(1.0 - CERTAIN * power / np.maximum(squares, 1e-300), texture / (texture + power))
    return _joined(basis.T @ (coefficients * gain) @ basis, padded.shape)[
        PATCH_PX : PATCH_PX + image.shape[0], PATCH_PX : PATCH_PX + image.shape[1]
    ]


def _typical(squares: Array) -> Array:
    """Variance of each coefficient, from the median over the patches."""
    median: Array = np.median(squares.reshape(-1, PATCH_PX, PATCH_PX), axis=0) / MEDIAN_POWER
    return median


def _patches(image: Array) -> Array:
    """[row of patches, column of patches, y, x]"""
    windows = np.lib.stride_tricks.sliding_window_view(image, (PATCH_PX, PATCH_PX))
    return windows[::STEP_PX, ::STEP_PX]


def _joined(patches: Array, shape: tuple[int, ...]) -> Array:
    """The mean of all patches that cover a pixel."""
    total, count = np.zeros(shape), np.zeros(shape)
    ny, nx = patches.shape[:2]
    for dy in range(PATCH_PX):
        for dx in range(PATCH_PX):
            at = np.s_[dy : dy + STEP_PX * ny : STEP_PX, dx : dx + STEP_PX * nx : STEP_PX]
            total[at] += patches[:, :, dy, dx]
            count[at] += 1.0
    mean: Array = total / np.maximum(count, 1.0)
    return mean
