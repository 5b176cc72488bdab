"""Gwyddion's own files (.gwy): one file for all channels of a scan, or for the curves of a spectrum.

The format: Gwyddion user guide, "Format of Gwyddion files". A file is "GWYP" and an object; an object is its name, the
size of its components, and the components: name, type, value. Numbers are little-endian, texts end with a zero byte.

Gwyddion's y axis points down: rows are written in reverse and y is negated. A field of Gwyddion extends to the outer
edges of its pixels; a region of afspm ends at the centres of the outermost pixels.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from afspm.basics.plain_data import PlainMapping
from afspm.model import Scan, Spectrum
from afspm.model.channels import ROLES_APART
from afspm.night.run import Run
from afspm.night.spectrum_stack import SpectrumStack, mean_over_repeats
from afspm.night.tables import ScanRow, SpectrumRow

_MAGIC = b"GWYP"
Item = tuple[str, str, object]
"""The name, the type (Gwyddion's letter) and the value of a component."""


def write(run: Run, row: ScanRow | SpectrumRow) -> Iterator[tuple[str, bytes]]:
    """Yield (suffix, content) of the file of a scan or spectrum."""
    meta = meta_of(run.about(row))
    if isinstance(row, ScanRow):
        yield ".gwy", scan_file(list(run.scan(row).values()), meta)
    else:
        yield ".gwy", spectrum_file(run.spectrum(row), meta)


def scan_file(scans: Sequence[Scan], meta: Mapping[str, str]) -> bytes:
    items: list[Item] = []
    for number, scan in enumerate(scans):
        values = scan.values[::-1]
        unknown = ~np.isfinite(values)
        items.append((f"/{number}/data", "o", _field(scan, np.where(unknown, _typical(values), values), scan.unit)))
        items.append((f"/{number}/data/title", "s", scan.channel))
        items.append((f"/{number}/data/visible", "b", True))
        if unknown.any():  # Gwyddion has no NaN: unmeasured pixels are masked
            items.append((f"/{number}/mask", "o", _field(scan, unknown.astype(np.float64), "")))
        own = {**meta, "roles": ROLES_APART.join(scan.roles)} if scan.roles else meta
        items.append((f"/{number}/meta", "o", _object("GwyContainer", [(k, "s", v) for k, v in own.items()])))
    return _MAGIC + _object("GwyContainer", items)


def spectrum_file(spectrum: Spectrum, meta: Mapping[str, str]) -> bytes:
    """Return the file of one spectrum: a graph of each further variable over the first variable."""
    items: list[Item] = []
    swept, units = spectrum.values[:, 0] if spectrum.names else np.empty(0), spectrum.units
    for number, name in enumerate(spectrum.names[1:], 1):
        curve = [
            ("xdata", "D", swept),
            ("ydata", "D", spectrum.values[:, number]),
            ("description", "s", name),
            ("type", "i", 2),
        ]
        graph = [
            ("title", "s", f"{spectrum.kind}: {name}"),
            ("bottom_label", "s", spectrum.names[0]),
            ("left_label", "s", name),
            ("x_unit", "o", _unit(units[0])),
            ("y_unit", "o", _unit(units[number])),
            ("curves", "O", [_object("GwyGraphCurveModel", curve)]),
        ]
        items.append((f"/0/graph/graph/{number}", "o", _object("GwyGraphModel", graph)))
        items.append((f"/0/graph/graph/{number}/visible", "b", True))
    items.append(("/0/meta", "o", _object("GwyContainer", [(k, "s", v) for k, v in meta.items()])))
    return _MAGIC + _object("GwyContainer", items)


def grid_file(stack: SpectrumStack, metadata: Mapping[str, str]) -> bytes:
    """Return a grid of spectra as volume data: a brick for each variable and direction, averaged over repeats.

    Unmeasured points get the median of the brick, since Gwyddion's bricks have no NaN.
    """
    meta = _object("GwyContainer", [(name, "s", text) for name, text in {"kind": stack.kind, **metadata}.items()])
    items: list[Item] = []
    for number, (title, unit, values) in enumerate(_bricks(stack)):
        items.append((f"/brick/{number}", "o", _brick(stack, np.nan_to_num(values, nan=_typical(values)), unit)))
        items.append((f"/brick/{number}/title", "s", title))
        items.append((f"/brick/{number}/visible", "b", True))
        items.append((f"/brick/{number}/meta", "o", meta))
    return _MAGIC + _object("GwyContainer", items)


def _bricks(stack: SpectrumStack) -> Iterator[tuple[str, str, NDArray[np.float64]]]:
    for name, curves in stack.curves.items():
        for number, direction in enumerate(stack.directions):
            yield f"{name}, {direction}", stack.units[name], mean_over_repeats(curves)[:, :, number]


def _brick(stack: SpectrumStack, values: NDArray[np.float64], unit: str) -> bytes:
    rows, columns, count = values.shape
    order, points = np.argsort(stack.swept), stack.points
    pixel_x, pixel_y = (float(np.ptp(axis)) / (len(axis) - 1) for axis in (points.x_m, points.y_m))
    step = float(np.ptp(stack.swept)) / max(count - 1, 1)
    planes = np.moveaxis(values[::-1, :, order], 2, 0)
    return _object(
        "GwyBrick",
        [
            ("xres", "i", columns),
            ("yres", "i", rows),
            ("zres", "i", count),
            ("xreal", "d", columns * pixel_x),
            ("yreal", "d", rows * pixel_y),
            ("zreal", "d", count * step),
            ("xoff", "d", float(points.x_m[0]) - pixel_x / 2),
            ("yoff", "d", -(float(points.y_m[-1]) + pixel_y / 2)),
            ("zoff", "d", float(stack.swept.min()) - step / 2),
            ("si_unit_x", "o", _unit("m")),
            ("si_unit_y", "o", _unit("m")),
            ("si_unit_z", "o", _unit(stack.swept_unit)),
            ("si_unit_w", "o", _unit(unit)),
            ("data", "D", planes.reshape(-1)),
        ],
    )


def _field(scan: Scan, values: NDArray[np.float64], unit: str) -> bytes:
    rows, columns = values.shape
    (width, height), (left, low) = scan.region.size_m, scan.region.top_left_m
    pixel_x, pixel_y = width / max(columns - 1, 1), height / max(rows - 1, 1)
    return _object(
        "GwyDataField",
        [
            ("xres", "i", columns),
            ("yres", "i", rows),
            ("xreal", "d", columns * pixel_x),
            ("yreal", "d", rows * pixel_y),
            ("xoff", "d", left - pixel_x / 2),
            ("yoff", "d", -(low + height + pixel_y / 2)),
            ("si_unit_xy", "o", _unit("m")),
            ("si_unit_z", "o", _unit(unit)),
            ("data", "D", values.reshape(-1)),
        ],
    )


def _unit(unit: str) -> bytes:
    return _object("GwySIUnit", [("unitstr", "s", unit)])


def _object(name: str, items: Sequence[Item]) -> bytes:
    content = b"".join(_text(key) + kind.encode() + _value(kind, value) for key, kind, value in items)
    return _text(name) + struct.pack("<I", len(content)) + content


def _value(kind: str, value: Any) -> bytes:
    match kind:
        case "b":
            return bytes([bool(value)])
        case "i":
            return struct.pack("<i", value)
        case "d":
            return struct.pack("<d", value)
        case "s":
            return _text(value)
        case "D":
            data = np.ascontiguousarray(value, "<f8")
            return struct.pack("<I", data.size) + data.tobytes()
        case "O":
            return struct.pack("<I", len(value)) + b"".join(value)
        case _:
            return bytes(value)


def _text(text: str) -> bytes:
    return text.replace("\0", " ").encode() + b"\0"


def _typical(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else 0.0


def meta_of(about: PlainMapping) -> dict[str, str]:
    """Return facts about a measurement as Gwyddion's metadata, which are texts."""
    texts: dict[str, str] = {}
    for name, value in about.items():
        if name in ("channels", "variables", "content") or value is None:
            continue
        if name == "angle_rad":
            texts |= {"angle": f"{math.degrees(value):g} deg", "angle_rad": repr(value)}
        elif name == "notes":
            texts |= {f"note {number}": note for number, note in enumerate(value, 1)}
        elif isinstance(value, Mapping):
            texts |= {f"{name} {inner}": str(one) for inner, one in value.items()}
        else:
            texts[str(name)] = str(value)
    return texts
