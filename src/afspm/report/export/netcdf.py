"""NetCDF (.nc, classic format), for xarray, MATLAB, ncdump …: a file for each scan and each spectrum.

`x` and `y` are the axes of the unrotated frame. If it is turned, `x_m` and `y_m` over (y, x) are where each pixel was
measured: plot over these.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict

import numpy as np

from afspm.model import ScanSet, Spectrum
from afspm.model.channels import ROLES_APART
from afspm.night.run import Run
from afspm.night.tables import ScanRow, SpectrumRow
from afspm.record import field_names
from afspm.storage.formats.netcdf import Attributes, Variable, encoded
from afspm.storage.formats.netcdf_reader import FACTS, PLACES

_RENAMED = {"mode": "control_mode", "filename": "controller_file", "Conventions": "controller_conventions"}
"""scipy's reader, which xarray uses, has attributes named `mode` and `filename`; conventions are the controller's."""


def write(run: Run, row: ScanRow | SpectrumRow) -> Iterator[tuple[str, bytes]]:
    """Yield (suffix, content) of the file of a scan or spectrum."""
    about = run.about(row)
    facts = {"time_ns": row.time_ns, "began_ns": row.began_ns, "controller": str(about.get("controller", ""))}
    if isinstance(row, ScanRow):
        yield ".nc", scan_file(run.scan(row), about, facts)
    else:
        yield ".nc", spectrum_file(run.spectrum(row), about, facts)


def scan_file(scans: ScanSet, about: Mapping[str, object], facts: Mapping[str, object]) -> bytes:
    """Return the file of a scan: all channels over (y, x)."""
    (left, low), (width, height), (rows, columns) = scans.region.top_left_m, scans.region.size_m, scans.first.shape
    variables = {
        "y": Variable(("y",), np.linspace(low, low + height, rows), {"units": "m"}),
        "x": Variable(("x",), np.linspace(left, left + width, columns), {"units": "m"}),
    }
    if scans.region.angle_rad:
        for name, places_m in zip(PLACES, scans.region.pixels_m((rows, columns)), strict=True):
            variables[name] = Variable(("y", "x"), places_m, {"units": "m", "long_name": f"{name[0]} of each pixel"})
    for name, scan in zip(field_names(scans, ("x", "y", *PLACES)), scans.values(), strict=True):
        roles = {"roles": ROLES_APART.join(scan.roles)} if scan.roles else {}
        attributes: Attributes = {"long_name": scan.channel, "units": scan.unit, **roles}
        variables[name] = Variable(("y", "x"), scan.values, attributes)
    region, first = scans.region, scans.first
    where = {"center_m": region.center_m, "size_m": region.size_m, "angle_rad": region.angle_rad}
    where |= {"in_force": list(map(asdict, first.in_force)), "simulated": first.simulated}
    ends_ns = [scan.time_ns for scan in scans.values()]
    own = {**facts, **where, "frame": region.frame.value, "filename": first.filename, "ends_ns": ends_ns}
    return encoded(variables, _attributes(about) | {FACTS: json.dumps(own)})


def spectrum_file(spectrum: Spectrum, about: Mapping[str, object], facts: Mapping[str, object]) -> bytes:
    """Return the file of a spectrum: every variable over (point)."""
    roles = spectrum.roles.roles_of(spectrum.names)
    variables = {
        name: Variable(("point",), spectrum.values[:, number], {"long_name": long_name, "units": unit, "role": role})
        for number, (name, long_name, unit, role) in enumerate(
            zip(field_names(spectrum.names), spectrum.names, spectrum.units, roles, strict=True)
        )
    }
    where = {"position_m": spectrum.position_m, "frame": spectrum.frame.value, "kind": spectrum.kind}
    known = {"variables": spectrum.roles.listed(spectrum.names), "in_force": list(map(asdict, spectrum.in_force))}
    own = {**facts, **where, **known, "filename": spectrum.filename, "measured_ns": spectrum.time_ns}
    return encoded(variables, _attributes(about) | {FACTS: json.dumps(own)})


def _attributes(about: Mapping[str, object]) -> dict[str, str | float]:
    # whole numbers are written as texts: float64, the only number type here, can't hold all of them
    made: dict[str, str | float] = {}
    for name, value in about.items():
        if value is not None and name not in ("channels", "variables"):
            plain = value if isinstance(value, str | float) else json.dumps(value, default=str)
            made[_RENAMED.get(name, str(name).replace("/", "_"))] = plain
    return made
