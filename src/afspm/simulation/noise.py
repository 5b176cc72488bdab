"""The instrument's noise, and the line flattening that it may apply."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from afspm.model.arrays import Array
from afspm.simulation.settings import check
from afspm.simulation.tip import TipShape


@dataclass(frozen=True)
class NoiseSettings:
    """Settings of the noise, as root mean squares unless noted.

    Attributes:
        white_m: noise of the height, independent for each pixel.
        one_over_f_m: noise of the height as a time series over the whole scan, with a power of 1 / frequency.
        line_offset_m: noise of the height, independent for each line, the same in trace and retrace.
        scar_probability: probability of a disturbed interval in a line.
        scar_m: height of the disturbance.
        hum_m, hum_hz: amplitude and frequency of mains hum in the height.
        debris_jumps_per_s: rate of jumps of debris on a contaminated tip.
        amplitude_v, phase_deg, current_a, frequency_hz: white noise of the channels of these names.
    """

    white_m: float = 0.05e-9
    one_over_f_m: float = 0.05e-9
    line_offset_m: float = 0.05e-9
    scar_probability: float = 0.01
    scar_m: float = 1e-9
    hum_m: float = 0.0
    hum_hz: float = 50.0
    debris_jumps_per_s: float = 0.4
    amplitude_v: float = 0.002
    phase_deg: float = 0.25
    current_a: float = 1e-12
    frequency_hz: float = 0.1

    def __post_init__(self) -> None:
        check(self, from_zero="white_m one_over_f_m line_offset_m scar_m hum_m hum_hz debris_jumps_per_s")
        check(self, from_zero="amplitude_v phase_deg current_a frequency_hz", fraction="scar_probability")


def disturbances(
    settings: NoiseSettings, tips: list[TipShape], line_s: float, nx: int, random: np.random.Generator
) -> Array | None:
    """Return the height of scars and jumps of debris, which the feedback follows.

    Args:
        tips: the tip of each line, in the order of time.

    Returns:
        Added height, shape (lines, 2 nx): trace, then retrace in the order of time; None without disturbances.
    """
    series = np.zeros((len(tips), 2 * nx))
    scarred = np.nonzero(random.random(len(tips)) < settings.scar_probability)[0]
    for scarred_line in scarred:
        start = int(random.integers(2 * nx))
        length = 1 + int(random.exponential(0.4 * nx))
        series[scarred_line, start : start + length] += settings.scar_m * abs(random.normal(1.0, 0.4))
    flat = series.reshape(-1)
    dirty = np.array([tip.debris_m for tip in tips])
    jumps = random.poisson(settings.debris_jumps_per_s * line_s * np.count_nonzero(dirty)) if dirty.any() else 0
    for _ in range(min(int(jumps), 4 * len(tips))):
        line = int(random.choice(np.nonzero(dirty)[0]))
        start = line * 2 * nx + int(random.integers(2 * nx))
        length = 1 + int(random.exponential(0.6 * nx))
        flat[start : start + length] += dirty[line] * random.normal(0.0, 0.25)
    return series if scarred.size or jumps else None


def height_noise(
    settings: NoiseSettings, lines: int, nx: int, line_s: float, start_s: float, random: np.random.Generator
) -> Array:
    """Return the noise of the height signal in the order of time, shape (lines, 2 nx)."""
    series = settings.white_m * random.standard_normal((lines, 2 * nx), dtype=np.float32).astype(np.float64)
    if settings.one_over_f_m:
        series += settings.one_over_f_m * one_over_f(lines * 2 * nx, random).reshape(lines, 2 * nx)
    series += settings.line_offset_m * random.standard_normal((lines, 1))
    if settings.hum_m:
        pixel_s = line_s / (2 * nx)
        t = (start_s % 1.0) + pixel_s * np.arange(lines * 2 * nx).reshape(lines, 2 * nx)
        series += settings.hum_m * np.sin(2.0 * np.pi * settings.hum_hz * t)
    return series


def one_over_f(count: int, random: np.random.Generator) -> Array:
    """Return a time series of zero mean and, on average, unit rms, with a power spectrum of 1 / frequency."""
    size = 1 << max(4, (count - 1).bit_length())
    amplitude = 1.0 / np.sqrt(np.arange(1, size // 2 + 1, dtype=np.float32))
    shape = (2, len(amplitude))
    parts = random.standard_normal(shape, dtype=np.float32) * amplitude
    spectrum = np.concatenate([np.zeros(1, np.complex64), parts[0] + 1j * parts[1]])
    series = np.fft.irfft(spectrum, size)[:count]
    # Each frequency contributes a variance of (2 amplitude / size)^2.
    return np.asarray(series * (size / (2.0 * np.sqrt(np.sum(amplitude.astype(np.float64) ** 2)))), dtype=np.float64)


def flattened(values: Array, how: str) -> Array:
    """Subtract from each line its mean ("offset") or the straight line fitted to it ("line", Flatten1)."""
    if how == "none":
        return values
    level: Array = values - values.mean(axis=1, keepdims=True)
    if how == "offset" or values.shape[1] < 3:
        return level
    x: Array = np.linspace(-1.0, 1.0, values.shape[1])
    return np.asarray(level - np.outer(level @ x / (x @ x), x))
