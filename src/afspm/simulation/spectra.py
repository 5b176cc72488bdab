"""Curves at a point: current against bias, and force against distance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from afspm.model.arrays import Array
from afspm.simulation.feedback import Loop
from afspm.simulation.settings import check
from afspm.simulation.tip import TipShape

KINDS = ("IV", "force")
Curves = tuple[tuple[str, ...], tuple[str, ...], Array]
"""Names, units, values [n_points, n_variables]."""

_KT_EV = 0.0257


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

    def __post_init__(self) -> None:
        check(self, above_zero="points range_v set_current_a barrier_ev preamplifier_a duration_s")
        check(self, from_zero="gap_ev noise_a relative_noise")


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


def current_voltage(
    settings: IVSettings, tip: TipShape, material: float, bias_v: float, loop: Loop, random: np.random.Generator
) -> Curves:
    """Return I(V), forward and backward, and dI/dV as a lock-in amplifier measures it.

    The current is the integral of the densities of states of sample and tip times the transmission of the barrier,
    scaled to the current that the feedback held before.
    """
    bias = np.linspace(-settings.range_v, settings.range_v, settings.points)
    energy = np.linspace(-settings.range_v - 0.5, settings.range_v + 0.5, 1201)
    density = _sample_density(settings, energy, material) * _tip_density(tip, energy)
    # Transmission rises with the energy above the mean barrier; the bias tilts it: currents at positive and
    # negative bias differ, more for a flawed tip.
    tilt = 0.25 + (0.35 if tip.debris_m else 0.0)
    density = density * np.exp(tilt * energy / math.sqrt(settings.barrier_ev))
    step = energy[1] - energy[0]
    from_zero = np.cumsum(density) * step
    from_zero -= np.interp(0.0, energy, from_zero)
    current = np.interp(bias, energy, from_zero)
    tunnels = loop.settings.mode == "current"
    held = loop.setpoint if tunnels else settings.set_current_a
    at_bias = abs(float(np.interp(bias_v if tunnels else settings.set_bias_v, energy, from_zero)))
    scale = held / max(at_bias, 1e-3 * float(np.abs(current).max()), 1e-30)
    clean = current * scale
    sweeps = [_through_preamplifier(settings, clean, tip, random) for _ in range(2)]
    lock_in = np.interp(bias, energy, density) * scale
    lock_in = lock_in + settings.noise_a * 2.0 * random.standard_normal(settings.points)
    return ("Bias", "Current", "Current Retrace", "dI/dV"), ("V", "A", "A", "S"), np.stack([bias, *sweeps, lock_in], 1)


def force_distance(settings: ForceSettings, tip: TipShape, material: float, random: np.random.Generator) -> Curves:
    """Return deflection and force against z, approach and retract; z is 0 where the unbent cantilever touches.

    The contact follows Derjaguin, Muller and Toporov; before contact, van der Waals attraction acts. Quasi-static: the
    cantilever follows a branch until its end, then jumps (snap-in, pull-off), so both directions differ.
    """
    modulus = _mix(settings.modulus_pa, material, logarithmic=True)
    adhesion = _mix(settings.adhesion_j_per_m2, material) * (1.4 if tip.debris_m else 1.0)
    radius, spring = tip.imaging_radius_m, settings.spring_n_per_m
    pull_off = 4.0 * math.pi * radius * adhesion
    deepest = ((settings.trigger_n + 2.0 * pull_off) / (4.0 / 3.0 * modulus * math.sqrt(radius))) ** (2.0 / 3.0)
    distance = np.concatenate([
        np.linspace(-deepest, 0.0, 1500, endpoint=False),
        np.geomspace(1e-13, 30e-9, 2500),
        np.linspace(31e-9, settings.range_m + 100e-9, 500),
    ])  # fmt: skip
    force_in = _force_n(distance, radius, modulus, settings.approach_share * pull_off, settings.hamaker_j)
    force_out = _force_n(distance, radius, modulus, pull_off, settings.hamaker_j)
    turn = float(np.interp(-settings.trigger_n, -force_in[:1500], (distance - force_in / spring)[:1500]))
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
    outside = np.abs(energy - settings.band_offset_ev) - gap / 2
    bands = np.sqrt(np.log1p(np.exp(np.clip(outside / (2 * _KT_EV), -60, 60))) * 2 * _KT_EV)
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
    if approaching:
        reached = np.minimum.accumulate(extension[::-1])  # falls on the way in
        index = np.searchsorted(-reached, -z, side="left")
        return np.asarray(force[::-1][np.minimum(index, len(force) - 1)])
    reached = np.maximum.accumulate(extension)
    return np.asarray(force[np.minimum(np.searchsorted(reached, z, side="left"), len(force) - 1)])
