"""Conversion of places, positions and scan parameters to and from the units and corners on the wire.

Sent messages are in metres and degrees; received messages may have any unit. A request to change a part of a setting
has only the fields to change.
"""

from __future__ import annotations

import math

from afspm import model
from afspm.basics.errors import InvalidValue
from afspm.basics.formatting import lengths_text
from afspm.basics.units import convert
from afspm.model.scan import ShapeChange
from afspm.wire.generated import control_pb2, scan_pb2, spectroscopy_pb2

# In metres, a setting and its published value are equal to the last bit; published peers assume degrees without a unit.
LENGTH_UNIT = "m"
ANGLE_UNIT = "deg"


def spatial_to_wire(region: model.Region | model.RegionChange) -> scan_pb2.SpatialAspects:
    spatial = scan_pb2.SpatialAspects(length_units=LENGTH_UNIT, angular_units=ANGLE_UNIT)
    if isinstance(region, model.Region):
        (left, low), (width, height) = region.top_left_m, region.size_m
        region = model.RegionChange(left, low, width, height, region.angle_rad)
    roi = spatial.roi
    if region.left_m is not None:
        roi.top_left.x = region.left_m
    if region.low_m is not None:
        roi.top_left.y = region.low_m
    if region.width_m is not None:
        roi.size.x = region.width_m
    if region.height_m is not None:
        roi.size.y = region.height_m
    if region.angle_rad is not None:
        roi.angle = math.degrees(region.angle_rad)
    return spatial


def spatial_from_wire(spatial: scan_pb2.SpatialAspects) -> model.RegionChange | None:
    """Return the given fields of a message's region, in SI; None for a message without a region.

    Raises:
        UnitError: the unit of lengths is not a length, or the unit of angles not an angle.
    """
    if not spatial.HasField("roi"):
        return None
    roi = spatial.roi
    # the wire format's units for a message without any
    unit = spatial.length_units or "m"
    angle_unit = spatial.angular_units or "deg"

    def metres(holder: str, axis: str) -> float | None:
        if not roi.HasField(holder) or not getattr(roi, holder).HasField(axis):
            return None
        return convert(float(getattr(getattr(roi, holder), axis)), unit, "m")

    angle = convert(roi.angle, angle_unit, "rad") if roi.HasField("angle") else None
    return model.RegionChange(
        metres("top_left", "x"), metres("top_left", "y"), metres("size", "x"), metres("size", "y"), angle
    )


def whole_region(change: model.RegionChange | None) -> model.Region | None:
    """Return the region if every field but the angle is given; a missing angle is zero.

    Raises:
        InvalidValue: the fields are no valid region.
    """
    if change is None:
        return None
    left, low, width, height = change.left_m, change.low_m, change.width_m, change.height_m
    if left is None or low is None or width is None or height is None:
        return None
    return model.Region.from_top_left((left, low), (width, height), change.angle_rad or 0.0)


def scan_parameters_to_wire(parameters: model.ScanParameters) -> scan_pb2.ScanParameters2d:
    message = scan_pb2.ScanParameters2d()
    if parameters.region is not None:
        message.spatial.CopyFrom(spatial_to_wire(parameters.region))
    if parameters.shape is not None:
        shape = parameters.shape
        change = shape if isinstance(shape, ShapeChange) else ShapeChange(*shape)
        if change.rows is not None:
            message.data.shape.y = change.rows
        if change.columns is not None:
            message.data.shape.x = change.columns
    if parameters.unit is not None:
        message.data.units = parameters.unit
    return message


def scan_parameters_from_wire(message: scan_pb2.ScanParameters2d) -> model.ScanParameters:
    """Return scan parameters, with a RegionChange if a field of the region, such as its angle, is missing.

    Raises:
        InvalidValue, UnitError: a value is invalid.
    """
    change = spatial_from_wire(message.spatial)
    _finite(change)
    # a request without an angle keeps the present angle, so it is only a change of the region
    region = whole_region(change) if change is not None and change.angle_rad is not None else None
    shape: tuple[int, int] | ShapeChange | None = None
    if message.data.HasField("shape"):
        rows = message.data.shape.y if message.data.shape.HasField("y") else None
        columns = message.data.shape.x if message.data.shape.HasField("x") else None
        shape = ShapeChange(rows, columns) if rows is None or columns is None else (rows, columns)
    return model.ScanParameters(region or change, shape, message.data.units or None)


def _finite(change: model.RegionChange | None) -> None:
    if change is None:
        return
    for name, value in vars(change).items():
        if value is not None and not math.isfinite(value):
            raise InvalidValue(f"{name.rsplit('_', 1)[0]} of the region is {value}")
    for side, size_m in (("width", change.width_m), ("height", change.height_m)):
        if size_m is not None and size_m <= 0.0:
            raise InvalidValue(f"the {side} of the region is {lengths_text([size_m])}", hint="above zero")


def position_to_wire(position: model.ProbePosition) -> spectroscopy_pb2.ProbePosition:
    message = spectroscopy_pb2.ProbePosition(units=LENGTH_UNIT)
    message.point.x, message.point.y = position.xy_m
    return message


def position_from_wire(message: spectroscopy_pb2.ProbePosition) -> model.ProbePosition:
    """Return a complete probe position.

    Raises:
        InvalidValue: a coordinate is missing or not finite.
        UnitError: a unit is not a length.
    """
    change = position_change_from_wire(message)
    if isinstance(change, model.PositionChange):
        raise InvalidValue("a probe position needs x and y")
    return change


def position_change_from_wire(
    message: spectroscopy_pb2.ProbePosition,
) -> model.ProbePosition | model.PositionChange:
    """Return the position in a request; a PositionChange if it gives only x or only y.

    Raises:
        InvalidValue: both coordinates are missing, or one is not finite.
        UnitError: the unit is not a length.
    """
    unit, point = message.units or "m", message.point
    x_m = convert(point.x, unit, "m") if point.HasField("x") else None
    y_m = convert(point.y, unit, "m") if point.HasField("y") else None
    if not all(math.isfinite(value) for value in (x_m, y_m) if value is not None):
        raise InvalidValue(f"the probe position is ({x_m}, {y_m}) m")
    if x_m is None and y_m is None:
        raise InvalidValue("a probe position without x and y")
    if x_m is None or y_m is None:
        return model.PositionChange(x_m, y_m)
    return model.ProbePosition((x_m, y_m))


def action_from_wire(message: control_pb2.ActionMsg) -> str:
    if not message.action:
        raise InvalidValue("an action without a name")
    return message.action
