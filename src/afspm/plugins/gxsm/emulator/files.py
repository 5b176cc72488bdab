"""The files that GXSM saves: scans as NetCDF-3 or NetCDF-4, spectra as text, with the headers of real files."""

from __future__ import annotations

import io
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    import h5py

_USER: Final = "user"
_VERSIONS: Final = {3: ("gxsm3", "3.54.0"), 4: ("gxsm4", "4.4.1")}
_ANGSTROM: Final = {"label": "L", "var_unit": "Å", "unit": "AA"}
UNITS: Final[Mapping[str, tuple[str, float]]] = {
    "AA": ("Å", 1.0),
    "nm": ("nm", 10.0),
    "um": ("µm", 1e4),
    "mm": ("mm", 1e7),
    "V": ("V", 1.0),
    "mV": ("mV", 1e-3),
    "mV1": ("mV", 1.0),
    "nA": ("nA", 1.0),
    "pA": ("pA", 1e-3),
    "Amp": ("A", 1e9),
    "Hz": ("Hz", 1.0),
    "mHz": ("mHz", 1e-3),
    "deg": ("°", 1.0),
}
"""Symbol and factor of units in GXSM's table: a window shows the stored number divided by the factor."""


@dataclass(frozen=True)
class GxsmChannel:
    """A channel that GXSM records.

    Attributes:
        source: name of the channel in the simulated instrument.
        label: name of the channel in GXSM.
        direction: "Xp" forward, "Xm" backward.
        unit: name of the display unit (see `UNITS`), and its symbol.
        scale: factor from the instrument's values to GXSM's base unit (Å, V, nA, Hz), not to the display unit.
        dz: factor from stored values to the base unit.
    """

    source: str
    label: str
    direction: str
    unit: tuple[str, str]
    scale: float
    dz: float

    def ending(self, *, master: bool) -> str:
        """Return the part of the file's name after the number; `master` marks the first channel."""
        return f"{'M-' if master else ''}{self.direction}-{self.label.replace('-', 'm')}.nc"

    def raw(self, values: np.ndarray) -> np.ndarray:
        """Return the stored values of an image [y, x] with y ascending: top row first, NaN where not scanned."""
        return (values[::-1] * (self.scale / self.dz)).astype(np.float32)


_IN_ANGSTROM: Final = (("AA", "Å"), 1e10)
SIMULATED_3: Final = (
    GxsmChannel("Height", "Topo", "Xp", *_IN_ANGSTROM, 0.117506942891),
    GxsmChannel("Amplitude", "MIX1", "Xp", ("V", "V"), 1.0, 0.000305185),
)
"""Channels of Gxsm3's simulator."""
CHANNELS: Final = {
    3: (
        GxsmChannel("Height", "Topo", "Xp", *_IN_ANGSTROM, 0.117506942891),
        GxsmChannel("Height Retrace", "Topo", "Xm", *_IN_ANGSTROM, 0.117506942891),
        GxsmChannel("Amplitude", "ADC1", "Xp", ("V", "V"), 1.0, 0.000305185),
    ),
    4: (
        GxsmChannel("Height", "ZS-Topo", "Xp", *_IN_ANGSTROM, 1.0),
        GxsmChannel("Height Retrace", "ZS-Topo", "Xm", *_IN_ANGSTROM, 1.0),
        GxsmChannel("Current", "I-Tunnel", "Xp", ("nA", "nA"), 1e9, 1.0),
        GxsmChannel("Frequency Shift", "dFreq", "Xp", ("Hz", "Hz"), 1.0, 1.0),
        GxsmChannel("Phase", "Phase", "Xp", ("deg", "°"), 1.0, 1.0),
    ),
}
"""Channels by the version of GXSM."""


@dataclass(frozen=True)
class GxsmScanFile:
    """The content of the file of one channel of a scan.

    Attributes:
        raw: stored values [y, x] or [time, y, x], rows from the top; multiplied by `dz`, they are in GXSM's base unit.
        unit: name of the display unit, and its symbol.
        frame: x, y, width, height in ångström, angle clockwise in degrees.
        original: path in the variable "basename"; empty: the path of this file.
    """

    path: str
    label: str
    raw: np.ndarray
    dz: float
    unit: tuple[str, str]
    frame: tuple[float, float, float, float, float]
    start_s: float
    end_s: float
    card: str
    bias_v: float
    original: str = ""

    def numbers(self) -> dict[str, float]:
        """Return the variables with one floating-point number."""
        x, y, width, height, angle_deg = self.frame
        rows, columns = self.raw.shape[-2:]
        return {
            "rangex": width,
            "rangey": height,
            "rangez": 1000.0,
            "dx": width / (columns - 1),
            "dy": height / (rows - 1),
            "dz": self.dz,
            "opt_xpiezo_av": 532.0,
            "opt_ypiezo_av": 532.0,
            "opt_zpiezo_av": 74.0,
            "offsetx": x,
            "offsety": y,
            "alpha": angle_deg,
            "contrast": 1.0,
            "bright": 1.0,
            "vrange_z": 1.0,
            "voffset_z": 0.0,
        }

    def times(self) -> dict[str, int]:
        """Return the integer variables: start and end in whole seconds, and the view mode."""
        return {"t_start": int(self.start_s), "t_end": int(self.end_s), "viewmode": 2}

    def texts(self) -> dict[str, str]:
        """Return the text variables."""
        begun = time.ctime(self.start_s)
        return {
            "reftime": f"{begun}\n",
            "comment": f"{_USER}@vm\nSession Date: {begun}\n",
            "title": "title not set",
            "type": "not set",
            "username": _USER,
            "dateofscan": f"{begun} ",
            "basename": self.original or self.path,
            "spm_scancontrol": "TopDown ",
            "extra_scan_info": "Extra Scan Info: N/A",
        }

    def field(self) -> np.ndarray:
        """Return the stored values [time, value, y, x]."""
        return self.raw.reshape(-1, 1, *self.raw.shape[-2:])

    def seconds(self) -> list[float]:
        """Return the values of the axis of time."""
        return [self.end_s - self.start_s] * len(self.field())

    def info(self) -> str:
        """Return the sentence in which Gxsm4 names the first value in the display unit."""
        shown = float(self.raw.flat[0]) * self.dz / UNITS[self.unit[0]][1]
        return f"The value for {self.label} is {shown:g} {self.unit[1]}."

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return x ascending and y descending, relative to the centre, in ångström."""
        _, _, width, height, _ = self.frame
        rows, columns = self.raw.shape[-2:]
        return np.linspace(-width / 2, width / 2, columns), np.linspace(height / 2, -height / 2, rows)

    def about(self, version: int) -> dict[str, str]:
        """Return the global attributes."""
        creator, number = _VERSIONS[version]
        return {
            "Creator": creator,
            "Version": number,
            "HardwareCtrlType": self.card,
            "HardwareConnectionDev": "/dev/sranger_mk2_0",
            "InstrumentType": "STM",
            "InstrumentName": "Quantum",
        }


def prepare(version: int) -> None:
    """Import the libraries that write the files, so that the first scan's files are not delayed."""
    import_module("scipy.io" if version == 3 else "h5py")


def netcdf3(scan: GxsmScanFile) -> bytes:
    """Encode the file that Gxsm3 saves."""
    from scipy.io import netcdf_file

    made = io.BytesIO()
    file: Any = netcdf_file(made, "w", version=1)
    for name, value in scan.about(3).items():
        setattr(file, name, value.encode())
    times, _, rows, columns = scan.field().shape
    for name, size in (("time", times), ("value", 1), ("dimy", rows), ("dimx", columns)):
        file.createDimension(name, size)
    x, y = scan.axes()
    field = _variable(file, "FloatField", "f4", ("time", "value", "dimy", "dimx"), scan.field())
    field.long_name = b"FLOAT: single precision floating point data field"
    field.ZLabel = b"Z" if scan.unit[0] == "AA" else scan.label.encode()
    field.unit, field.ZSrcUnit = (unit.encode() for unit in reversed(scan.unit))
    _variable(file, "time", "f8", ("time",), scan.seconds())
    _variable(file, "value", "f8", ("value",), [scan.bias_v])
    _variable(file, "dimx", "f4", ("dimx",), x)
    _variable(file, "dimy", "f4", ("dimy",), y)
    for name, text in scan.texts().items():
        content = text.encode() + b"\0"
        file.createDimension(f"{name}_dim", len(content))
        _variable(file, name, "c", (f"{name}_dim",), np.frombuffer(content, "S1"))
    for name, number in (scan.numbers() | {key: float(value) for key, value in scan.times().items()}).items():
        _variable(file, name, "f8", (), number)
    file.flush()
    return made.getvalue()


def _variable(file: Any, name: str, kind: str, dimensions: tuple[str, ...], values: object) -> Any:
    made = file.createVariable(name, kind, dimensions)
    made[...] = values
    return made


def netcdf4(scan: GxsmScanFile) -> bytes:
    """Encode the file that Gxsm4 saves."""
    import h5py

    made = io.BytesIO()
    with h5py.File(made, "w") as file:
        for name, value in scan.about(4).items():
            file.attrs[name] = np.bytes_(value)
        field = file.create_dataset("FloatField", data=scan.field().astype("<f4"))
        _describe(field, label=scan.label, var_unit=scan.unit[1], unit=scan.unit[0])
        _describe(field, Info=scan.info(), ZLabel=scan.label, unit_x_dz=scan.unit[1], ZSrcUnit=scan.unit[0])
        x, y = scan.axes()
        for name, values, unit in (
            ("time", scan.seconds(), "s"),
            ("value", [scan.bias_v], "V"),
            ("dimy", y, "AA"),
            ("dimx", x, "AA"),
        ):
            axis = file.create_dataset(name, data=np.asarray(values, "<f8" if name == "time" else "<f4"))
            axis.make_scale(name)
            _describe(axis, unit=unit)
            field.dims[("time", "value", "dimy", "dimx").index(name)].attach_scale(axis)
        for name, text in scan.texts().items():
            content = text.encode() + (b"" if name.startswith(("spm_", "extra_")) else b"\0")
            file.create_dataset(name, data=np.frombuffer(content, "S1"))
        for name, number in scan.numbers().items():
            _describe(file.create_dataset(name, data=number), **(_ANGSTROM if name[:3] in ("ran", "off") else {}))
        for name, seconds in scan.times().items():
            file.create_dataset(name, data=np.int64(seconds))
    return made.getvalue()


def _describe(node: h5py.Dataset, **attributes: str) -> None:
    for name, value in attributes.items():
        node.attrs[name] = np.bytes_(value.encode())


@dataclass(frozen=True)
class GxsmSpectrumFile:
    """The content of a spectrum's file.

    Attributes:
        columns: values by label with unit; the swept column comes first.
        offset: offset of the scan frame in ångström, which is not the place of the spectrum.
    """

    path: str
    columns: Mapping[str, np.ndarray]
    end_s: float
    offset: tuple[float, float]
    bias_v: float
    version: str


def vpdata(curve: GxsmSpectrumFile) -> bytes:
    """Encode the file of a spectrum."""
    labels, values = list(curve.columns), [*curve.columns.values()]
    count = len(values[0])
    x, y = curve.offset
    lines = [
        f"# view via: xmgrace -block {curve.path} -bxy 2:4 ...",
        f"# GXSM Vector Probe Data :: VPVersion={curve.version} vdate=20070227",
        f"# Date                   :: date={time.ctime(curve.end_s)}",
        "#",
        f"# FileName               :: name={curve.path}",
        f"# GXSM-Main-Offset       :: X0={x:g} Ang  Y0={y:g} Ang, iX0=0 Pix iX0=0 Pix",
        f"# GXSM-DSP-Control-FB    :: Bias={curve.bias_v:g} V, Current=0 nA",
        f'# GXSM-Main-Comment      :: comment="{_USER}@vm"',
        f"# Probe Data Number      :: N={count}",
        "#C ",
        "#C Data Table             :: data=",
        # real files repeat the swept column
        "\t".join(["#C Index", *(f'"{label}"' for label in [labels[0], *labels]), "Block-Start-Index"]),
    ]
    for i in range(count):
        row = [f"{column[i]:.12e}" for column in [values[0], *values]]
        lines.append("\t".join([str(i), *row, "0.000000000000e+00"]))
    lines += ["#C ", "#C END.", "#C START OF HEADER LIST APPENDIX", "#C END OF HEADER LIST APPENDIX.", ""]
    return "\n".join(lines).encode()
