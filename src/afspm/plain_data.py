"""Types of plain data: what JSON and TOML hold. The data say what is in them, so a reader checks each value."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

Plain: TypeAlias = dict[str, Any]
"""A table, to fill."""
PlainMapping: TypeAlias = Mapping[str, Any]
"""A table, to read."""
