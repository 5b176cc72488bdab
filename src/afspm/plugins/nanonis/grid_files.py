"""Nanonis grids of spectra (.3ds): header lines `name=value`, then big-endian float32, one record for each point.

A record has the fixed parameters, the experiment parameters, and the values of each channel; names carry their unit.
Two real files (SpmGrids.jl, MIT) show: rows ascend, points are at the centres of pixels as in `.sxm`, backward values
are in the order of the forward sweep, and a stopped grid ends after its last point. The angle is clockwise, as in
`.sxm`; SIDAM reads it so. In sweeps of several segments, neighbours share the point between them: two headers show it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import tzinfo
from pathlib import Path
from typing import Final

import numpy as np

from afspm.basics import FileError
from afspm.components import Array
from afspm.driver import FileContent, local_ns, name_and_unit, text_of
from afspm.model import XY, Region, Scan, Spectrum
from afspm.plugins.nanonis.scan_files import CONTROLLER

_END: Final = b":HEADER_END:\r\n"
_LAYOUT: Final = "%d.%m.%Y %H:%M:%S"
_SWEPT: Final = {"Bias": ("Bias calc", "bias spectroscopy"), "Z": ("Z rel", "Z spectroscopy")}
"""Name of the swept column and kind of spectrum, as in Nanonis' `.dat` of the same sweep, by the swept signal."""
_SETTINGS: Final = ("X", "Y", "Z offset", "Z sweep distance", "Settling time", "Integration time", "Z-Ctrl hold")
"""Experiment parameters that are set, not measured."""
_MOST: Final = 1 << 22
"""Most points of a grid: months of measurement. A damaged header may announce any number."""


@dataclass(frozen=True, eq=False)
class _Grid:
    """The header's entries, and the records of the measured points, row by row."""

    header: dict[str, str]
    columns: int
    rows: int
    records: Array
    parameters: tuple[tuple[str, str], ...]
    channels: tuple[tuple[str, str], ...]
    cut_bytes: int
    """Bytes of a last record that is not whole."""

    def parameter(self, name: str) -> Array | None:
        """Return a parameter of each point, or None without it."""
        for number, (own, _) in enumerate(self.parameters):
            if own == name:
                return self.records[:, number]
        return None


def read_grid(path: Path, zone: tzinfo | None) -> FileContent:
    """Read the spectrum at each measured point, and as scans what was measured once at each point.

    A stopped grid has fewer spectra; its scans have NaN at the other points. Grids of a single line have no scans.

    Raises:
        FileError, ValueError: another format, or damaged.
    """
    grid = _parsed(path.read_bytes())
    start, end = (_time(grid.header, name, zone) for name in ("Start time", "End time"))
    if start is not None and end is not None and end < start:  # the hour that the end of summer time repeats
        end = _time(grid.header, "End time", zone, fold=1)
    region = _region(grid)
    scans = () if region is None else tuple(_scans(grid, region, end, str(path)))
    spectra = tuple(_spectra(grid, region, str(path)))
    cut = (f"the record of point {len(grid.records) + 1}: the file ends in it",) if grid.cut_bytes else ()
    return FileContent(CONTROLLER, scans, spectra, grid.header, start, end, upwards=True, left_out=cut)


def _parsed(content: bytes) -> _Grid:
    head, found, data = content.partition(_END)
    if not found:
        raise FileError("is not a Nanonis grid, or incomplete: its header does not end")
    header: dict[str, str] = {}
    for key, _, value in (line.partition("=") for line in text_of(head).splitlines()):
        header.setdefault(key, value.strip().strip('"'))
    parameters = (*_names(header, "Fixed parameters"), *_names(header, "Experiment parameters"))
    channels, points = _names(header, "Channels"), int(_field(header, "Points"))
    if len(parameters) != int(_field(header, "# Parameters (4 byte)")):
        raise FileError(f"its header names {len(parameters)} parameters, not {header['# Parameters (4 byte)']}")
    if not channels or points < 1:
        raise FileError(f"holds no spectra: {len(channels)} channels of {points} points")
    columns, rows = (int(count) for count in _field(header, "Grid dim").split(" x "))
    if min(columns, rows) < 1 or columns * rows > _MOST:
        raise FileError(f"its header announces a grid of {columns} x {rows} points")
    size = 4 * (len(parameters) + len(channels) * points)
    data, rest = data[: len(data) - len(data) % size], len(data) % size
    if not data or len(data) > size * columns * rows:
        raise FileError(f"is incomplete: {len(data) + rest} bytes of values, not up to {columns * rows} times {size}")
    records = np.frombuffer(data, ">f4").reshape(-1, size // 4).astype(np.float64)
    return _Grid(header, columns, rows, records, parameters, channels, rest)


def _field(header: dict[str, str], name: str) -> str:
    if name not in header:
        raise FileError(f"its header lacks {name}")
    return header[name]


def _names(header: dict[str, str], field: str) -> tuple[tuple[str, str], ...]:
    return tuple(name_and_unit(text) for text in _field(header, field).split(";") if text.strip())


def _region(grid: _Grid) -> Region | None:
    if min(grid.columns, grid.rows) < 2:
        return None
    x, y, width, height, clockwise_deg = (float(text) for text in _field(grid.header, "Grid settings").split(";"))
    size_m = (width * (grid.columns - 1) / grid.columns, height * (grid.rows - 1) / grid.rows)
    return Region((x, y), size_m, math.radians(0.0 - clockwise_deg))


def _scans(grid: _Grid, region: Region, end: int | None, filename: str) -> Iterator[Scan]:
    fixed = len(_names(grid.header, "Fixed parameters"))
    for number, (name, unit) in enumerate(grid.parameters[fixed:], fixed):
        if name.casefold() not in map(str.casefold, _SETTINGS):
            values = np.full(grid.rows * grid.columns, np.nan)
            values[: len(grid.records)] = grid.records[:, number]
            yield Scan(region, name, unit, values.reshape(grid.rows, grid.columns), end, filename)


def _spectra(grid: _Grid, region: Region | None, filename: str) -> Iterator[Spectrum]:
    signal, swept_unit = name_and_unit(_field(grid.header, "Sweep Signal"))
    swept_name, kind = _SWEPT.get(signal, (signal, grid.header.get("Experiment", "Grid Spectroscopy")))
    names = (swept_name, *(name for name, _ in grid.channels))
    units = (swept_unit, *(unit for _, unit in grid.channels))
    curves = grid.records[:, len(grid.parameters) :].reshape(len(grid.records), len(grid.channels), -1)
    places = _positions(grid, region)
    for swept, channels, place in zip(_sweeps(grid, curves.shape[2]), curves, places, strict=True):
        yield Spectrum(place, kind, names, units, np.column_stack([swept, *channels]), None, filename)


def _positions(grid: _Grid, region: Region | None) -> list[XY | None]:
    x, y = grid.parameter("X"), grid.parameter("Y")
    if x is None or y is None:
        if region is None:
            return [None] * len(grid.records)
        x, y = (axis.ravel()[: len(grid.records)] for axis in region.pixels_m((grid.rows, grid.columns)))
    finite = np.isfinite(x) & np.isfinite(y)
    return [(float(a), float(b)) if known else None for a, b, known in zip(x, y, finite, strict=True)]


def _sweeps(grid: _Grid, points: int) -> Iterator[Array]:
    if grid.header.get("Filetype", "Linear") == "MLS":
        swept = _segments(grid.header, points)
        yield from (swept for _ in grid.records)
        return
    start, end = grid.parameter("Sweep Start"), grid.parameter("Sweep End")
    if start is None or end is None:
        raise FileError("its header lacks Sweep Start or Sweep End: the swept values are unknown")
    for first, last in zip(start, end, strict=True):
        yield np.linspace(first, last, points)


def _segments(header: dict[str, str], points: int) -> Array:
    # `Segment Start (V), Segment End (V), Settling (s), Integration (s), Steps (xn), …=0,1,1E-2,1E-1,30;…`
    table = next(((key, value) for key, value in header.items() if key.startswith("Segment Start (")), None)
    if table is None:
        raise FileError("its header lacks the segments of the sweep")
    titles = [title.strip() for title in table[0].split(",")]
    lines = [dict(zip(titles, line.split(","), strict=True)) for line in table[1].split(";")]
    counts = [int(line["Steps (xn)"]) for line in lines]
    if min(counts) < 1 or sum(counts) - len(counts) + 1 != points:
        raise FileError(f"segments of {', '.join(map(str, counts))} points do not form a sweep of {points}")
    parts = [
        np.linspace(float(line[titles[0]]), float(line[titles[1]]), count)
        for line, count in zip(lines, counts, strict=True)
    ]
    return np.concatenate([parts[0], *(part[1:] for part in parts[1:])])


def _time(header: dict[str, str], name: str, zone: tzinfo | None, *, fold: int = 0) -> int | None:
    return local_ns(header[name], _LAYOUT, zone, fold=fold) if header.get(name) else None
