"""Types of plain data, as in JSON and TOML: a reader must check the type of each value."""

from __future__ import annotations

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


def file_key(name: str) -> str:
    """Return the key of a setting in the experiment file: its name without the unit.

    >>> file_key("lease_s"), file_key("above_m"), file_key("idle")
    ('lease', 'above', 'idle')
    """
    return name.removesuffix("_s").removesuffix("_m")


SECTION: Plain = {"extra": "forbid", "alias_generator": file_key}
"""Value of `__pydantic_config__` for a dataclass that describes a table of the experiment file."""
