"""Files that afspm writes where a controller saves none: one per scan with all its channels, one per spectrum.

The simulated microscope saves them, and drivers save the data that they fetched. `afspm.storage.formats.simulator`
reads them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from afspm.basics.clock import utc_time
from afspm.model import Region, Spectrum
from afspm.storage.formats import netcdf, simulator
from afspm.storage.formats.netcdf import Attributes, Variable


@dataclass(frozen=True)
class FileFacts:
    """The metadata of a file.

    Attributes:
        time_ns: when the measurement was finished.
        attributes: all settings in force, for a reader of the file.
    """

    time_ns: int
    attributes: Attributes


def encode_scan(region: Region, channels: Mapping[str, tuple[str, np.ndarray]], facts: FileFacts) -> bytes:
    """Return a scan file: a variable over (y, x) per channel; x and y are those of the unrotated frame."""
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
    return {"Conventions": simulator.CONVENTIONS, "content": content, "time": when, "time_ns": str(facts.time_ns)}


def _identifier(name: str) -> str:
    # not every reader of NetCDF takes spaces or non-ASCII characters; the attribute `long_name` has the real name
    return "".join(c if c.isascii() and c.isalnum() else "_" for c in name).lower()
