"""Positions of scan and probe in tip coordinates, and the parameters that make them up."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace

from afspm.basics.errors import InvalidValue
from afspm.basics.plain_data import Plain
from afspm.model import PositionChange, ProbePosition, Region, RegionChange, ScanParameters, names
from afspm.model.geometry import XY
from afspm.model.scan import ShapeChange

SHAPE_CHANGES: dict[str, Callable[[int], ShapeChange]] = {
    names.SCAN_RESOLUTION_X: lambda value: ShapeChange(columns=value),
    names.SCAN_RESOLUTION_Y: lambda value: ShapeChange(rows=value),
}
PROBE_CHANGES: dict[str, Callable[[float], PositionChange]] = {
    names.PROBE_POS_X: lambda value: PositionChange(x_m=value),
    names.PROBE_POS_Y: lambda value: PositionChange(y_m=value),
}
REGION_CHANGES: dict[str, Callable[[float], RegionChange]] = {
    names.SCAN_TOP_LEFT_X: lambda value: RegionChange(left_m=value),
    names.SCAN_TOP_LEFT_Y: lambda value: RegionChange(low_m=value),
    names.SCAN_SIZE_X: lambda value: RegionChange(width_m=value),
    names.SCAN_SIZE_Y: lambda value: RegionChange(height_m=value),
    names.SCAN_ANGLE: lambda value: RegionChange(angle_rad=value),
}
PLACES = frozenset((*REGION_CHANGES, *PROBE_CHANGES, *SHAPE_CHANGES))
"""Parameters that say where to measure."""

_CORNER_AND_SIZE = REGION_CHANGES.keys() - {names.SCAN_ANGLE}
_ANYWHERE = Region((0.0, 0.0), (1.0, 1.0))
"""A placeholder: every field is replaced at once."""


@dataclass(frozen=True, slots=True)
class KnownPosition:
    """The last set or published position of scan and probe.

    Attributes:
        region, shape: region and shape of the scan; the shape as (rows, columns).
        probe_m: the probe position.
    """

    region: Region | None = None
    shape: tuple[int, int] | None = None
    probe_m: XY | None = None

    def learn(self, subject: object) -> KnownPosition:
        """Return the positions after a setting or publication, complete or in part.

        A part of an unknown region, and an invalid value, change nothing.
        """
        with suppress(InvalidValue):  # a part of an unknown region
            return self.onto(subject)
        return self

    def onto(self, subject: object) -> KnownPosition:
        """Return the positions after a request that sets a position, complete or in part.

        Raises:
            InvalidValue: a part of an unknown region, or an invalid region.
        """
        if isinstance(subject, ScanParameters):
            scan = subject.onto(ScanParameters(self.region, self.shape))
            region = scan.region if isinstance(scan.region, Region) else None
            return replace(self, region=region, shape=scan.shape if isinstance(scan.shape, tuple) else None)
        if isinstance(subject, ProbePosition):
            return replace(self, probe_m=subject.xy_m)
        if isinstance(subject, PositionChange) and self.probe_m is not None:
            return replace(self, probe_m=moved(self.probe_m, subject))
        return self

    def learn_values(self, values: Iterable[tuple[str, float]]) -> KnownPosition:
        """Return the positions after single parameters in SI; parameters without a position are ignored."""
        known = self
        with suppress(InvalidValue):
            for change in changes_by(values):
                known = known.learn(change)
        return known

    def was_read(self, values: Mapping[str, float | None]) -> KnownPosition:
        """Return the positions after single parameters read together; a missing parameter keeps its value.

        On a microscope without an angle parameter a frame counts as unrotated.

        Args:
            values: values in SI by the parameter's name; None for an answer without a number.
        """
        wrong = [name for name, value in values.items() if value is None]
        known = self.without(wrong)
        read = [(name, value) for name, value in values.items() if value is not None]
        names_read = {name for name, _ in read}
        if known.region is None and names_read >= _CORNER_AND_SIZE and names.SCAN_ANGLE not in wrong:
            known = replace(known, region=_ANYWHERE)
        if known.shape is None and names_read >= SHAPE_CHANGES.keys():
            known = replace(known, shape=(1, 1))
        if known.probe_m is None and names_read >= PROBE_CHANGES.keys():
            known = replace(known, probe_m=(0.0, 0.0))
        for place in (REGION_CHANGES, SHAPE_CHANGES, PROBE_CHANGES):
            given = [(name, value) for name, value in read if name in place]
            try:
                for change in changes_by(given):
                    known = known.onto(change)
            except InvalidValue:  # the microscope answered nonsense: a frame without size, half a pixel
                known = known.without([name for name, _ in given])
        return known

    def without(self, names_: Collection[str]) -> KnownPosition:
        """Return the positions, with region, shape or probe forgotten if a named parameter is a part of it."""
        return KnownPosition(
            None if REGION_CHANGES.keys() & names_ else self.region,
            None if SHAPE_CHANGES.keys() & names_ else self.shape,
            None if PROBE_CHANGES.keys() & names_ else self.probe_m,
        )


def changes_by(values: Iterable[tuple[str, float]]) -> list[PositionChange | ScanParameters]:
    """Return the changes of probe and scan by single parameters that are set together.

    Raises:
        InvalidValue: a number of pixels is not a whole number, or below 1.
    """
    given: dict[type, Plain] = {}
    for name, value in values:
        change: PositionChange | RegionChange | ShapeChange
        if name in SHAPE_CHANGES:
            if value < 1 or value != int(value):
                raise InvalidValue(f"{name} = {value:g}: pixels are counted from 1 in whole numbers")
            change = SHAPE_CHANGES[name](int(value))
        elif name in PROBE_CHANGES:
            change = PROBE_CHANGES[name](value)
        elif name in REGION_CHANGES:
            change = REGION_CHANGES[name](value)
        else:
            continue
        parts = given.setdefault(type(change), {})
        parts.update((part, one) for part, one in asdict(change).items() if one is not None)
    found: list[PositionChange | ScanParameters] = []
    if PositionChange in given:
        found.append(PositionChange(**given[PositionChange]))
    if RegionChange in given or ShapeChange in given:
        region = RegionChange(**given[RegionChange]) if RegionChange in given else None
        shape = ShapeChange(**given[ShapeChange]) if ShapeChange in given else None
        found.append(ScanParameters(region, shape))
    return found


def moved(xy_m: XY, change: PositionChange) -> XY:
    """Return the probe position after a move along one axis or both."""
    return (xy_m[0] if change.x_m is None else change.x_m, xy_m[1] if change.y_m is None else change.y_m)


def scan_values(wanted: ScanParameters) -> list[tuple[str, float]]:
    """Return the parameters that a request for a scan sets, with values in SI."""
    region, values = wanted.region, list[tuple[str, float]]()
    if isinstance(region, Region):
        (left, low), (width, height) = region.top_left_m, region.size_m
        region = RegionChange(left, low, width, height, region.angle_rad)
    if region is not None:
        given = (
            (names.SCAN_TOP_LEFT_X, region.left_m),
            (names.SCAN_TOP_LEFT_Y, region.low_m),
            (names.SCAN_SIZE_X, region.width_m),
            (names.SCAN_SIZE_Y, region.height_m),
            (names.SCAN_ANGLE, region.angle_rad),
        )
        values += [(name, value) for name, value in given if value is not None]
    shape = wanted.shape
    if shape is not None:
        change = shape if isinstance(shape, ShapeChange) else ShapeChange(*shape)
        pixels = ((names.SCAN_RESOLUTION_X, change.columns), (names.SCAN_RESOLUTION_Y, change.rows))
        values += [(name, value) for name, value in pixels if value is not None]
    return values
