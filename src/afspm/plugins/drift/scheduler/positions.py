"""The places in force at the microscope, in both coordinates: as asked for, and as set."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

from afspm.basics.units import convert
from afspm.model import Parameter, ProbePosition, Region, names
from afspm.model.names import BASE_PARAMETERS
from afspm.scheduler.events import Codec

P = TypeVar("P", bound=Region | ProbePosition)

SAME = 1e-3
"""Part of a region's size by which a controller may round: what it tells then is what it was set to."""
SAME_PLACE_M = 1e-9

_CANDIDATES = 8
_VALUES = {
    names.SCAN_TOP_LEFT_X: lambda region: region.top_left_m[0],
    names.SCAN_TOP_LEFT_Y: lambda region: region.top_left_m[1],
    names.SCAN_SIZE_X: lambda region: region.size_m[0],
    names.SCAN_SIZE_Y: lambda region: region.size_m[1],
    names.SCAN_ANGLE: lambda region: region.angle_rad,
}


class PlaceCodec(Codec, Protocol):
    """The wire as far as places matter."""

    def encode(self, thing: object) -> bytes:
        """A ScanParameters or ProbePosition as a message."""

    def relocated(self, message: str, payload: bytes | memoryview, told: bytes) -> bytes:
        """A message with the place of another: of a ScanParameters2d (for scans too), or of a ProbePosition."""


@dataclass(frozen=True)
class PositionPair(Generic[P]):
    """A place in both coordinates.

    Attributes:
        sample: as components say it.
        said: the message in which they said it, to the last bit.
        tip: as the microscope was set.
        sent: the message by which it was.
    """

    sample: P
    said: bytes
    tip: P
    sent: bytes


@dataclass(frozen=True)
class TargetPosition(Generic[P]):
    """The place in force, and the places sent lately: a packet may come before the answer to its request."""

    current: PositionPair[P] | None = None
    sent: tuple[PositionPair[P], ...] = ()

    def at(self, place: PositionPair[P]) -> TargetPosition[P]:
        """Put a place in force."""
        return replace(self, current=place)

    def sending(self, place: PositionPair[P]) -> TargetPosition[P]:
        """Add a place to which the microscope will be set."""
        return replace(self, sent=(*self.sent, place)[-_CANDIDATES:])

    def was_set(self, sent: bytes) -> TargetPosition[P]:
        """Put a place in force: the microscope accepted the message."""
        return replace(self, current=next((place for place in reversed(self.sent) if place.sent == sent), self.current))

    def published(self, tip: P) -> TargetPosition[P] | None:
        """Return the target with the place that the microscope publishes in force; None: the scheduler set no such."""
        known: list[PositionPair[P]] = [*self.sent] if self.current is None else [self.current, *self.sent]
        near = [place for place in reversed(known) if is_same(place.tip, tip)]  # the newest first, of those as near
        return self.at(min(near, key=lambda place: away_m(place.tip, tip))) if near else None


def away_m(a: Region | ProbePosition, b: Region | ProbePosition) -> float:
    """The largest distance of two corners, or of two positions, m."""
    if isinstance(a, Region) and isinstance(b, Region):
        corners = zip(a.corners_m(), b.corners_m(), strict=True)
        return max(math.dist(one, other) for one, other in corners)
    assert isinstance(a, ProbePosition)
    assert isinstance(b, ProbePosition)
    return math.dist(a.xy_m, b.xy_m)


def is_same(a: Region | ProbePosition, b: Region | ProbePosition) -> bool:
    """Return whether two places are one but for rounding."""
    near_m = SAME * math.hypot(*a.size_m) if isinstance(a, Region) else SAME_PLACE_M
    return away_m(a, b) <= near_m


def value_in(name: str, region: Region) -> float:
    """Return the value of a parameter in a region, in SI."""
    return float(_VALUES[name](region))


def told_as(name: str, value: float, told: Parameter | None) -> Parameter:
    """A value in SI in the unit in which the microscope told its own."""
    unit = _unit(told or Parameter(name))
    # 15 digits: what was set as 0.1 nm is told as 0.1, not as 0.09999999999999999
    return Parameter(name, f"{convert(value, BASE_PARAMETERS[name] or '', unit):.15g}", unit)


def _unit(parameter: Parameter) -> str:
    # without a unit an angle is in degrees on the wire, everything else in SI
    return parameter.unit or ("deg" if parameter.name == names.SCAN_ANGLE else BASE_PARAMETERS[parameter.name] or "")
