"""Treatments of a tip, their order and their places. Pure, so that each repair can be predicted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from afspm.basics.errors import ConfigError
from afspm.model import Region

XY = tuple[float, float]


@dataclass(frozen=True)
class Pulse:
    """A pulse of the bias voltage."""

    voltage_v: float
    duration_s: float

    def __str__(self) -> str:
        return f"pulse of {self.voltage_v:+g} V, {self.duration_s * 1e3:g} ms"


@dataclass(frozen=True)
class Crash:
    """A controlled crash: the tip is driven into the sample by a depth, at a speed."""

    depth_m: float
    speed_m_per_s: float

    def __str__(self) -> str:
        return f"crash of {self.depth_m * 1e9:g} nm at {self.speed_m_per_s * 1e9:g} nm/s"


Treatment = Pulse | Crash


def treatments(
    pulse_voltages_v: Sequence[float],
    pulse_duration_s: float,
    crash_depths_m: Sequence[float],
    crash_speed_m_per_s: float,
) -> tuple[Treatment, ...]:
    """Return the treatments of one repair: pulses as listed, then crashes as listed.

    Raises:
        ConfigError: no treatment is listed, or a value is invalid.
    """
    if not pulse_voltages_v and not crash_depths_m:
        raise ConfigError("no treatment is allowed", hint="list `pulse_voltages`, `crash_depths` or both")
    if any(v == 0.0 for v in pulse_voltages_v) or (pulse_voltages_v and pulse_duration_s <= 0.0):
        raise ConfigError("a pulse needs a voltage and a duration", where="pulse_voltages")
    if any(depth <= 0.0 for depth in crash_depths_m) or (crash_depths_m and crash_speed_m_per_s <= 0.0):
        raise ConfigError("a crash needs a depth and a speed above zero", where="crash_depths")
    pulses = tuple(Pulse(float(v), float(pulse_duration_s)) for v in pulse_voltages_v)
    crashes = tuple(Crash(float(depth), float(crash_speed_m_per_s)) for depth in crash_depths_m)
    return pulses + crashes


def fresh_place(center_m: XY, spacing_m: float, number: int) -> XY:
    """Return place `number`, from 0, of a spiral of places at least `spacing_m` apart: sunflower seeds (Vogel 1979)."""
    # with this factor the two nearest places are 1.2 spacings apart
    radius = 1.2 * spacing_m * math.sqrt(number)
    angle = number * math.pi * (3.0 - math.sqrt(5.0))
    return center_m[0] + radius * math.cos(angle), center_m[1] + radius * math.sin(angle)


@dataclass(frozen=True)
class TreatmentPlaces:
    """The places of treatments on the sample, each used once.

    Attributes:
        center_m: the centre of the places.
        spacing_m: the distance between the places of two treatments.
        keep_away_m: least distance of a place from scanned regions.
    """

    center_m: XY
    spacing_m: float
    keep_away_m: float

    def __post_init__(self) -> None:
        if self.spacing_m <= 0.0 or self.keep_away_m < 0.0:
            raise ConfigError("`place_spacing` must be above zero, `keep_away` not below")

    def fresh(self, number: int) -> XY:
        return fresh_place(self.center_m, self.spacing_m, number)


def clearance_m(place_m: XY, region: Region) -> float:
    """Return the distance of a place from a region; 0 within."""
    cos, sin = math.cos(region.angle_rad), math.sin(region.angle_rad)
    dx, dy = place_m[0] - region.center_m[0], place_m[1] - region.center_m[1]
    u, v = dx * cos + dy * sin, -dx * sin + dy * cos
    beside = (max(abs(u) - region.size_m[0] / 2, 0.0), max(abs(v) - region.size_m[1] / 2, 0.0))
    return math.hypot(*beside)
