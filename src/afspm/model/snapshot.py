"""Snapshots: trees of dataclasses as plain data and back, with a kind and a version.

Plain data are JSON's types (bytes as base64) and numpy arrays, which the caller stores beside the JSON (or converts to
lists). The types of the fields alone determine how they are read: a snapshot never names code.
"""

from __future__ import annotations

import base64
import sys
import types
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from afspm.basics.errors import InvalidValue
from afspm.basics.plain_data import Plain
from afspm.basics.type_aliases import unaliased

T = TypeVar("T")
_PLAIN_TYPES = frozenset({str, int, float, bool, type(None)})


def snapshot(state: object, kind: str, version: int, *, lists: bool = False) -> Plain:
    """Return a dataclass as plain data.

    Args:
        kind, version: labels that `restored` checks.
        lists: convert arrays to lists, so that JSON can hold everything.
    """
    return {"kind": kind, "version": version, **to_plain(state, lists=lists)}


def restored(type_: type[T], plain: Mapping[str, object], kind: str, version: int) -> T:
    """Return the dataclass of a snapshot.

    Raises:
        InvalidValue: the snapshot is of another kind or version, or damaged.
    """
    if (plain.get("kind"), plain.get("version")) != (kind, version):
        found = f"{plain.get('kind')!r}, version {plain.get('version')!r}"
        raise InvalidValue(f"a snapshot of kind {found} instead of {kind!r}, version {version}")
    try:
        made: T = from_plain(type_, {key: value for key, value in plain.items() if key not in ("kind", "version")})
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InvalidValue(f"a damaged snapshot of {kind!r}: {error}") from error
    return made


def _numpy() -> types.ModuleType | None:
    # Without a loaded numpy there are no arrays, and most processes do not load it. While another thread imports it,
    # the module is there without its names.
    numpy = sys.modules.get("numpy")
    return numpy if hasattr(numpy, "ndarray") and hasattr(numpy, "generic") else None


def to_plain(value: object, *, lists: bool = False) -> Any:
    """Return dataclasses, enums, collections and arrays as plain data."""
    type_: Any = type(value)
    if type_ in _PLAIN_TYPES:  # first, since most of a snapshot is plain: the scheduler waits for its own before a scan
        return value
    if isinstance(value, Enum):
        return value.value
    if (names := _field_names(type_)) is not None:
        return {name: to_plain(getattr(value, name), lists=lists) for name in names}
    if (np := _numpy()) is not None:
        if isinstance(value, np.ndarray):
            return value.tolist() if lists else value
        if isinstance(value, np.generic):
            return value.item()
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, Mapping):
        if all(isinstance(key, str) for key in value):
            return {key: to_plain(one, lists=lists) for key, one in value.items()}
        # JSON has only text as keys: other mappings become pairs
        return [[to_plain(key, lists=lists), to_plain(one, lists=lists)] for key, one in value.items()]
    if isinstance(value, list | tuple | deque):
        return [to_plain(one, lists=lists) for one in value]
    if isinstance(value, set | frozenset):
        # sorted, so that equal states give equal snapshots
        return sorted(to_plain(one, lists=lists) for one in value)
    return value


def from_plain(type_: Any, plain: Any) -> Any:
    """Return plain data as a value of a type: the inverse of `to_plain`.

    Raises:
        TypeError: a field without a default is missing, or a value does not fit its type.
        ValueError: a field is unknown, or a value is not allowed.
        AttributeError: the plain data of a dataclass are no mapping.
    """
    type_ = unaliased(type_)
    origin, arguments = get_origin(type_), get_args(type_)
    if type_ is Any:
        return plain
    if origin is Literal:
        return _one_of(arguments, plain)
    if origin in (Union, types.UnionType):
        return _from_union(arguments, plain)
    if (np := _numpy()) is not None and origin is np.ndarray:
        if not isinstance(plain, np.ndarray | list):
            raise TypeError(f"{plain!r} is not an array")
        return np.asarray(plain, dtype=get_args(arguments[1])[0])
    if is_dataclass(type_):
        return _from_fields(type_, plain)
    if isinstance(type_, type) and issubclass(type_, Enum):
        return type_(plain)
    if origin is not None:
        return _from_collection(origin, arguments, plain)
    # a whole number in JSON is an int
    if type_ is float:
        return float(plain)
    if type_ is bytes:
        return base64.b64decode(plain, validate=True)
    if not isinstance(plain, type_):
        raise TypeError(f"{plain!r} is no {type_.__name__}")
    return plain


def _from_union(arguments: Sequence[object], plain: object) -> object:
    # only `X | None`: plain data do not show the class of a value
    if plain is None and types.NoneType in arguments:
        return None
    (only,) = (one for one in arguments if one is not types.NoneType)
    return from_plain(only, plain)


def _one_of(allowed: Sequence[object], plain: object) -> object:
    if plain not in allowed:
        raise ValueError(f"{plain!r} is none of {', '.join(map(repr, allowed))}")
    return plain


def _from_fields(type_: Any, plain: Mapping[str, object]) -> object:
    hints = _hints(type_)
    known = {field.name: hints[field.name] for field in fields(type_) if field.init}
    if unknown := plain.keys() - known.keys():
        raise ValueError(f"{type_.__name__} has no {', '.join(sorted(unknown))}")
    return type_(**{name: from_plain(known[name], value) for name, value in plain.items()})


def _from_collection(origin: Any, arguments: Sequence[Any], plain: Any) -> object:
    if issubclass(origin, Mapping):
        key, value = arguments
        pairs = plain.items() if isinstance(plain, Mapping) else plain
        return {from_plain(key, one): from_plain(value, other) for one, other in pairs}
    if origin is tuple and not (len(arguments) == 2 and arguments[1] is Ellipsis):
        return tuple(from_plain(one, value) for one, value in zip(arguments, plain, strict=True))
    made = [from_plain(arguments[0], value) for value in plain]
    return made if origin in (list, Sequence) else origin(made)


@cache
def _field_names(type_: type[object]) -> tuple[str, ...] | None:
    # None: no dataclass
    return tuple(field.name for field in fields(type_) if field.init) if is_dataclass(type_) else None


@cache
def _hints(type_: type[object]) -> dict[str, object]:
    return get_type_hints(type_)
