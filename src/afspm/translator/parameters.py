"""The parameters of a microscope as a table: generic name, vendor's name, unit and bounds of each.

Inside the translator every number is in the SI unit of its parameter (angles in rad). This module converts the units
and texts of vendors and peers, and refuses impossible values. Nothing is ever clamped.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

from afspm.basics import units
from afspm.basics.errors import AfspmError, ConfigError, ErrorCollector, Refused, UnitError
from afspm.basics.formatting import unit_text
from afspm.basics.plain_data import PlainMapping
from afspm.model import ControlResponse, names

Value = bool | int | float | str

FEEDBACK_ON: Final = names.FEEDBACK_ON

_TYPES = ("float", "int", "bool", "text")
_LONGEST_TEXT = 200


def refuse_value(name: str, reason: str) -> Refused:
    """Return the refusal of a parameter's value: PARAM_ERROR, with the parameter's name and the reason."""
    return Refused(ControlResponse.PARAM_ERROR, f"{name}: {reason}")


@dataclass(frozen=True)
class ParameterSpec:
    """A parameter of a microscope: a row of its table.

    Attributes:
        name: the generic name, e.g. "scan-speed".
        vendor: the controller's name of the parameter; by default the generic name.
        unit: the controller's unit.
        type: "float", "int", "bool" or "text".
        range: the smallest and largest value accepted, in SI.
        choices: the texts accepted; empty: any.
        read_only: the parameter can be read, but not set.
        while_busy: the parameter may be set during a scan or a move.
        sign: -1 where the controller's sign is opposite (an axis pointing down, angles clockwise).
        resolution: smaller differences are ignored (rounding by the controller, noise of a read-back), in SI.
        measured: a reading is a measured value, and not the setting: no measurement stands for it.
        multiple: for an "int", the step of the accepted values, from 0: 16 accepts 16, 32, 48 …
        lent: a measurement may carry it: it is set for the measurement, and set back after it; None: the parameters of
            `names.MAY_BE_LENT` alone.
        watched: a change by a person is published and recorded, as one of bias, setpoint and frame always is.
        where: the place where `range` was set; empty without a range.
    """

    name: str
    vendor: str = ""
    unit: str = ""
    type: str = "float"
    range: tuple[float, float] = (-math.inf, math.inf)
    choices: tuple[str, ...] = ()
    read_only: bool = False
    while_busy: bool = False
    sign: float = 1.0
    resolution: float = 0.0
    measured: bool = False
    multiple: int = 1
    watched: bool = False
    lent: bool | None = None
    where: str = ""

    @property
    def may_be_lent(self) -> bool:
        return not self.read_only and (self.name in names.MAY_BE_LENT if self.lent is None else self.lent)

    @property
    def si_unit(self) -> str:
        """The SI unit of the value; for setpoint, gains and a maker's own parameters, by the `unit` of the row."""
        si = names.BASE_PARAMETERS.get(self.name)
        return units.si_unit(self.unit) if si is None else si

    @property
    def wire_unit(self) -> str:
        """The unit of values on the wire that carry no unit: lengths in m, angles in deg."""
        return "deg" if self.si_unit == "rad" else self.si_unit

    @property
    def is_number(self) -> bool:
        return self.type not in ("bool", "text")

    def parse(self, text: str, unit: str | None = None) -> Value:
        """Return a peer's value, converted and checked.

        Raises:
            Refused: PARAM_ERROR; for a value out of range with the bounds, and the place where they were set.
        """
        if len(text) > _LONGEST_TEXT:
            raise refuse_value(self.name, f"a value of {len(text)} characters is too long")
        if self.type in ("bool", "text"):
            if unit:
                raise refuse_value(self.name, f"it has no unit; got {unit!r}")
            return self._checked_word(text)
        try:
            number = float(text.replace("_", "?"))  # Python would read 1_000
        except ValueError:
            raise refuse_value(self.name, f"{text!r} is not a number") from None
        return self.checked(self.from_unit(number, unit))

    def from_unit(self, number: float, unit: str | None) -> float:
        """Convert a number from a peer's unit to SI; None or empty: the unit of the wire.

        Raises:
            Refused: PARAM_ERROR: the unit is unknown or of another dimension.
        """
        try:
            return units.convert(float(number), unit or self.wire_unit, self.si_unit)
        except (UnitError, OverflowError) as error:
            raise refuse_value(self.name, str(error)) from error

    def checked(self, value: Value) -> Value:
        """Return a value in SI, checked for type, range and choices, and converted to the type of the row.

        Raises:
            Refused: PARAM_ERROR.
        """
        if self.type == "bool" and isinstance(value, bool):
            return value
        if self.type in ("bool", "text"):
            return self._checked_word(str(value))
        if isinstance(value, bool | str):
            raise refuse_value(self.name, f"{value!r} is not a number")
        if not math.isfinite(value):
            raise refuse_value(self.name, f"{value} is not a finite number")
        low, high = self.range
        if not low <= value <= high:
            raise refuse_value(self.name, f"{self.quantity(value)} is outside {self.range_text()}")
        if self.type == "int":
            if value != int(value):
                raise refuse_value(self.name, f"{value:g} is not a whole number")
            if value % self.multiple:
                below = max(int(value // self.multiple), 1) * self.multiple
                nearest = f"{below} or {below + self.multiple}"
                raise refuse_value(self.name, f"{value:g} is no multiple of {self.multiple}: set {nearest}")
            return int(value)
        return float(value)

    def same(self, a: Value, b: Value) -> bool:
        """Return True if two values are equal within the controller's precision (`resolution`)."""
        if isinstance(a, str) or isinstance(b, str):
            return a == b
        # a value converted to the vendor's unit and back may differ in the last bits
        return math.isclose(a, b, rel_tol=1e-12, abs_tol=self.resolution)

    def to_vendor(self, value: Value) -> Value:
        """Convert a value from SI to the controller's unit and sign."""
        if isinstance(value, bool | str):
            return value
        number = units.convert(float(value), self.si_unit, self.unit) * self.sign
        return round(number) if self.type == "int" else number

    def from_vendor(self, value: Value) -> Value:
        """Convert a value of the controller to SI.

        Raises:
            Refused: PARAM_ERROR: the value is not of the type in the table, or not finite.
        """
        if self.type == "text":
            return str(value)
        if self.type == "bool":
            return self._checked_word(value) if isinstance(value, str) else bool(self._finite(value))
        try:
            number = float(value) * self.sign + 0.0  # no minus before a zero of a negative sign
        except (ValueError, TypeError):
            raise refuse_value(self.name, f"the controller returned {value!r}, which is not a number") from None
        number = units.convert(self._finite(number), self.unit, self.si_unit)
        return round(number) if self.type == "int" else number

    def _finite(self, number: float) -> float:
        if not math.isfinite(number):
            raise refuse_value(self.name, f"the controller returned {number}, which is not a finite number")
        return number

    def for_peer(self, value: Value, unit: str | None = None) -> tuple[str, str]:
        """Convert a value in SI to (text, unit), in the peer's unit.

        Without a unit, or with a unit of another dimension, the unit is that on the wire (`wire_unit`).
        """
        if isinstance(value, bool):
            return ("true" if value else "false"), ""
        if isinstance(value, str):
            return value, ""
        wanted = unit or self.wire_unit
        if not units.same_kind(wanted, self.si_unit):
            wanted = self.wire_unit
        if isinstance(value, int):
            return str(value), wanted
        # 15 digits: a value set as "0.1 nm" is returned as 0.1, not as 0.09999999999999999
        return f"{units.convert(value, self.si_unit, wanted):.15g}", wanted

    def quantity(self, value: Value) -> str:
        """Return a value in SI as readable text with the controller's unit."""
        if isinstance(value, bool | str):
            return str(value)
        number = units.convert(float(value), self.si_unit, self.unit)
        return f"{number:.6g} {unit_text(self.unit)}".rstrip()

    def within(self, bounds: tuple[float, float], where: str) -> ParameterSpec:
        """Return the row with a narrower range, if it reaches beyond these bounds.

        Args:
            where: the place where the bounds are set, for people.
        """
        low, high = max(self.range[0], bounds[0]), min(self.range[1], bounds[1])
        return self if (low, high) == self.range else replace(self, range=(low, high), where=where)

    def range_text(self) -> str:
        """Return the range as readable text, with the place where the range was set."""
        text = f"{self.quantity(self.range[0])} to {self.quantity(self.range[1])}"
        return f"{text} (set in {self.where})" if self.where else text

    def _checked_word(self, text: str) -> Value:
        word = text.strip()
        if self.type == "bool":
            if word.lower() in names.ON_WORDS | names.OFF_WORDS:
                return word.lower() in names.ON_WORDS
            raise refuse_value(self.name, f"{text!r} is neither true nor false")
        if self.choices and word not in self.choices:
            raise refuse_value(self.name, f"{text!r} is not one of {', '.join(self.choices)}")
        return word


class ParameterTable(Mapping[str, ParameterSpec]):
    """The parameters of a microscope by their generic names."""

    def __init__(self, rows: Mapping[str, ParameterSpec]) -> None:
        self._rows = dict(rows)

    @classmethod
    def from_toml(cls, path: Path) -> ParameterTable:
        """Read a microscope's own table: `[parameters.<generic name>]` with the attributes of `ParameterSpec`.

        Raises:
            ConfigError: the file can't be read or has an impossible value.
        """
        try:
            with path.open("rb") as file:
                content = tomllib.load(file)
        except (OSError, tomllib.TOMLDecodeError) as error:
            raise ConfigError(f"the file of parameters can't be read: {error}", where=str(path)) from error
        return cls({}).extended(content.get("parameters", {}), where=f"the driver's {path.name}")

    def extended(
        self, rows: Mapping[str, Mapping[str, object]], *, where: str, translated: Collection[str] = ()
    ) -> ParameterTable:
        """Return the table with rows added or changed, attribute by attribute, e.g. by the experiment file.

        Args:
            translated: the names of rows that code translates: a row can't change their vendor's name or sign.

        Raises:
            ConfigError: an attribute is unknown or has an impossible value; the errors of all rows at once.
        """
        table = dict(self._rows)
        errors = ErrorCollector()
        for name, given in rows.items():
            if name == names.BIAS_OF_SAMPLE:
                what = f"{name} is another name of {names.TIP_BIAS_VOLTAGE}, and has no row of its own"
                errors.add(ConfigError(what, where=f"{where}, parameters.{name}", hint="give it a name with x-"))
                continue
            known = table.get(name, ParameterSpec(name, vendor=name, unit=names.BASE_PARAMETERS.get(name) or ""))
            with errors:
                table[name] = _row(known, given, where, translated=name in translated)
        errors.raise_all()
        return ParameterTable(table)

    def without(self, names_: Collection[str]) -> ParameterTable:
        return ParameterTable({name: row for name, row in self._rows.items() if name not in names_})

    @property
    def watched(self) -> tuple[str, ...]:
        """The names of the rows whose changes by a person are published."""
        return tuple(name for name, row in self._rows.items() if row.watched)

    def find(self, name: str) -> ParameterSpec:
        """Return a parameter by the name that a peer sent.

        Raises:
            Refused: PARAM_NOT_SUPPORTED, with the nearest name.
        """
        if name == names.BIAS_OF_SAMPLE:
            reason = f"{name} is a name for requests, [limits] and sweeps: name {names.TIP_BIAS_VOLTAGE} here"
            raise Refused(ControlResponse.PARAM_NOT_SUPPORTED, reason)
        if name not in self._rows:
            # the name comes from a peer, and may be of any length
            near = difflib.get_close_matches(name[:100], self._rows, n=1)
            hint = f", perhaps {near[0]!r}" if near else ""
            reason = f"this microscope has no parameter {name[:100]!r}{hint}"
            raise Refused(ControlResponse.PARAM_NOT_SUPPORTED, reason)
        return self._rows[name]

    def written(self, given: PlainMapping, *, where: str) -> dict[str, Value]:
        """Return values of the experiment file in SI, from texts like "2 um/s" or plain numbers in the row's unit.

        Raises:
            ConfigError: a name or a value is impossible; all such errors at once.
        """
        values: dict[str, Value] = {}
        errors = ErrorCollector()
        for name, value in given.items():
            try:
                values[name] = self._written(name, value)
            except (AfspmError, TypeError) as error:
                errors.add(ConfigError(str(error), where=f"{where}.{name}"))
        errors.raise_all()
        return values

    def _written(self, name: str, value: Any) -> Value:
        spec = self.find(name)
        if isinstance(value, str) and spec.type in ("float", "int"):
            number, unit = units.parse_quantity(value)
            value = spec.from_unit(number, unit) if unit else self._plain(spec, number)
        elif not isinstance(value, bool | str):
            value = self._plain(spec, value)
        return spec.checked(value)

    @staticmethod
    def _plain(spec: ParameterSpec, number: float) -> float:
        units.require_unit(number, spec.unit)
        return spec.from_unit(number, spec.unit)

    def __getitem__(self, name: str) -> ParameterSpec:
        return self._rows[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)


_ATTRIBUTES = {field.name for field in fields(ParameterSpec)} - {"name", "where"}
_OF_THE_CONTROLLER = frozenset({"vendor", "sign"})


def _row(known: ParameterSpec, given: PlainMapping, where: str, *, translated: bool) -> ParameterSpec:
    at = f"{where}, parameters.{known.name}"
    if not isinstance(given, Mapping):
        raise ConfigError(f"expected a table, got {given!r}", where=at)
    errors = ErrorCollector()
    for key in given:
        if key not in _ATTRIBUTES:
            near = difflib.get_close_matches(key, _ATTRIBUTES, n=1)
            hint = f"did you mean {near[0]!r}?" if near else ""
            errors.add(ConfigError(f"unknown attribute {key!r}", where=at, hint=hint))
        if translated and key in _OF_THE_CONTROLLER:
            hint = "to translate it differently, derive a driver class from this one"
            message = f"{key} has no effect: the driver's code translates this parameter"
            errors.add(ConfigError(message, where=at, hint=hint))
    errors.raise_all()
    values = dict(given)
    for key in ("vendor", "unit", "type"):
        if not isinstance(values.get(key, ""), str):
            raise ConfigError(f"{key} must be a text, not {values[key]!r}", where=at)
    multiple = values.get("multiple", 1)
    if isinstance(multiple, bool) or not isinstance(multiple, int) or multiple < 1:
        raise ConfigError(f"multiple must be a whole number from 1 on, not {multiple!r}", where=at)
    for key in ("read_only", "while_busy", "watched", "lent"):
        if not isinstance(values.get(key, False), bool):
            raise ConfigError(f"{key} must be true or false, not {values[key]!r}", where=at)
    if "choices" in values:
        values["choices"] = tuple(str(choice) for choice in values["choices"])
    row = replace(known, **{k: v for k, v in values.items() if k not in ("range", "resolution")})
    if not units.same_kind(row.unit, known.unit):
        row = replace(row, range=ParameterSpec.range, where="")  # a bound in A is none in Hz
    try:
        return _with_numbers(row, values, where)
    except (UnitError, TypeError, ValueError) as error:
        raise ConfigError(str(error), where=at) from error


def _with_numbers(row: ParameterSpec, values: PlainMapping, where: str) -> ParameterSpec:
    # plain numbers are in the row's unit, texts carry their own

    def number(value: Any) -> float:
        given, unit = units.parse_quantity(value) if isinstance(value, str) else (float(value), "")
        return units.convert(given, unit or row.unit, row.si_unit)

    if row.type not in _TYPES:
        raise ValueError(f"type must be one of {', '.join(_TYPES)}, not {row.type!r}")
    if not isinstance(row.sign, int | float) or abs(row.sign) != 1:
        raise ValueError(f"sign must be 1 or -1, not {row.sign!r}")
    if row.type in ("float", "int"):
        units.convert(1.0, row.unit, row.si_unit)  # raises unless the vendor's unit has the right dimension
    if "range" in values:
        low, high = map(number, values["range"])
        if not low <= high:
            raise ValueError(f"the range {values['range']} is empty")
        row = replace(row, range=(low, high), where=where)
    if "resolution" in values:
        row = replace(row, resolution=number(values["resolution"]))
    return row
