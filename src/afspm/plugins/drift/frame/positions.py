"""Places set at the microscope, in both coordinates: as requested in sample, and as set in tip coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Generic, Protocol, TypeVar

from afspm.basics import convert
from afspm.model import Parameter, ProbePosition, Region, names
from afspm.scheduler import Codec

P = TypeVar("P", bound=Region | ProbePosition)

SAME = 1e-3
"""Largest rounding by a controller, as a share of the region's diagonal; a smaller difference is no change."""
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
    """Part of the wire format that places need."""

    def encode(self, thing: object) -> bytes:
        """Return a ScanParameters or ProbePosition as a message."""

    def relocated(self, message: str, payload: bytes | memoryview, told: bytes) -> bytes:
        """Return a message with its place replaced by the place in another message.

        The other message is a ScanParameters2d or a ProbePosition.
        """


@dataclass(frozen=True)
class PositionPair(Generic[P]):
    """A place in sample and in tip coordinates.

    Attributes:
        sample: place as requested by a component.
        requested: the component's message, unchanged.
        tip: place as set at the microscope.
        sent: message that set the place at the microscope.
    """

    sample: P
    requested: bytes
    tip: P
    sent: bytes


@dataclass(frozen=True)
class TargetPosition(Generic[P]):
    """The place in force, and recently sent places: a packet may arrive before the answer to its request."""

    current: PositionPair[P] | None = None
    sent: tuple[PositionPair[P], ...] = ()

    def at(self, place: PositionPair[P]) -> TargetPosition[P]:
        """Return a copy with another place in force."""
        return replace(self, current=place)

    def sending(self, place: PositionPair[P]) -> TargetPosition[P]:
        """Return a copy with a place that is about to be sent to the microscope."""
        return replace(self, sent=(*self.sent, place)[-_CANDIDATES:])

    def was_set(self, sent: bytes) -> TargetPosition[P]:
        """Return a copy with the place of an accepted message in force; an unknown message changes nothing."""
        return replace(self, current=next((place for place in reversed(self.sent) if place.sent == sent), self.current))

    def published(self, tip: P) -> TargetPosition[P] | None:
        """Return a copy with the place published by the microscope in force.

        None if the place is neither in force nor among the recently sent places, within a controller's rounding.
        """
        known: list[PositionPair[P]] = [*self.sent] if self.current is None else [self.current, *self.sent]
        away = [(away_m(place.tip, tip), place) for place in reversed(known)]
        near = [(far_m, place) for far_m, place in away if far_m <= _rounding_m(place.tip)]
        return self.at(min(near, key=itemgetter(0))[1]) if near else None  # of equally near places the newest


def away_m(a: Region | ProbePosition, b: Region | ProbePosition) -> float:
    """Return the largest distance between corresponding corners of two regions, or between two positions, in m."""
    if a == b:  # as for each packet of lines, but for those after a new frame
        return 0.0
    if isinstance(a, Region) and isinstance(b, Region):
        corners = zip(a.corners_m(), b.corners_m(), strict=True)
        return max(math.dist(one, other) for one, other in corners)
    assert isinstance(a, ProbePosition)
    assert isinstance(b, ProbePosition)
    return math.dist(a.xy_m, b.xy_m)


def is_same(a: Region | ProbePosition, b: Region | ProbePosition) -> bool:
    """Return whether two places are equal to within the rounding of a controller."""
    return away_m(a, b) <= _rounding_m(a)


def _rounding_m(place: Region | ProbePosition) -> float:
    return SAME * math.hypot(*place.size_m) if isinstance(place, Region) else SAME_PLACE_M


def value_in(name: str, region: Region) -> float:
    """Return the value of a scan parameter in a region, in SI units."""
    return float(_VALUES[name](region))


def in_reported_unit(name: str, value: float, reported: Parameter | None) -> Parameter:
    """Return a value in SI units as a parameter in the unit that the microscope reported.

    Without a reported unit, angles are in degrees and all other values in SI units.
    """
    unit = _unit(reported or Parameter(name))
    # 15 digits: a value set as 0.1 nm reads as 0.1, not as 0.09999999999999999
    return Parameter(name, f"{convert(value, names.BASE_PARAMETERS[name] or '', unit):.15g}", unit)


def _unit(parameter: Parameter) -> str:
    # without a unit an angle is in degrees on the wire, everything else in SI
    si = names.BASE_PARAMETERS[parameter.name] or ""
    return parameter.unit or ("deg" if parameter.name == names.SCAN_ANGLE else si)
