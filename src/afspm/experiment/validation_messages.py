"""Errors of pydantic in the words of an experiment file: one sentence for each wrong value."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

import pydantic
from pydantic_core import ErrorDetails

from afspm.basics.errors import AfspmError
from afspm.experiment.document import Document
from afspm.experiment.findings import closest, nearest

SettingPath = tuple[str | int, ...]

_UNKNOWN: Final = ("extra_forbidden", "unexpected_keyword_argument")
_WANTED: Final = {
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float", "int_parsing_size"), "a whole number"),
    **dict.fromkeys(("float_type", "float_parsing", "decimal_type", "decimal_parsing"), "a number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    **dict.fromkeys(("tuple_type", "list_type", "set_type", "frozen_set_type"), "a list of values in brackets"),
    **dict.fromkeys(
        ("model_type", "model_attributes_type", "dict_type", "dataclass_type", "mapping_type"),
        "a table of keys and values",
    ),
    **dict.fromkeys(("enum", "literal_error"), "{expected}"),
    **dict.fromkeys(("path_type", "path_not_file", "path_not_directory"), "a path in quotes"),
    **dict.fromkeys(("datetime_type", "datetime_parsing", "datetime_from_date_parsing"), "a date and time"),
    **dict.fromkeys(("date_type", "date_parsing", "date_from_datetime_parsing"), "a date"),
    "is_instance_of": "a {class}",
    "none_required": "left out",
    "finite_number": "a finite number",
    "string_type": "a text in quotes",
    "greater_than": "above {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "below {lt:g}",
    "less_than_equal": "at most {le:g}",
}
"""Descriptions of the expected value, by pydantic's types of errors."""


def report(
    error: pydantic.ValidationError,
    given: object,
    path: SettingPath,
    document: Document,
    known: Callable[[SettingPath], Iterable[str]] = lambda place: (),
    location: SettingPath | None = None,
) -> list[SettingPath]:
    """Report pydantic's errors about a value of the document, one for each place; return the places in the value.

    Args:
        path: name of the value in the texts.
        known: returns the valid names of settings at a place.
        location: path of the value in the document; None: `path`.
    """
    by_place: dict[SettingPath, list[ErrorDetails]] = {}
    for detail in error.errors(include_url=False):
        by_place.setdefault(_place(detail, given), []).append(detail)
    for place, errors in by_place.items():
        if any(other[: len(place)] == place != other for other in by_place):
            continue  # another member of the union fits better: its error lies deeper
        full = (*path, *place)
        what, hint = _sentence(errors, name_of(full), known(place))
        document.error(what, *(path if location is None else location), *place, hint=hint)
    return list(by_place)


def name_of(path: SettingPath) -> str:
    """Return a setting's path as text: ("limits", "a", 0) as "[limits] a[0]"."""
    text = ""
    for part in path[1:]:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return f"[{path[0]}] {text}".rstrip()


def _place(detail: ErrorDetails, given: Any) -> SettingPath:
    # pydantic's location also holds names of union members and validators, which the file does not.
    place: list[str | int] = []
    for number, part in enumerate(detail["loc"], 1):
        if part in (given if isinstance(given, Mapping) else range(len(given)) if isinstance(given, list) else ()):
            given = given[part]
        elif not (detail["type"] == "missing" and number == len(detail["loc"]) and isinstance(part, str)):
            continue
        place.append(part)
    return tuple(place)


def _sentence(errors: Sequence[ErrorDetails], shown: str, known: Iterable[str]) -> tuple[str, str]:
    value = errors[0].get("input")
    if len(errors) > 1 and isinstance(value, list | Mapping):  # a union: the value is not meant as a quantity
        errors = [detail for detail in errors if _cause(detail) is None] or errors
    last = errors[-1]
    kind, context = last["type"], last.get("ctx", {})
    if kind in _UNKNOWN:
        return f"{shown} is not a setting", nearest(str(last["loc"][-1]), known)
    if kind == "missing" and isinstance(index := last["loc"][-1], int):
        return f"{shown} needs {index + 1} values, and has {len(value)}", ""
    if kind == "missing":
        return f"{shown} is missing", ""
    if kind == "too_long":
        return f"{shown} has {context['actual_length']} values, and takes {context['max_length']} at most", ""
    for detail in errors:
        if (cause := _cause(detail)) is not None:
            return f"{shown} = {value!r}: {cause.what}", cause.hint
    wanted = [_WANTED[detail["type"]].format(**detail.get("ctx", {})) for detail in errors if detail["type"] in _WANTED]
    if wanted:
        near = closest(str(value), re.findall(r"'(.*?)'", " ".join(wanted)))
        hint = f"did you mean {near!r}?" if near else ""
        return f"{shown} is {' or '.join(dict.fromkeys(wanted))}, not {value!r}", hint
    message = last["msg"].removeprefix("Value error, ").replace("Input should be", "it should be")
    return f"{shown}: {message[:1].lower()}{message[1:]}, not {value!r}", ""


def _cause(detail: ErrorDetails) -> AfspmError | None:
    cause = detail.get("ctx", {}).get("error")
    return cause if isinstance(cause, AfspmError) else None
