"""Reader of Gwyddion's own files (.gwy): images, and the curves of graphs. The format: `record.export.gwyddion`.

Of the files that `afspm export --to gwy` writes it takes the exact region and the unmeasured pixels: there a mask
means "not measured", as in files by Gwyddion's converter; in a person's own it may mean anything. Selections and views
are left out.
"""

from __future__ import annotations

import ast
import re
import struct
from collections.abc import Iterator, Mapping
from datetime import tzinfo
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from afspm.basics.errors import FileError, UnitError
from afspm.basics.plain_data import Plain
from afspm.basics.units import convert
from afspm.model import Frame, Region, Scan, Spectrum
from afspm.model.arrays import Array
from afspm.model.channels import ROLES_APART
from afspm.storage.formats.content import FileContent, text_of

_MAGIC: Final = b"GWYP"
_IMAGE: Final = re.compile(r"/(\d+)/data")
_GRAPH: Final = re.compile(r"/(?:\d+/)?graph/graph/(\d+)")
_OTHERS: Final = {"brick": "volume data", "surface": "points in space", "sps": "spectra"}
_OTHER: Final = re.compile(rf"/({'|'.join(_OTHERS)})/(\d+)")
_UNREADABLE: Final = (FileError, UnitError, KeyError, ValueError)
_MOST: Final = {"m": 1.0, "N": 1e-3, "V": 1e5, "A": 10.0}
"""Largest amounts of a measurement with a scanning probe, by unit."""
_MOST_OF_ALL: Final = 1e30
_NUMBERS: Final = {"b": "?", "c": "c", "i": "<i4", "q": "<i8", "d": "<f8"}
_DEEPEST: Final = 20
"""Most objects in each other; a damaged file may announce any number."""


def read_gwyddion(path: Path, zone: tzinfo | None, *, is_converted: bool = False) -> FileContent:
    """Return each image as a scan, and the curves over the same values as one spectrum.

    An image or graph that can't be read is left out, and named with the reason in `left_out`; so is volume data.

    Args:
        is_converted: the file is by Gwyddion's converter: a mask means "not measured", and an image or graph with
            impossible values is left out.

    Raises:
        FileError: the file is damaged, or nothing of it can be read.
    """
    data = path.read_bytes()
    if not data.startswith(_MAGIC):
        raise FileError("is not a file of Gwyddion")
    content, end = _object(data, len(_MAGIC), len(data), 0)
    if end != len(data):
        raise FileError(f"has {len(data) - end} bytes after its last object")
    numbers = sorted(int(match[1]) for key in content if (match := _IMAGE.fullmatch(key)))
    others = sorted(match.groups() for key in content if (match := _OTHER.fullmatch(key)))
    left_out = [f"{_OTHERS[kind]} no. {number}: afspm reads images and graphs of Gwyddion" for kind, number in others]
    scans: list[Scan] = []
    for number in numbers:
        try:
            scans.append(_possible(_scan(content, number, str(path), is_converted), is_converted))
        except _UNREADABLE as error:  # one channel must not cost the others
            left_out.append(f"{content.get(f'/{number}/data/title', f'image {number}')}: {_reason(error)}")
    graphs = [(int(match[1]), graph) for key, graph in content.items() if (match := _GRAPH.fullmatch(key))]
    meta = _meta(content, numbers[0] if numbers else 0)
    spectra: list[Spectrum] = []
    try:
        in_order = [graph for _, graph in sorted(graphs, key=lambda one: one[0])]
        spectra += (_possible(one, is_converted) for one in _spectra(in_order, meta, str(path)))
    except _UNREADABLE as error:
        left_out.append(f"curves of graphs: {_reason(error)}")
    if not scans and not spectra:
        raise FileError(f"holds no image and no graph that can be read{': ' if left_out else ''}{'; '.join(left_out)}")
    times = _whole(meta, "began_ns"), _whole(meta, "time_ns")
    return FileContent("Gwyddion", tuple(scans), tuple(spectra), meta, *times, left_out=tuple(left_out))


def _reason(error: Exception) -> str:
    return f"it lacks {error}" if isinstance(error, KeyError) else str(error)


T = TypeVar("T", Scan, Spectrum)


def _possible(found: T, is_converted: bool) -> T:
    # the converter believes any bytes: half a file has become values up to 1e299 m, and a deflection newtons
    if not is_converted:
        return found
    columns = [(found.unit, found.values)] if isinstance(found, Scan) else zip(found.units, found.values.T, strict=True)
    for unit, values in columns:
        most = float(np.nanmax(np.abs(values), initial=0.0))
        if most > _MOST.get(unit, _MOST_OF_ALL):
            raise FileError(f"has values up to {most:.3g} {unit}, which no measurement has: a wrong unit, or damage")
    return found


def _meta(content: Plain, number: int) -> dict[str, str]:
    return {key: value for key, value in content.get(f"/{number}/meta", {}).items() if isinstance(value, str)}


def _whole(meta: Mapping[str, str], name: str) -> int | None:
    text = meta.get(name, "")
    return int(text) if text.isdecimal() else None


def _scan(content: Plain, number: int, filename: str, is_converted: bool) -> Scan:
    field, meta = content[f"/{number}/data"], _meta(content, number)
    values, unit = _pixels(field)[::-1].copy(), _unit(field, "si_unit_z")
    title = content.get(f"/{number}/data/title", f"Channel {number + 1}")
    mask = content.get(f"/{number}/mask")
    if mask is not None and (is_converted or "angle_rad" in meta):
        values[_pixels(mask)[::-1] > 0.5] = np.nan
    if "angle_rad" not in meta:
        return Scan(_region(field), title, unit, values, None, filename)
    angle_rad, frame = float(meta["angle_rad"]), Frame(meta["frame"])
    region = Region(_pair(meta["center_m"]), _pair(meta["size_m"]), angle_rad, frame)
    roles = tuple(filter(None, meta.get("roles", "").split(ROLES_APART)))
    return Scan(region, title, unit, values, _whole(meta, "time_ns"), meta.get("filename", ""), roles=roles)


def _pixels(field: Plain) -> Array:
    columns, rows = field["xres"], field["yres"]
    if min(columns, rows) < 2 or len(field["data"]) != columns * rows:
        raise FileError(f"has {len(field['data'])} values in an image of {columns} x {rows} pixels")
    values: Array = field["data"].reshape(rows, columns).astype(np.float64)
    return values


def _region(field: Plain) -> Region:
    # Gwyddion's y axis points down, and its sides include the outer halves of the outermost pixels
    columns, rows, unit = field["xres"], field["yres"], _unit(field, "si_unit_xy")
    sides = (field["xreal"], field["yreal"], field.get("xoff", 0.0), field.get("yoff", 0.0))
    width, height, left, top = (convert(float(side), unit, "m") for side in sides)
    size_m = (width * (columns - 1) / columns, height * (rows - 1) / rows)
    return Region((left + width / 2, -(top + height / 2)), size_m)


def _spectra(graphs: list[Plain], meta: Mapping[str, str], filename: str) -> Iterator[Spectrum]:
    together: dict[tuple[str, str, bytes], list[tuple[str, str, Array]]] = {}
    for graph in graphs:
        swept, unit = graph.get("bottom_label", "x"), _unit(graph, "x_unit")
        for curve in graph.get("curves", []):
            column = (curve.get("description", graph.get("left_label", "")), _unit(graph, "y_unit"), curve["ydata"])
            together.setdefault((swept, unit, curve["xdata"].tobytes()), []).append(column)
    position = _pair(meta["position_m"]) if "position_m" in meta else None
    for (swept, swept_unit, raw), columns in together.items():
        names = (swept, *(name for name, _, _ in columns))
        units = (swept_unit, *(unit for _, unit, _ in columns))
        values = np.column_stack([np.frombuffer(raw, "<f8"), *(curve for _, _, curve in columns)])
        kind, frame = meta.get("kind", "graph"), Frame(meta.get("frame", Frame.TIP.value))
        time_ns, own = _whole(meta, "measured_ns"), meta.get("filename", "") if "time_ns" in meta else filename
        yield Spectrum(position, kind, names, units, values, time_ns, own, frame)


def _unit(owner: Plain, name: str) -> str:
    unit: str = owner.get(name, {}).get("unitstr", "")
    return unit


def _pair(text: str) -> tuple[float, float]:
    x, y = ast.literal_eval(text)
    return float(x), float(y)


def _object(data: bytes, at: int, limit: int, depth: int) -> tuple[Plain, int]:
    # a name, the size of the components, and the components: name, type, value
    if depth > _DEEPEST:
        raise FileError(f"has more than {_DEEPEST} objects in each other")
    _, at = _text(data, at, limit)
    (size,) = struct.unpack_from("<I", data, at)
    at, end = at + 4, at + 4 + size
    if end > limit:
        raise FileError("is incomplete: an object ends after the file")
    found: dict[str, Any] = {}
    while at < end:
        name, at = _text(data, at, end)
        kind = data[at : at + 1].decode("latin-1")
        found[name], at = _value(kind, data, at + 1, end, depth)
    if at != end:
        raise FileError("is damaged: the sizes of its objects do not add up")
    return found, end


def _value(kind: str, data: bytes, at: int, end: int, depth: int) -> tuple[Any, int]:
    if kind == "s":
        return _text(data, at, end)
    if kind == "o":
        return _object(data, at, end, depth + 1)
    if kind in _NUMBERS:
        size = np.dtype(_NUMBERS[kind]).itemsize
        found = np.frombuffer(data[at : at + size], _NUMBERS[kind])[0].item()
        return text_of(found) if kind == "c" else found, at + size
    (count,) = struct.unpack_from("<I", data, at)
    at, item = at + 4, kind.lower()
    if item in _NUMBERS:
        size = np.dtype(_NUMBERS[item]).itemsize * count
        if at + size > end:
            raise FileError(f"is damaged: it announces {count} numbers and holds fewer")
        return np.frombuffer(data, _NUMBERS[item], count, at), at + size
    if item not in "so":
        raise FileError(f"is damaged: it has a value of the unknown type {kind!r}")
    values = []
    for _ in range(count):
        value, at = _value(item, data, at, end, depth)
        values.append(value)
    return values, at


def _text(data: bytes, at: int, limit: int) -> tuple[str, int]:
    end = data.find(b"\0", at, limit)
    if end < 0:
        raise FileError("is damaged: a text does not end")
    return text_of(data[at:end]), end + 1
