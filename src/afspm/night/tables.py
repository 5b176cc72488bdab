"""The rows of a record as small objects, and tables of them as arrays."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import UTC
from enum import Enum
from html import escape
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeVar, overload

from afspm.basics import imports_of_extra
from afspm.basics.formatting import day_and_time, quantity, scale
from afspm.model import ControlState, Frame, ProcessCondition, Region, RegistrationOutcome
from afspm.model.caption import SettingInForce, caption
from afspm.model.geometry import XY

if TYPE_CHECKING:
    import pandas
    import xarray
    from numpy.typing import NDArray

    from afspm.record.instrument_values import InstrumentValue


T = TypeVar("T")


class SweptSetting(NamedTuple):
    """A parameter that a sweep had set.

    Attributes:
        value: a number, a switch, or text.
        unit: an SI unit, or the microscope's own unit; empty without a unit.
    """

    name: str
    value: float | str | bool
    unit: str

    @property
    def column(self) -> str:
        """The column name of the setting: "scan-speed [m/s]"."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def text(self) -> str:
        """The value for a person: "2 µm/s"."""
        if isinstance(self.value, bool):
            return "on" if self.value else "off"
        return self.value if isinstance(self.value, str) else quantity(self.value, self.unit)


@dataclass(frozen=True, slots=True)
class ScanRow:
    """A scan, without its values.

    Attributes:
        number: the number of the scan, from 1, in the order of recording.
        time_ns: the end of the scan, or its interruption; began_ns: None if the start was not observed.
        channels: (name, unit) of each channel.
        region, shape: None if the scan was interrupted before its first line; shape is (rows, columns).
        interrupted: the scan is incomplete.
        holder, mode, problems: the state of control at the start; None or () if unknown.
        filename: the controller's file; file: the record's file, relative to the run folder, empty if there is none.
        key: the key of the request, `scope.scan(…, key="tile-1")`; empty without a key.
        registration: how the position of the scan on the sample is known; None without drift correction.
        position_sd_m: standard deviation of the position along its most uncertain axis; None if unknown.
        in_force: bias, setpoint, speed, feedback, lock-in and calibrations as they were in force; a column for each
            with the value at the begin, "tip-bias-voltage [V]", and "tip-bias-voltage.end [V]" where another value was
            found at the end. No value: not known.
        settings: parameters that a sweep had set for the scan, as the microscope reported them; a column for each.
            Without each that a person changed at the microscope before its end.
        point: number of the sweep's point, from 1 in the order of measurement; None outside of a sweep, and in runs
            recorded before points had numbers.
        tip_score: the last verdict on the tip: 1 good, 0.5 unclear, 0 bad; None if the scan was not judged.
        instruments: values of other instruments at the end; two columns each: "cryo.temperature [K]" and its age,
            "cryo.temperature.age [s]".
        outside: the conditions of [conditions] that did not hold all the time; the scan counts all the same.
    """

    number: int
    time_ns: int
    began_ns: int | None
    channels: tuple[tuple[str, str], ...]
    region: Region | None
    shape: tuple[int, int] | None
    interrupted: bool
    holder: str | None
    mode: str | None
    problems: tuple[str, ...]
    filename: str
    file: str
    key: str = ""
    registration: RegistrationOutcome | None = None
    position_sd_m: float | None = None
    settings: tuple[SweptSetting, ...] = ()
    tip_score: float | None = None
    instruments: tuple[InstrumentValue, ...] = ()
    outside: tuple[str, ...] = ()
    in_force: tuple[SettingInForce, ...] = ()
    point: int | None = None

    def caption(self) -> str:
        """Return the settings in force, "V = 100 mV, I = 20 pA, 5 nm/s"; empty if none is known."""
        return caption(self.in_force)


@dataclass(frozen=True, slots=True)
class SpectrumRow:
    """A spectrum, without its values; attributes as of `ScanRow`. `position_m` is (x, y) in `frame`."""

    number: int
    time_ns: int
    began_ns: int | None
    kind: str
    position_m: XY | None
    frame: Frame
    points: int
    names: tuple[str, ...]
    units: tuple[str, ...]
    holder: str | None
    mode: str | None
    problems: tuple[str, ...]
    filename: str
    file: str
    key: str = ""
    settings: tuple[SweptSetting, ...] = ()
    instruments: tuple[InstrumentValue, ...] = ()
    outside: tuple[str, ...] = ()
    in_force: tuple[SettingInForce, ...] = ()
    point: int | None = None

    def caption(self) -> str:
        """Return the settings in force, "V = 100 mV, I = 20 pA"; empty if none is known."""
        return caption(self.in_force)


@dataclass(frozen=True, slots=True)
class ControlRow:
    """The control state from `time_ns` on."""

    time_ns: int
    state: ControlState


@dataclass(frozen=True, slots=True)
class ProblemRow:
    """One flag of a problem; `cleared_ns` is None while it is flagged. `by`: the component that flagged it, or ""."""

    name: str
    number: int
    flagged_ns: int
    cleared_ns: int | None
    by: str


@dataclass(frozen=True, slots=True)
class ProcessRow:
    """A change of a process; attributes as of `model.ProcessState`. `time_ns` is the time of the report."""

    time_ns: int
    name: str
    role: str
    condition: ProcessCondition
    since_ns: int
    starts: int
    pid: int
    last_exit: str


@dataclass(frozen=True, slots=True)
class NoteRow:
    """A note; attributes as of `model.Note`. `scan` is the number of its scan, or None."""

    time_ns: int
    who: str
    text: str
    scan: int | None
    written_ns: int | None


class Table(Sequence[T], Generic[T]):
    """Rows of one kind: a sequence, which a notebook shows as a table.

    `to_pandas`, `to_numpy` and `to_xarray` return its columns.

    Args:
        kind: the class of the rows, which gives the columns of an empty table.
    """

    def __init__(self, rows: Iterable[T], kind: type[T]) -> None:
        self._rows = tuple(rows)
        self._kind = kind

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> Table[T]: ...
    def __getitem__(self, index: int | slice) -> T | Table[T]:
        return Table(self._rows[index], self._kind) if isinstance(index, slice) else self._rows[index]

    def __len__(self) -> int:
        return len(self._rows)

    def __iter__(self) -> Iterator[T]:
        return iter(self._rows)

    def where(self, wanted: Callable[[T], bool]) -> Table[T]:
        """Return the rows for which `wanted` returns True."""
        return Table((row for row in self._rows if wanted(row)), self._kind)

    def columns(self) -> dict[str, list[Any]]:
        """Return each column by name, as numbers and texts; positions are split (`center_x_m` …), times are ns."""
        taken_apart = [_apart(row) for row in self._rows]
        more = dict.fromkeys(name for row in self._rows for name in _own_columns(row))
        return {name: [row.get(name) for row in taken_apart] for name in (*_names(self._kind), *more)}

    def to_numpy(self) -> NDArray[Any]:
        """Return a structured array: times as datetime64[ns], unknown numbers as NaN or -1."""
        import numpy as np

        columns = {name: _array(name, values) for name, values in self.columns().items()}
        made = np.empty(len(self), [(name, values.dtype) for name, values in columns.items()])
        for name, values in columns.items():
            made[name] = values
        return made

    def to_xarray(self) -> xarray.Dataset:
        """Return a Dataset over `row`, which xarray can write as NetCDF (needs the extra `xarray`)."""
        with imports_of_extra("xarray", "to_xarray"):
            import xarray

        from afspm.night.netcdf_encoding import fit_classic_netcdf  # imports numpy, which the supervisor avoids

        columns = {name: ("row", _array(name, values)) for name, values in self.columns().items()}
        return fit_classic_netcdf(xarray.Dataset(columns))

    def to_pandas(self) -> pandas.DataFrame:
        """Return a DataFrame with the columns of `to_numpy` (needs the extra `xarray`)."""
        with imports_of_extra("xarray", "to_pandas"):
            import pandas

        return pandas.DataFrame({name: _array(name, values) for name, values in self.columns().items()})

    def _repr_html_(self) -> str:

        return table_html(self.columns(), len(self))

    def __repr__(self) -> str:
        return f"<Table of {len(self)} {self._kind.__name__}>"


_REGION = ("center_x_m", "center_y_m", "width_m", "height_m", "angle_rad", "frame")
_COLUMNS = {
    "region": _REGION,
    "shape": ("rows", "columns"),
    "position_m": ("x_m", "y_m"),
    "state": ("holder", "mode", "problems"),
    "translation_m": ("x_m", "y_m"),
    "rate_m_s": ("rate_x_m_s", "rate_y_m_s"),
}
"""Attributes that are split into several columns."""
_WITH_OWN_COLUMNS = frozenset({"in_force", "settings", "instruments"})
"""The attributes with columns for each parameter that was in force or swept, or of an instrument."""


def _names(kind: type) -> list[str]:
    shared = (field.name for field in fields(kind) if field.name not in _WITH_OWN_COLUMNS)
    return [name for attribute in shared for name in _COLUMNS.get(attribute, (attribute,))]


def _own_columns(row: Any) -> dict[str, object]:
    found: dict[str, object] = {}
    for one in getattr(row, "in_force", ()):
        found |= one.columns
    found |= {one.column: one.value for one in getattr(row, "settings", ())}
    return found | {name: value for one in getattr(row, "instruments", ()) for name, value in one.columns.items()}


def _apart(row: Any) -> dict[str, object]:
    made: dict[str, object] = {}
    for field in fields(row):
        name, value = field.name, getattr(row, field.name)
        if name in _COLUMNS:
            made |= zip(_COLUMNS[name], _parts(value, len(_COLUMNS[name])), strict=True)
        elif name in _WITH_OWN_COLUMNS:
            continue
        elif name == "channels":
            made[name] = ";".join(f"{channel} [{unit}]" for channel, unit in value)
        elif isinstance(value, tuple):
            made[name] = ";".join(map(str, value))
        elif isinstance(value, Enum):
            made[name] = value.name.lower()
        else:
            made[name] = value
    return made | _own_columns(row)


def _parts(value: Any, count: int) -> tuple[object, ...]:
    if isinstance(value, Region):
        return (*value.center_m, *value.size_m, value.angle_rad, value.frame.value)
    if isinstance(value, ControlState):
        return value.holder, value.mode.name.lower(), " ".join(map(str, value.problems))
    return (None,) * count if value is None else tuple(value)


def _array(name: str, values: list[object]) -> NDArray[Any]:
    import numpy as np

    if name.endswith("_ns"):
        return np.array(["NaT" if value is None else value for value in values], "datetime64[ns]")
    known = [value for value in values if value is not None]
    if known and all(isinstance(value, bool) for value in known):
        return np.array([bool(value) for value in values])
    if known and all(isinstance(value, int) for value in known):
        return np.array([-1 if value is None else value for value in values], np.int64)
    if all(isinstance(value, int | float) for value in known):
        return np.array([np.nan if value is None else value for value in values], np.float64)
    return np.array(["" if value is None else str(value) for value in values])


MOST_ROWS: Final = 60
_ENDS: Final = 10
"""The number of rows shown at both ends of a long table."""
_UNITS: Final = {"_m_s": "m/s", "_m": "m", "_rad": "rad", "_s": "s"}
_FIRST: Final = ("number", "key")
_CELL: Final = 'style="text-align:left;white-space:nowrap;max-width:18em;overflow:hidden;text-overflow:ellipsis"'


def table_html(columns: Mapping[str, Sequence[object]], count: int) -> str:
    """Return an HTML table of columns of `count` rows each, without empty columns."""
    shown = range(count) if count <= MOST_ROWS else [*range(_ENDS), None, *range(count - _ENDS, count)]
    columns = {name: columns[name] for name in sorted(columns, key=lambda name: name not in _FIRST)}
    filled = [_column(name, values) for name, values in columns.items() if any(map(_has_content, values))]
    head = "".join(f"<th {_CELL}>{escape(name)}</th>" for name, _ in filled)
    body = "".join(_row(filled, number) for number in shown)
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


def _has_content(value: object) -> bool:
    return value is not None and value is not False and value != ""


def _text(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
