"""Scans and spectra as HDF5 files that follow NeXus' NXspm where that fits, and lose nothing.

    /entry                  NXentry, definition "NXspm"; start_time, end_time, title
      data                  NXdata: a field for each channel over y and x (unrotated, in m), with units
      experiment_instrument NXinstrument: scan_environment/scan_control/scan_region has centre, range and angle
      sample                NXsample
      afspm                 NXcollection: `about`, all that is known as JSON; who was in control, problems, drift …
      vendor                NXcollection: `header` of the controller's own file as JSON, where that could be read

What NXspm requires and nobody here knows (technique, temperatures, amplifiers) is left out rather than made up.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from afspm.clock import iso_utc
from afspm.files import hdf5
from afspm.files.nexus import ABOUT, DEFINITION, VENDOR, about_of
from afspm.model import Scan, Spectrum

Array = NDArray[np.float64]

_SHOWN = ("in_control", "mode", "interrupted", "number", "run")
"""Facts that are attributes, too, for whoever looks into a file with a viewer."""


@dataclass(frozen=True)
class FileProvenance:
    """The provenance that is written into a file, as far as it is known.

    Attributes:
        time_ns: when it was finished; began_ns: when it began.
        facts: all else, in JSON's types: who was in control, mode, problems, feedback, drift, the run, its seed …
        header: of the controller's own file.
    """

    time_ns: int
    began_ns: int | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    header: Mapping[str, Any] = field(default_factory=dict)


def encode_scan(scans: Sequence[Scan], circumstances: FileProvenance) -> bytes:
    """All channels of one scan, of the same region and shape, as a file."""
    first, fields = scans[0], field_names((scan.channel for scan in scans), ("x", "y"))
    region = first.region
    about = _about("scan", first.filename, circumstances) | {
        "center_m": region.center_m,
        "size_m": region.size_m,
        "angle_rad": region.angle_rad,
        "frame": region.frame.value,
        "channels": [
            {"name": scan.channel, "unit": scan.unit, "field": name, "time_ns": scan.time_ns}
            for scan, name in zip(scans, fields, strict=True)
        ],
    }
    (left, low), (width, height), (rows, columns) = region.top_left_m, region.size_m, first.shape
    x, y = np.linspace(left, left + width, columns), np.linspace(low, low + height, rows)

    def fill(entry: Any) -> None:
        data = _group(entry, "data", "NXdata")
        data.attrs.update(signal=fields[0], axes=["y", "x"], x_indices=1, y_indices=0)
        if fields[1:]:
            data.attrs["auxiliary_signals"] = fields[1:]
        for name, axis in (("x", x), ("y", y)):
            _values(data, name, axis, "m", f"{name} before the frame was turned")
        for scan, name in zip(scans, fields, strict=True):
            _values(data, name, scan.values, scan.unit, scan.channel)
        _scan_region(entry, first)

    return _encoded(about, circumstances, fill)


def encode_spectrum(spectrum: Spectrum, circumstances: FileProvenance) -> bytes:
    """One spectrum as a file."""
    fields = field_names(spectrum.names)
    about = _about("spectrum", spectrum.filename, circumstances) | {
        "position_m": spectrum.position_m,
        "frame": spectrum.frame.value,
        "kind": spectrum.kind,
        "measured_ns": spectrum.time_ns,
        "variables": [
            {"name": name, "unit": unit, "field": one}
            for name, unit, one in zip(spectrum.names, spectrum.units, fields, strict=True)
        ],
    }

    def fill(entry: Any) -> None:
        data = _group(entry, "data", "NXdata")
        if fields[1:]:
            data.attrs.update({"signal": fields[1], "axes": [fields[0]], f"{fields[0]}_indices": 0})
        if fields[2:]:
            data.attrs["auxiliary_signals"] = fields[2:]
        for number, name in enumerate(fields):
            column = np.ascontiguousarray(spectrum.values[:, number])
            _values(data, name, column, spectrum.units[number], spectrum.names[number])
        instrument = _group(entry, "experiment_instrument", "NXinstrument")
        if spectrum.position_m is not None:
            probe = _group(instrument, "piezo_sensor", "NXsensor")
            for axis, value in zip("xy", spectrum.position_m, strict=True):
                _values(probe, axis, value, "m")

    return _encoded(about, circumstances, fill)


def facts_of(path: Path) -> dict[str, Any]:
    """Return what a file says beside its values. Raises FileError: it is damaged."""
    with hdf5.opened(path) as file:
        return about_of(file)


def _encoded(about: dict[str, Any], circumstances: FileProvenance, fill: Any) -> bytes:
    """Made in memory: whatever is wrong with the disk is then found in one place, where the bytes are written."""
    import h5py

    with h5py.File("aside", "w", driver="core", backing_store=False) as file:
        file.attrs.update(NX_class="NXroot", default="entry", creator="afspm", creator_version=afspm_version())
        entry = _group(file, "entry", "NXentry")
        entry.attrs["default"] = "data"
        entry["definition"] = DEFINITION
        entry["title"] = str(about.get("experiment", ""))
        entry["end_time"] = iso_utc(circumstances.time_ns)
        if circumstances.began_ns is not None:
            entry["start_time"] = iso_utc(circumstances.began_ns)
        if about.get("simulated"):
            entry["experiment_description"] = "SIMULATED"
        program = entry.create_dataset("program_name", data="afspm")
        program.attrs["version"] = afspm_version()
        _group(entry, "sample", "NXsample")["name"] = str(about.get("sample", ""))
        fill(entry)
        collection = _group(entry, ABOUT, "NXcollection")
        collection["about"] = json.dumps(about)
        collection.attrs.update({name: about[name] for name in _SHOWN if about.get(name) is not None})
        if circumstances.header:
            vendor = _group(entry, VENDOR, "NXcollection")
            vendor["header"] = json.dumps(dict(circumstances.header), default=_plain)
        file.flush()
        image: bytes = file.id.get_file_image()
    return image


def _about(content: str, filename: str, circumstances: FileProvenance) -> dict[str, Any]:
    return {
        **circumstances.facts,
        "content": content,
        "filename": filename,
        "time_ns": circumstances.time_ns,
        "began_ns": circumstances.began_ns,
    }


def _scan_region(entry: Any, scan: Scan) -> None:
    instrument = _group(entry, "experiment_instrument", "NXinstrument")
    environment = _group(instrument, "scan_environment", "NXenvironment")
    region = _group(_group(environment, "scan_control", "NXspm_scan_control"), "scan_region", "NXspm_scan_region")
    region.attrs["frame"] = scan.region.frame.value
    for axis, center, size in zip("xy", scan.region.center_m, scan.region.size_m, strict=True):
        _values(region, f"scan_offset_value_{axis}", center, "m")
        _values(region, f"scan_range_{axis}", size, "m")
    _values(region, "scan_angle_x", math.degrees(scan.region.angle_rad), "deg")


def _group(parent: Any, name: str, nexus_class: str) -> Any:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nexus_class
    return group


def _values(group: Any, name: str, values: Array | float, unit: str, long_name: str = "") -> None:
    dataset = group.create_dataset(name, data=values, dtype="<f8")
    dataset.attrs["units"] = unit
    if long_name:
        dataset.attrs["long_name"] = long_name


def field_names(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Return names that NeXus allows, all different; the real ones are in `long_name`."""
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
    """Return the version of this program."""
    from importlib.metadata import version

    return version("afspm")


def _plain(value: Any) -> Any:
    """Return a value of a vendor's header in JSON's types."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return str(value)
