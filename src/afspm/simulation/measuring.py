"""Computation of a scan's channels from sample, tip, drift and feedback."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from afspm.model import Feedback
from afspm.model.arrays import Array
from afspm.simulation.feedback import LEAST_BIAS_V, Loop
from afspm.simulation.imaging import SampleGrid, Sampler, across_m, felt, reach_m
from afspm.simulation.noise import NoiseSettings, disturbances, flattened, height_noise
from afspm.simulation.scanning import Course, ScannerSettings
from afspm.simulation.settings import check
from afspm.simulation.surfaces import Relief
from afspm.simulation.tip import TipShape


@dataclass(frozen=True)
class SignalSettings:
    """The response of the sample in phase, current and frequency shift.

    Attributes:
        dissipation: energy lost to the sample per cycle, relative to the cantilever's own loss, mean of both materials.
        dissipation_contrast: difference of this loss between both materials.
        conductance_s: mean conductance of the contact over a cycle of gentle tapping.
        conductance_contrast: ln of the ratio of both materials' conductances.
        current_decay_m: increase of the gap over which the tapping current falls by a factor e.
        preamplifier_a: current at which the amplifier saturates.
        contact_potential_v: contact potential of both materials: the sample bias at the vertex of the parabola of the
            frequency shift over the bias.
    """

    dissipation: float = 0.12
    dissipation_contrast: float = 0.12
    conductance_s: float = 100e-12
    conductance_contrast: float = 1.5
    current_decay_m: float = 4e-9
    preamplifier_a: float = 10e-9
    contact_potential_v: tuple[float, float] = (0.25, -0.1)

    def __post_init__(self) -> None:
        check(self, from_zero="dissipation conductance_s", above_zero="current_decay_m preamplifier_a")


def phase_deg(settings: SignalSettings, loop: Loop, amplitude_v: Array, material: Array, slope: Array) -> Array:
    """Return the phase lag of the cantilever: sin(phase) = A / A0 * (1 + dissipation) (Cleveland et al. 1998).

    The free cantilever lags by 90 degrees; on a slope the tip's flank touches more of the sample and dissipates more.
    """
    share = amplitude_v / loop.settings.free_amplitude_v
    lost = settings.dissipation + settings.dissipation_contrast * (material - 0.5)
    lost = lost * (1.0 + 0.5 * np.sqrt(1.0 + slope * slope) - 0.5) * (1.0 - share) / 0.3
    return np.asarray(np.degrees(np.arcsin(np.clip(share * (1.0 + lost), 0.0, 1.0))))


def current_a(
    settings: SignalSettings, loop: Loop, gap_m: Array, material: Array, bias_v: float, set_bias_v: float | None = None
) -> Array:
    """Return the tunnelling or tapping current, exponential in the gap and proportional to the bias at one gap.

    Args:
        gap_m: z minus the height at which the setpoint is reached.
        set_bias_v: bias at which this height has the setpoint; None: the present bias, as while the feedback is on.
    """
    contrast = settings.conductance_contrast * (material - 0.5)
    if loop.settings.mode == "current":
        # The feedback keeps the current constant, so conductance shows in the height; the current shows the error.
        share = np.sign(bias_v) if set_bias_v is None else bias_v / max(abs(set_bias_v), LEAST_BIAS_V)
        mean = np.float64(loop.setpoint * share)
        exponent = -gap_m / loop.settings.decay_m
    else:
        mean = np.float64(settings.conductance_s * bias_v)
        exponent = contrast - gap_m / settings.current_decay_m + 2.0 * (loop.force - 1.0)
    current = mean * np.exp(np.clip(exponent, -60.0, 60.0))
    return np.asarray(np.clip(current, -settings.preamplifier_a, settings.preamplifier_a))


def attraction_hz(
    loop: Loop,
    tip: TipShape,
    sharp_m: float,
    gap_m: Array,
    bias_v: Array | float,
    set_bias_v: float,
    contact_v: Array | float,
) -> Array:
    """Return the frequency shift of an oscillating tip; a blunt or double tunnelling tip is attracted more.

    Args:
        sharp_m: radius of the sharp tip, which corresponds to the sensor's `radius_m`.
        gap_m: z minus the height at which the setpoint is reached.
        set_bias_v: bias at which this height has the setpoint.
        contact_v: contact potential.
    """
    sensor, distance_m = loop.settings.sensor, loop.distance_m(set_bias_v, contact_v) + gap_m
    voltage_v = bias_v - contact_v
    if loop.settings.mode == "frequency-shift":  # the setpoint is a shift of this tip, whichever its shape
        return sensor.shift_hz(distance_m, voltage_v)
    of_radius = sensor.radius_m / sharp_m
    shift = replace(sensor, radius_m=of_radius * tip.imaging_radius_m).shift_hz(distance_m, voltage_v)
    if tip.second_apex_m is not None:
        second = replace(sensor, radius_m=of_radius * tip.radius_m)
        shift = shift + second.shift_hz(distance_m - tip.second_apex_m[2], voltage_v)
    return shift


Channels = dict[str, tuple[str, Array]]
TipTimes = Sequence[tuple[float, TipShape]]
"""(start time, tip), the first not later than the scan's start."""

_POINTS = 1_400_000  # of the grid, with automatic oversampling
_MOST_POINTS = 4_000_000  # of the grid in any case
_FLICKER_M = 0.02e-9  # of debris at rest: a third of the current, up or down
# lateral reach of a tip in grid steps: beyond, the grid gets coarser, since a blunt tip resolves no detail
_MOST_TAPS = 160


@dataclass(frozen=True)
class Held:
    """The state that the feedback held last, in force while it is off.

    Attributes:
        z_m: z; None: not set.
        setpoint, bias_v: of the feedback when it was on; they define the distance of the tip from the sample.
    """

    z_m: float | None
    setpoint: float
    bias_v: float


@dataclass(frozen=True)
class Setup:
    """The constant conditions of a scan.

    Attributes:
        sample: returns the present relief of the sample from (x, y, resolution_m).
        drift_m: returns the drift (x, y, z) minus the scanner's own compensation, at times.
        turn: returns rotation and scale of the sample at times, as complex factors.
        unturned: returns (x, y) without rotation and scale, from (x, y, times).
        bias_v: the present bias.
        held: the state that the feedback held before it was switched off.
        contact_v: returns the contact potential from (material, x, y), positions of the sample.
        slope: (x, y) compensation of tilt set on the instrument, m/m.
        sharp_m: radius of the sharp tip.
        offset_m: returns the remaining distance (x, y) of the scanner to its target (creep), at times.
        settling_m: returns z that the last move has left, at times.
        scales: the errors of calibration, see `ScannerSettings.scales`.
    """

    sample: Callable[[Array, Array, float], Relief]
    drift_m: Callable[[Array], Array]
    turn: Callable[[float], NDArray[np.complex128]]
    unturned: Callable[[Array, Array, Array], tuple[Array, Array]]
    offset_m: Callable[[Array], Array]
    settling_m: Callable[[Array], Array]
    scales: tuple[float, float, float]
    scanner: ScannerSettings
    noise: NoiseSettings
    signals: SignalSettings
    loop: Loop
    bias_v: float
    held: Held
    contact_v: Callable[[Array, Array, Array], Array]
    slope: tuple[float, float]
    sharp_m: float

    def __post_init__(self) -> None:
        # heights are those of the setpoint in force, which is without effect while the feedback is off
        if not self.loop.on:
            object.__setattr__(self, "loop", replace(self.loop, setpoint=self.held.setpoint))

    @property
    def set_bias_v(self) -> float | None:
        """The bias at which the heights have the setpoint; None: the present bias."""
        return None if self.loop.on else self.held.bias_v


@dataclass(frozen=True)
class Felt:
    """The surface under the tip along the lines, by row index, x ascending.

    Attributes:
        height_m: (trace, retrace), each [y, x].
        material: (trace, retrace), each [y, x], from 0 to 1.
        contact_v: contact potential of the trace, [y, x].
    """

    height_m: tuple[Array, Array]
    material: tuple[Array, Array]
    contact_v: Array


@dataclass(frozen=True)
class Measured:
    """The channels of a scan, z at the end of each line in the order of time, and the mean indentation.

    The indentation is due to feedback errors.
    """

    channels: Channels
    ends_z_m: Array
    pressed_m: float

    def continued(self, anew: Measured, rows: NDArray[np.bool_], lines: int) -> Measured:
        """Return the measurement with `rows` taken from the first argument, the same scan with other settings.

        Args:
            lines: the number of lines before these rows.
        """
        channels = {
            name: (unit, np.where(rows[:, None], anew.channels[name][1], values))
            for name, (unit, values) in self.channels.items()
        }
        share = float(rows.mean())
        ends_z_m = np.concatenate([self.ends_z_m[:lines], anew.ends_z_m[lines:]])
        return Measured(channels, ends_z_m, share * anew.pressed_m + (1.0 - share) * self.pressed_m)


@dataclass(frozen=True)
class Adjustment:
    """A change during a scan: its time, and the new settings."""

    t_s: float
    feedback: Feedback
    bias_v: float


def measure(course: Course, tips: TipTimes, setup: Setup, random: np.random.Generator) -> Measured:
    """Compute the channels of a scan."""
    heights = feel(course, tips, setup)
    tilt = _tilt(course, (setup.scanner.tilt_x, setup.scanner.tilt_y))
    order = course.order
    lines = np.concatenate([(heights.height_m[0] + tilt)[order], (heights.height_m[1] + tilt)[order, ::-1]], axis=1)
    nx = course.shape[1]
    happened = disturbances(setup.noise, _tip_of_lines(course, tips), course.line_s, nx, random)
    if happened is not None:
        lines += happened
    z = _z(lines, course, setup, random)
    gap = z - lines
    noise = height_noise(setup.noise, course.shape[0], nx, course.line_s, course.start_s, random)
    both = setup.scales[2] * z + noise
    trace, retrace = np.empty(course.shape), np.empty(course.shape)
    trace[order], retrace[order] = both[:, :nx], both[:, nx:][:, ::-1]
    compensated = _tilt(course, setup.slope)
    how = setup.scanner.flatten
    channels: Channels = {
        "Height": ("m", flattened(trace - compensated, how)),
        "Height Retrace": ("m", flattened(retrace - compensated, how)),
    }
    gap_by_row = np.empty(course.shape)
    gap_by_row[order] = gap[:, :nx]
    line_tips = np.empty(course.shape[0], dtype=object)
    line_tips[order] = _tip_of_lines(course, tips)
    channels.update(_signals(gap_by_row, heights, line_tips, course, setup, random))
    return Measured(channels, z[:, -1], float(np.maximum(-gap, 0.0).mean()))


def at_rest(course: Course, felt_m: Felt, tip: TipShape, setup: Setup, random: np.random.Generator) -> dict[str, float]:
    """Measure at the single pixel of a course: the tip stands still and the feedback has settled.

    Debris on a contaminated tip never settles: the tunnelling current flickers.
    """
    loop = setup.loop
    height = felt_m.height_m[0] + _tilt(course, (setup.scanner.tilt_x, setup.scanner.tilt_y))
    z = np.full(height.shape, rest_z_m(course, felt_m, setup))
    noise = setup.noise.white_m * random.standard_normal(height.shape)
    channels = {"Height": ("m", setup.scales[2] * z + noise - _tilt(course, setup.slope))}
    gap = z - height
    if tip.debris_m and loop.settings.mode == "current":
        gap = gap + _FLICKER_M * random.standard_normal(height.shape)
    channels.update(_signals(gap, felt_m, np.array([tip], dtype=object), course, setup, random))
    return {name: float(values[0, 0]) for name, (_, values) in channels.items()}


def rest_z_m(course: Course, felt_m: Felt, setup: Setup) -> float:
    """Return z at the single pixel of a course, with a settled feedback or as it was left."""
    loop, held = setup.loop, setup.held
    if not loop.on and held.z_m is not None:
        return held.z_m
    height = felt_m.height_m[0] + _tilt(course, (setup.scanner.tilt_x, setup.scanner.tilt_y))
    return float(height[0, 0]) + (0.0 if loop.engages else loop.settings.range_m / 2)


def feel(course: Course, tips: TipTimes, setup: Setup) -> Felt:
    """Return the surface under the tip at every pixel, without feedback and noise."""
    trace, retrace = (_sample_positions(course, setup, part) for part in (0.25, 0.75))
    x = np.stack([trace[0], retrace[0]])
    y = np.stack([trace[1], retrace[1]])
    grid, blur = _grid(course, setup, x, y, tips)
    relief = setup.sample(*grid.axes_m(), max(grid.dx_m, grid.dy_m))
    height, material = np.empty(x.shape), np.empty(x.shape)
    taken_s = _pixel_times_s(course)
    for number, (since_s, tip) in enumerate(tips):
        until_s = tips[number + 1][0] if number + 1 < len(tips) else math.inf
        rows = np.any((taken_s >= since_s) & (taken_s < until_s), axis=(0, 2)) if len(tips) > 1 else slice(None)
        if isinstance(rows, np.ndarray) and not rows.any():
            continue
        part, start, stop = _rows_of_grid(grid, y[:, rows], reach_m(tip, float(np.ptp(relief.height_m))))
        path, offset = felt(relief.height_m[start:stop], part, tip, blur)
        sampler = Sampler(part, x[:, rows], y[:, rows])
        here = sampler.spline(path) + (offset + tip.length_m)
        stuff = sampler.linear(relief.material[start:stop])
        now = taken_s[:, rows] >= since_s
        height[:, rows] = np.where(now, here, height[:, rows])
        material[:, rows] = np.where(now, stuff, material[:, rows])
    times = [course.row_times_s(part) for part in (0.25, 0.75)]
    z_drift = np.stack([setup.drift_m(row_s)[:, 2:] + setup.settling_m(row_s)[:, None] for row_s in times])
    height += z_drift
    return Felt((height[0], height[1]), (material[0], material[1]), setup.contact_v(material[0], x[0], y[0]))


def _sample_positions(course: Course, setup: Setup, part: float) -> tuple[Array, Array]:
    # the drift is constant within a row
    x, y = course.pixels_m()
    times = course.row_times_s(part)
    away = setup.drift_m(times)[:, :2] + setup.offset_m(times)
    angle = course.region.angle_rad
    if part > 0.5:
        lag = setup.scanner.retrace_lag_m(course.shape[1], course.region.size_m[0])
        x, y = x + lag * math.cos(angle), y + lag * math.sin(angle)
    x, y = setup.scales[0] * x - away[:, :1], setup.scales[1] * y - away[:, 1:2]
    return setup.unturned(x, y, times[:, None])


def _pixel_times_s(course: Course) -> Array:
    # shape (2, ny, nx): trace and retrace
    nx = course.shape[1]
    start = course.row_times_s(0.0)[:, None]
    along = (np.arange(nx) + 0.5) / nx * (course.line_s / 2)
    return np.stack([start + along, start + course.line_s - along])


def _grid(course: Course, setup: Setup, x: Array, y: Array, tips: TipTimes) -> tuple[SampleGrid, tuple[float, float]]:
    # the blur (y, x) is in steps of the grid; accuracy asks for small steps, memory for few points
    turn = complex(setup.turn(course.start_s))
    pixel = (course.pixel_m[0] / abs(turn), course.pixel_m[1] / abs(turn))
    angle_rad = course.region.angle_rad - cmath.phase(turn)  # on the sample
    if angle_rad % (math.pi / 2) > 1e-9:
        pixel = (min(pixel), min(pixel))  # the grid is along the sample's axes, not the scan's
    elif angle_rad % math.pi > 1e-9:
        pixel = (pixel[1], pixel[0])
    # A coarse grid gives the range of heights, and with it the lateral reach of the tip.
    extent = (float(np.ptp(x)) or pixel[0], float(np.ptp(y)) or pixel[1])
    look = SampleGrid.covering(x, y, (max(extent[0] / 48, pixel[0]), max(extent[1] / 48, pixel[1])), 0.0)
    rise = 1.2 * float(np.ptp(setup.sample(*look.axes_m(), max(look.dx_m, look.dy_m)).height_m))
    margin = max(reach_m(tip, rise) for _, tip in tips) + 2 * max(pixel)
    area = (extent[0] + 2 * margin) * (extent[1] + 2 * margin)
    finest = math.sqrt(_POINTS * pixel[0] * pixel[1] / area)
    over = setup.scanner.oversampling or int(min(4, max(1, math.floor(finest))))
    wide = max(across_m(tip, rise) for _, tip in tips) / _MOST_TAPS
    step = (max(pixel[0] / over, wide), max(pixel[1] / over, wide))
    coarser = max(1.0, math.sqrt(area / (step[0] * step[1]) / _MOST_POINTS))
    step = (step[0] * coarser, step[1] * coarser)
    blur = setup.scanner.band_limit_px
    return SampleGrid.covering(x, y, step, margin), (blur * pixel[1] / step[1], blur * pixel[0] / step[0])


def _rows_of_grid(grid: SampleGrid, y: Array, margin_m: float) -> tuple[SampleGrid, int, int]:
    # only the rows in reach of the tip at these y
    start = max(0, math.floor((y.min() - margin_m - grid.y0_m) / grid.dy_m) - 7)
    stop = min(grid.shape[0], math.ceil((y.max() + margin_m - grid.y0_m) / grid.dy_m) + 8)
    return grid.rows(start, stop), start, stop


def _tip_of_lines(course: Course, tips: TipTimes) -> list[TipShape]:
    starts = course.start_s + np.arange(course.shape[0]) * course.line_s
    index = np.searchsorted([since for since, _ in tips], starts, side="right") - 1
    return [tips[int(i)][1] for i in np.maximum(index, 0)]


def _tilt(course: Course, slope: tuple[float, float]) -> Array | float:
    # a plane through the origin of tip coordinates
    if slope == (0.0, 0.0):
        return 0.0
    x, y = course.pixels_m()
    return np.asarray(slope[0] * x + slope[1] * y)


def _z(lines: Array, course: Course, setup: Setup, random: np.random.Generator) -> Array:
    # z along the lines in time, trace then retrace; each starts from the end of the previous retrace
    loop = setup.loop
    if not loop.on:
        return np.full(lines.shape, lines.max() if setup.held.z_m is None else setup.held.z_m)
    if not loop.engages:
        return np.full(lines.shape, lines.mean() + loop.settings.range_m / 2)
    nx = course.shape[1]
    lead = min(nx, 6 + nx // 16)
    path: Array = np.concatenate([lines[:, lead:0:-1] if nx > 1 else lines[:, :1], lines], axis=1).T
    # An oscillation grows from any disturbance; a stable loop starts at rest.
    start_v: Array = (1e-6 if loop.oscillates else 0.0) * random.standard_normal((path.shape[1],))
    z: Array = loop.follow(np.ascontiguousarray(path), course.line_s / (2 * nx), start_v)
    return z[-2 * nx :].T


def _signals(
    gap_m: Array, heights: Felt, tips: NDArray[np.object_], course: Course, setup: Setup, random: np.random.Generator
) -> Channels:
    # of the trace: amplitude and phase in tapping mode, frequency shift of an oscillating sensor, and current
    loop, noise, material = setup.loop, setup.noise, heights.material[0]
    ny, nx = course.shape

    def white(rms: float) -> Array:
        return rms * random.standard_normal((ny, nx), dtype=np.float32).astype(np.float64)

    channels: Channels = {}
    if loop.settings.mode == "amplitude":
        amplitude = loop.amplitude_v(gap_m)
        slope = np.gradient(heights.height_m[0], course.pixel_m[0], axis=1) if nx > 1 else np.zeros((ny, nx))
        phase = phase_deg(setup.signals, loop, amplitude, material, slope)
        channels["Amplitude"] = ("V", amplitude + white(noise.amplitude_v))
        channels["Phase"] = ("deg", phase + white(noise.phase_deg))
    shift = np.empty((ny, nx))
    set_bias_v = setup.bias_v if setup.set_bias_v is None else setup.set_bias_v
    for tip in set(tips) if loop.settings.senses_shift else ():
        rows, contact_v = tips == tip, heights.contact_v
        shift[rows] = attraction_hz(loop, tip, setup.sharp_m, gap_m[rows], setup.bias_v, set_bias_v, contact_v[rows])
    if loop.settings.mode == "frequency-shift":
        channels["Frequency Shift"] = ("Hz", shift + white(noise.frequency_hz))
    current = current_a(setup.signals, loop, gap_m, material, setup.bias_v, setup.set_bias_v)
    channels["Current"] = ("A", current + white(noise.current_a))
    if loop.settings.mode == "current" and loop.settings.qplus:
        channels["Frequency Shift"] = ("Hz", shift + white(noise.frequency_hz))
    return channels
