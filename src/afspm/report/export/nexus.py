"""NeXus (.h5): the files of the record, with their keys, and the notes on each scan as NXnote."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict

import numpy as np

from afspm.basics.clock import iso_utc
from afspm.night.run import Run
from afspm.night.spectrum_stack import SpectrumStack, mean_over_repeats
from afspm.night.tables import ScanRow, SpectrumRow
from afspm.record import field_names, measured_file
from afspm.record.nexus_reader import ABOUT, GRID
from afspm.record.nxspm import group, mark, put, values


def grid_file(stack: SpectrumStack, metadata: Mapping[str, str]) -> bytes:
    """Return the file of a grid: an NXdata over (y, x, swept variable) for each direction, averaged over repeats."""
    import h5py

    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        mark(file, NX_class="NXroot", default="entry", creator="afspm")
        entry = group(file, "entry", "NXentry")
        mark(entry, default=stack.directions[0])
        put(entry, "title", f"{stack.kind}, {len(stack.points.x_m)} x {len(stack.points.y_m)}")
        put(group(entry, "sample", "NXsample"), "name", metadata.get("sample", ""))
        (swept, *fields) = field_names([stack.swept_name, *stack.curves], ("x", "y"))
        for number, direction in enumerate(stack.directions):
            data = group(entry, direction, "NXdata")
            mark(data, signal=fields[0], axes=["y", "x", swept], angle_deg=math.degrees(stack.points.angle_rad))
            mark(data, auxiliary_signals=fields[1:] or [fields[0]])
            values(data, "y", stack.points.y_m, "m", "y before the grid was turned")
            values(data, "x", stack.points.x_m, "m", "x before the grid was turned")
            values(data, swept, stack.swept, stack.swept_unit, stack.swept_name)
            mark(data[swept], role=stack.role_of(stack.swept_name))
            for field, (name, curves) in zip(fields, stack.curves.items(), strict=True):
                values(data, field, mean_over_repeats(curves)[:, :, number], stack.units[name], name)
                columns = stack.columns[min(number, len(stack.columns) - 1)]
                mark(data[field], role=stack.role_of(columns.get(name, "")))
        collection = group(entry, ABOUT, "NXcollection")
        put(collection, "about", json.dumps(_about_grid(stack, swept, dict(zip(stack.curves, fields, strict=True)))))
        collection["time_ns"] = stack.times[:, :, 0].astype(np.int64)
    return content.getvalue()


def _about_grid(stack: SpectrumStack, swept: str, fields: Mapping[str, str]) -> dict[str, object]:
    # `afspm.read` rebuilds the spectra from this; `ways` lists the directions present in a column
    columns = {
        column: {
            "name": column,
            "unit": stack.units[name],
            "field": fields[name],
            "ways": [direction],
            **stack.roles.listed([column])[0],
        }
        for direction, one in zip(stack.directions, stack.columns, strict=False)
        for name, column in one.items()
    }
    if len(stack.columns) < len(stack.directions):
        columns = {name: column | {"ways": stack.directions} for name, column in columns.items()}
    return {
        "content": GRID,
        "kind": stack.kind,
        "frame": stack.frame.value,
        "center_m": stack.points.center_m,
        "angle_rad": stack.points.angle_rad,
        "swept": {
            "name": stack.swept_name,
            "unit": stack.swept_unit,
            "field": swept,
            **stack.roles.listed([stack.swept_name])[0],
        },
        "in_force": [asdict(one) for one in stack.in_force],
        "columns": [columns[name] for name in stack.names],
    }


def write(run: Run, row: ScanRow | SpectrumRow) -> Iterator[tuple[str, bytes]]:
    """Yield (suffix, content) of the file of a scan or spectrum."""
    import h5py

    run.about(row)  # raises where the file is damaged
    content = io.BytesIO(measured_file(run.folder, row.file).read_bytes())
    with h5py.File(content, "r+") as file:
        if row.key:
            mark(file["entry"]["afspm"], key=row.key)
        for number, note in enumerate(run.notes_on(row), 1):
            made = group(file["entry"], f"note_{number}", "NXnote")
            for name, text in (("author", note.who), ("description", note.text), ("type", "text/plain")):
                put(made, name, text)
            if note.written_ns is not None:
                put(made, "date", iso_utc(note.written_ns))
    yield ".h5", content.getvalue()
