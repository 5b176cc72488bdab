"""Scans and spectra as HDF5 files that follow NeXus' NXspm (spectra over the bias: NXsts), without loss.

    /entry                  NXentry, definition "NXspm" or "NXsts"; technique, start_time, end_time, title
      data                  NXdata: a field for each channel over y and x (unrotated, in m), with units;
                            float32 if that is exact for each value, else float64
      experiment_instrument NXinstrument: hardware, software, position and number of points
      sample, user          NXsample, NXuser
      afspm                 NXcollection: `about`, all facts as JSON: holder, problems, drift …
      vendor                NXcollection: `header` of the controller's own file as JSON, where that could be read

Unknown facts (temperatures, amplifiers; the technique of some microscopes) are left out, not made up.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from afspm.basics.clock import iso_utc
from afspm.basics.plain_data import Plain, PlainMapping
from afspm.model import Scan, Spectrum, names
from afspm.model.arrays import Array
from afspm.model.caption import SettingInForce
from afspm.record import nxspm
from afspm.record.nexus_reader import ABOUT, BIAS_SPECTRUM, DEFINITION, VENDOR, about_of
from afspm.record.nxspm import group, mark, put, values
from afspm.storage.formats import hdf5_reading

if TYPE_CHECKING:
    import h5py

    _Fill = Callable[[h5py.Group, h5py.Group], None]

_VERSIONS: Final = ("v110", "v110")
"""HDF5 1.10 (of 2016) and later read the files; in the older format each group takes 1 kB."""
_BLOCK: Final = 16_384
"""Values that are compared at a time: they stay in the processor's cache, 512² at once take four times as long."""
_SHOWN = ("in_control", "mode", "interrupted", "number", "run", "frame")
"""Facts that are also attributes, so that a viewer of HDF5 files shows them."""


@dataclass(frozen=True)
class FileProvenance:
    """The provenance that is written into a file, where known.

    Attributes:
        time_ns: the end of the measurement; began_ns: its start.
        facts: all else, in JSON's types: holder, mode, problems, feedback, drift, the run, its seed …
        header: the header of the controller's own file.
    """

    time_ns: int
    began_ns: int | None = None
    facts: PlainMapping = field(default_factory=dict)
    header: Mapping[str, object] = field(default_factory=dict)


def encode_scan(scans: Sequence[Scan], circumstances: FileProvenance) -> bytes:
    """Return the bytes of an HDF5 file with all channels of one scan, which share one region and shape."""
    first, fields = scans[0], field_names((scan.channel for scan in scans), ("x", "y"))
    region = first.region
    about = _about("scan", first.filename, circumstances) | {
        "center_m": region.center_m,
        "size_m": region.size_m,
        "angle_rad": region.angle_rad,
        "frame": region.frame.value,
        "channels": [
            {"name": scan.channel, "unit": scan.unit, "field": name, "time_ns": scan.time_ns, "roles": scan.roles}
            for scan, name in zip(scans, fields, strict=True)
        ],
    }
    (left, low), (width, height), (rows, columns) = region.top_left_m, region.size_m, first.shape
    x, y = np.linspace(left, left + width, columns), np.linspace(low, low + height, rows)

    def fill(entry: h5py.Group, instrument: h5py.Group) -> None:
        data = group(entry, "data", "NXdata")
        mark(data, signal=fields[0], axes=["y", "x"], x_indices=1, y_indices=0)
        if fields[1:]:
            mark(data, auxiliary_signals=fields[1:])
        for name, axis in (("x", x), ("y", y)):
            values(data, name, axis, "m", f"{name} before the frame was turned")
        for scan, name in zip(scans, fields, strict=True):
            values(data, name, _in_single_precision(scan.values), scan.unit, scan.channel)
        nxspm.write_frame(instrument, first)

    return _encoded(DEFINITION, about, circumstances, fill)


def encode_spectrum(spectrum: Spectrum, circumstances: FileProvenance) -> bytes:
    fields = field_names(spectrum.names)
    about = _about("spectrum", spectrum.filename, circumstances) | {
        "position_m": spectrum.position_m,
        "frame": spectrum.frame.value,
        "kind": spectrum.kind,
        "measured_ns": spectrum.time_ns,
        "variables": [
            {"name": name, "unit": unit, "field": one, **listed}
            for name, unit, one, listed in zip(
                spectrum.names, spectrum.units, fields, spectrum.roles.listed(spectrum.names), strict=True
            )
        ],
    }

    definition = nxspm.definition_of(spectrum, circumstances.facts.get("metadata") or {})

    def fill(entry: h5py.Group, instrument: h5py.Group) -> None:
        data = group(entry, "data", "NXdata")
        if fields[1:]:
            mark(data, signal=fields[1], axes=[fields[0]], **{f"{fields[0]}_indices": 0})
        if fields[2:]:
            mark(data, auxiliary_signals=fields[2:])
        for number, name in enumerate(fields):
            column = np.ascontiguousarray(spectrum.values[:, number])
            values(data, name, column, spectrum.units[number], spectrum.names[number])
        if definition == BIAS_SPECTRUM:
            nxspm.write_bias_sweep(entry, instrument, spectrum, _bias_v(about))
        else:
            nxspm.write_point(instrument, spectrum)

    return _encoded(definition, about, circumstances, fill)


def facts_of(path: Path) -> Plain:
    """Return the facts stored in a file beside its values. Raises FileError if the file is damaged."""
    with hdf5_reading.opened(path) as file:
        return about_of(file)


def _encoded(
    definition: str,
    about: dict[str, object],
    circumstances: FileProvenance,
    fill: _Fill,
) -> bytes:
    # in memory: errors of the disk then occur in one place, where the bytes are written
    import h5py

    content = io.BytesIO()
    with (
        h5py.File("aside", "w", driver="core", backing_store=False, libver=_VERSIONS) as aside,
        h5py.File(content, "w", libver=_VERSIONS) as file,
    ):
        entry = group(aside, "entry", "NXentry")
        mark(entry, default="data")
        put(entry, "end_time", iso_utc(circumstances.time_ns))
        if circumstances.began_ns is not None:
            put(entry, "start_time", iso_utc(circumstances.began_ns))
        fill(entry, nxspm.describe(entry, definition, about, afspm_version()))
        collection = group(entry, ABOUT, "NXcollection")
        put(collection, "about", json.dumps(about))
        _write_in_force(collection, about)
        shown: PlainMapping = about
        mark(collection, **{name: shown[name] for name in _SHOWN if shown.get(name) is not None})
        if circumstances.header:
            vendor = group(entry, VENDOR, "NXcollection")
            put(vendor, "header", json.dumps(dict(circumstances.header), default=_plain))
        mark(file, NX_class="NXroot", default="entry", creator="afspm", creator_version=afspm_version())
        # HDF5 reserves 256 bytes for the header of each new field, and a copy has what the field needs: 4 kB less
        aside.copy(entry, file)
    return content.getvalue()


def _write_in_force(collection: h5py.Group, about: PlainMapping) -> None:
    # each setting as a field of its own, for programs that read no JSON; the end only where it differs
    if not (settings := [SettingInForce(**one) for one in about.get("in_force", ())]):
        return
    made = group(collection, "in_force", "NXcollection")
    for one in settings:
        ends = {"": one.begin} | ({} if one.end == one.begin else {"_end": one.end})
        for suffix, value in ends.items():
            name = f"{one.name.replace('-', '_')}{suffix}"
            if isinstance(value, float | int) and not isinstance(value, bool):
                values(made, name, float(value), one.unit)
            elif value is not None:
                put(made, name, value)


def _bias_v(about: PlainMapping) -> float | None:
    # while the height was controlled, before the sweep
    found = (SettingInForce(**one) for one in about.get("in_force", ()))
    value = next((one.begin for one in found if one.name == names.TIP_BIAS_VOLTAGE), None)
    return value if isinstance(value, float) else None


def _in_single_precision(numbers: Array) -> NDArray[np.floating]:
    # most controllers deliver float32; the first block alone reveals most arrays of float64
    exact, single = np.ascontiguousarray(numbers, "<f8"), np.empty(numbers.shape, "<f4")
    whole, narrow = exact.reshape(-1), single.reshape(-1)
    for start in range(0, whole.size, _BLOCK):
        block = slice(start, start + _BLOCK)
        with np.errstate(over="ignore", invalid="ignore"):
            narrow[block] = whole[block]
        if not np.array_equal(narrow[block].astype("<f8").view("<u8"), whole[block].view("<u8")):
            return numbers
    return single


def _about(content: str, filename: str, circumstances: FileProvenance) -> dict[str, object]:
    return {
        **circumstances.facts,
        "content": content,
        "filename": filename,
        "time_ns": circumstances.time_ns,
        "began_ns": circumstances.began_ns,
    }


def field_names(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Return a unique name that NeXus allows for each channel or variable, in lower case.

    Args:
        taken: names that are already used in the group.
    """
    found, used = [], set(taken)
    for name in names:
        plain = re.sub(r"[^a-z0-9_]+", "_", name.lower()).strip("_") or "value"
        plain = f"channel_{plain}" if plain[0].isdigit() or plain in used else plain
        number, unique = 1, plain
        while unique in used:
            number += 1
            unique = f"{plain}_{number}"
        used.add(unique)
        found.append(unique)
    return found


@cache
def afspm_version() -> str:
    from importlib.metadata import version

    return version("afspm")


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return str(value)
