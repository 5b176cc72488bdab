"""NetCDF (.nc, classic format), for xarray, MATLAB, ncdump …: a file for each scan and each spectrum."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping

import numpy as np

from afspm.model import ScanSet, Spectrum
from afspm.record.nexus_writer import field_names
from afspm.record.run import Run
from afspm.record.tables import ScanRow, SpectrumRow
from afspm.storage.formats.netcdf import Attributes, Variable, encoded

_RENAMED = {"mode": "control_mode", "filename": "controller_file"}
"""scipy's reader, which xarray uses, has its own attributes with these names."""


def write(run: Run, row: ScanRow | SpectrumRow) -> Iterator[tuple[str, bytes]]:
    """Yield (suffix, content) of the file of a scan or spectrum."""
    about = run.about(row)
    if isinstance(row, ScanRow):
        yield ".nc", scan_file(run.scan(row), about)
    else:
        yield ".nc", spectrum_file(run.spectrum(row), about)


def scan_file(scans: ScanSet, about: Mapping[str, object]) -> bytes:
    """Return the file of a scan: all channels over (y, x), the axes of the unrotated frame."""
    (left, low), (width, height), (rows, columns) = scans.region.top_left_m, scans.region.size_m, scans.first.shape
    variables = {
        "y": Variable(("y",), np.linspace(low, low + height, rows), {"units": "m"}),
        "x": Variable(("x",), np.linspace(left, left + width, columns), {"units": "m"}),
    }
    for name, scan in zip(field_names(scans, ("x", "y")), scans.values(), strict=True):
        attributes: Attributes = {"long_name": scan.channel, "units": scan.unit}
        variables[name] = Variable(("y", "x"), scan.values, attributes)
    return encoded(variables, _attributes(about))


def spectrum_file(spectrum: Spectrum, about: Mapping[str, object]) -> bytes:
    """Return the file of a spectrum: every variable over (point)."""
    variables = {
        name: Variable(("point",), spectrum.values[:, number], {"long_name": long_name, "units": unit})
        for number, (name, long_name, unit) in enumerate(
            zip(field_names(spectrum.names), spectrum.names, spectrum.units, strict=True)
        )
    }
    return encoded(variables, _attributes(about))


def _attributes(about: Mapping[str, object]) -> Attributes:
    # whole numbers are written as texts: float64, the only number type here, can't hold all of them
    made: dict[str, str | float] = {}
    for name, value in about.items():
        if value is not None and name not in ("channels", "variables"):
            plain = value if isinstance(value, str | float) else json.dumps(value, default=str)
            made[_RENAMED.get(name, str(name).replace("/", "_"))] = plain
    return made
