"""NetCDF files (.nc) of GXSM's scans: NetCDF-3 of Gxsm3, NetCDF-4 (HDF5) of Gxsm4, one channel each.

Values are FloatField * dz, in GXSM's base unit (Å, V, nA, Hz …): the unit named in the file is the one in which GXSM's
windows show them. Rows come from the top; lengths of the frame are in ångström; rangex is from the first pixel to the
last; offsetx is the centre; alpha is clockwise in degrees.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import tzinfo
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from afspm.basics import NS_PER_S, FileError, convert
from afspm.driver import FileContent, OtherFormat, hdf5_reading, netcdf
from afspm.model import Region, Scan

CONTROLLER = "GXSM"
# GXSM's table of units (`XsmUnitsTable`) has a name, a symbol and a factor for each: a window shows the stored number
# divided by the factor. Here are the entries whose factor is not 1, or whose name is no unit, with the unit of the
# stored number. The name "A" is ångström, the symbol "A" ampere; the second millivolt, "mV1", is stored in millivolt.
_STORED_BY_NAME = dict.fromkeys(("AA", "A", "nm", "um", "mm"), "Å") | {
    "mV": "V",
    "mV1": "mV",
    "pA": "nA",
    "Amp": "nA",
    "mHz": "Hz",
    "0": "1",
}
_STORED_BY_SYMBOL = dict.fromkeys(("Å", "Ang", "nm", "um", "µm", "mm"), "Å") | {
    "mV": "V",
    "pA": "nA",
    "A": "nA",
    "mHz": "Hz",
}
_TEXT_MAX = 1 << 16
_FILE_NAME = re.compile(r"-X([pm])-(.+)\.nc$")
_WAS_DASH = re.compile(r"(?<=[A-Z0-9])m(?=[A-Z])")
_SHORT = {"Z": "Topo"}
"""Name of a channel in the file's name by the label of Gxsm3, where the label is another name."""


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
    if hdf5_reading.is_hdf5(path):
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
    with hdf5_reading.opened(path) as file:
        if "FloatField" not in file:
            raise OtherFormat("a NetCDF file that GXSM did not write")
        field = file["FloatField"]
        numbers: dict[str, float] = {}
        texts: dict[str, str] = {}
        for key, node in file.items():
            if node.dtype.kind == "S" and node.size * node.dtype.itemsize <= _TEXT_MAX:
                texts[key] = hdf5_reading.text(node[()])
            elif node.dtype.kind in "iuf" and node.size == 1:
                numbers[key] = float(np.ravel(node[()])[0])
        return _Raw(
            hdf5_reading.array(field), hdf5_reading.texts(field.attrs), numbers, texts, hdf5_reading.texts(file.attrs)
        )


def _content(raw: _Raw, path: Path) -> FileContent:
    if raw.values.ndim != 4 or min(raw.values.shape[2:]) < 2:
        raise FileError(f"holds no scan, but an array of shape {raw.values.shape}")
    region = _region(raw.numbers)
    start, end = (_ns(raw.numbers, key) for key in ("t_start", "t_end"))
    upwards = {"TopDown": False, "BottomUp": True}.get(raw.texts.get("spm_scancontrol", "").strip())
    stored, dz = _unit(raw), raw.numbers["dz"]
    unit = "m" if stored == "Å" else stored
    layers = raw.values.reshape(-1, *raw.values.shape[2:])
    name = _channel(raw, path)
    scans = tuple(
        Scan(
            region,
            name if k == 0 else f"{name} #{k + 1}",
            unit,
            convert(_measured(layer, upwards) * dz, "Å", "m") if unit == "m" else _measured(layer, upwards) * dz,
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


def stored_unit(name: str, symbol: str) -> str:
    """Return the unit of GXSM's stored numbers.

    Args:
        name: name of the display unit in GXSM's table; empty if unknown.
        symbol: text in GXSM's windows for this unit; empty if unknown.
    """
    return _STORED_BY_NAME.get(name) or _STORED_BY_SYMBOL.get(symbol) or symbol or name


def _unit(raw: _Raw) -> str:
    # ZSrcUnit is the name of the unit. Gxsm4 has the symbol in `var_unit` and the name again in `unit`; Gxsm3 has the
    # symbol in `unit`.
    given = raw.attributes
    symbol = given.get("var_unit", given.get("unit", ""))
    name = given.get("ZSrcUnit") or (given.get("unit", "") if "var_unit" in given else "")
    return stored_unit(name, symbol)


def _channel(raw: _Raw, path: Path) -> str:
    # The file's own name counts first: `basename` is the path of the file that a person opened last, until GXSM is
    # restarted. So it counts for a renamed file alone, and only if ZLabel confirms its channel.
    # "ZS-Topo" is ZSmTopo in the file's name. Gxsm3 has the full name nowhere else: "ADC0-ITunnel" has the label "I".
    # There, an "m" between a capital or digit and a capital is taken for the original dash.
    label = raw.attributes.get("ZLabel", "")
    short = _SHORT.get(label, label.replace("-", "m"))
    match = _FILE_NAME.search(path.name)
    if match is None:
        match = _FILE_NAME.search(raw.texts.get("basename", ""))
        if match is None or match[2] != short:
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
