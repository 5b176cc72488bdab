"""Types of plain data, as in JSON and TOML: a reader must check the type of each value."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler

Plain: TypeAlias = dict[str, Any]
"""A table that may be changed."""
PlainMapping: TypeAlias = Mapping[str, Any]
"""A read-only table."""
PlainList: TypeAlias = list[Any]
"""A list, such as a line of a log in JSON."""


class _Strict:
    """Annotation of a boolean setting that accepts true and false only, not "yes" or 1."""

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> object:
        from pydantic_core import core_schema

        return core_schema.bool_schema(strict=True)


@dataclass(frozen=True)
class _AtLeast:
    """Annotation of an integer setting with the lower bound `least`."""

    least: int

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> object:
        from pydantic_core import core_schema

        return core_schema.int_schema(ge=self.least)


Switch = Annotated[bool, _Strict()]
WholeNumber = Annotated[int, _AtLeast(0)]
Count = Annotated[int, _AtLeast(1)]


def from_json(text: str | bytes | bytearray) -> Any:
    """Return the value of JSON that another program or person wrote.

    Raises:
        ValueError: the text is not JSON, or is nested too deeply.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        # A few kilobytes of brackets are enough; a reader that expects ValueError would end with a traceback.
        raise ValueError("JSON that is nested too deeply") from error


def file_key(name: str) -> str:
    """Return the key of a setting in the experiment file: its name without the unit.

    >>> file_key("lease_s"), file_key("above_m"), file_key("idle")
    ('lease', 'above', 'idle')
    """
    return name.removesuffix("_s").removesuffix("_m")


SECTION: Plain = {"extra": "forbid", "alias_generator": file_key}
"""Value of `__pydantic_config__` for a dataclass that describes a table of the experiment file."""
