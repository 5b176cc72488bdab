"""Settings of the simulated physics: frozen dataclasses created from plain tables; invalid values are refused.

Every setting carries its unit in its name: a number is in that unit, and a text has a unit of its own ("8 nm"). A
table may contain a table (another dataclass) or a list (a tuple).
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

from afspm.basics.errors import ConfigError, ErrorCollector, UnitError, individual_errors
from afspm.basics.type_aliases import unaliased
from afspm.basics.units import si_or_text

T = TypeVar("T")
_LONGEST_M = 1e-3
_UNIT = re.compile(r"(?<!_per)(?<!conductance)_(m_per_s|m|s|v|a|hz|n|deg|rad)(?:\[\d+\])?$")
_UNITS = {"m_per_s": "m/s", "v": "V", "a": "A", "hz": "Hz", "n": "N"}


def build(cls: type[T], settings: object, where: str) -> T:
    """Create an instance of the frozen dataclass `cls` from a table.

    Raises:
        ConfigError: an unknown key (with the most similar name as hint), a value of the wrong type, or an error of the
            dataclass itself; several errors together as `ConfigErrors`.
    """
    if not isinstance(settings, Mapping):
        raise ConfigError(f"expected a table, got {settings!r}", where=where)
    hints = typing.get_type_hints(cls)
    names = _names(cls)
    values: dict[str, object] = {}
    errors = ErrorCollector()
    for key, value in settings.items():
        at = f"{where}.{key}"
        if key not in names:
            errors.add(ConfigError(f"no setting named {key!r}", where=at, hint=nearest(str(key), names)))
            continue
        with errors:
            values[key] = _convert(hints[key], value, at)
    known = not errors.errors
    try:
        made = cls(**values)
    except ConfigError as error:
        for one in individual_errors(error):
            if known or one.where in values:  # an error about a field omitted above is a consequence, not a cause
                errors.add(ConfigError(one.what, where=f"{where}.{one.where}" if one.where else where, hint=one.hint))
    except TypeError:
        if known:
            missing = [name for name in names if name not in values and _is_required(cls, name)]
            errors.add(ConfigError(f"missing: {', '.join(missing)}", where=where))
    errors.raise_all()
    return made


def nearest(name: str, names: Iterable[str]) -> str:
    """Return a hint with the most similar name, or with all names."""
    names = list(names)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"did you mean {close[0]!r}?" if close else "there are " + ", ".join(names)


def one_of(value: str, choices: Iterable[str], where: str) -> str:
    """Return `value` if it is one of `choices`. Raises ConfigError otherwise."""
    choices = list(choices)
    if value not in choices:
        raise ConfigError(f"unknown: {value!r}", where=where, hint=nearest(value, choices))
    return value


def check(settings: object, *, above_zero: str = "", from_zero: str = "", fraction: str = "") -> None:
    """Check the named attributes (separated by spaces) of a dataclass in its `__post_init__`.

    A fraction lies in [0, 1], and a length, whose name ends in "_m", is at most a millimetre: metres in place of
    nanometres would take more time and memory than a computer has.

    Raises:
        ConfigError: invalid attributes, all at once, each named in `where`.
    """
    errors = ErrorCollector()
    rules: tuple[tuple[str, str, Callable[[float], bool]], ...] = (
        (above_zero, "above zero", lambda value: value > 0),
        (from_zero, "zero or more", lambda value: value >= 0),
        (fraction, "between 0 and 1", lambda value: 0 <= value <= 1),
    )
    for names, wanted, holds in rules:
        for name in names.split():
            value = getattr(settings, name)
            if not holds(value):
                errors.add(ConfigError(f"{value!r} is not {wanted}", where=name))
            elif name.endswith("_m") and not name.endswith("_per_m") and value > _LONGEST_M:
                errors.add(ConfigError(f"{value!r} m is longer than a millimetre", where=name, hint="lengths are in m"))
    errors.raise_all()


def _names(cls: type) -> list[str]:
    return [field.name for field in dataclasses.fields(cls)]


def _is_required(cls: Any, name: str) -> bool:
    field = cls.__dataclass_fields__[name]
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _convert(hint: Any, value: object, where: str) -> object:
    hint = unaliased(hint)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        return _convert(next(a for a in arguments if a is not type(None)), value, where)
    if origin is dict:
        hint = dict  # a table of any values
    if origin is tuple:
        return _sequence(arguments, value, where)
    if dataclasses.is_dataclass(hint):
        made: type[object] = hint  # type: ignore[assignment]
        return value if isinstance(value, made) else build(made, value, where)
    if hint is float and isinstance(value, str) and (named := _UNIT.search(where)):
        try:
            value = si_or_text(value, _UNITS.get(named[1], named[1]))
        except UnitError as error:
            raise ConfigError(error.what, where=where, hint=error.hint) from error
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if not math.isfinite(value):
            raise ConfigError(f"{value!r} is not a finite number", where=where)
        return float(value)
    if hint is not float and isinstance(value, hint) and isinstance(value, bool) == (hint is bool):
        return value
    wanted, remedy = getattr(hint, "__name__", hint), "a number, without a unit" if hint is float else ""
    raise ConfigError(f"expected {wanted}, got {value!r}", where=where, hint=remedy)


def _sequence(arguments: tuple[object, ...], value: object, where: str) -> tuple[object, ...]:
    if not isinstance(value, (list, tuple)):
        raise ConfigError(f"expected a list, got {value!r}", where=where)
    if arguments[-1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(value) != len(arguments):
        raise ConfigError(f"expected {len(arguments)} values, got {len(value)}", where=where)
    return tuple(_gathered(zip(arguments, value, strict=True), where))


def _gathered(pairs: Iterable[tuple[object, object]], where: str) -> list[object]:
    errors, found = ErrorCollector(), []
    for i, (hint, item) in enumerate(pairs):
        with errors:
            found.append(_convert(hint, item, f"{where}[{i}]"))
    errors.raise_all()
    return found
