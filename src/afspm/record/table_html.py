"""A table as HTML for a notebook: times as dates, numbers with the prefix that suits their column."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from datetime import UTC
from html import escape
from typing import Any, Final

from afspm.formatting import day_and_time, scale

MOST_ROWS: Final = 60
_ENDS: Final = 10
"""Rows that are shown at both ends of a longer table."""
_UNITS: Final = {"_m_s": "m/s", "_m": "m", "_rad": "rad", "_s": "s"}
_FIRST: Final = ("number", "key")
_CELL: Final = 'style="text-align:left;white-space:nowrap;max-width:18em;overflow:hidden;text-overflow:ellipsis"'


def table_html(columns: Mapping[str, Sequence[object]], count: int) -> str:
    """Return columns of `count` rows each; those in which nothing stands are left out."""
    shown = range(count) if count <= MOST_ROWS else [*range(_ENDS), None, *range(count - _ENDS, count)]
    columns = {name: columns[name] for name in sorted(columns, key=lambda name: name not in _FIRST)}
    told = [_column(name, values) for name, values in columns.items() if any(map(_says, values))]
    head = "".join(f"<th {_CELL}>{escape(name)}</th>" for name, _ in told)
    body = "".join(_row(told, number) for number in shown)
    rows = "1 row" if count == 1 else f"{count} rows"
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table><p>{rows}</p>"


def _row(columns: Sequence[tuple[str, Sequence[str]]], number: int | None) -> str:
    cells = ("…" if number is None else cells[number] for _, cells in columns)
    return f"<tr>{''.join(f'<td {_CELL}>{escape(cell)}</td>' for cell in cells)}</tr>"


def _column(name: str, values: Sequence[Any]) -> tuple[str, list[str]]:
    if name.endswith("_ns"):
        return f"{name.removesuffix('_ns')} (UTC)", ["" if v is None else day_and_time(v, UTC)[:19] for v in values]
    unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    numbers = [value for value in values if isinstance(value, float) and math.isfinite(value)]
    if not unit or not numbers:
        return name, [_text(value) for value in values]
    plain = re.sub(f"{next(end for end in _UNITS if name.endswith(end))}$", "", name)
    if unit == "rad":
        return f"{plain} / °", [_text(None if v is None else math.degrees(v)) for v in values]
    factor, prefixed = scale(max(map(abs, numbers)), unit)
    return f"{plain} / {prefixed}", [_text(None if v is None else v * factor) for v in values]


def _says(value: object) -> bool:
    return value is not None and value is not False and value != ""


def _text(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
