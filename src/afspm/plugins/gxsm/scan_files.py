"""NetCDF files (.nc) of GXSM's scans: NetCDF-3 of Gxsm3, NetCDF-4 (HDF5) of Gxsm4, one channel each.

Values are FloatField * dz; rows come from the top; lengths are in ångström even if their attributes name another unit;
rangex is from the first pixel to the last; offsetx is the centre; alpha is clockwise in degrees.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import tzinfo
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import FileError
from afspm.basics.units import convert
from afspm.model import Region, Scan
from afspm.storage.formats import hdf5, netcdf
from afspm.storage.formats.content import FileContent, OtherFormat

CONTROLLER = "GXSM"
_ANGSTROM = ("AA", "Å", "Ang")
_TEXT_MAX = 1 << 16
_FILE_NAME = re.compile(r"-X([pm])-(.+)\.nc$")
_WAS_DASH = re.compile(r"(?<=[A-Z0-9])m(?=[A-Z])")


@dataclass(frozen=True, eq=False)
class _Raw:
    """The needed parts of a file, for both kinds of NetCDF.

    Attributes:
        values: FloatField, in NetCDF-3 also H: (time, value, y, x), top row first, without the factor dz.
        attributes: attributes of this variable.
        numbers, texts: other variables, with a single number or a text.
        about: global attributes, such as the program's version.
    """

    values: NDArray[np.float64]
    attributes: dict[str, str]
    numbers: dict[str, float]
    texts: dict[str, str]
    about: dict[str, str]


def read_netcdf(path: Path, zone: tzinfo | None) -> FileContent:
    """Read a scan. Raises FileError, KeyError, ValueError: another format, or damaged."""
    if hdf5.is_hdf5(path):
        return _content(_netcdf4(path), path)
    return _content(_netcdf3(netcdf.read(path)), path)


def _netcdf3(file: netcdf.File) -> _Raw:
    name = "FloatField" if "FloatField" in file.variables else "H"
    if name not in file.variables:
        raise OtherFormat("a NetCDF file written neither by GXSM nor by the simulated microscope")
    field = file.variables[name]
    numbers = {key: float(v.values.flat[0]) for key, v in file.variables.items() if v.values.size == 1}
    return _Raw(field.values, _as_texts(field.attributes), numbers, dict(file.texts), _as_texts(file.attributes))


def _as_texts(attributes: netcdf.Attributes) -> dict[str, str]:
    return {key: str(value) for key, value in attributes.items()}


def _netcdf4(path: Path) -> _Raw:
    with hdf5.opened(path) as file:
        if "FloatField" not in file:
            raise OtherFormat("a NetCDF file that GXSM did not write")
        field = file["FloatField"]
        numbers: dict[str, float] = {}
        texts: dict[str, str] = {}
        for key, node in file.items():
            if node.dtype.kind == "S" and node.size * node.dtype.itemsize <= _TEXT_MAX:
                texts[key] = hdf5.text(node[()])
            elif node.dtype.kind in "iuf" and node.size == 1:
                numbers[key] = float(np.ravel(node[()])[0])
        return _Raw(hdf5.array(field), hdf5.texts(field.attrs), numbers, texts, hdf5.texts(file.attrs))


def _content(raw: _Raw, path: Path) -> FileContent:
    if raw.values.ndim != 4 or min(raw.values.shape[2:]) < 2:
        raise FileError(f"holds no scan, but an array of shape {raw.values.shape}")
    region = _region(raw.numbers)
    start, end = (_ns(raw.numbers, key) for key in ("t_start", "t_end"))
    upwards = {"TopDown": False, "BottomUp": True}.get(raw.texts.get("spm_scancontrol", "").strip())
    unit, scale = _unit(raw)
    layers = raw.values.reshape(-1, *raw.values.shape[2:])
    name = _channel(raw, path)
    scans = tuple(
        Scan(
            region,
            name if k == 0 else f"{name} #{k + 1}",
            unit,
            convert(_measured(layer, upwards) * scale, "Å", "m") if unit == "m" else _measured(layer, upwards) * scale,
            end,
            str(path),
        )
        for k, layer in enumerate(layers)
    )
    header: dict[str, object] = {**raw.about, **raw.numbers, **raw.texts}
    return FileContent(CONTROLLER, scans, header=header, start_ns=start, end_ns=end, upwards=upwards)


def _region(numbers: dict[str, float]) -> Region:
    x, y, width, height = (convert(numbers[key], "Å", "m") for key in ("offsetx", "offsety", "rangex", "rangey"))
    return Region((x, y), (width, height), math.radians(0.0 - numbers.get("alpha", 0.0)))


def _ns(numbers: dict[str, float], key: str) -> int | None:
    # A scan that never started has the time zero.
    seconds = numbers.get(key, 0.0)
    return round(seconds) * NS_PER_S if seconds > 0.0 else None


def _unit(raw: _Raw) -> tuple[str, float]:
    # ZSrcUnit is the unit's name in GXSM's own list, where a second millivolt is "mV1". The unit is in `var_unit` in
    # Gxsm4, whose `unit` has that name, too, and in `unit` in Gxsm3. A length by either name is in ångström.
    given = raw.attributes
    named = given.get("ZSrcUnit", "")
    unit = given.get("var_unit") or given.get("unit", "") or named
    return ("m" if {unit, named} & set(_ANGSTROM) else unit), raw.numbers["dz"]


def _channel(raw: _Raw, path: Path) -> str:
    # "ZS-Topo" is ZSmTopo in the file's name. Gxsm3 has the full name nowhere else: "ADC0-ITunnel" has the label "I".
    # There, an "m" between a capital or digit and a capital is taken for the original dash.
    label = raw.attributes.get("ZLabel", "")
    match = _FILE_NAME.search(raw.texts.get("basename", "")) or _FILE_NAME.search(path.name)
    if match is None:
        return label
    name = label if label.replace("-", "m") == match[2] else _WAS_DASH.sub("-", match[2])
    return f"{name} Backward" if match[1] == "m" else name


def _measured(image: NDArray[np.float64], upwards: bool | None) -> NDArray[np.float64]:
    # Rows that a stopped scan did not reach are zero, without any mark: whole rows of zeros at its end become NaN. If
    # all rows are zero, the zeros are values.
    rows = image[::-1].copy()
    zero = (rows == 0.0).all(axis=1)
    if zero.all():
        return rows
    if upwards is not True:  # the low rows come last
        rows[: int(np.argmin(zero))] = np.nan
    if upwards is not False:
        rows[len(rows) - int(np.argmin(zero[::-1])) :] = np.nan
    return rows
