"""Reader of the NetCDF files that `afspm export --to nc` writes, without loss."""

from __future__ import annotations

import json
from datetime import tzinfo
from pathlib import Path
from typing import Final

import numpy as np

from afspm.basics.plain_data import Plain
from afspm.model import Frame, Region, Scan, Spectrum
from afspm.model.caption import SettingInForce
from afspm.model.channels import ROLES_APART
from afspm.model.variables import VariableRoles
from afspm.storage.formats import hdf5_reading, netcdf
from afspm.storage.formats.content import FileContent, OtherFormat

FACTS: Final = "afspm"
"""The attribute with geometry, times and controller as JSON; other attributes may be the controller's own."""
PLACES: Final = ("x_m", "y_m")
"""The variables with the position of each pixel of a turned frame."""
_AXES: Final = ("x", "y", *PLACES)


def read_netcdf(path: Path, zone: tzinfo | None) -> FileContent:
    """Return the scan or spectrum of an exported file.

    Raises:
        OtherFormat: another program wrote the file.
        FileError, KeyError, ValueError: the file is damaged.
    """
    if hdf5_reading.is_hdf5(path):
        raise OtherFormat("is NetCDF-4, which afspm does not export")
    file = netcdf.read(path)
    if FACTS not in file.attributes:
        raise OtherFormat("afspm did not export it")
    facts: Plain = json.loads(str(file.attributes[FACTS]))
    scans = tuple(_scans(file, facts)) if "size_m" in facts else ()
    spectra = () if scans else (_spectrum(file, facts),)
    header = {name: value for name, value in file.attributes.items() if name != FACTS}
    return FileContent(facts["controller"], scans, spectra, header, facts["began_ns"], facts["time_ns"])


def _scans(file: netcdf.File, facts: Plain) -> list[Scan]:
    region = Region(tuple(facts["center_m"]), tuple(facts["size_m"]), facts["angle_rad"], Frame(facts["frame"]))
    return [
        Scan(
            region,
            *_name_and_unit(variable),
            variable.values,
            time_ns,
            facts["filename"],
            roles=tuple(filter(None, str(variable.attributes.get("roles", "")).split(ROLES_APART))),
            in_force=_in_force(facts),
            simulated=bool(facts.get("simulated")),
        )
        for variable, time_ns in zip(
            (variable for name, variable in file.variables.items() if name not in _AXES), facts["ends_ns"], strict=True
        )
    ]


def _spectrum(file: netcdf.File, facts: Plain) -> Spectrum:
    variables, place = list(file.variables.values()), facts["position_m"]
    names, units = zip(*map(_name_and_unit, variables), strict=True)
    values = np.stack([variable.values for variable in variables], axis=1)
    position_m = None if place is None else (place[0], place[1])
    frame, roles = Frame(facts["frame"]), VariableRoles.from_listed(names, facts.get("variables", ()))
    time_ns, filename = facts["measured_ns"], facts["filename"]
    return Spectrum(position_m, facts["kind"], names, units, values, time_ns, filename, frame, roles, _in_force(facts))


def _in_force(facts: Plain) -> tuple[SettingInForce, ...]:
    return tuple(SettingInForce(**one) for one in facts.get("in_force", ()))


def _name_and_unit(variable: netcdf.Variable) -> tuple[str, str]:
    return str(variable.attributes["long_name"]), str(variable.attributes["units"])
