"""Levelling of scans: pure functions that subtract a polynomial surface fitted to the heights.

Heights are fitted over x and y from -1 to 1, so that the result does not depend on the scan's size. NaN (not measured)
is left out of the fit.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final

import numpy as np

from afspm.basics.errors import InvalidValue
from afspm.model import line_levelling as drawing
from afspm.model.arrays import SD_PER_MAD, Array
from afspm.model.line_levelling import Levelling

_MOST_PIXELS: Final = 4096
"""Most pixels of a robust fit, spread over the scan."""
_ROUNDS: Final = 50
_TRIALS: Final = 200
# Huber's constant: 95 % of the efficiency of least squares for normally distributed noise
_HUBER: Final = 1.345


def levelled(
    values: Array, order: int = 1, fit: str = "least-squares", quantile: float = 0.5, rows: str | None = None
) -> Array:
    """Return values [y, x] without a polynomial surface, NaN where nothing was measured.

    Arguments and errors as for `Scan.levelled`.
    """
    if fit not in FITS:
        raise InvalidValue(f"there is no fit {fit!r}", hint=f"one of {', '.join(sorted(FITS))}")
    if order not in range(4) or not 0.0 < quantile < 1.0:
        raise InvalidValue(
            f"order {order}, quantile {quantile}", hint="an order from 0 to 3, a quantile between 0 and 1"
        )
    terms = _terms(values.shape, order)
    if rows is not None and rows not in ROWS:
        raise InvalidValue(f"rows can't be levelled by {rows!r}", hint=f"one of {', '.join(sorted(ROWS))}")
    values = values if rows is None else drawing.levelled(values, ROWS[rows])
    known = np.isfinite(values)
    if known.sum() < 2 * len(terms):
        raise InvalidValue("too little was measured to level it")
    columns, heights = terms[:, known].T, values[known]
    scale = float(np.ptp(heights)) or 1.0  # in units of their range: one set of limits fits any height
    solve = partial(_quantile, quantile=quantile) if fit == "quantile" else FITS[fit]
    coefficients = solve(columns, (heights - heights.mean()) / scale)
    surface: Array = np.tensordot(coefficients, terms, 1) * scale + heights.mean()
    return values - surface


def _terms(shape: tuple[int, ...], order: int) -> Array:
    # [term, y, x]: 1, x, y, x² … up to the order
    y, x = (np.linspace(-1.0, 1.0, count) for count in shape)
    powers = [(i, j) for total in range(order + 1) for i in range(total + 1) for j in [total - i]]
    return np.stack([np.outer(y**j, x**i) for i, j in powers])


def _least_squares(columns: Array, heights: Array) -> Array:
    found = np.linalg.lstsq(columns, heights, rcond=None)[0]
    return np.asarray(found, dtype=np.float64)


def _weighted(columns: Array, heights: Array, weights: Array) -> Array:
    root = np.sqrt(weights)
    return _least_squares(columns * root[:, None], heights * root)


def _reweighted(columns: Array, heights: Array, weigh: Callable[[Array], Array]) -> Array:
    columns, heights = _few(columns, heights)
    coefficients = _least_squares(columns, heights)
    for _ in range(_ROUNDS):
        before, coefficients = coefficients, _weighted(columns, heights, weigh(heights - columns @ coefficients))
        if np.allclose(before, coefficients, rtol=0.0, atol=1e-9):
            break
    return coefficients


def _huber(columns: Array, heights: Array) -> Array:
    def weigh(residuals: Array) -> Array:
        # the floors keep a perfectly flat scan from a division by zero
        sigma = max(SD_PER_MAD * float(np.median(np.abs(residuals))), 1e-9)
        return np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(residuals), 1e-12))

    return _reweighted(columns, heights, weigh)


def _quantile(columns: Array, heights: Array, quantile: float) -> Array:
    def weigh(residuals: Array) -> Array:
        return np.where(residuals > 0.0, quantile, 1.0 - quantile) / np.maximum(np.abs(residuals), 1e-4)

    return _reweighted(columns, heights, weigh)


def _samples(columns: Array, heights: Array) -> Array:
    # [trial, term]: exact fits through the fewest pixels that determine a surface; with a fixed seed, so that levelling
    # the same scan twice gives the same values
    chance = np.random.default_rng(0)
    rows = [chance.choice(len(heights), columns.shape[1], replace=False) for _ in range(_TRIALS)]
    return np.array([_least_squares(columns[row], heights[row]) for row in rows])


def _theil_sen(columns: Array, heights: Array) -> Array:
    # Theil and Sen: the median over small samples, term by term, then of the height
    columns, heights = _few(columns, heights)
    coefficients = np.median(_samples(columns, heights), axis=0).astype(np.float64)
    coefficients[0] += np.median(heights - columns @ coefficients)
    return coefficients


def _ransac(columns: Array, heights: Array) -> Array:
    # RANSAC: the surface with the most pixels within the scatter, fitted again to these pixels
    columns, heights = _few(columns, heights)
    residuals = np.abs(heights - _samples(columns, heights) @ columns.T)
    limit = max(2.5 * SD_PER_MAD * float(np.median(residuals, axis=1).min()), 1e-9)
    inliers = residuals[(residuals <= limit).sum(axis=1).argmax()] <= limit
    return _least_squares(columns[inliers], heights[inliers])


def _few(columns: Array, heights: Array) -> tuple[Array, Array]:
    step = max(1, len(heights) // _MOST_PIXELS)
    # spread over the scan by chance, but with a fixed seed: the same scan is always levelled alike
    chosen = np.random.default_rng(1).permutation(len(heights))[::step] if step > 1 else slice(None)
    return columns[chosen], heights[chosen]


ROWS: Final = {"median": Levelling.MEDIANS, "difference": Levelling.DIFFERENCES, "line": Levelling.LINES}
FITS: Final[dict[str, Callable[..., Array]]] = {  # (terms [pixel, term], heights) -> coefficients
    "least-squares": _least_squares,
    "huber": _huber,
    "quantile": _quantile,
    "theil-sen": _theil_sen,
    "ransac": _ransac,
}
