"""Conversion of units at the edges of afspm: inside, all quantities are in SI (metres, seconds, volts, radians …).

A small exact table holds the units of scanning probe microscopy; pint, loaded on demand, converts all others.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Final, TypeVar

from afspm.basics.errors import UnitError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from pydantic import GetCoreSchemaHandler

Number = TypeVar("Number", float, "NDArray[np.float64]")

_PREFIXES = {"": 0, "k": 3, "M": 6, "G": 9, "m": -3, "u": -6, "µ": -6, "μ": -6, "n": -9, "p": -12, "f": -15}
_BASES = {
    "m": "m",
    "s": "s",
    "V": "V",
    "A": "A",
    "Hz": "Hz",
    "N": "N",
    "rad": "rad",
    "W": "W",
    "K": "K",
    "S": "S",
    "Ohm": "ohm",
    "ohm": "ohm",
}
# fractions are exact: a ratio of two units has no rounding error
_NANO, _MICRO = Fraction(1, 10**9), Fraction(1, 10**6)
_DEGREE = Fraction(math.pi) / 180
_SPECIAL: dict[str, tuple[str, Fraction]] = {
    "": ("", Fraction(1)),
    "1": ("", Fraction(1)),
    "%": ("", Fraction(1, 100)),
    **dict.fromkeys(("Å", "\u212b", "angstrom"), ("m", Fraction(1, 10**10))),  # the letter Å and the ångström sign
    **dict.fromkeys(("min", "minute", "minutes"), ("s", Fraction(60))),
    **dict.fromkeys(("h", "hour", "hours"), ("s", Fraction(3600))),
    **dict.fromkeys(("d", "day", "days"), ("s", Fraction(86400))),
    **dict.fromkeys(("sec", "second", "seconds"), ("s", Fraction(1))),
    **dict.fromkeys(("deg", "°", "degree", "degrees"), ("rad", _DEGREE)),
    **dict.fromkeys(("meter", "metre"), ("m", Fraction(1))),
    **dict.fromkeys(("micron", "micrometer", "micrometre"), ("m", _MICRO)),
    **dict.fromkeys(("nanometer", "nanometre"), ("m", _NANO)),
    **dict.fromkeys(("px", "pixel", "pixels"), ("px", Fraction(1))),
}


@dataclass(frozen=True)
class Dimension:
    """A kind of quantity.

    Attributes:
        name: noun with its article, such as "a length".
        example: a quantity of this kind as text, such as "400 nm".
        largest_plain: the largest number accepted without a unit, in SI.
    """

    name: str
    example: str
    largest_plain: float = math.inf

    @property
    def hint(self) -> str:
        """Return a hint for an error message, with an example."""
        return f'{self.name}, for example "{self.example}"'


DIMENSIONS: Final[Mapping[str, Dimension]] = {
    "m": Dimension("a length", "400 nm", 1e-3),
    "m/s": Dimension("a speed", "2 um/s", 1e-3),
    "V": Dimension("a voltage", "300 mV", 10.0),
    "A": Dimension("a current", "50 pA", 1e-6),
    "N": Dimension("a force", "5 nN", 1e-6),
    "rad": Dimension("an angle", "30 deg", math.tau),
    "s": Dimension("a time", "15 min"),
    "Hz": Dimension("a frequency", "2 kHz"),
}
"""Dimensions by SI unit. A number without a unit is in SI, so 400 as a length means 400 m; the bounds refuse it."""


@dataclass(frozen=True)
class Unit:
    """Annotation of a float setting that the experiment file may give as text with a unit.

    Attributes:
        si: the SI unit of the component's value, e.g. "m".
        is_written: whether the file must give a unit, since a plain number is ambiguous (seconds or minutes). Zero
            needs no unit.
        least: the smallest value, in the SI unit.
        above: exclusive lower bound of the values, in the SI unit.
    """

    si: str
    is_written: bool = False
    least: float = -math.inf
    above: float = -math.inf

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> object:
        # only pydantic calls this, so pydantic is not loaded at the top
        from pydantic_core import core_schema

        return core_schema.no_info_before_validator_function(self.read, handler(source))

    def read(self, value: object) -> float:
        """Convert a value of the experiment file to the SI unit; a number without a unit is in SI.

        Raises:
            UnitError: not a finite number, an unknown unit, a unit of another kind, a required unit is missing, or a
                value out of range.
        """
        if isinstance(value, bool) or not isinstance(value, str | float | int):
            raise UnitError(f"{value!r} is not a quantity", hint=_hint(self.si))
        number = si(value, self.si)
        if self.is_written and number and (not isinstance(value, str) or not parse_quantity(value)[1]):
            raise UnitError(f"{value} has no unit", hint=_hint(self.si))
        if not math.isfinite(number):
            raise UnitError(f"{value!r} is not a finite number")
        if number < self.least:
            raise UnitError(f"{value!r} is below {self.least:g} {self.si}", hint=_hint(self.si))
        if number <= self.above:
            raise UnitError(f"{value!r} is not above {self.above:g} {self.si}", hint=_hint(self.si))
        return number


Length = Annotated[float, Unit("m")]
PositiveLength = Annotated[float, Unit("m", above=0.0)]
Duration = Annotated[float, Unit("s", least=0.0)]
PositiveDuration = Annotated[float, Unit("s", above=0.0)]
Period = Annotated[float, Unit("s", is_written=True, least=0.0)]
"""A duration that must be written with a unit, since 10 could mean milliseconds, seconds or minutes."""
PollPeriod = Annotated[float, Unit("s", least=1e-3)]
"""Time between two polls of a controller, at least 1 ms, so that polls don't use up a processor."""
Angle = Annotated[float, Unit("rad", is_written=True)]
"""An angle that must be written with a unit, since 5 could mean degrees or radians."""
Voltage = Annotated[float, Unit("V")]
Current = Annotated[float, Unit("A")]
Speed = Annotated[float, Unit("m/s")]
Frequency = Annotated[float, Unit("Hz")]


def convert(value: Number, unit_from: str, unit_to: str) -> Number:
    """Convert `value` (a float or an array) from one unit to another.

    Raises:
        UnitError: a unit is unknown, or the units are of different kinds.
    """
    if unit_from == unit_to:
        return value
    ratio = _ratio(unit_from, unit_to)
    # divide by 10**9, which is an exact float, and don't multiply by 1e-9: 1500 nm become 1.5e-06 m to the last bit
    if ratio.numerator == 1:
        return value / float(ratio.denominator)
    return value * float(ratio)


_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf))\s*(.*?)\s*", re.IGNORECASE)


def parse_quantity(text: str) -> tuple[float, str]:
    """Return number and unit of a text, "2.5 um" as (2.5, "um"); the unit may be missing.

    Raises:
        UnitError: the text does not begin with a number.
    """
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise UnitError(f"{text!r} is not a number with a unit", hint='write it as "2.5 um"')
    if match[2].startswith(","):  # else "1,5 um" would be read as 1 with the unit ",5 um"
        raise UnitError(f"{text!r} has a comma: numbers have a decimal point", hint='write it as "2.5 um"')
    return float(match[1]), match[2]


def si(value: str | float, unit: str) -> float:
    """Convert a quantity as text ("2.5 um"), or a number in SI, to a float in the SI unit `unit`.

    Raises:
        UnitError: not a number, an unknown unit, a unit of another kind than `unit`, or a number without a unit that is
            implausibly large (`Dimension.largest_plain`).
    """
    if isinstance(value, bool):
        raise UnitError(f"{value} is not a number in {unit}")
    try:
        number, given = parse_quantity(value) if isinstance(value, str) else (float(value), "")
        converted = convert(number, given or unit, unit)
    except UnitError as error:
        raise UnitError(error.what, hint=_hint(unit) or error.hint) from error
    if not given:
        require_unit(number, unit)
    return converted


def si_or_text(value: float | str, unit: str) -> float:
    """Convert a number in the SI unit `unit`, or a text with a unit, to a float in `unit`.

    Raises:
        UnitError: text without a number or a unit, or with a unit that is unknown or of another kind.
        TypeError, ValueError: neither a number nor text.
    """
    if not isinstance(value, str):
        return float(value)
    if not parse_quantity(value)[1]:
        raise UnitError(f"{value!r} has no unit", hint=_hint(unit) or f"in {unit} give a number, not text")
    return si(value, unit)


def require_unit(number: float, unit: str) -> None:
    """Refuse a number without a unit that is implausibly large in `unit`.

    Raises:
        UnitError: the amount of the number is above `Dimension.largest_plain`.
    """
    dimension = DIMENSIONS.get(unit)
    if dimension is not None and dimension.largest_plain < abs(number) < math.inf:
        what = f"without a unit this means {number:g} {unit}"
        raise UnitError(what, hint=dimension.hint)


def si_unit(unit: str) -> str:
    """Return the SI unit of the same kind: "nm" -> "m", "um/s" -> "m/s", "deg" -> "rad".

    Raises:
        UnitError: the unit is unknown.
    """
    return _base_and_factor(unit)[0]


def si_unit_or_none(unit: str) -> str | None:
    """Return the SI unit of the same kind; None for an unknown unit."""
    try:
        return si_unit(unit)
    except UnitError:
        return None


def in_si(value: Number, unit: str) -> tuple[Number, str]:
    """Return a value in the SI unit of the same kind, and this unit; both unchanged for units like "arb" and "dBm"."""
    base = si_unit_or_none(unit)
    if base is None or " " in base:
        return value, unit
    return convert(value, unit, base), base


def same_kind(unit_a: str, unit_b: str) -> bool:
    """Return whether one unit can be converted to the other; False for unknown units."""
    found = si_unit_or_none(unit_a)
    return found is not None and found == si_unit_or_none(unit_b)


@lru_cache(maxsize=1000)
def _ratio(unit_from: str, unit_to: str) -> Fraction:
    base_from, factor_from = _base_and_factor(unit_from)
    base_to, factor_to = _base_and_factor(unit_to)
    if base_from != base_to:
        raise UnitError(
            f"{unit_from or 'a number without a unit'} can't be converted to {unit_to or 'one without a unit'}",
            hint=f"give it in {unit_to}" if unit_to else "leave the unit out",
        )
    return factor_from / factor_to


def _hint(si_unit: str) -> str:
    dimension = DIMENSIONS.get(si_unit)
    return dimension.hint if dimension else ""


@lru_cache(maxsize=1000)
def _base_and_factor(unit: str) -> tuple[str, Fraction]:
    # the kind of a unit, written in base units, and the factor to them
    unit = unit.strip()
    simple = _simple(unit)
    if simple is not None:
        return simple
    if unit.count("/") == 1:
        over, under = (_simple(part.strip()) for part in unit.split("/"))
        if over is not None and under is not None:
            return (over[0] if not under[0] else f"{over[0]}/{under[0]}"), over[1] / under[1]
    return _by_pint(unit)


def _simple(unit: str) -> tuple[str, Fraction] | None:
    if unit in _SPECIAL:
        return _SPECIAL[unit]
    if unit in _BASES:
        return _BASES[unit], Fraction(1)
    prefix, base = unit[:1], unit[1:]
    if prefix in _PREFIXES and base in _BASES:
        return _BASES[base], Fraction(10) ** _PREFIXES[prefix]
    return None


# pint's names of base units
_SI_NAMES = {
    "meter": "m",
    "second": "s",
    "radian": "rad",
    "meter / second": "m/s",
    "1 / second": "Hz",
    "kelvin": "K",
    "kilogram * meter ** 2 / ampere / second ** 3": "V",
    "kilogram * meter / second ** 2": "N",
    "ampere": "A",
    "kilogram * meter ** 2 / second ** 3": "W",
    "kilogram * meter ** 2 / ampere ** 2 / second ** 3": "ohm",
    "ampere ** 2 * second ** 3 / kilogram / meter ** 2": "S",
    "dimensionless": "",
}


def _by_pint(unit: str) -> tuple[str, Fraction]:
    if len(unit) > 100:
        raise UnitError(f"{unit[:30]!r}… is not a unit")
    import pint

    try:
        none, one = (pint.Quantity(value, unit).to_base_units() for value in (0.0, 1.0))
        base, factor = f"{one.units}", Fraction(float(one.magnitude))
    except Exception as error:  # pint raises many kinds, even plain AttributeError and TokenError
        raise UnitError(f"{unit!r} is not a unit", hint="e.g. nm, um, mV, nA, deg, nm/s") from error
    if none.magnitude != 0.0:  # units with an offset (degrees Celsius, decibels) have no factor to SI
        raise UnitError(f"{unit!r} does not count from zero, and is not converted here", hint=f"give it in {base}")
    return _SI_NAMES.get(base, base), factor
