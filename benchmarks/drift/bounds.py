"""Cramér-Rao bounds of the displacement at the middle of the overlap, for any estimator.

With J the derivatives of the difference of both images and Q the precision of the noise of one row, the covariance of
any unbiased estimate is at least (sum over rows of J^T Q J / f + P)^-1, f the noise of both images over the noise of
one and P the prior precision. Van Trees, "Detection, Estimation, and Modulation Theory", part I, 2.4.

These bounds know the surface, which an estimator has to learn from the same scans: see `unknown_rough`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from afspm.components import Array
from benchmarks.drift.conditions import Condition, one_over_f_power
from benchmarks.drift.pairs import Pair
from benchmarks.drift.surfaces import rough_power


@dataclass(frozen=True)
class Bounds:
    """Covariances, (2, 2) each, in square standard pixels.

    Attributes:
        white: C, of white noise alone, with only the displacement unknown.
        rows: Cc, with 1/f noise, too, and an unknown straight line in each row.
        full: Cb, with unknown contrast, shear and rotation besides, as far as scans may have them.
    """

    white: Array
    rows: Array
    full: Array


def bounds(pair: Pair) -> Bounds:
    """Return the bounds of a pair with an overlap."""
    how = pair.condition
    first, second = pair.frames
    window = _window(pair)
    q = first.offsets_px()[(slice(None), *window)]
    sample = first.sample_px(q)
    gradient = np.einsum("ij,i...->j...", first.matrix, pair.view.gradient(sample))
    # A finer second scan averages noise away: what counts is noise power an area.
    finer = np.prod(second.step_px) / np.prod(first.step_px)
    noise = 1.0 + float(finer) / pair.gain**2
    plain = np.einsum("iyx,jyx->ij", gradient, gradient) / (noise * how.white**2)
    x, y = q - np.linalg.solve(first.matrix, -first.origin_px)[:, None, None]
    linear = [g * a for g in gradient for a in (x, y)]
    level = pair.view.at(sample)
    columns = np.stack([*gradient, level - level.mean(), *linear], axis=1)  # (rows, 7, columns)
    information = np.einsum("yix,xw,yjw->ij", columns, row_precision(how, q.shape[2]), columns, optimize=True) / noise
    known = np.zeros((7, 7))
    known[3:, 3:] = _linear_precision(how, first.width_px[1])
    fixed = [0, 1] if how.gain == 1.0 and not how.bend else [0, 1, 2]
    kept = fixed if not (how.drift_px or how.rotation_deg or how.calibration) else [*fixed, 3, 4, 5, 6]
    full = np.linalg.inv((information + known)[np.ix_(kept, kept)])[:2, :2]
    return Bounds(np.linalg.inv(plain), np.linalg.inv(information[:2, :2]), full)


def _window(pair: Pair) -> tuple[slice, slice]:
    # rows and columns of the reference within the scan
    first, second = pair.frames
    back = np.linalg.solve(
        second.matrix, (first.sample_px(first.offsets_px()) - second.origin_px[:, None, None]).reshape(2, -1)
    )
    inside = (np.abs(back) <= second.width_px[:, None] / 2).all(axis=0).reshape(first.shape)
    rows = np.flatnonzero(inside.mean(axis=1) > inside.mean(axis=1).max() / 2)
    columns = np.flatnonzero(inside.mean(axis=0) > inside.mean(axis=0).max() / 2)
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def unknown_rough(how: Condition, size: int = 128) -> float:
    """Return the least error on the rough surface over its bound, if nothing is known of the surface.

    The surface is a Gaussian field. If it is seen twice, with power S and noise N of each, a frequency k contributes k²
    S² / (N² + 2 N S) to the information about a displacement along it, instead of k² S / 2 N for a known surface
    (Hannan and Thomson, Biometrika 58, 77, 1971). On the other surfaces, which are not Gaussian, an estimator can
    recognise edges.
    """
    f = np.fft.fftfreq(size)
    power = rough_power(f[None, :] ** 2 + f[:, None] ** 2)
    power[0, 0] = 0.0
    power *= size**2 / power.sum()
    waves = np.exp(2j * math.pi * np.outer(f, np.arange(size))) / math.sqrt(size)
    precision = np.einsum("fx,xy,fy->f", waves.conj(), row_precision(how, size), waves, optimize=True).real
    noise = 1.0 / np.maximum(precision, 1e-12)[None, :]  # of what is slower than a line in a row nothing is seen
    variances = []
    for told in (power / (2 * noise), power**2 / (noise**2 + 2 * noise * power)):
        variances.append(1 / np.sum(f[None, :] ** 2 * told) + 1 / np.sum(f[:, None] ** 2 * told))
    known, unknown = variances
    return math.sqrt(unknown / known)


def row_precision(how: Condition, width: int) -> Array:
    """Return the precision of `width` pixels of one row, with an unknown straight line or polynomial in it."""
    covariance = how.white**2 * np.eye(width)
    if how.one_over_f:
        count = 2 * 128 * 128
        lags = np.arange(width)
        k = np.arange(1, count // 2 + 1)
        # Slow noise is a line in a row: what is slower than sixteen rows adds nothing but rounding.
        fast = k >= count // (16 * 128)
        power = np.where(fast, one_over_f_power(count, how.exponent), 0.0)
        series = np.zeros(count // 2 + 1)
        series[1:] = power / 2
        covariance += how.one_over_f**2 * linalg.toeplitz(np.fft.irfft(series, count)[lags] * count)
    x = np.linspace(-1.0, 1.0, width)
    lines = np.stack([x**k for k in range(1 + max(1, how.flatten or 0))], axis=1)
    precision = np.linalg.inv(covariance)
    seen = precision @ lines
    return np.asarray(precision - seen @ np.linalg.solve(lines.T @ seen, seen.T))


def _linear_precision(how: Condition, height_px: float) -> Array:
    # of (xx, xy, yx, yy), as far as drift during the scans and rotation leave it unknown
    shear = 2 * (how.drift_px / height_px) ** 2
    turn = math.radians(how.rotation_deg) ** 2 / 3
    covariance = np.diag([0.0, shear, 0.0, shear]) + turn * np.outer((0, 1, -1, 0), (0, 1, -1, 0))
    covariance += how.calibration**2 * np.diag([1.0, 0.0, 0.0, 1.0])
    return np.linalg.inv(covariance + 1e-12 * np.eye(4))
