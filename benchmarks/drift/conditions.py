"""Effects of the microscope on an image: named mixtures of noise, drift and other changes between two scans.

Noise is in units of the standard deviation of the image without noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from afspm.components import Array

WANDERS = ("steady", "smooth", "swinging")
"""Spectra of lines that wander: of a first-order process, of one smoothed once more, and with a period."""


@dataclass(frozen=True)
class Condition:
    """The circumstances of two scans.

    Attributes:
        white: independent noise of each pixel.
        row_offset: independent offset of each row.
        row_memory: correlation of the offsets of neighbouring rows.
        row_tilt: independent rise over each row.
        one_over_f: noise of the whole scan as a time series, power as 1 / frequency^exponent.
        scars: share of the rows with a stretch where the tip is disturbed.
        scar_rows: largest thickness of a scar.
        spikes: share of the pixels that are off by some rms heights.
        lost: share of the rows without data.
        tilt: largest rise over the image.
        bow: largest parabola over the image.
        flatten: order of the polynomial fitted to and subtracted from each row; None: none.
        gain: the contrast of the second scan lies between 1 / gain and gain.
        bend: largest nonlinearity of contrast: this share of z² / 2 is added to z.
        drift_px: standard deviation of each component of the drift during a scan; scans are independent of each other.
        rotation_deg: largest rotation of the second scan.
        overlap: least and most.
        calibration: standard deviation of the stretch of each axis of the second scan.
        creep_px: displacement at the start of lines; decays to 1/e within `creep_length_px`.
        wander_px: standard deviation, in each direction, of a displacement of the lines: vibration, hysteresis, creep.
        wander_rows: rows within which it decays to 1/e.
        wander: its spectrum, one of `WANDERS`.
        slow_creep_px: displacement of the first row; decays to 1/e within `slow_creep_rows`.
        aspect: height of a pixel over its width.
        blunt: radius of the tip, over the usual one.
        double_px: distance of a second apex that the tip has in both scans.
        second_tip_px: distance of a second apex that the second scan alone has.
        turned_round: the second scan is taken in the other direction.
        elsewhere: the scans show two unrelated places of the sample.
    """

    white: float
    row_offset: float = 0.0
    row_memory: float = 0.0
    row_tilt: float = 0.0
    one_over_f: float = 0.0
    exponent: float = 1.0
    scars: float = 0.0
    scar_rows: int = 1
    spikes: float = 0.0
    lost: float = 0.0
    tilt: float = 0.0
    bow: float = 0.0
    flatten: int | None = None
    gain: float = 1.0
    bend: float = 0.0
    drift_px: float = 0.0
    rotation_deg: float = 0.0
    overlap: tuple[float, float] = (0.8, 1.0)
    calibration: float = 0.0
    creep_px: float = 0.0
    creep_length_px: float = 8.0
    wander_px: float = 0.0
    wander_rows: float = 10.0
    wander: str = "steady"
    slow_creep_px: tuple[float, float] = (0.0, 0.0)
    slow_creep_rows: float = 12.0
    aspect: float = 1.0
    blunt: float = 1.0
    double_px: float = 0.0
    second_tip_px: float = 0.0
    turned_round: bool = False
    elsewhere: bool = False


_REAL = {
    "white": 1 / 20, "row_offset": 0.2, "one_over_f": 0.15, "scars": 0.02, "tilt": 1.0, "flatten": 1, "gain": 1.1,
    "drift_px": 0.7, "overlap": (0.75, 1.0),
}  # fmt: skip
_HARD = {
    "white": 1 / 10, "row_offset": 0.5, "one_over_f": 0.3, "scars": 0.06, "tilt": 1.0, "flatten": 1, "gain": 1.7,
    "bend": 0.2, "drift_px": 1.4, "rotation_deg": 1.0, "overlap": (0.5, 0.7),
}  # fmt: skip

CONDITIONS: dict[str, Condition] = {
    "white100": Condition(1 / 100),
    "white30": Condition(1 / 30),
    "white10": Condition(1 / 10),
    "white3": Condition(1 / 3),
    "flat30": Condition(1 / 30, row_offset=0.3, tilt=1.0, flatten=1),
    "real": Condition(**_REAL),  # type: ignore[arg-type]
    "hard": Condition(**_HARD),  # type: ignore[arg-type]
    "dtip": Condition(**_REAL, second_tip_px=2.5),  # type: ignore[arg-type]
    "null": Condition(**_REAL, elsewhere=True),  # type: ignore[arg-type]
    "real-wander": Condition(**_REAL, wander_px=0.1),  # type: ignore[arg-type]
    "hard-wander": Condition(**_HARD, wander_px=0.1),  # type: ignore[arg-type]
}


def wandered(rows: int, condition: Condition, random: np.random.Generator) -> Array:
    """Return the displacement of each row, px, shape (2, rows), and creep at the first rows.

    Its mean over the rows is no drift of the sample: it is part of the error of a pair, as on a real scanner.
    """
    keep = np.exp(-1.0 / condition.wander_rows)
    made = _remembered(random.standard_normal((4 * rows, 2)), keep)
    if condition.wander == "smooth":
        made = _remembered(made, keep)
    elif condition.wander == "swinging":
        phase = 2.0 * np.pi * np.arange(4 * rows) / (4.0 * condition.wander_rows)
        other = _remembered(random.standard_normal((4 * rows, 2)), keep)
        made = made * np.cos(phase)[:, None] + other * np.sin(phase)[:, None]
    made = made / np.sqrt(np.mean(made**2, axis=0))
    taken = made[3 * rows :] * condition.wander_px
    crept = np.exp(-np.arange(rows) / condition.slow_creep_rows)[:, None] * np.array(condition.slow_creep_px)
    return np.asarray((taken + crept).T)


def measured(image: Array, condition: Condition, random: np.random.Generator, gain: float = 1.0) -> Array:
    """Return an image, [y, x] of unit rms, with the effects of the microscope."""
    ny, nx = image.shape
    bend = condition.bend * random.uniform(-1.0, 1.0)
    level = image - image.mean()
    seen = gain * (level + bend / 2 * level**2)
    seen += condition.white * random.standard_normal(image.shape)
    seen += condition.row_offset * _remembered(random.standard_normal((ny, 1)), condition.row_memory)
    if condition.row_tilt:
        seen += condition.row_tilt * random.standard_normal((ny, 1)) * np.linspace(-0.5, 0.5, nx)
    if condition.one_over_f:
        series = _one_over_f(ny * nx * 2, random, condition.exponent)
        seen += condition.one_over_f * series.reshape(ny, 2 * nx)[:, :nx]
    for row in np.flatnonzero(np.less(random.random(ny), condition.scars)):
        start, length = random.integers(nx), 1 + int(random.exponential(0.4 * nx))
        thick = int(random.integers(1, condition.scar_rows + 1)) if condition.scar_rows > 1 else 1
        seen[row : row + thick, start : start + length] += random.choice((-1.0, 1.0)) * abs(random.normal(1.0, 0.4))
    if condition.spikes:
        seen += 3.0 * random.standard_normal(image.shape) * (random.random(image.shape) < condition.spikes)
    x, y = np.linspace(-0.5, 0.5, nx), np.linspace(-0.5, 0.5, ny)[:, None]
    slope = condition.tilt * random.uniform(-1.0, 1.0, 2)
    seen += slope[0] * x + slope[1] * y
    if condition.bow:
        seen += 4.0 * condition.bow * (random.uniform(-1.0, 1.0) * x**2 + random.uniform(-1.0, 1.0) * y**2)
    if condition.flatten is not None:
        seen = flattened(seen, condition.flatten)
    if condition.lost:
        seen[random.random(ny) < condition.lost] = np.nan
    return np.asarray(seen)


def flattened(image: Array, order: int = 1) -> Array:
    """Subtract from each row the polynomial fitted to it (Flatten1)."""
    x = np.linspace(-1.0, 1.0, image.shape[1])
    powers, _ = np.linalg.qr(np.stack([x**k for k in range(order + 1)], axis=1))
    return np.asarray(image - (image @ powers) @ powers.T)


def _remembered(values: Array, memory: float) -> Array:
    # of the same variance, each correlated with the one before
    from scipy.signal import lfilter

    if not memory:
        return values
    return np.asarray(lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], values, axis=0))


def one_over_f_power(count: int, exponent: float = 1.0) -> Array:
    """Return the variance of each frequency k / count, k from 1 to count / 2, in a series of unit variance."""
    power = np.arange(1, count // 2 + 1, dtype=np.float64) ** -exponent
    return np.asarray(power / np.sum(power))


def _one_over_f(count: int, random: np.random.Generator, exponent: float) -> Array:
    # a time series of even length, unit rms on average, zero mean and a power spectrum as 1 / frequency^exponent
    amplitude = np.sqrt(one_over_f_power(count, exponent)) * count / 2
    spectrum = np.zeros(count // 2 + 1, dtype=np.complex128)
    spectrum[1:] = amplitude * (random.standard_normal(count // 2) + 1j * random.standard_normal(count // 2))
    return np.asarray(np.fft.irfft(spectrum, count))
