"""Single numbers of a place as generic parameters: out of a text with a unit, and into one."""

from __future__ import annotations

import math

from afspm.errors import AfspmError
from afspm.model import Parameter, Region, names
from afspm.model.names import BASE_PARAMETERS
from afspm.units import convert

_VALUES = {
    names.SCAN_TOP_LEFT_X: lambda region: region.top_left_m[0],
    names.SCAN_TOP_LEFT_Y: lambda region: region.top_left_m[1],
    names.SCAN_SIZE_X: lambda region: region.size_m[0],
    names.SCAN_SIZE_Y: lambda region: region.size_m[1],
    names.SCAN_ANGLE: lambda region: region.angle_rad,
}


def number_of(parameter: Parameter) -> float | None:
    """Its value in SI; None if it is no finite number of the right kind."""
    try:
        value = float(convert(float(parameter.value or ""), _unit(parameter), BASE_PARAMETERS[parameter.name] or ""))
    except (AfspmError, ValueError, KeyError):
        return None
    return value if math.isfinite(value) else None


def value_in(name: str, region: Region) -> float:
    """What a parameter is of a region, in SI."""
    return float(_VALUES[name](region))


def told_as(name: str, value: float, told: Parameter | None) -> Parameter:
    """A value in SI in the unit in which the microscope told its own."""
    unit = _unit(told or Parameter(name))
    # 15 digits: what was set as 0.1 nm is told as 0.1, not as 0.09999999999999999
    return Parameter(name, f"{convert(value, BASE_PARAMETERS[name] or '', unit):.15g}", unit)


def _unit(parameter: Parameter) -> str:
    """Without a unit an angle is in degrees on the wire, everything else in SI."""
    return parameter.unit or ("deg" if parameter.name == names.SCAN_ANGLE else BASE_PARAMETERS[parameter.name] or "")
