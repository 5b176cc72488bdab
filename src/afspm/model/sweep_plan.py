"""Plans of parameter sweeps: the values of each parameter, and the order in which their combinations are measured."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, get_args

from afspm.basics.argument_checks import FINITE, is_number, plain
from afspm.basics.errors import InvalidValue, UnitError
from afspm.basics.units import convert, parse_quantity, require_unit, si_unit
from afspm.model.instruments import is_of_instrument
from afspm.model.parameter_names import BIAS_OF_SAMPLE, TIP_BIAS_VOLTAGE, UNITS_OF_REQUESTS
from afspm.model.requests import Parameter

SweptValue = float | str | bool
SweptValues = Sequence[SweptValue] | Mapping[str, SweptValue]
"""A list of values, or a range: {"from": "0.5 um/s", "to": "4 um/s", "points": 4, "spacing": "log"}."""
SweepOrder = Literal["snake", "listed", "random"]

MOST_POINTS: Final = 100_000
_RANGE: Final = ("from", "to", "points", "step", "spacing")
_DIGITS: Final = 12  # significant ones of a value in a range: 0.3 instead of 0.30000000000000004
_WHOLE: Final = 1e15
_EXAMPLE: Final = 'for example { from = "0.5 um/s", to = "4 um/s", points = 4, spacing = "log" }'


@dataclass(frozen=True)
class SweepAxis:
    """A parameter and its values.

    Attributes:
        values: numbers in `unit`. A value may come again: up and down again, as a hysteresis needs it.
        unit: SI for quantities; None for texts, switches, and numbers in the microscope's own unit.
    """

    name: str
    values: tuple[SweptValue, ...]
    unit: str | None = None

    @classmethod
    def of(cls, name: str, given: SweptValues) -> SweepAxis:
        """Read the values of a parameter from a list or a range.

        Raises:
            InvalidValue, UnitError: there are no values, or values that this parameter can't have.
        """
        if isinstance(given, Mapping):
            unit, values = (
                _unit_of(name, [given[end] for end in ("from", "to") if end in given]),
                _in_range(name, given),
            )
        elif isinstance(given, str) or not isinstance(given, Sequence):
            raise InvalidValue(f"{name} is swept over {given!r}", hint="give a list of values, or a range")
        else:
            unit = _unit_of(name, given)
            values = tuple(_in_unit(name, value, unit) for value in given)
        if not values:
            raise InvalidValue(f"{name} has no value to be swept over", hint="list one at least")
        if is_of_instrument(name) and not all(isinstance(value, float) for value in values):
            raise InvalidValue(
                f"{name}: targets of an instrument are numbers", hint='with their unit: ["4.2 K", "10 K"]'
            )
        return cls(name, values, unit)

    def parameter(self, place: int) -> Parameter:
        """Return the Parameter that sets the value with index `place`."""
        value = self.values[place]
        if isinstance(value, bool):
            return Parameter(self.name, str(value).lower())
        if isinstance(value, str):
            return Parameter(self.name, value)
        # a number of pixels is written without a decimal point
        text = repr(int(value)) if float(value).is_integer() and abs(value) < _WHOLE else repr(value)
        return Parameter(self.name, text, self.unit)

    def in_steps(self) -> SweepAxis:
        """Return the axis with its numbers sorted; the first and last listed number give the direction.

        An axis with texts or switches stays unchanged.
        """
        numbers = [value for value in self.values if not isinstance(value, str | bool)]
        if len(numbers) < len(self.values):
            return self
        falls = numbers[0] > numbers[-1]
        return SweepAxis(self.name, tuple(sorted(numbers, reverse=falls)), self.unit)


@dataclass(frozen=True)
class SweepPlan:
    """All combinations of the values of some parameters.

    Attributes:
        axes: the first parameter changes least often.
        order: "snake": between points one parameter changes, to a neighbouring value. "listed": nested
            loops over the values as listed. "random": shuffled by `seed`.
        repeat: number of points with the same values, one after the other.
    """

    axes: tuple[SweepAxis, ...]
    order: SweepOrder = "snake"
    seed: int = 0
    repeat: int = 1

    def __post_init__(self) -> None:
        if not self.axes:
            raise InvalidValue("a sweep needs a parameter at least")
        if {BIAS_OF_SAMPLE, TIP_BIAS_VOLTAGE} <= {axis.name for axis in self.axes}:
            raise InvalidValue(f"{BIAS_OF_SAMPLE} and {TIP_BIAS_VOLTAGE} are one setting", hint="sweep one of them")
        if self.order not in get_args(SweepOrder):
            raise InvalidValue(f"there is no order {self.order!r}", hint=f"one of {', '.join(get_args(SweepOrder))}")
        if self.repeat < 1:
            raise InvalidValue(f"each point is measured {self.repeat} times", where="repeat", hint="1 or more")
        for axis in self.axes if self.order == "snake" else ():
            if len(set(axis.values)) < len(axis.values):
                raise InvalidValue(
                    f'{axis.name} has a value twice, and the order "snake" sorts the values',
                    hint='order = "listed" keeps them as listed; `repeat` takes each point several times',
                )
        if self.total > MOST_POINTS:
            raise InvalidValue(f"a sweep of {self.total} points", hint=f"at most {MOST_POINTS}")

    @classmethod
    def of(
        cls, parameters: Mapping[str, SweptValues], order: SweepOrder = "snake", seed: int = 0, repeat: int = 1
    ) -> SweepPlan:
        """Read a plan from the values of each parameter.

        Raises:
            InvalidValue, UnitError: see `SweepAxis.of`; no parameter, an unknown order, too many points, or a value
                twice in an order that sorts the values.
        """
        axes = tuple(SweepAxis.of(name, given) for name, given in parameters.items())
        return cls(tuple(axis.in_steps() for axis in axes) if order == "snake" else axes, order, seed, repeat)

    @property
    def total(self) -> int:
        """Return the number of points."""
        return self._combinations * self.repeat

    @property
    def _combinations(self) -> int:
        return math.prod(len(axis.values) for axis in self.axes)

    def places(self) -> list[tuple[int, ...]]:
        """Return the points in the order of measurement, each as a tuple of one value's index per axis."""
        of_order = self._snake if self.order == "snake" else self._listed
        places = [of_order(index) for index in range(self._combinations)]
        if self.order == "random":
            random.Random(self.seed).shuffle(places)
        return [place for place in places for _ in range(self.repeat)]

    def settings(self, places: Sequence[int]) -> tuple[Parameter, ...]:
        """Return the parameter values of a point."""
        return tuple(axis.parameter(place) for axis, place in zip(self.axes, places, strict=True))

    def values(self, places: Sequence[int]) -> dict[str, SweptValue]:
        """Return the values at a point by parameter name."""
        return {axis.name: axis.values[place] for axis, place in zip(self.axes, places, strict=True)}

    def _listed(self, index: int) -> tuple[int, ...]:
        places = []
        for axis in reversed(self.axes):
            index, place = divmod(index, len(axis.values))
            places.append(place)
        return tuple(reversed(places))

    def _snake(self, index: int) -> tuple[int, ...]:
        # a Gray code: each parameter runs back where those before it stand at an odd step
        places = []
        for axis in reversed(self.axes):
            index, place = divmod(index, len(axis.values))
            places.append(len(axis.values) - 1 - place if index % 2 else place)
        return tuple(reversed(places))


def _unit_of(name: str, given: Sequence[SweptValue]) -> str | None:
    # a base parameter has its SI unit, another one the unit of the first quantity with a unit
    if unit := UNITS_OF_REQUESTS.get(name):
        return unit
    for value in given:
        if isinstance(value, str) and (quantity := _quantity(value)) is not None and quantity[1]:
            return si_unit(quantity[1])
    return None


def _in_unit(name: str, value: SweptValue, unit: str | None) -> SweptValue:
    value = plain(value)
    if isinstance(value, bool):
        return value
    if isinstance(value, str):
        quantity = _quantity(value)
        if quantity is None:
            if unit is not None or name in UNITS_OF_REQUESTS:
                raise InvalidValue(f"{name} can't be {value!r}", hint="a number, with its unit")
            return value
        number, given = quantity
        if given:
            return _finite(name, convert(number, given, unit if unit is not None else given))
    else:
        number = value
    if not FINITE.fits(number):  # also None
        raise InvalidValue(
            f"{name} can't be set to {number!r}", hint="a finite number, text with a unit, True or False"
        )
    if unit and not UNITS_OF_REQUESTS.get(name):  # its own unit or the unit of the others? A person knows
        raise UnitError(f"{name}: {value!r} has no unit, others have", hint=f"write it as in '1 {unit}'")
    require_unit(number, unit or "")
    return _finite(name, number)


def _finite(name: str, number: float) -> float:
    if not math.isfinite(number):
        raise InvalidValue(f"{name} can't be set to {number}", hint="a finite number")
    return float(f"{number:.{_DIGITS}g}")


def _in_range(name: str, given: Mapping[str, SweptValue]) -> tuple[SweptValue, ...]:
    if unknown := sorted(given.keys() - set(_RANGE)):
        raise InvalidValue(f"{name}: a range has no {unknown[0]!r}", hint=_EXAMPLE)
    if "from" not in given or "to" not in given or ("points" in given) == ("step" in given):
        raise InvalidValue(f"{name}: a range needs `from`, `to`, and either `points` or `step`", hint=_EXAMPLE)
    unit = _unit_of(name, [given["from"], given["to"]])
    low, high = (_number(name, given[end], unit) for end in ("from", "to"))
    spacing = given.get("spacing", "linear")
    if spacing not in ("linear", "log"):
        raise InvalidValue(f"{name}: there is no spacing {spacing!r}", hint='"linear" or "log"')
    if low == high:
        raise InvalidValue(f"{name}: a range from {low:g} to {high:g} is empty", hint="list one value instead")
    if "step" in given:
        if spacing == "log":
            raise InvalidValue(f"{name}: a log-spaced range has no `step`", hint="give `points`")
        return _by_step(name, low, high, _number(name, given["step"], unit))
    points = _points(name, given["points"])
    if spacing == "log":
        if low * high <= 0.0:
            raise InvalidValue(f"{name}: a log-spaced range from {low:g} to {high:g}", hint="both ends above zero")
        ratio = high / low
        return tuple(_finite(name, low * ratio ** (k / (points - 1))) for k in range(points))
    return tuple(_finite(name, low + (high - low) * k / (points - 1)) for k in range(points))


def _points(name: str, given: SweptValue) -> int:
    # the bounds first: a float does not hold each whole number
    if not is_number(given) or not 2 <= given <= MOST_POINTS or not float(given).is_integer():
        raise InvalidValue(f"{name}: a range of {given!r} points", hint="a whole number, 2 at least")
    return int(given)


def _by_step(name: str, low: float, high: float, step: float) -> tuple[SweptValue, ...]:
    if not step > 0.0:
        raise InvalidValue(f"{name}: a step of {step:g}", hint="above zero; `from` and `to` say the direction")
    steps = math.floor(abs(high - low) / step * (1 + 1e-9))
    if steps >= MOST_POINTS:
        raise InvalidValue(f"{name}: a range of {steps + 1} points", hint=f"at most {MOST_POINTS}")
    signed = math.copysign(step, high - low)
    return tuple(_finite(name, low + signed * k) for k in range(steps + 1))


def _number(name: str, given: SweptValue, unit: str | None) -> float:
    value = _in_unit(name, given, unit)
    if isinstance(value, str | bool):
        raise InvalidValue(f"{name}: {given!r} is no end of a range", hint=_EXAMPLE)
    return value


def _quantity(text: str) -> tuple[float, str] | None:
    if text[:1] not in "+-.0123456789":
        return None
    try:
        return parse_quantity(text)
    except UnitError:
        return None
