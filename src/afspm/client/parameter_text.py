"""Conversion of parameter values to and from text on the wire."""

from __future__ import annotations

from collections.abc import Mapping

from afspm import wire
from afspm.basics.argument_checks import FINITE, is_text, plain
from afspm.basics.errors import InvalidValue, UnitError
from afspm.basics.units import convert, parse_quantity, require_unit
from afspm.model import Parameter, Response, is_of_instrument
from afspm.model.parameter_names import UNITS_OF_REQUESTS

Value = float | str | bool


def to_parameter(name: str, value: Value, unit: str | None) -> Parameter:
    """Convert a value into a parameter to set: a number in `unit` (default: SI), text such as "2 um/s", True …

    Raises:
        InvalidValue: neither text nor a finite number.
        UnitError: a number without a unit is implausibly large in SI.
    """
    value = plain(value)
    if isinstance(value, bool):
        return Parameter(name, "true" if value else "false", unit)
    if not (is_text(value) or FINITE.fits(value)):
        raise InvalidValue(
            f"{name} can't be set to {value!r}", where="set", hint="a finite number, text with a unit, True or False"
        )
    if isinstance(value, str):
        if unit is None and value[:1] in "+-.0123456789" and (quantity := _quantity(value)) is not None:
            number, given = quantity
            if not given:
                require_unit(number, UNITS_OF_REQUESTS.get(name) or "")
            return Parameter(name, repr(number), given or UNITS_OF_REQUESTS.get(name))
        return Parameter(name, value, unit)
    if unit is None:
        require_unit(value, UNITS_OF_REQUESTS.get(name) or "")
    # the repr of a numpy number is "np.float64(…)"
    text = repr(int(value)) if isinstance(value, int) else repr(float(value))
    return Parameter(name, text, UNITS_OF_REQUESTS.get(name) if unit is None else unit)


def to_settings(settings: Mapping[str, Value]) -> dict[str, Parameter]:
    """Convert the settings of a measurement into parameters by name; raises as `to_parameter`.

    A parameter of another instrument raises InvalidValue.
    """
    if others := [name for name in settings if is_of_instrument(name)]:
        what = f"{others[0]} belongs to another instrument, which takes its time"
        raise InvalidValue(what, where="settings", hint="sweep it, or set it before the measurement")
    return {name: to_parameter(name, value, None) for name, value in settings.items()}


def from_parameter(parameter: Parameter, unit: str | None) -> Value:
    """Return a received value in `unit`; without `unit`, in SI for base parameters, else as received.

    Text that is not a number becomes True, False or text.

    Raises:
        UnitError: the microscope's unit can't be converted to `unit`.
    """
    text = (parameter.value or "").strip()
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        number = float(text)
    except ValueError:
        return text
    wanted = UNITS_OF_REQUESTS.get(parameter.name) if unit is None else unit
    if not parameter.unit or not wanted:
        return number
    return convert(number, parameter.unit, wanted)


def value_in(response: Response, asked: Parameter, unit: str | None) -> Value:
    """Return the value in a response; the requested value if the response only confirms."""
    return from_parameter(wire.decode_parameter(response.payload) if response.payload else asked, unit)


def _quantity(text: str) -> tuple[float, str] | None:
    try:
        return parse_quantity(text)
    except UnitError:
        return None
