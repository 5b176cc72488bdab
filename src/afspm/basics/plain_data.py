"""Types of plain data: what JSON and TOML hold. The data say what is in them, so a reader checks each value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler

Plain: TypeAlias = dict[str, Any]
"""A table, to fill."""
PlainMapping: TypeAlias = Mapping[str, Any]
"""A table, to read."""


class _Strict:
    """Marks a bool of the settings: pydantic reads "yes" and 1 as true, too, a file has true alone."""

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> object:
        from pydantic_core import core_schema

        return core_schema.bool_schema(strict=True)


@dataclass(frozen=True)
class _AtLeast:
    """Marks an int of the settings: a whole number, not below `least`."""

    least: int

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> object:
        from pydantic_core import core_schema

        return core_schema.int_schema(ge=self.least)


Switch = Annotated[bool, _Strict()]
WholeNumber = Annotated[int, _AtLeast(0)]
Count = Annotated[int, _AtLeast(1)]


def file_key(name: str) -> str:
    """Return the key in the experiment file of a setting, which is its name without its unit.

    >>> file_key("lease_s"), file_key("above_m"), file_key("idle")
    ('lease', 'above', 'idle')
    """
    return name.removesuffix("_s").removesuffix("_m")


SECTION: Plain = {"extra": "forbid", "alias_generator": file_key}
"""For `__pydantic_config__` of a dataclass that describes a table of the experiment file."""
