"""HDF5 files that follow NeXus' NXspm as the record writes them (`record.nexus`), read back without loss."""

from __future__ import annotations

import json
from datetime import tzinfo
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from afspm.errors import FileError
from afspm.files import hdf5, nsid
from afspm.files.content import FileContent
from afspm.model import Frame, Region, Scan, Spectrum
from afspm.plain_data import Plain

if TYPE_CHECKING:
    import h5py

DEFINITION = "NXspm"
BIAS_SPECTRUM = "NXsts"
"""The definition that a spectrum over the bias of a tunnelling microscope follows."""
ABOUT = "afspm"
"""The group with what NeXus has no name for."""
VENDOR = "vendor"
"""The group with what the controller's own file said."""


def read_hdf5(path: Path, zone: tzinfo | None) -> FileContent:
    """A file of the record; else one of NSID. Raises FileError: it is neither, or broken."""
    with hdf5.opened(path) as file:
        if not _is_ours(file):
            return nsid.read_nsid(path, zone)
        about = about_of(file)
        scans = tuple(_scans(file, about)) if about["content"] == "scan" else ()
        spectra = (_spectrum(file, about),) if about["content"] == "spectrum" else ()
        return FileContent(
            str(about.get("controller", "")), scans, spectra, about | vendor_header(file), about.get("began_ns"),
            about["time_ns"],
        )  # fmt: skip


def about_of(file: h5py.File) -> Plain:
    """Return what the record noted beside the values: holder of control, problems … Raises FileError: it is damaged."""
    try:
        about: Plain = json.loads(hdf5.text(file["entry"][ABOUT]["about"][()]))
    except (KeyError, ValueError) as error:
        raise FileError(f"is damaged: {error}") from error
    return about


def vendor_header(file: h5py.File) -> dict[str, object]:
    """The header of the controller's own file, as that said it; empty if it was not there to be read."""
    group = file["entry"].get(VENDOR)
    if group is None or "header" not in group:
        return {}
    header: dict[str, object] = json.loads(hdf5.text(group["header"][()]))
    return header


def _is_ours(file: h5py.File) -> bool:
    entry = file.get("entry")
    return entry is not None and ABOUT in entry and hdf5.text(entry["definition"][()]) in (DEFINITION, BIAS_SPECTRUM)


def _scans(file: h5py.File, about: Plain) -> list[Scan]:
    region = Region(tuple(about["center_m"]), tuple(about["size_m"]), about["angle_rad"], Frame(about["frame"]))
    data = file["entry"]["data"]
    return [
        Scan(
            region,
            channel["name"],
            channel["unit"],
            hdf5.array(data[channel["field"]]),
            channel["time_ns"],
            about["filename"],
        )
        for channel in about["channels"]
    ]


def _spectrum(file: h5py.File, about: Plain) -> Spectrum:
    data, variables = file["entry"]["data"], about["variables"]
    columns = [hdf5.array(data[variable["field"]]) for variable in variables]
    place = about["position_m"]
    return Spectrum(
        None if place is None else (place[0], place[1]),
        about["kind"],
        tuple(variable["name"] for variable in variables),
        tuple(variable["unit"] for variable in variables),
        np.column_stack(columns) if columns else np.empty((0, 0)),
        about["measured_ns"],
        about["filename"],
        Frame(about["frame"]),
    )
