"""Reader of NeXus files of other programs (.nxs, .h5): images and curves in any NXdata with units.

NeXus gives an image axes and, in NXspm, a scan region: its offset is the centre, its angle the rotation, in a sense
that the definition leaves open. Files of pynxtools-spm, compared with the Nanonis files that they were made
from, show: the angle is Nanonis' own, clockwise, and is not applied to the axes. Its older files state the offset as
the start of the region, their axes are wrong by half a frame, and y descends although the rows ascend.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from afspm.basics import same_kind
from afspm.basics.errors import FileError, UnitError
from afspm.basics.units import convert
from afspm.model import Region, Scan, Spectrum
from afspm.model.arrays import Array
from afspm.model.geometry import XY
from afspm.storage.formats import hdf5_reading
from afspm.storage.formats.content import FileContent, OtherFormat, clock_ns

if TYPE_CHECKING:
    import h5py

_SYMBOLS: Final = {
    "ampere": "A", "volt": "V", "hertz": "Hz", "kelvin": "K", "newton": "N", "second": "s", "degree": "deg",
    "meter": "m", "metre": "m", "radian": "rad", "watt": "W", "dimensionless": "",
}  # fmt: skip
_CLOCKWISE: Final = ("nanonis",)
"""Programs of controllers whose angles are clockwise."""
_BIAS_SPECTRUM: Final = "NXsts"


@dataclass(frozen=True, eq=False)
class _Axis:
    name: str
    unit: str
    values: Array


@dataclass(frozen=True, eq=False)
class _Signal:
    """The signal of an NXdata with its axes, one for each dimension."""

    name: str
    unit: str
    values: Array
    axes: tuple[_Axis, ...]


@dataclass(frozen=True)
class _Frame:
    """The scan region that the file states beside its axes.

    Attributes:
        angle_rad: counter-clockwise.
        region: centre and size where the axes are known to be wrong; None: the axes count.
        unknown: why the frame of an image is unknown; empty if it is known.
    """

    angle_rad: float = 0.0
    region: tuple[XY, XY] | None = None
    unknown: str = ""


def read_nexus(path: Path, zone: tzinfo | None) -> FileContent:
    """Read each NXdata of two dimensions as a scan, and those of one dimension over the same axis as one spectrum.

    `header` has the single values of the file, and under "not read" the reason for each NXdata that can't be read.

    Raises:
        OtherFormat: the file has no NXdata.
        FileError: it is damaged, or no NXdata can be read: the error names what each one lacks.
    """
    with hdf5_reading.opened(path) as file:
        nodes: dict[str, h5py.Dataset | h5py.Group] = {}
        file.visititems(lambda name, node: nodes.update({name: node}))
        groups = {name: node for name, node in nodes.items() if _class(node) == "NXdata"}
        if not groups:
            raise OtherFormat("holds no NXdata")
        texts = {name: _plain(node) for name, node in nodes.items() if getattr(node, "shape", None) == ()}
        frame, missing = _frame(nodes), dict[str, str]()
        scans: list[Scan] = []
        curves: list[_Signal] = []
        end = _time(texts, "end_time", zone)
        for name, group in groups.items():
            try:
                for signal in _signals(name, group, is_only=len(groups) == 1):
                    if len(signal.axes) == 1:
                        curves.append(signal)
                    else:
                        scans.append(_scan(signal, frame, end, str(path)))
            except (FileError, UnitError) as error:
                missing[name] = error.what
        if not scans and not curves:
            raise FileError("no NXdata can be read: " + "; ".join(f"{name} {why}" for name, why in missing.items()))
        kind = "bias spectroscopy" if _last(texts, "definition") == _BIAS_SPECTRUM else "spectrum"
        spectra = tuple(_spectra(curves, _position(nodes), kind, end, str(path)))
    header = texts | ({"not read": missing} if missing else {})
    controller = _last(texts, "software/name")
    return FileContent(controller, tuple(scans), spectra, header, _time(texts, "start_time", zone), end)


def _class(node: h5py.Dataset | h5py.Group) -> str:
    return hdf5_reading.text(node.attrs.get("NX_class", ""))


def _plain(node: h5py.Dataset) -> object:
    value = node[()]
    return (
        hdf5_reading.text(value)
        if isinstance(value, bytes)
        else value.item()
        if isinstance(value, np.generic)
        else value
    )


def _last(texts: Mapping[str, object], end: str) -> str:
    return next((str(value) for name, value in texts.items() if f"/{name}".endswith(f"/{end}")), "")


def _time(texts: Mapping[str, object], name: str, zone: tzinfo | None) -> int | None:
    if not (text := _last(texts, name)):
        return None
    time = datetime.fromisoformat(text)
    return clock_ns(time, zone) if time.tzinfo is None else clock_ns(time.replace(tzinfo=None), time.tzinfo)


def _signals(path: str, group: h5py.Group, *, is_only: bool) -> Iterator[_Signal]:
    first = hdf5_reading.text(group.attrs.get("signal", ""))
    if not first:
        raise FileError("lacks the attribute signal")
    axes = tuple(_axis(group, name) for name in _texts(group.attrs.get("axes", ())))
    shape = tuple(len(axis.values) for axis in axes)
    for name in (first, *_texts(group.attrs.get("auxiliary_signals", ()))):
        data = group.get(name)
        if data is None:
            raise FileError(f"lacks its signal {name}")
        if data.ndim not in (1, 2):
            raise FileError(f"has {data.ndim} dimensions, not 1 or 2")
        if data.shape != shape:
            raise FileError(f"has a signal of shape {data.shape} and axes of {shape}")
        unit = hdf5_reading.text(data.attrs.get("units", ""))
        values = hdf5_reading.array(data)
        if same_kind(unit, "m"):
            values, unit = convert(values, unit, "m"), "m"
        # of several groups, the names tell forward from backward, and the signals often do not
        own = path.rpartition("/")[2] if not is_only and name == first else name
        yield _Signal(own, _symbol(unit), values, axes)


def _axis(group: h5py.Group, name: str) -> _Axis:
    if name not in group:
        raise FileError(f"lacks its axis {name}")
    return _Axis(name, hdf5_reading.text(group[name].attrs.get("units", "")), hdf5_reading.array(group[name]).ravel())


def _texts(value: object) -> list[str]:
    if isinstance(value, str | bytes):
        return [hdf5_reading.text(value)]
    return [hdf5_reading.text(one) for one in np.ravel(value)]  # type: ignore[call-overload]


def _symbol(unit: str) -> str:
    parts = [part.strip() for part in unit.split("/")]
    return "/".join(_SYMBOLS.get(part, part) for part in parts)


def _scan(signal: _Signal, frame: _Frame, end: int | None, filename: str) -> Scan:
    if min(signal.values.shape) < 2:
        raise FileError("has an image of less than two lines or columns")
    tokens = [re.split(r"[\W_]+", axis.name.casefold()) for axis in signal.axes]
    order = [next((number for number, own in enumerate(tokens) if axis in own), -1) for axis in "yx"]
    if sorted(order) != [0, 1]:
        raise FileError(f"has the axes {', '.join(axis.name for axis in signal.axes)}, not y and x")
    if frame.unknown:
        raise FileError(frame.unknown)
    values = signal.values.transpose(order)
    if frame.region is not None:
        center, size = frame.region
        rows, columns = values.shape
        size = (size[0] * (columns - 1) / columns, size[1] * (rows - 1) / rows)
        return Scan(Region(center, size, frame.angle_rad), signal.name, signal.unit, values.copy(), end, filename)
    y, x = (_even_m(signal.axes[number]) for number in order)
    values = values[:: 1 if y[1] > y[0] else -1, :: 1 if x[1] > x[0] else -1]
    center = (float(x[0] + x[-1]) / 2, float(y[0] + y[-1]) / 2)
    region = Region(center, (abs(float(x[-1] - x[0])), abs(float(y[-1] - y[0]))), frame.angle_rad)
    return Scan(region, signal.name, signal.unit, values.copy(), end, filename)


def _even_m(axis: _Axis) -> Array:
    if not axis.unit:
        raise FileError(f"lacks the unit of its axis {axis.name}")
    values = convert(axis.values, axis.unit, "m")
    steps = np.diff(values)
    if not np.isfinite(steps).all() or not steps.all() or np.ptp(steps) > 1e-3 * abs(float(steps.mean())):
        raise FileError(f"has an axis {axis.name} without even steps")
    return values


def _frame(nodes: Mapping[str, h5py.Dataset | h5py.Group]) -> _Frame:
    regions = [node for node in nodes.values() if _class(node) == "NXspm_scan_region" and "scan_offset_value_x" in node]
    if not regions:
        return _Frame()
    known = {name: _quantity(regions[0], name, unit) for name, unit in (("scan_angle_x", "deg"), *_LENGTHS)}
    makers = [_plain(node) for name, node in nodes.items() if name.endswith(("/vendor", "/name", "/model"))]
    is_clockwise = any(maker in str(text).casefold() for text in makers for maker in _CLOCKWISE)
    angle_deg = known["scan_angle_x"] or 0.0
    if angle_deg and not is_clockwise:
        return _Frame(unknown="is turned, and the file does not state in which sense its scan_angle_x counts")
    center, size, start = (
        (known[f"scan_{what}_x"], known[f"scan_{what}_y"]) for what in ("offset_value", "range", "start")
    )
    angle_rad = math.radians(0.0 - angle_deg)
    if None in (*center, *size) or center != start or 0.0 in size:
        return _Frame(angle_rad)
    if not is_clockwise:  # only with Nanonis' files was it compared with the original
        return _Frame(unknown="has a scan region that starts at its centre: its axes contradict it")
    return _Frame(angle_rad, (center, size))  # type: ignore[arg-type]  # without None, see above


_LENGTHS: Final = [(f"scan_{what}_{axis}", "m") for what in ("offset_value", "range", "start") for axis in "xy"]


def _quantity(group: h5py.Group, name: str, unit: str) -> float | None:
    if name not in group or group[name].shape != ():
        return None
    return convert(float(group[name][()]), hdf5_reading.text(group[name].attrs.get("units", unit)), unit)


def _position(nodes: Mapping[str, h5py.Dataset | h5py.Group]) -> XY | None:
    sensors = [node for node in nodes.values() if _class(node) in ("NXspm_piezo_sensor", "NXcoordinate_system")]
    places = {(_quantity(one, "x", "m"), _quantity(one, "y", "m")) for one in sensors if "x" in one and "y" in one}
    if len(places) != 1:
        return None
    x, y = places.pop()
    return None if x is None or y is None or not math.isfinite(x + y) else (x, y)


def _spectra(
    curves: Sequence[_Signal], position: XY | None, kind: str, end: int | None, filename: str
) -> Iterator[Spectrum]:
    together: dict[tuple[str, str, bytes], list[_Signal]] = {}
    for curve in curves:
        axis = curve.axes[0]
        together.setdefault((axis.name, axis.unit, axis.values.tobytes()), []).append(curve)
    for (name, unit, _), columns in together.items():
        names = (name, *(one.name for one in columns))
        units = (_symbol(unit), *(one.unit for one in columns))
        values = np.column_stack([columns[0].axes[0].values, *(one.values for one in columns)])
        yield Spectrum(position, kind, names, units, values, end, filename)
