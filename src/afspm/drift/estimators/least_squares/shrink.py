"""What of an image is signal, patch by patch."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.spectra import MEDIAN_POWER

Array = NDArray[np.float64]
Small = NDArray[np.float32]

PATCH_PX, STEP_PX = 8, 4
TINY = np.finfo(np.float32).tiny
CERTAIN = 9.0  # times its noise power must a coefficient have to be kept for its own sake


def denoised(image: Array, noise: Array) -> tuple[Array, Array]:
    """An image with the coefficients of its patches' cosine transforms shrunk by what noise has in them.

    Where a surface is flat its gradient is noise. Multiplied with the noise of the residual it blurs the estimate and
    makes it look certain, the more the less of the image is edges; a bound knows the true gradient and has no such
    term. Coefficients c of overlapping patches are shrunk by the larger of two gains: the garrote 1 - k N / c²
    (Breiman, Technometrics 37, 373, 1995), which keeps features, and Wiener's S / (S + N), which keeps the texture that
    all patches have in common. The power of noise N and texture S of each coefficient are medians over the patches, so
    that rows, which have more noise across than along, and features are both allowed for.

    Args:
        noise: an image of noise alone, as strong as it is in `image`, but another.

    Returns:
        The shrunk image, and its derivative in the direction of the noise: the product of that with the noise is, on
        average, the product of the shrunk image with the noise that is in `image` (Stein, Ann. Stat. 9, 1135, 1981;
        with a noise of one's own: Ramani, Blu and Unser, IEEE Trans. Image Process. 17, 1540, 2008).
    """
    c, n = _coefficients(image), _coefficients(noise)  # in 32 bits: half the time, and precise enough for a weight
    apart = PATCH_PX // STEP_PX  # patches that don't overlap hold as much
    power = _typical(n[::apart, ::apart] ** 2) + TINY
    texture = np.maximum(_typical(c[::apart, ::apart] ** 2) - power, 0.0)
    garrote, wiener = 1.0 - CERTAIN * power / np.maximum(c**2, TINY), texture / (texture + power)
    gain = np.maximum(garrote, wiener)
    change = np.where(garrote > wiener, 2.0 - gain, wiener)  # of c times its gain
    return _image(c * gain, image.shape), _image(n * change, image.shape)


def _typical(squares: Small) -> Small:
    """Variance of each coefficient, from the median over the patches."""
    by_coefficient = np.ascontiguousarray(squares.reshape(-1, squares.shape[2]).T)
    return np.asarray(np.median(by_coefficient, axis=1, overwrite_input=True) / MEDIAN_POWER, dtype=np.float32)


@cache
def _basis() -> Small:
    """Of the cosine transform of a patch, in a line each: orthonormal."""
    from scipy.fft import dct

    one = dct(np.eye(PATCH_PX), norm="ortho", axis=0)
    both = np.asarray(np.kron(one, one), dtype=np.float32)
    both.flags.writeable = False
    return both


def _coefficients(image: Array) -> Small:
    """[row of patches, column of patches, coefficient], of the image mirrored at its borders."""
    padded = np.pad(image.astype(np.float32), [(PATCH_PX, PATCH_PX + STEP_PX)] * 2, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (PATCH_PX, PATCH_PX))[::STEP_PX, ::STEP_PX]
    found: Small = windows.reshape(*windows.shape[:2], -1) @ _basis().T
    return found


def _image(coefficients: Small, shape: tuple[int, ...]) -> Array:
    """The inverse: the mean of all patches that cover a pixel."""
    ny, nx = coefficients.shape[:2]
    times = PATCH_PX // STEP_PX
    patches = (coefficients @ _basis()).reshape(ny, nx, times, STEP_PX, times, STEP_PX)
    total = np.zeros((ny + times - 1, STEP_PX, nx + times - 1, STEP_PX), dtype=np.float32)
    for dy in range(times):
        for dx in range(times):
            total[dy : dy + ny, :, dx : dx + nx, :] += patches[:, :, dy, :, dx, :].transpose(0, 2, 1, 3)
    inner = np.s_[PATCH_PX : PATCH_PX + shape[0], PATCH_PX : PATCH_PX + shape[1]]
    return total.reshape(total.shape[0] * STEP_PX, -1)[inner].astype(np.float64) / times**2
