"""The parameters in a request or a packet, each in one unit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from afspm.basics.errors import AfspmError
from afspm.basics.units import convert
from afspm.model import Feedback, Parameter, PositionChange, ProbePosition, ScanParameters, names
from afspm.model.parameter_names import BASE_PARAMETERS, OF_CURVES, OF_HELD_Z
from afspm.model.positions import scan_values
from afspm.scheduler.safety.limits import Limit


class ParameterValue(NamedTuple):
    """A parameter with its number; None for a text or a switch.

    The number is in the unit of the parameter's limit; without such a unit in SI for a base parameter or one of curves,
    else as given.
    """

    name: str
    number: float | None


class ParameterValueError(Exception):
    """The error that a parameter can't have the given value; it does not leave this package."""


def values_of(subject: object, limits: Mapping[str, Limit]) -> list[ParameterValue]:
    """Return the parameters set by the subject of a request.

    Raises:
        ParameterValueError: a text where there must be a number, a number that is not finite, a unit of another
            dimension.
    """
    if isinstance(subject, Parameter):
        if subject.value is None:
            return []
        return [ParameterValue(subject.name, _number(subject, subject.value, limits.get(subject.name)))]
    if isinstance(subject, ScanParameters):
        return [ParameterValue(*one) for one in scan_values(subject)]
    if isinstance(subject, Feedback):
        loop = (
            (names.ZCTRL_SETPOINT, subject.setpoint),
            (names.ZCTRL_PGAIN, subject.proportional_gain),
            (names.ZCTRL_IGAIN, subject.integral_gain),
        )
        switch = [] if subject.on is None else [ParameterValue(names.FEEDBACK_ON, None)]
        return switch + [ParameterValue(name, _finite(name, value)) for name, value in loop if value is not None]
    if isinstance(subject, ProbePosition | PositionChange):
        x, y = subject.xy_m if isinstance(subject, ProbePosition) else (subject.x_m, subject.y_m)
        return [
            ParameterValue(name, value)
            for name, value in ((names.PROBE_POS_X, x), (names.PROBE_POS_Y, y))
            if value is not None
        ]
    return []


def numbers(values: list[ParameterValue]) -> list[tuple[str, float]]:
    return [(name, number) for name, number in values if number is not None]


def number_of(parameter: Parameter) -> float | None:
    """Return the value of a parameter; None if it is no finite number or its unit has another dimension.

    The value of a base parameter is in SI. Any other value stays in the unit of the parameter.
    """
    try:
        return _number(parameter, parameter.value or "", None)
    except ParameterValueError:
        return None


def _number(parameter: Parameter, text: str, limit: Limit | None) -> float | None:
    # None for a text where a text is allowed
    name = parameter.name
    try:
        value = float(text)
    except ValueError:
        if name not in BASE_PARAMETERS and not (limit is not None and limit.is_of_a_number):
            return None
        raise ParameterValueError(f"{name} = {text!r} is not a number") from None
    _finite(name, value)
    si = BASE_PARAMETERS.get(name) or OF_CURVES.get(name) or OF_HELD_Z.get(name)
    unit = limit.unit if limit is not None and limit.unit is not None else si
    # without a unit an angle is in degrees on the wire, everything else in SI
    given = parameter.unit or ("deg" if unit == "rad" else unit)
    if not given or unit is None or given == unit:
        return value
    try:
        return float(convert(value, given, unit))
    except AfspmError as error:
        raise ParameterValueError(f"{name} = {text} {given}: {error}") from error


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise ParameterValueError(f"{name} = {value}: not a finite number")
    return value
