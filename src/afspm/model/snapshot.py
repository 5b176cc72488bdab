"""Snapshots: a tree of dataclasses as plain data (for JSON) and back, checked against the types of its fields."""

from __future__ import annotations

import base64
import types
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

T = TypeVar("T")

Plain = dict[str, Any] | list[Any] | str | float | int | bool | None


class SnapshotError(ValueError):
    """Plain data that is not a snapshot of the type expected; the text names the field."""


def take(thing: object, version: int) -> dict[str, Any]:
    """Return the snapshot of a dataclass, marked with the version of its layout."""
    return {"version": version, "state": to_plain(thing)}


def load(expected: type[T], snapshot: object, version: int) -> T:
    """Return the object that `take` was given.

    Raises:
        SnapshotError: another version, an unknown or missing field, a value of another type.
    """
    found = snapshot.get("version") if isinstance(snapshot, dict) else None
    if found != version or not isinstance(snapshot, dict):
        raise SnapshotError(f"a snapshot of version {found}, this program reads version {version}")
    return from_plain(expected, snapshot.get("state"))


def to_plain(thing: Any) -> Any:
    """Return dataclasses as dictionaries, enums by name, tuples as lists, bytes and arrays in base 64."""
    if thing is None or isinstance(thing, bool | str) or type(thing) in (int, float):
        return thing
    if isinstance(thing, Enum):
        return thing.name
    if is_dataclass(thing):
        return {one.name: to_plain(getattr(thing, one.name)) for one in fields(thing)}
    if isinstance(thing, Mapping):
        return {str(key): to_plain(value) for key, value in thing.items()}
    if isinstance(thing, bytes):
        return base64.b64encode(thing).decode()
    if isinstance(thing, np.ndarray):
        return {"dtype": thing.dtype.str, "shape": list(thing.shape), "data": to_plain(thing.tobytes())}
    if isinstance(thing, Sequence):
        return [to_plain(one) for one in thing]
    raise SnapshotError(f"a {type(thing).__name__} can't be kept in a snapshot")


def from_plain(expected: type[T], plain: object, where: str = "snapshot") -> T:
    """Return the object of a type that `to_plain` wrote.

    Raises:
        SnapshotError: it is not a snapshot of that type.
    """
    try:
        return _read(expected, plain, where)  # type: ignore[no-any-return]
    except SnapshotError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise SnapshotError(f"{where}: {error!r}") from error


def _read(expected: Any, plain: Any, where: str) -> Any:
    if expected is Any:
        return plain
    origin, parameters = get_origin(expected), get_args(expected)
    if origin in (Union, types.UnionType):
        return _one_of(parameters, plain, where)
    if origin is tuple:
        kinds = [parameters[0]] * len(plain) if parameters[1:] == (...,) else parameters
        return tuple(_read(*one, f"{where}[{i}]") for i, one in enumerate(zip(kinds, plain, strict=True)))
    if origin is not None and issubclass(origin, Mapping):
        return {_key(parameters[0], key): _read(parameters[1], one, f"{where}.{key}") for key, one in plain.items()}
    if isinstance(expected, type) and is_dataclass(expected):
        return _dataclass(expected, plain, where)
    if isinstance(expected, type) and issubclass(expected, Enum):
        return expected[plain]
    if expected is bytes:
        return base64.b64decode(plain, validate=True)
    if origin is np.ndarray:
        return np.frombuffer(base64.b64decode(plain["data"]), plain["dtype"]).reshape(plain["shape"])
    if expected is float and type(plain) is int:
        return float(plain)
    if expected not in (str, int, float, bool, dict, type(None)) or type(plain) is not expected:
        raise SnapshotError(f"{where}: {plain!r} is not a {getattr(expected, '__name__', expected)}")
    return plain


def _one_of(parameters: tuple[Any, ...], plain: Any, where: str) -> Any:
    if plain is None and type(None) in parameters:
        return None
    errors = []
    for one in parameters:
        try:
            return from_plain(one, plain, where)
        except SnapshotError as error:
            errors.append(str(error))
    raise SnapshotError("; ".join(errors))


def _dataclass(expected: type, plain: Any, where: str) -> Any:
    hints = _hints(expected)
    if not isinstance(plain, dict) or plain.keys() != hints.keys():
        found = sorted(plain) if isinstance(plain, dict) else plain
        raise SnapshotError(f"{where}: {found} are not the fields of {expected.__name__}, {sorted(hints)}")
    return expected(**{name: _read(hint, plain[name], f"{where}.{name}") for name, hint in hints.items()})


@cache
def _hints(expected: type) -> dict[str, Any]:
    hints = get_type_hints(expected)
    return {one.name: hints[one.name] for one in fields(expected)}


def _key(expected: Any, key: str) -> Any:
    return int(key) if expected is int else key
