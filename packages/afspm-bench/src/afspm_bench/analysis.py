"""Analysis of scans and spectra, for the judges and the included agents. Pure."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from afspm.components import Array
from afspm.model import Region, Scan, Spectrum

XY = tuple[float, float]


@dataclass(frozen=True)
class Peak:
    """A particle: position of its top, and height above the ground."""

    xy_m: XY
    height_m: float


def above_ground(values: Array) -> Array:
    """Return heights above the ground, estimated as the 25th percentile of each line, which particles hardly affect.

    The median of the lower half of all heights is then set to zero.
    """
    ground = np.nanpercentile(values, 25.0, axis=1, keepdims=True)
    flat = values - ground
    return np.asarray(flat - np.nanmedian(flat[flat < np.nanpercentile(flat, 50.0)]))


def place_in(region: Region, shape: tuple[int, int], row: float, column: float) -> XY:
    """Return the position of a pixel, in m, in a region that is not rotated."""
    (left, low), (width, height) = region.top_left_m, region.size_m
    return left + column / (shape[1] - 1) * width, low + row / (shape[0] - 1) * height


def peaks(heights: Array, region: Region, *, least_m: float, apart_m: float) -> list[Peak]:
    """Return the local maxima above `least_m`, highest first, in a map of heights above the ground.

    A maximum is the highest pixel within about `apart_m` / 2, after a median filter of 3 x 3 pixels.
    """
    pixel_m = region.size_m[0] / (heights.shape[1] - 1)
    reach = max(1, round(apart_m / pixel_m / 2))
    size = 2 * reach + 1
    smooth = ndimage.median_filter(heights, 3)  # a scar is one line wide
    is_top = (smooth == ndimage.maximum_filter(smooth, size)) & (smooth > least_m)
    marked, count = cast("tuple[NDArray[np.int32], int]", ndimage.label(is_top))
    tops = ndimage.center_of_mass(is_top, marked, list(range(1, count + 1))) if count else []
    found = [
        Peak(place_in(region, heights.shape, row, column), float(smooth[round(row), round(column)]))
        for row, column in cast("Sequence[tuple[float, float]]", tops)
    ]
    return sorted(found, key=lambda peak: -peak.height_m)


def peaks_of(scan: Scan, *, least_m: float = 15e-9, apart_m: float = 40e-9) -> list[Peak]:
    return peaks(above_ground(scan.values), scan.region, least_m=least_m, apart_m=apart_m)


def near(found: Sequence[Peak], xy_m: XY, within_m: float) -> Peak | None:
    """Return the peak nearest to a position; None if none is within `within_m`."""
    best = min(found, key=lambda peak: math.dist(peak.xy_m, xy_m), default=None)
    return best if best is not None and math.dist(best.xy_m, xy_m) <= within_m else None


def flattest(heights: Array, region: Region, size_m: float) -> tuple[XY, float]:
    """Return the centre of the square of a given size with the smallest range of heights, and this range."""
    pixel_m = region.size_m[0] / (heights.shape[1] - 1)
    size = math.ceil(size_m / pixel_m) + 2
    smooth = ndimage.median_filter(heights, 3)
    spread = ndimage.maximum_filter(smooth, size) - ndimage.minimum_filter(smooth, size)
    edge = size // 2 + 1
    inner = spread[edge:-edge, edge:-edge]
    row, column = np.unravel_index(int(np.argmin(inner)), inner.shape)
    return place_in(region, heights.shape, float(row + edge), float(column + edge)), float(inner.min())


def shift_m(first: Scan, second: Scan) -> XY:
    """Return the displacement of features between two scans of equal size, relative to their regions, in m."""
    a, b = (_windowed(above_ground(scan.values)) for scan in (first, second))
    rows, columns = a.shape
    spectrum = np.fft.rfft2(b, (2 * rows, 2 * columns)) * np.conj(np.fft.rfft2(a, (2 * rows, 2 * columns)))
    found = np.fft.fftshift(np.fft.irfft2(spectrum, (2 * rows, 2 * columns)))
    row, column = np.unravel_index(int(np.argmax(found)), found.shape)
    dy = row + _vertex(found[:, column], int(row)) - rows
    dx = column + _vertex(found[row], int(column)) - columns
    width, height = first.region.size_m
    return float(dx) * width / (columns - 1), float(dy) * height / (rows - 1)


def _windowed(values: Array) -> Array:
    low, high = np.nanpercentile(values, (1.0, 99.5))
    clipped = np.clip(np.nan_to_num(values, nan=float(np.nanmedian(values))), low, high)
    window = np.outer(np.hanning(len(values)), np.hanning(values.shape[1])) ** 0.5
    return np.asarray((clipped - clipped.mean()) * window)


def _vertex(values: Array, at: int) -> float:
    # the maximum of the parabola through a value and its neighbours, relative to it
    if not 0 < at < len(values) - 1:
        return 0.0
    left, middle, right = map(float, values[at - 1 : at + 2])
    curvature = left - 2 * middle + right
    return 0.5 * (left - right) / curvature if curvature < 0 else 0.0


def lattice_constant(scan: Scan) -> tuple[float, float]:
    """Return the lattice constant of a hexagonal lattice and its standard error, in m.

    The three strongest reciprocal vectors between 2 and 8 per nm are refined by the power of a windowed Fourier sum.
    The mean of their lengths cancels a shear of the raster to first order, but not a change of scale.
    """
    values = scan.values - ndimage.gaussian_filter(scan.values, scan.shape[0] / 8)
    values = (values - values.mean()) * np.outer(np.hanning(scan.shape[0]), np.hanning(scan.shape[1]))
    (width, height), (rows, columns) = scan.region.size_m, scan.shape
    step_x, step_y = width / (columns - 1), height / (rows - 1)
    power = np.abs(np.fft.fft2(values, (4 * rows, 4 * columns)))
    fy, fx = np.fft.fftfreq(4 * rows, step_y)[:, None], np.fft.fftfreq(4 * columns, step_x)[None, :]
    radius = np.hypot(fx, fy)
    power = np.where((radius > 2e9) & (radius < 8e9) & ((fy > 0) | ((fy == 0) & (fx > 0))), power, 0.0)
    found: list[float] = []
    directions: list[float] = []
    while len(found) < 3:
        row, column = np.unravel_index(int(np.argmax(power)), power.shape)
        x, y = float(fx[0, column]), float(fy[row, 0])
        x, y = _refined(values, step_x, step_y, x, y)
        found.append(math.hypot(x, y))
        directions.append(math.atan2(y, x))
        power[np.hypot(fx - x, fy - y) < 1.2e9] = 0.0
    constants = 2.0 / (math.sqrt(3.0) * np.array(found))
    mean = float(2.0 / (math.sqrt(3.0) * np.mean(found)))
    return mean, max(float(constants.std(ddof=1)) / math.sqrt(3.0), 0.002 * mean)


def _refined(values: Array, step_x: float, step_y: float, x: float, y: float) -> XY:
    rows, columns = values.shape
    reach = 0.5 / (columns * step_x)
    for _ in range(4):
        offsets = np.linspace(-reach, reach, 9)
        along = np.exp(-2j * np.pi * np.outer(x + offsets, np.arange(columns) * step_x))
        across = np.exp(-2j * np.pi * np.outer(y + offsets, np.arange(rows) * step_y))
        power = np.abs(across @ values @ along.T)
        row, column = np.unravel_index(int(np.argmax(power)), power.shape)
        x, y, reach = x + float(offsets[column]), y + float(offsets[row]), reach / 3
    return x, y


def step_height(scan: Scan) -> tuple[float, float]:
    """Return the height of equal steps and its standard error, in m, from the period of the heights.

    Lines have different offsets, so the period is taken from height differences within lines. Steps lie between 0.18
    and 0.8 nm.
    """
    values = ndimage.median_filter(scan.values, (1, 5))
    lag = max(4, scan.shape[1] // 8)
    differences = np.concatenate([(values[:, k:] - values[:, :-k]).ravel() for k in (lag, 2 * lag, 3 * lag, 4 * lag)])
    periods = np.linspace(0.18e-9, 0.8e-9, 1200)
    # multiples of the true period have power at its submultiples: a difference of one step must be the rule
    some = differences[:: max(1, differences.size // 4000)]
    power = np.array([np.cos(2 * np.pi * some / period).mean() for period in periods])
    coarse = periods[_first_high(power)]
    order = np.round(differences / coarse)
    used = (np.abs(differences - order * coarse) < 0.25 * coarse) & (np.abs(order) > 0)
    fitted = float((differences[used] * order[used]).sum() / (order[used] ** 2).sum())
    rows = np.array_split(np.flatnonzero(used), 8)
    parts = [(differences[part] * order[part]).sum() / (order[part] ** 2).sum() for part in rows if len(part)]
    return fitted, max(float(np.std(parts, ddof=1)) / math.sqrt(len(parts)), 0.004 * fitted)


def _first_high(power: Array) -> int:
    # the largest period whose power is near the highest
    high = np.flatnonzero(power > 0.9 * power.max())
    groups = np.split(high, np.flatnonzero(np.diff(high) > 1) + 1)
    return int(groups[-1][np.argmax(power[groups[-1]])])


def conductance_in_gap(curve: Spectrum) -> float:
    """Return the ratio of the conductance within ±0.2 V to the mean conductance: about 1 in a metal, 0 in a gap."""
    bias, current = curve.values[:, 0], curve.values[:, 1]
    inside = np.abs(bias) < 0.2
    slope = float(np.polyfit(bias[inside], current[inside], 1)[0])
    return slope / max(float(np.ptp(current) / np.ptp(bias)), 1e-30)


def band_gap(curves: Sequence[Spectrum]) -> tuple[float, float]:
    """Return the width of the gap and its standard error, in V, from dI/dV of several curves."""
    widths = [_gap_width(curve) for curve in curves]
    mean = float(np.mean(widths))
    return mean, max(float(np.std(widths, ddof=1)) / math.sqrt(len(widths)) if len(widths) > 1 else 0.0, 0.02)


def _gap_width(curve: Spectrum) -> float:
    bias, slope = curve.values[:, 0], ndimage.gaussian_filter1d(curve.values[:, 3], 1.5)
    level = 0.1 * float(np.median(slope[np.abs(bias) > 0.9 * np.abs(bias).max()]))
    middle = int(np.argmin(ndimage.gaussian_filter1d(slope, 6)))
    low = next((i for i in range(middle, -1, -1) if slope[i] > level), 0)
    high = next((i for i in range(middle, len(bias)) if slope[i] > level), len(bias) - 1)
    return float(bias[high] - bias[low])


def constellation_shift(known: Sequence[XY], found: Sequence[Peak], within_m: float) -> tuple[XY, int]:
    """Return the shift that maps most known positions onto found peaks, and the number of matches."""
    best: tuple[XY, int] = ((0.0, 0.0), 0)
    for (x, y), peak in itertools.product(known, found):
        shift = (peak.xy_m[0] - x, peak.xy_m[1] - y)
        pairs = [near(found, (kx + shift[0], ky + shift[1]), within_m) for kx, ky in known]
        offsets = [
            (one.xy_m[0] - kx, one.xy_m[1] - ky) for one, (kx, ky) in zip(pairs, known, strict=True) if one is not None
        ]
        if len(offsets) > best[1]:
            best = (float(np.mean([o[0] for o in offsets])), float(np.mean([o[1] for o in offsets]))), len(offsets)
    return best
