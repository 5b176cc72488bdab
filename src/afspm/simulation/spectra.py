"""Curves at a point: current and frequency shift against bias or z, and force against distance."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from afspm.model.arrays import Array
from afspm.simulation.feedback import Loop
from afspm.simulation.settings import check
from afspm.simulation.tip import TipShape

KINDS = ("IV", "force", "z")
Curves = tuple[tuple[str, ...], tuple[str, ...], Array]
"""Names, units, values [n_points, n_variables]."""

_BOLTZMANN_EV_PER_K = 8.617333e-5
_TAILS = 15.0  # of the Fermi function, in kT
_PHASES = 64  # of the modulation, at which the lock-in amplifier is computed


@dataclass(frozen=True)
class SweptCurve:
    """What a request says of one curve; None: as the settings of its kind.

    Attributes:
        ends: first and last bias in V, or height in m relative to z at the start, positive away from the sample.
        point_s: time to measure each point, each way.
        z_offset_m: height at which the bias is swept.
        modulation_v: peak amplitude of the lock-in amplifier's modulation.
    """

    ends: tuple[float, float] | None = None
    points: int | None = None
    point_s: float | None = None
    z_offset_m: float = 0.0
    modulation_v: float | None = None

    def duration_s(self, points: int, usual_s: float) -> float:
        """Return the duration of both ways, by the settings of a kind."""
        points = self.points or points
        return usual_s if self.point_s is None else 2.0 * points * self.point_s


AS_SET = SweptCurve()
"""A curve by the settings of its kind."""


@dataclass(frozen=True)
class IVSettings:
    """Sweep and sample of current-voltage curves.

    Attributes:
        range_v: largest bias: the sweep goes from -range_v to range_v.
        set_bias_v, set_current_a: the current at this bias before the feedback is opened (tunnelling: the setpoint at
            the present bias).
        gap_ev: band gap of material 0; material 1 is a metal.
        band_offset_ev: middle of the gap relative to the Fermi level (doping).
        noise_a: white noise of the current.
        relative_noise: additional noise as a fraction of the current.
        duration_s: duration of a curve.
        temperature_k: temperature of tip and sample, which broadens dI/dV by 3.5 kT.
        modulation_v: peak amplitude of the lock-in amplifier's modulation, which broadens dI/dV by 1.73 times as much.
        time_constant_s: time constant of the lock-in amplifier (6 dB per octave); dI/dV lags by it.
        noise_density_a: noise of the current around the frequency of the modulation, in A per square root of Hz.
    """

    points: int = 256
    range_v: float = 1.5
    set_bias_v: float = 1.0
    set_current_a: float = 100e-12
    gap_ev: float = 1.1
    band_offset_ev: float = 0.15
    barrier_ev: float = 4.2
    noise_a: float = 0.5e-12
    relative_noise: float = 0.005
    preamplifier_a: float = 10e-9
    duration_s: float = 2.0
    temperature_k: float = 298.0
    modulation_v: float = 20e-3
    time_constant_s: float = 2.5e-3
    noise_density_a: float = 1.4e-15

    def __post_init__(self) -> None:
        check(self, above_zero="points range_v set_current_a barrier_ev preamplifier_a duration_s temperature_k")
        check(
            self, above_zero="modulation_v time_constant_s", from_zero="gap_ev noise_a relative_noise noise_density_a"
        )


@dataclass(frozen=True)
class ForceSettings:
    """Cantilever, sample and sweep of force-distance curves; pairs are (material 0, material 1).

    Attributes:
        range_m: largest distance from the contact.
        trigger_n: the force at which the approach reverses.
        modulus_pa: reduced Young's modulus.
        adhesion_j_per_m2: work of adhesion during retraction; `approach_share` of it acts during the approach.
        hamaker_j: Hamaker constant of the attraction before contact.
    """

    points: int = 512
    range_m: float = 120e-9
    trigger_n: float = 15e-9
    spring_n_per_m: float = 0.4
    modulus_pa: tuple[float, float] = (2e9, 20e9)
    adhesion_j_per_m2: tuple[float, float] = (0.08, 0.03)
    approach_share: float = 0.5
    hamaker_j: float = 1e-19
    noise_m: float = 0.06e-9
    duration_s: float = 2.0

    def __post_init__(self) -> None:
        check(self, above_zero="points range_m trigger_n spring_n_per_m hamaker_j duration_s")
        check(self, from_zero="noise_m", fraction="approach_share")


@dataclass(frozen=True)
class ZSettings:
    """Sweep of current and frequency shift against z, relative to z at the start.

    Attributes:
        nearest_m, farthest_m: the sweep goes from `nearest_m` (below zero: towards the sample) to `farthest_m`.
        duration_s: duration of a curve.
    """

    points: int = 256
    nearest_m: float = -0.1e-9
    farthest_m: float = 2e-9
    duration_s: float = 2.0

    def __post_init__(self) -> None:
        check(self, above_zero="points farthest_m duration_s")


def current_voltage(
    settings: IVSettings,
    tip: TipShape,
    material: float,
    bias_v: float,
    loop: Loop,
    random: np.random.Generator,
    gap_m: float = 0.0,
    ends_v: tuple[float, float] | None = None,
) -> Curves:
    """Return I(V), forward and backward, and dI/dV as a lock-in amplifier measures it during the forward sweep.

    The current is the integral of the densities of states of sample and tip times the transmission of the barrier, at
    a temperature (`thermal_current`), scaled to the current that the feedback held before.

    Args:
        bias_v: bias at which the feedback held the setpoint.
        gap_m: z minus the height at which the setpoint is reached.
        ends_v: first and last bias; None: from -range_v to range_v.
    """
    first_v, last_v = ends_v or (-settings.range_v, settings.range_v)
    bias = np.linspace(first_v, last_v, settings.points)
    kt_ev = _BOLTZMANN_EV_PER_K * settings.temperature_k
    beyond = max(abs(first_v), abs(last_v), abs(bias_v)) + settings.modulation_v + _TAILS * kt_ev
    finest = min(kt_ev, settings.modulation_v) / 4.0
    energy = np.linspace(-beyond, beyond, min(20_001, max(1201, 2 * math.ceil(beyond / finest) + 1)))
    density = _sample_density(settings, energy, material) * _tip_density(tip, energy)
    # Transmission rises with the energy above the mean barrier; the bias tilts it: currents at positive and
    # negative bias differ, more for a flawed tip.
    tilt = 0.25 + (0.35 if tip.debris_m else 0.0)
    density = density * np.exp(tilt * energy / math.sqrt(settings.barrier_ev))
    current = thermal_current(energy, density, kt_ev)
    tunnels = loop.settings.mode == "current"
    held = loop.setpoint * math.exp(-gap_m / loop.settings.decay_m) if tunnels else settings.set_current_a
    at_bias = abs(float(np.interp(bias_v if tunnels else settings.set_bias_v, energy, current)))
    largest = float(np.abs(np.interp(bias, energy, current)).max())
    current *= held / max(at_bias, 1e-3 * largest, 1e-30)
    sweeps = [_through_preamplifier(settings, np.interp(bias, energy, current), tip, random) for _ in range(2)]
    clipped = np.clip(current, -settings.preamplifier_a, settings.preamplifier_a)
    dwell_s = settings.duration_s / (2.0 * settings.points)
    noise_a = settings.noise_density_a * random.standard_normal(settings.points)
    lock_in = lock_in_s(bias, energy, clipped, settings.modulation_v, settings.time_constant_s, dwell_s, noise_a)
    return ("Bias", "Current", "Current Retrace", "dI/dV"), ("V", "A", "A", "S"), np.stack([bias, *sweeps, lock_in], 1)


def thermal_current(energy_ev: Array, density: Array, kt_ev: float) -> Array:
    """Return the current at biases equal to these evenly spaced energies, 0 at 0 V, in units of the density.

    The Fermi functions of tip and sample bound the window of energies: dI/dV is the density, convolved with the
    derivative of the Fermi function, whose full width at half maximum is 3.5 kT.
    """
    step = energy_ev[1] - energy_ev[0]
    half = min(math.ceil(_TAILS * kt_ev / step), len(energy_ev) // 2 - 1)
    edges = (np.arange(-half, half + 2) - 0.5) * step
    kernel = np.diff(0.5 * (1.0 + np.tanh(edges / (2.0 * kt_ev))))
    sharp = np.cumsum((density + np.roll(density, 1)) / 2.0) * step
    current = np.convolve(np.pad(sharp, half, mode="edge"), kernel / kernel.sum(), mode="valid")
    return np.asarray(current - np.interp(0.0, energy_ev, current))


def lock_in_s(
    bias_v: Array,
    energy_ev: Array,
    current_a: Array,
    modulation_v: float,
    time_constant_s: float,
    dwell_s: float,
    noise_a: Array,
) -> Array:
    """Return dI/dV as a lock-in amplifier shows it along a sweep: the first harmonic of a modulated current.

    A modulation of peak amplitude V broadens a peak by a half circle of radius V (Klein et al. 1973). A low-pass of the
    first order with time constant t lets pass the bandwidth 1 / (4 t).

    Args:
        bias_v: the biases of the sweep, in the order of time, each for `dwell_s`.
        energy_ev, current_a: the current behind the preamplifier at biases.
        noise_a: noise in A per square root of Hz, times a normal random number for each bias.
    """
    phases = np.cos((np.arange(_PHASES) + 0.5) * (2.0 * math.pi / _PHASES))
    seen = np.interp(bias_v[:, None] + modulation_v * phases, energy_ev, current_a)
    harmonic_a = 2.0 * (seen * phases).mean(axis=1)
    part = -math.expm1(-dwell_s / time_constant_s)
    # the low-pass leaves part / (2 - part) of the power of white noise
    noise_v = np.sqrt(2.0) * noise_a * math.sqrt((2.0 - part) / part / (4.0 * time_constant_s))
    shown = np.empty_like(bias_v)
    low_pass = harmonic_a[0] + noise_v[0] * math.sqrt(part / (2.0 - part))
    for n, value in enumerate(harmonic_a + noise_v):
        shown[n] = low_pass = low_pass + (part * (value - low_pass) if n else 0.0)
    return shown / modulation_v


def over_z(
    settings: ZSettings,
    current_a: Callable[[Array], Array],
    noise_a: float,
    random: np.random.Generator,
    ends_m: tuple[float, float] | None = None,
) -> Curves:
    """Return the current against z, relative to z at the start, both ways; `current_a` is without its noise."""
    z = np.linspace(*(ends_m or (settings.nearest_m, settings.farthest_m)), settings.points)
    there, back = (current_a(z) + noise_a * random.standard_normal(settings.points) for _ in range(2))
    return ("Z", "Current", "Current Retrace"), ("m", "A", "A"), np.stack([z, there, back], 1)


def with_shift(curves: Curves, shift_hz: Array, noise_hz: float, random: np.random.Generator) -> Curves:
    """Return the curves of an oscillating sensor, which measures its frequency shift at each point as well."""
    names, units, values = curves
    both = (shift_hz + noise_hz * random.standard_normal(len(values)) for _ in range(2))
    added = ("Frequency Shift", "Frequency Shift Retrace")
    return (*names, *added), (*units, "Hz", "Hz"), np.column_stack([values, *both])


def force_distance(
    settings: ForceSettings,
    tip: TipShape,
    material: float,
    random: np.random.Generator,
    nearest_m: float = -math.inf,
) -> Curves:
    """Return deflection and force against z, approach and retract; z is 0 where the unbent cantilever touches.

    The contact follows Derjaguin, Muller and Toporov (1975): the pull-off force is 2 pi R w for a work of adhesion w.
    Before contact, van der Waals attraction acts. Quasi-static: the
    cantilever follows a branch until its end, then jumps (snap-in, pull-off), so both directions differ.

    Args:
        nearest_m: the lowest z, where the approach reverses even below the trigger.
    """
    modulus = _mix(settings.modulus_pa, material, logarithmic=True)
    adhesion = _mix(settings.adhesion_j_per_m2, material) * (1.4 if tip.debris_m else 1.0)
    radius, spring = tip.imaging_radius_m, settings.spring_n_per_m
    pull_off = 2.0 * math.pi * radius * adhesion
    deepest = ((settings.trigger_n + 2.0 * pull_off) / (4.0 / 3.0 * modulus * math.sqrt(radius))) ** (2.0 / 3.0)
    distance = np.concatenate([
        np.linspace(-deepest, 0.0, 1500, endpoint=False),
        np.geomspace(1e-13, 30e-9, 2500),
        np.linspace(31e-9, settings.range_m + 100e-9, 500),
    ])  # fmt: skip
    force_in = _force_n(distance, radius, modulus, settings.approach_share * pull_off, settings.hamaker_j)
    force_out = _force_n(distance, radius, modulus, pull_off, settings.hamaker_j)
    turn = float(np.interp(-settings.trigger_n, -force_in[:1500], (distance - force_in / spring)[:1500]))
    turn = max(turn, nearest_m)
    z = np.linspace(turn, settings.range_m, settings.points)
    there = _followed(z, distance, force_in, spring, approaching=True)
    back = _followed(z, distance, force_out, spring, approaching=False)
    deflections = [force / spring + settings.noise_m * random.standard_normal(len(z)) for force in (there, back)]
    names = ("Z", "Deflection", "Deflection Retrace", "Force", "Force Retrace")
    columns = [z, *deflections, *(d * spring for d in deflections)]
    return names, ("m", "m", "m", "N", "N"), np.stack(columns, axis=1)


def _sample_density(settings: IVSettings, energy: Array, material: float) -> Array:
    # `material` from 0 (semiconductor) to 1 (metal)
    gap = settings.gap_ev * (1.0 - 0.3 * material)
    bands = np.sqrt(np.maximum(np.abs(energy - settings.band_offset_ev) - gap / 2, 0.0))
    metal = 0.7 + 0.12 * energy + 0.25 * np.exp(-(((energy + 0.45) / 0.12) ** 2))
    share = material**2
    return np.asarray((1.0 - share) * bands + share * metal + 1e-3)


def _tip_density(tip: TipShape, energy: Array) -> Array:
    # flat for a clean metal; debris adds a state of its own, a deformed tip a slope
    density = np.ones_like(energy)
    if tip.debris_m:
        density += 1.6 * np.exp(-(((energy - 0.62) / 0.09) ** 2))
    if tip.second_apex_m or "blunt" in tip.flaws:
        density += 0.15 * np.tanh(energy)
    return density


def _through_preamplifier(settings: IVSettings, clean: Array, tip: TipShape, random: np.random.Generator) -> Array:
    share = settings.relative_noise * (4.0 if tip.debris_m else 1.0)
    noisy = clean * (1.0 + share * random.standard_normal(len(clean)))
    noisy += settings.noise_a * random.standard_normal(len(clean))
    return np.asarray(np.clip(noisy, -settings.preamplifier_a, settings.preamplifier_a))


def _mix(pair: tuple[float, float], material: float, *, logarithmic: bool = False) -> float:
    if logarithmic:
        return float(pair[0] ** (1.0 - material) * pair[1] ** material)
    return pair[0] * (1.0 - material) + pair[1] * material


def _force_n(distance: Array, radius: float, modulus: float, pull_off: float, hamaker: float) -> Array:
    # positive repels; the attraction levels off at contact, at the pull-off force
    contact = math.sqrt(hamaker * radius / (6.0 * pull_off)) if pull_off else 0.3e-9
    attraction = -hamaker * radius / (6.0 * (np.maximum(distance, 0.0) + contact) ** 2)
    pressed = 4.0 / 3.0 * modulus * math.sqrt(radius) * np.maximum(-distance, 0.0) ** 1.5
    return np.asarray(attraction + pressed)


def _followed(z: Array, distance: Array, force: Array, spring: float, *, approaching: bool) -> Array:
    # the branch depends on history: approaching from afar, or retracting from contact
    # In equilibrium z = distance - deflection; where that is not monotonic the branch ends.
    extension = distance - force / spring
    if approaching:  # the same with the sign of z turned
        z, extension, force = -z, -extension[::-1], force[::-1]
    reached = np.maximum.accumulate(extension)
    after = np.clip(np.searchsorted(reached, z, side="left"), 1, len(force) - 1)
    before = after - 1
    share = np.clip((z - extension[before]) / (extension[after] - extension[before]), 0.0, 1.0)
    share[extension[before] < reached[before]] = 1.0  # beyond the end of a branch
    return np.asarray(force[before] + share * (force[after] - force[before]))
