"""Files that afspm writes where a controller saves none: one per scan with all its channels, one per spectrum.

NetCDF with a variable for each channel. The simulated microscope saves such files, and drivers save the data that they
fetched; `read_netcdf` reads them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import tzinfo
from itertools import count
from pathlib import Path
from types import MappingProxyType

import numpy as np

from afspm.basics.clock import NS_PER_S, utc_time
from afspm.basics.errors import FileError
from afspm.model import Region, Scan, Spectrum, names
from afspm.model.channels import ROLES_APART
from afspm.model.variables import VariableRoles
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


def encode_scan(
    region: Region,
    channels: Mapping[str, tuple[str, np.ndarray]],
    facts: FileFacts,
    roles: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> bytes:
    """Return a scan file with a variable over (y, x) per channel; axes of the unrotated frame.

    Args:
        channels: unit and values of each channel.
        roles: of each channel, as in `Scan.roles`.
    """
    rows, columns = next(iter(channels.values()))[1].shape
    (left, low), (width, height) = region.top_left_m, region.size_m
    variables = {
        "y": Variable(("y",), np.linspace(low, low + height, rows), {"units": "m"}),
        "x": Variable(("x",), np.linspace(left, left + width, columns), {"units": "m"}),
    }
    for name, (channel, (unit, values)) in zip(_identifiers(channels, variables), channels.items(), strict=True):
        attributes: dict[str, str | float] = {"long_name": channel, "units": unit}
        its = {"roles": ROLES_APART.join(roles[channel])} if roles.get(channel) else {}
        variables[name] = Variable(("y", "x"), values, attributes | its)
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
    variables, listed = {}, spectrum.roles.listed(spectrum.names)
    for number, identifier in enumerate(_identifiers(spectrum.names)):
        its = listed[number]
        attributes: dict[str, str | float] = {"long_name": spectrum.names[number], "units": spectrum.units[number]}
        attributes |= {"role": its["role"]} | ({"positive": "down"} if its["towards"] else {})
        variables[identifier] = Variable(("point",), spectrum.values[:, number], attributes)
    where: dict[str, str | float] = {"kind": spectrum.kind}
    if spectrum.position_m is not None:
        where |= {"position_x_m": spectrum.position_m[0], "position_y_m": spectrum.position_m[1]}
    return netcdf.encoded(variables, _header("spectrum", facts) | where | dict(facts.attributes))


def _header(content: str, facts: FileFacts) -> dict[str, str | float]:
    # as text: a float64 has no room for nanoseconds since 1970
    when = utc_time(facts.time_ns).isoformat()
    return {"Conventions": CONVENTIONS, "content": content, "time": when, "time_ns": str(facts.time_ns)}


def _identifiers(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    # not every reader of NetCDF takes spaces or non-ASCII characters; the attribute `long_name` has the real name. Two
    # signals of a controller may have the same name.
    found, used = list[str](), set(taken)
    for name in names:
        plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in name).lower()
        free = (one for number in count(1) if (one := plain if number == 1 else f"{plain}_{number}") not in used)
        found.append(next(free))
        used.add(found[-1])
    return found


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
            roles=tuple(filter(None, str(variable.attributes.get("roles", "")).split(ROLES_APART))),
        )
        for name, variable in file.variables.items()
        if name not in _AXES
    )


def _spectrum(file: File, end_ns: int, path: Path) -> Spectrum:
    position = None
    if "position_x_m" in file.attributes:
        position = (float(file.attributes["position_x_m"]), float(file.attributes["position_y_m"]))
    variables = list(file.variables.values())
    found = tuple(str(variable.attributes["long_name"]) for variable in variables)
    listed = [
        {"role": one.attributes["role"], "towards": one.attributes.get("positive") == "down"}
        for one in variables
        if "role" in one.attributes
    ]
    return Spectrum(
        position,
        str(file.attributes["kind"]),
        found,
        tuple(str(variable.attributes["units"]) for variable in variables),
        np.stack([variable.values for variable in variables], axis=1),
        end_ns,
        str(path),
        declared_roles=VariableRoles.from_listed(found, listed),
    )
