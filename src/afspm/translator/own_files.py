"""Files that afspm writes where a controller saves none: one per scan with all its channels, one per spectrum.

NetCDF with a variable for each channel. The simulated microscope saves such files, and drivers save the data that they
fetched; `read_netcdf` reads them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import tzinfo
from pathlib import Path

import numpy as np

from afspm.basics.clock import NS_PER_S, utc_time
from afspm.basics.errors import FileError
from afspm.model import Region, Scan, Spectrum, names
from afspm.storage.formats import hdf5_reading, netcdf
from afspm.storage.formats.content import FileContent, OtherFormat
from afspm.storage.formats.netcdf import Attributes, File, Variable

CONTROLLER = "afspm simulator"
CONVENTIONS = "afspm simulator 1"
_AXES = ("x", "y")


@dataclass(frozen=True)
class FileFacts:
    """The metadata of a file.

    Attributes:
        time_ns: the end of the measurement, ns since 1970.
        attributes: all settings in force, for a reader of the file.
    """

    time_ns: int
    attributes: Attributes


def encode_scan(region: Region, channels: Mapping[str, tuple[str, np.ndarray]], facts: FileFacts) -> bytes:
    """Return a scan file with a variable over (y, x) per channel; axes of the unrotated frame."""
    rows, columns = next(iter(channels.values()))[1].shape
    (left, low), (width, height) = region.top_left_m, region.size_m
    variables = {
        "y": Variable(("y",), np.linspace(low, low + height, rows), {"units": "m"}),
        "x": Variable(("x",), np.linspace(left, left + width, columns), {"units": "m"}),
    }
    for channel, (unit, values) in channels.items():
        attributes: Attributes = {"long_name": channel, "units": unit}
        variables[_identifier(channel)] = Variable(("y", "x"), values, attributes)
    where = {
        "region_center_x_m": region.center_m[0],
        "region_center_y_m": region.center_m[1],
        "region_size_x_m": region.size_m[0],
        "region_size_y_m": region.size_m[1],
        "region_angle_rad": region.angle_rad,
    }
    return netcdf.encoded(variables, _header("scan", facts) | where | dict(facts.attributes))


def encode_spectrum(spectrum: Spectrum, facts: FileFacts) -> bytes:
    """Return a spectrum file: a variable over (point) per measured quantity, in their order."""
    variables = {}
    for number, (name, unit) in enumerate(zip(spectrum.names, spectrum.units, strict=True)):
        attributes: Attributes = {"long_name": name, "units": unit}
        variables[_identifier(name)] = Variable(("point",), spectrum.values[:, number], attributes)
    where: dict[str, str | float] = {"kind": spectrum.kind}
    if spectrum.position_m is not None:
        where |= {"position_x_m": spectrum.position_m[0], "position_y_m": spectrum.position_m[1]}
    return netcdf.encoded(variables, _header("spectrum", facts) | where | dict(facts.attributes))


def _header(content: str, facts: FileFacts) -> dict[str, str | float]:
    # as text: a float64 has no room for nanoseconds since 1970
    when = utc_time(facts.time_ns).isoformat()
    return {"Conventions": CONVENTIONS, "content": content, "time": when, "time_ns": str(facts.time_ns)}


def _identifier(name: str) -> str:
    # not every reader of NetCDF takes spaces or non-ASCII characters; the attribute `long_name` has the real name
    return "".join(c if c.isascii() and c.isalnum() else "_" for c in name).lower()


def read_netcdf(path: Path, zone: tzinfo | None) -> FileContent:
    """Return the scan or spectrum of a file.

    Raises:
        OtherFormat: another program wrote the file.
        FileError: a part of the file is missing.
    """
    if hdf5_reading.is_hdf5(path):
        raise OtherFormat("is NetCDF-4, which the simulated microscope does not write")
    file = netcdf.read(path)
    if file.attributes.get("Conventions") != CONVENTIONS:
        raise OtherFormat("the simulated microscope did not write it")
    header: dict[str, object] = dict(file.attributes)
    try:
        end_ns = int(str(file.attributes["time_ns"]))
        if header.get("content") == "spectrum":
            return FileContent(CONTROLLER, spectra=(_spectrum(file, end_ns, path),), header=header, end_ns=end_ns)
        scans = _scans(file, end_ns, path)
    except KeyError as error:
        raise FileError(f"lacks {error}", where=str(path)) from error
    if not scans:
        raise FileError("holds no channel", where=str(path))
    direction = header.get(names.SCAN_DIRECTION)
    return FileContent(
        CONTROLLER,
        scans,
        header=header,
        start_ns=_start_ns(header, scans[0], end_ns),
        end_ns=end_ns,
        upwards=None if direction is None else direction == names.UP,
    )


def _start_ns(header: dict[str, object], scan: Scan, end_ns: int) -> int | None:
    # the simulated microscope scans every line forward and backward
    speed_m_s = header.get(f"{names.SCAN_SPEED} [m/s]")
    if not isinstance(speed_m_s, float) or not speed_m_s > 0.0:
        return None
    return end_ns - round(scan.shape[0] * 2.0 * scan.region.size_m[0] / speed_m_s * NS_PER_S)


def _scans(file: File, end_ns: int, path: Path) -> tuple[Scan, ...]:
    def number(name: str) -> float:
        return float(file.attributes[f"region_{name}"])

    region = Region(
        (number("center_x_m"), number("center_y_m")),
        (number("size_x_m"), number("size_y_m")),
        number("angle_rad"),
    )
    return tuple(
        Scan(
            region,
            str(variable.attributes["long_name"]),
            str(variable.attributes["units"]),
            variable.values,
            end_ns,
            str(path),
        )
        for name, variable in file.variables.items()
        if name not in _AXES
    )


def _spectrum(file: File, end_ns: int, path: Path) -> Spectrum:
    position = None
    if "position_x_m" in file.attributes:
        position = (float(file.attributes["position_x_m"]), float(file.attributes["position_y_m"]))
    variables = list(file.variables.values())
    return Spectrum(
        position,
        str(file.attributes["kind"]),
        tuple(str(variable.attributes["long_name"]) for variable in variables),
        tuple(str(variable.attributes["units"]) for variable in variables),
        np.stack([variable.values for variable in variables], axis=1),
        end_ns,
        str(path),
    )
