"""Nanosurf Studio's files (.nhf): HDF5 of formats 1 (since 2023) and 2, with images and curves.

A file of the maker's examples and the maker's reader (nanosurf-utils, MIT) show: rows and columns ascend, backward
segments are not mirrored, integers are scaled to a range. A rotation is taken as counter-clockwise in degrees
(! angle-counter-clockwise).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from afspm.basics import FileError, PlainMapping
from afspm.components import Array
from afspm.driver import FileContent, hdf5_reading
from afspm.model import Region, Scan, Spectrum

if TYPE_CHECKING:
    import h5py

CONTROLLER: Final = "Nanosurf Studio"
_TYPES: Final = {0: "int32", 1: "uint8", 2: "uint16", 3: "uint32", 4: "uint64", 5: "int16", 6: "int64", 7: "double"}
"""Types of values by their numbers in format 1; format 2 has their names."""
_SPECTROSCOPY: Final = ("spectroscopy", "spectroscopy_grid")
_MEASUREMENTS: Final = (*_SPECTROSCOPY, "image_line_based", "wavemode_nma")
"""Kinds of groups with measurements; format 2 also has other groups, such as calibrations."""


def read_nhf(path: Path, zone: tzinfo | None) -> FileContent:
    """Read all images and curves of a file.

    Raises:
        FileError: the file has another format, inconsistent sizes, or neither images nor curves.
        OSError: the file is damaged.
    """
    with hdf5_reading.opened(path) as file:
        version = int(file.attrs.get("nsf_file_version_major", 0))
        if version not in (1, 2):
            raise FileError(f"is of Nanosurf's format {version}, not 1 or 2")
        groups = [group for group in file.values() if _kind(group) in _MEASUREMENTS]
        scans = [replace(scan, filename=str(path)) for group in groups for scan in _scans(group)]
        curves = [one for group in groups if _kind(group) in _SPECTROSCOPY for one in _curves(group)]
        spectra = [replace(one, filename=str(path)) for one in curves]
        if not (scans or spectra):
            raise FileError("holds neither images nor curves")
        header = {key: _plain(value) for group in groups for key, value in group.attrs.items()}
    direction = header.get("image_scan_direction")
    return FileContent(
        CONTROLLER,
        tuple(scans),
        tuple(spectra),
        header,
        start_ns=_time_ns(header.get("created")),
        end_ns=_time_ns(header.get("modified")),
        upwards={"up": True, "down": False}.get(str(direction)),
    )


def _kind(group: h5py.Group) -> str:
    return hdf5_reading.text(group.attrs.get("group_type", group.attrs.get("measurement_type", "")))


def _scans(group: h5py.Group) -> Iterator[Scan]:
    # Maps with several values in a pixel are left out.
    if _kind(group) in _SPECTROSCOPY:
        return
    for segment in _segments(group):
        region, (rows, columns) = _frame({**group.attrs, **segment.attrs})
        acquired = int(group.attrs.get("image_number_of_lines_acquired", rows))
        for name, unit, dataset in _channels(segment):
            if dataset.size != rows * columns:
                continue
            if min(rows, columns) < 2:
                raise FileError(f"an image must have at least 2 x 2 pixels, not {columns} x {rows}")
            values = _values(dataset).reshape(rows, columns)
            # A stopped image: the remaining lines were not scanned.
            if acquired < rows:
                upwards = hdf5_reading.text(group.attrs.get("image_scan_direction", "up")) == "up"
                values[slice(acquired, None) if upwards else slice(rows - acquired)] = np.nan
            yield Scan(region, f"{name} {_segment_name(segment)}", unit, values)


def _curves(group: h5py.Group) -> Iterator[Spectrum]:
    # The segments of a curve are joined, for channels that all of them have. Positions of curves are not in the file
    # (! curve-positions).
    parts = [_blocks(segment) for segment in _segments(group)]
    shared = [name for name in parts[0] if all(name in part for part in parts)] if parts else []
    count = min((len(part[name][1]) for part in parts for name in shared), default=0)
    for number in range(count):
        columns = [np.concatenate([part[name][1][number] for part in parts]) for name in shared]
        if len({len(column) for column in columns}) != 1:
            raise FileError("a curve has channels of different lengths")
        units = tuple(parts[0][name][0] for name in shared)
        yield Spectrum(None, "force", tuple(shared), units, np.column_stack(columns))


def _blocks(segment: h5py.Group) -> dict[str, tuple[str, list[Array]]]:
    found = {}
    for name, unit, dataset in _channels(segment):
        sizes = _block_sizes(segment, dataset)
        if (sizes < 0).any() or sizes.sum() != dataset.size:
            raise FileError(f"{name} holds {dataset.size} values instead of {sizes.sum()}")
        found[name] = (unit, np.split(_values(dataset), np.cumsum(sizes)[:-1]))
    return found


def _block_sizes(segment: h5py.Group, dataset: h5py.Dataset) -> NDArray[np.int64]:
    # Another dataset of the segment has the number of values of each curve.
    source = dataset.attrs.get("dataset_block_size_source")
    for other in segment.values():
        named = hdf5_reading.text(other.attrs.get("name", "")) == "number_of_datapoints_acquired"
        referenced = source is not None and other.attrs.get("dataset_block_size_id") == source
        if named or referenced:
            return hdf5_reading.array(other).astype(np.int64).ravel()
    return np.array([dataset.size])


def _segments(group: h5py.Group) -> list[h5py.Group]:
    return [one for _, one in sorted(group.items()) if hasattr(one, "keys")]


def _segment_name(segment: h5py.Group) -> str:
    return hdf5_reading.text(segment.attrs.get("segment_name", segment.attrs.get("name", "")))


def _channels(segment: h5py.Group) -> Iterator[tuple[str, str, h5py.Dataset]]:
    for _, dataset in sorted(segment.items()):
        attributes = dataset.attrs
        prefix = "signal" if "signal_name" in attributes else "base"
        name = attributes.get("signal_name", attributes.get("name"))
        unit = attributes.get(f"{prefix}_calibration_unit")
        if name is not None and unit is not None and hasattr(dataset, "dtype"):
            yield hdf5_reading.text(name), hdf5_reading.text(unit), dataset


def _values(dataset: h5py.Dataset) -> Array:
    # Integers span the range of their type; in format 2 one number stands for a missing value.
    raw = hdf5_reading.array(dataset)
    attributes = dataset.attrs
    prefix = "signal" if "signal_name" in attributes else "base"
    kind = attributes.get("dataset_element_type", 7)
    kind = hdf5_reading.text(kind) if isinstance(kind, str | bytes) else _TYPES.get(int(kind), "double")
    # Floating-point values are stored in their unit.
    if kind == "double" or f"{prefix}_calibration_max" not in attributes:
        return raw
    low, high = (float(attributes[f"{prefix}_calibration_{end}"]) for end in ("min", "max"))
    limits = np.iinfo(kind)
    smallest, largest = float(limits.min), float(limits.max)
    if prefix == "signal":  # format 2 reserves one number for missing values
        missing = raw == float(dataset.fillvalue)
        smallest, largest = (smallest + 1.0, largest) if limits.min else (smallest, largest - 1.0)
        raw = np.where(missing, np.nan, raw)
    return (raw - smallest) * ((high - low) / (largest - smallest)) + low


def _frame(attributes: PlainMapping) -> tuple[Region, tuple[int, int]]:
    if "rect_axis_size" in attributes:
        rows, columns = (int(number) for number in attributes["rect_axis_size"])
        height, width = (float(length) for length in attributes["rect_axis_range"])
    else:
        rows, columns = int(attributes["image_number_of_lines"]), int(attributes["image_points_per_line"])
        width, height = float(attributes["image_size_x"]), float(attributes["image_size_y"])
    center = (float(attributes.get("scanner_offset_x", 0.0)), float(attributes.get("scanner_offset_y", 0.0)))
    angle_deg = float(attributes.get("rect_rotation", attributes.get("scanner_rotation", 0.0)))
    return Region(center, (width, height), math.radians(angle_deg)), (rows, columns)


def _plain(value: object) -> Any:
    return hdf5_reading.text(value) if isinstance(value, bytes | str) else getattr(value, "tolist", lambda: value)()


def _time_ns(text: object) -> int | None:
    # Times have a zone: "2023-07-18T15:26:38.320Z".
    return None if not text else round(datetime.fromisoformat(str(text)).timestamp() * 1e6) * 1000
