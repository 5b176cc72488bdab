"""Generalised least squares row by row: each row has an offset and a tilt of its own, and noise with a memory.

A row is scanned in seconds and the next one begins anew (feedback, flattening, drift of the z piezo), so nothing is
assumed of the offset and tilt of a row, and the noise within it is white plus 1/f, with covariance C and Q = C^-1. What
is left of a row f after the nuisance B = [1, x] is fitted in this metric, f - B (B'QB)^-1 B'Q f, carries all that the
row tells (Frisch and Waugh, Econometrica 1, 387, 1933; Aitken, Proc. R. Soc. Edinb. 55, 42, 1936).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.spectra import FineFilter

Array = NDArray[np.float64]

BLOCK_ROWS = 8
CACHED = 1 << 15  # numbers
LEAST_NOISE = 1e-8
"""Variance, where that of the scan is 1: digits end somewhere, and two scans that agree beyond are not known better."""
HIGHEST_FREQUENCY = 0.22  # per pixel, of the spectrum of residuals: above it the filter leaves little of them


def seen(columns: Array, weight: Array, metric: Array | None) -> Array:
    """Q f less what lines explain of it, so that the product with another image g is f'Qg free of both their lines.

    Args:
        columns: [y, column, x].
        weight: [y, x] of each pixel; 0 where nothing is known. f and g are multiplied with its root.
        metric: Q, (x, x); None: white noise.

    Returns:
        Like `columns`; the root of the weight of g is in it.
    """
    found = np.empty_like(columns)
    at_once = max(1, CACHED // columns[0].size)
    for first in range(0, len(columns), at_once):
        some = slice(first, first + at_once)
        found[some] = _seen(columns[some], weight[some], metric)
    return found


def _seen(columns: Array, weight: Array, metric: Array | None) -> Array:
    """Of rows that fit into the processor's cache, which halves the time."""
    root = np.sqrt(weight)[:, None, :]
    x = np.linspace(-1.0, 1.0, columns.shape[2])
    rows, lines = columns * root, np.concatenate([root, root * x], axis=1)
    rows_q, lines_q = (rows, lines) if metric is None else (_along_rows(rows, metric), _along_rows(lines, metric))
    gram = lines @ lines_q.transpose(0, 2, 1) + 1e-9 * np.eye(2)  # there may be rows of which nothing is known
    fitted = np.linalg.solve(gram, lines_q @ rows.transpose(0, 2, 1)).transpose(0, 2, 1)
    rows_q -= fitted @ lines_q
    rows_q *= root
    return rows_q


def _along_rows(columns: Array, metric: Array) -> Array:
    """Q f of each column: one large product takes a quarter of the time of one for each row."""
    return (columns.reshape(-1, metric.shape[0]) @ metric).reshape(columns.shape)


def without_lines(values: Array, known: NDArray[np.bool_]) -> Array:
    """Each row, [y, x], less the straight line fitted to it; 0 where nothing is known."""
    return seen(values[:, None], known.astype(np.float64), None)[:, 0]


def products(one: Array, two: Array, block_rows: int = BLOCK_ROWS) -> Array:
    """Sums of the products of columns, [y, column, x] each, over blocks of rows: (block, columns of one, columns
    of two). Where `one` is `seen` of something the lines of `two` cancel, but in whole rows only."""
    starts = np.arange(0, one.shape[0], block_rows)
    sums: Array = np.add.reduceat(one @ two.transpose(0, 2, 1), starts, axis=0)
    return sums


def noise_metric(residual: Array, known: NDArray[np.bool_], seen_through: FineFilter) -> Array | None:
    """Q of white and 1/f noise, N(f) = a + b / f, fitted to the spectra of the rows of a residual (median over rows),
    after what the filter has done to them.

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
    power = np.median(spectrum[:, used], axis=0) / np.log(2.0) / seen_through.along_rows(f[used])
    if not power.max() > LEAST_NOISE:
        return None
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
