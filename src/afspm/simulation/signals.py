"""Signals besides the height: what phase and current tell of the sample."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from afspm.simulation.feedback import Loop
from afspm.simulation.fields import Array
from afspm.simulation.settings import check


@dataclass(frozen=True)
class SignalSettings:
    """How the sample answers.

    Attributes:
        dissipation: energy lost to the sample a cycle, as a share of what the cantilever loses itself, mean of both
            materials; dissipation_contrast: their difference.
        conductance_s: of the contact when the tip taps gently (mean over the cycle).
        conductance_contrast: ln of the ratio of both materials' conductances.
        current_decay_m: the gap over which that current falls by e.
        preamplifier_a: where the current amplifier saturates.
    """

    dissipation: float = 0.12
    dissipation_contrast: float = 0.12
    conductance_s: float = 100e-12
    conductance_contrast: float = 1.5
    current_decay_m: float = 4e-9
    preamplifier_a: float = 10e-9

    def __post_init__(self) -> None:
        check(self, from_zero="dissipation conductance_s", above_zero="current_decay_m preamplifier_a")


def phase_deg(settings: SignalSettings, loop: Loop, amplitude_v: Array, material: Array, slope: Array) -> Array:
    """Phase of the cantilever behind its drive: sin(phase) = A / A0 * (1 + dissipation) (Cleveland et al. 1998).

    Free it lags by 90 degrees; on a slope the flank of the tip touches more of the sample and dissipates more.
    """
    share = amplitude_v / loop.settings.free_amplitude_v
    lost = settings.dissipation + settings.dissipation_contrast * (material - 0.5)
    lost = lost * (1.0 + 0.5 * np.sqrt(1.0 + slope * slope) - 0.5) * (1.0 - share) / 0.3
    return np.asarray(np.degrees(np.arcsin(np.clip(share * (1.0 + lost), 0.0, 1.0))))


def current_a(settings: SignalSettings, loop: Loop, gap_m: Array, material: Array, bias_v: float) -> Array:
    """Exponential in the gap; tunnelling at the setpoint's current, tapping at the conductance of the contact."""
    contrast = settings.conductance_contrast * (material - 0.5)
    if loop.settings.mode == "current":
        # The feedback holds the current, so a better conductor shows in the height; what is left is the error.
        mean = np.copysign(loop.setpoint, bias_v)
        exponent = -gap_m / loop.settings.decay_m
    else:
        mean = np.float64(settings.conductance_s * bias_v)
        exponent = contrast - gap_m / settings.current_decay_m + 2.0 * (loop.force - 1.0)
    current = mean * np.exp(np.clip(exponent, -60.0, 60.0))
    return np.asarray(np.clip(current, -settings.preamplifier_a, settings.preamplifier_a))
