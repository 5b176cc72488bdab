"""Metrics of the tip from its scans, chosen to depend little on the place.

A changed tip blunts, doubles or shakes all features in the same way, so three properties of a scan characterise the tip
rather than the place:

- `detail`: the power of the slopes at short wavelengths against the power at long wavelengths. Every edge of the sample
  has both; a blunt tip loses the short wavelengths. (Heights of terraces, or the number of particles, scale both.) The
  power is the cross spectrum of trace and retrace, in which noise averages out.
- `ghost`: the autocorrelation of the slopes away from zero. A second apex repeats every feature at one distance.
- `unrest`: stretches of flat ground in which trace and retrace disagree far more than in the rest of the line, which
  loose debris causes and feedback does not. Noise and hum fill the whole line, and count as `noise`.

(Villarrubia 1997 for the effect of a tip on an image; the rest is standard signal analysis.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.basics.errors import InvalidValue
from afspm.model.arrays import SD_PER_MAD, Array

# the long band ends at wavelengths of 32 pixels
FEWEST_PIXELS = 32
LARGEST_HOLES = 0.2  # share of pixels that may be missing
SHORT_PX = (3.0, 8.0)  # wavelengths that a blunt tip loses
LONG_PX = (8.0, 32.0)  # wavelengths that it keeps
CORE_PX = 6.0  # lags within which any edge correlates with itself
STRETCH = 10  # a stretch of a line is a tenth of it
ALIKE = 3.0  # spreads of a line's stretches that are no unrest
LEAST_CONTRAST = 0.1  # slopes common to trace and retrace, relative to those of noise


@dataclass(frozen=True)
class TipMetrics:
    """Metrics of the tip from one scan.

    Attributes:
        detail: short-wave against long-wave power of the slopes.
        ghost: largest autocorrelation of the slopes beside the centre, 0 to 1, beyond what was expected there; above 1
            if trace and retrace are displaced against each other, and the metrics mean nothing.
        unrest_m: disagreement of trace and retrace in single stretches, exceeded in a tenth of the lines; 0 without
            retrace.
        contrast: power of the sample's slopes relative to noise; below `LEAST_CONTRAST` the other metrics mean nothing.
        noise_m: standard deviation of the noise.
    """

    detail: float
    ghost: float
    unrest_m: float
    contrast: float
    noise_m: float = 0.0


@dataclass(frozen=True)
class Slopes:
    """Slopes of a scan along its lines.

    Attributes:
        trace, retrace: (rows, columns - 1).
        difference: the levelled heights of trace less retrace, (rows, columns).
    """

    trace: Array
    retrace: Array | None
    difference: Array | None


def slopes(trace: Array, retrace: Array | None = None) -> Slopes:
    """Return the slopes of a scan, without offsets and tilt of its lines, missing pixels filled.

    Args:
        trace, retrace: heights in m, [y, x], retrace reversed as in scans; NaN where not measured.

    Raises:
        InvalidValue: too few pixels, too many holes, or different shapes.
    """
    if min(trace.shape) < FEWEST_PIXELS:
        raise InvalidValue(
            f"a scan of {trace.shape} pixels is too small to judge the tip", hint=f"at least {FEWEST_PIXELS}"
        )
    if retrace is not None and retrace.shape != trace.shape:
        raise InvalidValue(f"trace {trace.shape} and retrace {retrace.shape} differ in shape")
    level = _levelled(trace)
    if retrace is None:
        return Slopes(_clipped(np.diff(level, axis=1)), None, None)
    back = _levelled(retrace)
    return Slopes(_clipped(np.diff(level, axis=1)), _clipped(np.diff(back, axis=1)), level - back)


def share_at_ends(heights: Array) -> float:
    """Return the share of the pixels at the highest or the lowest value of a scan, whichever is larger.

    Rows of one value are left out: some controllers fill lost rows with zeros.
    """
    rows = heights[np.isfinite(heights).all(axis=1)]
    rows = rows[np.ptp(rows, axis=1) > 0.0]
    return float(max((rows == end).mean() for end in (rows.min(), rows.max()))) if rows.size else 0.0


def autocorrelation(of: Slopes, reach_px: int) -> Array:
    """Return the autocorrelation of the slopes, 1 at the peak near zero lag.

    Returns:
        Lags of 0 … reach rows by -reach … reach columns; the other half is the same by symmetry.
    """
    ny, nx = of.trace.shape
    window = np.outer(np.hanning(ny + 2)[1:-1], np.hanning(nx + 2)[1:-1])
    size = (2 * ny, 2 * nx)

    def spectrum(values: Array) -> NDArray[np.complex128]:
        return np.fft.rfft2(values * window, size)

    first = spectrum(of.trace)
    second = first if of.retrace is None else spectrum(of.retrace)
    power = (first * second.conj()).real
    correlation = np.fft.irfft2(power, size)
    overlap = np.fft.irfft2(np.abs(np.fft.rfft2(window, size)) ** 2, size)
    rows, columns = np.arange(reach_px + 1), np.arange(-reach_px, reach_px + 1)
    part = correlation[np.ix_(rows, columns)] / overlap[np.ix_(rows, columns)]
    peak = float(part[0, reach_px]) if of.retrace is None else float(part[:2, reach_px - 2 : reach_px + 3].max())
    normalised: Array = part / peak if peak > 0 else np.zeros_like(part)
    return normalised


def metrics(of: Slopes, correlation: Array, expected: Array | None = None) -> TipMetrics:
    """Return the metrics of one scan.

    Args:
        correlation: its `autocorrelation`.
        expected: autocorrelation with a good tip on this sample, which may be periodic; None: zero.
    """
    short, long, noise = _band_powers(of)
    return TipMetrics(
        detail=short / long if long > 0 else 0.0,
        ghost=ghost(correlation, expected),
        unrest_m=_unrest_m(of),
        contrast=(short + long) / noise if noise > 0 else float(short + long > 0) * 1e3,
        noise_m=math.sqrt(noise / _white_power(of.trace.shape[1])),
    )


def ghost(correlation: Array, expected: Array | None = None) -> float:
    """Return the largest excess of the smoothed correlation over the expected correlation; 0 without an excess.

    Lags within `CORE_PX` pixels of the centre are left out.
    """
    beyond = _smoothed(correlation if expected is None else correlation - expected)
    reach = correlation.shape[0] - 1
    rows, columns = np.mgrid[0 : reach + 1, -reach : reach + 1]
    aside = np.hypot(rows, columns) > CORE_PX
    return max(0.0, float(beyond[aside].max()))


def _levelled(heights: Array) -> Array:
    values = _filled(np.array(heights, dtype=np.float64))
    tilt = np.median(np.diff(values, axis=1))
    there = np.nonzero(np.ptp(values, axis=1) > 0.0)[0]  # some controllers fill lost rows with zeros
    if there.size:  # a lost row is no ramp
        values = values[there[np.abs(np.arange(len(values))[:, None] - there).argmin(axis=1)]]
    values = values - tilt * np.arange(values.shape[1])
    levelled: Array = values - np.median(values, axis=1, keepdims=True)
    return levelled


def _filled(values: Array) -> Array:
    holes = ~np.isfinite(values)
    if holes.mean() > LARGEST_HOLES:
        raise InvalidValue(f"{holes.mean():.0%} of the scan are missing")
    for row in np.nonzero(holes.any(axis=1))[0]:
        there = values[row][~holes[row]]
        values[row][holes[row]] = np.median(there) if there.size else 0.0
    return values


def _clipped(slope: Array) -> Array:
    # without the limit one large particle would outweigh all other slopes
    slope = slope - np.median(slope)
    limit = np.quantile(np.abs(slope), 0.995)
    return np.clip(slope, -limit, limit) if limit > 0 else slope


def _band_powers(of: Slopes) -> tuple[float, float, float]:
    nx = of.trace.shape[1]
    window = np.hanning(nx + 2)[1:-1]
    first = np.fft.rfft(of.trace * window, axis=1)
    frequency = np.fft.rfftfreq(nx)
    if of.retrace is None:
        # the next line shows nearly the same place with other noise
        pairs, alone = first[1:] * first[:-1].conj(), np.abs(first) ** 2
    else:
        second = np.fft.rfft(of.retrace * window, axis=1)
        pairs, alone = first * second.conj(), (np.abs(first) ** 2 + np.abs(second) ** 2) / 2
    # lag of the feedback shifts trace and retrace against each other: it changes the phase, not the modulus
    common, total = np.abs(pairs.mean(axis=0)), alone.mean(axis=0)
    noise = np.maximum(total - common, 0.0)

    def band(power: Array, wavelengths: tuple[float, float]) -> float:
        chosen = (frequency >= 1 / wavelengths[1]) & (frequency < 1 / wavelengths[0])
        return float(power[chosen].sum())

    bias = 1.0 / np.sqrt(len(pairs))  # expected modulus of the mean of that many random phases
    common = np.maximum(common - bias * noise, 0.0)
    return band(common, SHORT_PX), band(common, LONG_PX), band(noise, (SHORT_PX[0], LONG_PX[1]))


def _unrest_m(of: Slopes) -> float:
    if of.difference is None:
        return 0.0
    flat = _flat(of.trace)
    width = max(4, of.difference.shape[1] // STRETCH)
    window = np.lib.stride_tricks.sliding_window_view
    count = window(flat, width, axis=1)[:, :: width // 2].sum(axis=-1)
    total = window(of.difference * flat, width, axis=1)[:, :: width // 2].sum(axis=-1)
    levels = np.where(count >= width // 3, total / np.maximum(count, 1), np.nan)
    levels = levels[np.isfinite(levels).any(axis=1)]
    if not levels.size:
        return 0.0
    off = np.abs(levels - np.nanmedian(levels, axis=1, keepdims=True))
    own = SD_PER_MAD * np.nanmedian(off, axis=1)
    own = np.maximum(own, np.median(own))  # of few stretches it may be small by chance
    return float(np.quantile(np.maximum(0.0, np.nanmax(off, axis=1) - ALIKE * own), 0.9))


def _white_power(slopes_per_line: int) -> float:
    # of the slopes of white noise of 1, in the bands of `_band_powers`
    frequency, window = np.fft.rfftfreq(slopes_per_line), np.hanning(slopes_per_line + 2)
    chosen = (frequency >= 1 / LONG_PX[1]) & (frequency < 1 / SHORT_PX[0])
    return float(np.sum(4.0 * np.sin(np.pi * frequency[chosen]) ** 2) * np.sum(window**2))


def _flat(slope: Array) -> Array:
    # 1 where the scan is flat: near edges trace and retrace differ because the feedback lags behind.
    steep = np.abs(slope)
    steep = np.maximum(steep, np.maximum(np.roll(steep, 1, axis=1), np.roll(steep, -1, axis=1)))
    flat = steep <= np.quantile(steep, 0.6)
    padded: Array = np.pad(flat.astype(np.float64), ((0, 0), (0, 1)), mode="edge")
    return padded


def _smoothed(correlation: Array) -> Array:
    # a ghost is as wide as an edge, so the mean of 3 x 3 keeps it and lowers chance maxima
    padded = np.pad(correlation, 1, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    smooth: Array = windows.mean(axis=(-1, -2))
    return smooth
