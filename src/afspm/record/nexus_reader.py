"""Reader of the record's HDF5 files, which follow NeXus' NXspm (`record.nexus_writer`), without loss.

It also reads a grid of spectra in one file (`record.export.nexus`), with the mean of repeated spectra at a point.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from afspm.basics.errors import FileError
from afspm.basics.plain_data import Plain, from_json
from afspm.model import Frame, Region, Scan, Spectrum
from afspm.model.caption import SettingInForce
from afspm.model.variables import VariableRoles
from afspm.record.spectrum_grid import PointGrid
from afspm.storage.formats import hdf5_reading
from afspm.storage.formats.content import FileContent, OtherFormat

if TYPE_CHECKING:
    import h5py

DEFINITION = "NXspm"
BIAS_SPECTRUM = "NXsts"
"""The NeXus definition of a bias spectrum of a tunnelling microscope."""
ABOUT = "afspm"
"""The group for facts without a name in NeXus."""
GRID = "grid"
"""The content of a file with the spectra of a grid."""
VENDOR = "vendor"
"""The group with the header of the controller's own file."""


def read_hdf5(path: Path, zone: tzinfo | None) -> FileContent:
    """Return the content of a file of the record.

    Raises:
        OtherFormat: another program wrote the file.
        FileError: the file is damaged.
    """
    with hdf5_reading.opened(path) as file:
        if not _is_ours(file):
            raise OtherFormat("afspm did not write it")
        about = about_of(file)
        if about["content"] == GRID:
            return FileContent("", spectra=tuple(_grid(file, about)), header=about)
        scans = tuple(_scans(file, about)) if about["content"] == "scan" else ()
        spectra = (_spectrum(file, about),) if about["content"] == "spectrum" else ()
        return FileContent(
            str(about.get("controller", "")), scans, spectra, about | vendor_header(file), about.get("began_ns"),
            about["time_ns"],
        )  # fmt: skip


def about_of(file: h5py.File) -> Plain:
    """Return the facts that the record keeps beside the values: holder of control, problems …

    Raises:
        FileError: the file is damaged.
    """
    try:
        about: Plain = from_json(hdf5_reading.text(file["entry"][ABOUT]["about"][()]))
    except (KeyError, ValueError) as error:
        raise FileError(f"is damaged: {error}") from error
    return about


def vendor_header(file: h5py.File) -> dict[str, object]:
    """Return the header of the controller's own file, unchanged; empty if that file could not be read."""
    group = file["entry"].get(VENDOR)
    if group is None or "header" not in group:
        return {}
    header: dict[str, object] = from_json(hdf5_reading.text(group["header"][()]))
    return header


def _is_ours(file: h5py.File) -> bool:
    entry = file.get("entry")
    return entry is not None and ABOUT in entry


def _scans(file: h5py.File, about: Plain) -> list[Scan]:
    region = Region(tuple(about["center_m"]), tuple(about["size_m"]), about["angle_rad"], Frame(about["frame"]))
    data = file["entry"]["data"]
    return [
        Scan(
            region,
            channel["name"],
            channel["unit"],
            hdf5_reading.array(data[channel["field"]]),
            channel["time_ns"],
            about["filename"],
            roles=tuple(channel.get("roles", ())),
            in_force=_in_force(about),
            simulated=bool(about.get("simulated")),
        )
        for channel in about["channels"]
    ]


def _spectrum(file: h5py.File, about: Plain) -> Spectrum:
    data, variables = file["entry"]["data"], about["variables"]
    columns = [hdf5_reading.array(data[variable["field"]]) for variable in variables]
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
        _roles(variables),
        _in_force(about),
    )


def _in_force(about: Plain) -> tuple[SettingInForce, ...]:
    return tuple(SettingInForce(**one) for one in about.get("in_force", ()))


def _roles(variables: Any) -> VariableRoles | None:
    return VariableRoles.from_listed([one["name"] for one in variables], variables)


def _grid(file: h5py.File, about: Plain) -> Iterator[Spectrum]:
    # only the points that were measured, row by row
    entry, swept, columns = file["entry"], about["swept"], about["columns"]
    data = [[hdf5_reading.array(entry[way][one["field"]]) for way in one["ways"]] for one in columns]
    forward = entry[columns[0]["ways"][0]]
    points = PointGrid(
        hdf5_reading.array(forward["x"]), hdf5_reading.array(forward["y"]), tuple(about["center_m"]), about["angle_rad"]
    )
    sweep = _there_and_back([hdf5_reading.array(forward[swept["field"]])] * max(len(one["ways"]) for one in columns))
    times, roles = np.asarray(entry[ABOUT]["time_ns"][()]).astype("datetime64[ns]"), _roles([swept, *columns])
    for row, column in np.ndindex(times.shape):
        curves = [_there_and_back([way[row, column] for way in ways]) for ways in data]
        if np.isnan(curves).all():
            continue
        yield Spectrum(
            points.position_m(row, column),
            about["kind"],
            (swept["name"], *(one["name"] for one in columns)),
            (swept["unit"], *(one["unit"] for one in columns)),
            np.column_stack([sweep, *curves]),
            None if np.isnat(times[row, column]) else int(times[row, column].astype(np.int64)),
            frame=Frame(about["frame"]),
            declared_roles=roles,
            in_force=_in_force(about),
        )


def _there_and_back(ways: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.concatenate([ways[0], *(way[::-1] for way in ways[1:])])
