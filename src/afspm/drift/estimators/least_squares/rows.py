"""Generalised least squares row by row: each row has an offset and a tilt of its own, and noise with a memory.

A row is scanned in seconds and the next one begins anew (feedback, flattening, drift of the z piezo), so nothing is
assumed of the offset and tilt of a row, and the noise within it is white plus 1/f, with covariance C and Q = C^-1. What
is left of a row f after the nuisance B = [1, x] is fitted in this metric, f - B (B'QB)^-1 B'Q f, carries all that the
row tells (Frisch and Waugh, Econometrica 1, 387, 1933; Aitken, Proc. R. Soc. Edinb. 55, 42, 1936).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HIGHEST_FREQUENCY = 0.22  # per pixel, of the spectrum of residuals: above it the fine filter colours them


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations of blocks of the image, to be summed.

    Attributes:
        blocks: (n, 8, 8), J'QJ with the residual as the last column.
    """

    blocks: Array

    @property
    def matrix(self) -> Array:
        """(7, 7)"""
        total: Array = self.blocks.sum(axis=0)[:7, :7]
        return total

    @property
    def vector(self) -> Array:
        """(7,)"""
        total: Array = self.blocks.sum(axis=0)[:7, 7]
        return total

    @property
    def power(self) -> float:
        """r'Qr"""
        return float(self.blocks[:, 7, 7].sum())


def projected(columns: Array, weight: Array, metric: Array | None) -> tuple[Array, Array]:
    """Rows without their offset and tilt.

    Args:
        columns: [y, column, x].
        weight: [y, x] of each pixel; 0 where nothing is known.
        metric: Q, (x, x); None: white noise.

    Returns:
        f and Q f, each like `columns`.
    """
    root = np.sqrt(weight)[:, None, :]
    rows = columns * root
    x = np.linspace(-1.0, 1.0, columns.shape[2])
    nuisance = np.concatenate([root, root * x], axis=1)
    seen, nuisance_seen = (rows, nuisance) if metric is None else (rows @ metric, nuisance @ metric)
    gram = nuisance @ nuisance_seen.transpose(0, 2, 1)
    gram += 1e-9 * np.eye(2)  # rows of which nothing is known
    fitted = np.linalg.solve(gram, nuisance_seen @ rows.transpose(0, 2, 1)).transpose(0, 2, 1)
    return rows - fitted @ nuisance, seen - fitted @ nuisance_seen


def normal_equations(columns: Array, weight: Array, metric: Array | None, block_rows: int = 8) -> Normal:
    """Of blocks of `block_rows` rows and half of their length."""
    rows, seen = projected(columns, weight, metric)
    ny, _, nx = rows.shape
    half = nx // 2
    parts = [rows[:, :, s] @ seen[:, :, s].transpose(0, 2, 1) for s in (slice(0, half), slice(half, nx))]
    starts = np.arange(0, ny, block_rows)
    blocks = np.concatenate([np.add.reduceat(part, starts, axis=0) for part in parts])
    return Normal((blocks + blocks.transpose(0, 2, 1)) / 2)


def noise_metric(residual: Array, known: NDArray[np.bool_]) -> Array | None:
    """Q of white and 1/f noise, N(f) = a + b / f, fitted to the spectra of the rows of a residual (median over rows).

    None: it is as good as white (b W <= 0.3 a).
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
    power = np.median(spectrum[:, used], axis=0) / np.log(2.0)
    model = np.stack([np.ones(used.sum()), 1.0 / f[used]], axis=1)
    expected = power
    for _ in range(3):  # the scatter of a spectrum is in proportion to what is expected of it
        (a, b), _ = nnls(model / expected[:, None], power / expected)
        expected = np.maximum(model @ (a, b), 1e-3 * power.max())
    if not b * width > 0.3 * a:
        return None
    dense = np.arange(1, 2 * width + 1) / (4.0 * width)
    covariance = b * (np.cos(2.0 * np.pi * np.outer(np.arange(width), dense)) @ (1.0 / dense)) / (2.0 * width)
    covariance[0] += max(a, 0.02 * covariance[0])
    return np.asarray(inv(toeplitz(covariance / covariance[0])), dtype=np.float64)
