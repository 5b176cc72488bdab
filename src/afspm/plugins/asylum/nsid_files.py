"""NSID files (.h5, pycroscopy's format): images are indexed [x, y], and their axes ascend.

A file that was converted from Asylum's format contains Asylum's note, with the position, the angle and the time.
"""

from __future__ import annotations

from datetime import tzinfo
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from afspm.basics import FileError, convert
from afspm.driver import FileContent, OtherFormat, hdf5_reading
from afspm.model import Region, Scan
from afspm.plugins.asylum import scan_files as asylum

if TYPE_CHECKING:
    import h5py


def read_nsid(path: Path, zone: tzinfo | None) -> FileContent:
    """Read all images of a file.

    Raises:
        FileError: the file is not HDF5, or has no image. UnitError: the axes are not lengths.
        OSError: the file is damaged.
    """
    with hdf5_reading.opened(path) as file:
        nodes: list[h5py.Dataset | h5py.Group] = []
        file.visititems(lambda _, node: nodes.append(node))
        images = [node for node in nodes if "quantity" in node.attrs and len(getattr(node, "shape", ())) == 2]
        if not images:
            raise OtherFormat("holds no images")
        note = _note(images[0])
        end = asylum.end_ns(note, zone)
        scans = tuple(_scan(image, note, end, path) for image in images)
    return FileContent(
        asylum.CONTROLLER if note else "",
        scans=scans,
        header=note,
        start_ns=asylum.start_ns(note, scans[0].shape[0], zone),
        end_ns=end,
        upwards=asylum.upwards(note),
    )


def _note(image: h5py.Dataset) -> dict[str, object]:
    # All images of a file share the note. Files of other instruments have no XOffset.
    metadata = image.parent.get("original_metadata")
    if metadata is None:
        return {}
    values = {str(key): _plain(value) for key, value in metadata.attrs.items()}
    return values if "XOffset" in values else {}


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        value = value.item()
    return hdf5_reading.text(value) if isinstance(value, bytes) else value


def _axis_m(axis: h5py.Dataset, unit: str) -> NDArray[np.float64]:
    values: NDArray[np.float64] = convert(
        hdf5_reading.array(axis), unit or hdf5_reading.text(axis.attrs.get("units", "m")), "m"
    )
    return values


def _scan(image: h5py.Dataset, note: dict[str, object], end_ns: int | None, path: Path) -> Scan:
    channel = hdf5_reading.text(image.attrs["quantity"])
    values = hdf5_reading.array(image).T
    # the program that converts Asylum's files gives axes the unit of the channel, but their values are in m
    x, y = (_axis_m(image.parent[axis], "m" if note else "") for axis in "xy")
    if values.shape != (len(y), len(x)) or not ((np.diff(x) > 0).all() and (np.diff(y) > 0).all()):
        raise FileError(f"the axes of {channel} do not fit an image of {values.shape[1]} x {values.shape[0]} pixels")
    center_m, angle_rad = ((x[0] + x[-1]) / 2, (y[0] + y[-1]) / 2), 0.0
    if note:
        center_m, angle_rad = asylum.center_and_angle(note)
    region = Region(center_m, (x[-1] - x[0], y[-1] - y[0]), angle_rad)
    # the program that converts the files gives the unit "m" to unknown channels
    unit = (asylum.unit_of(channel) if note else "") or hdf5_reading.text(image.attrs.get("units", ""))
    return Scan(region, channel, unit, np.ascontiguousarray(values), end_ns, str(path))
