"""Files of Nanosurf's older programs (.nid): a header with sections like an .ini, "#!", and the values of each channel.

Ten files of the maker's examples (NSFopen, MIT), compared with Gwyddion, show: rows ascend, backward lines are not
mirrored, integers are scaled to a range. A rotation is taken as counter-clockwise (! angle-counter-clockwise). Curves
have no position, since a map of curves does not contain the positions. Thermal tuning writes a spectrum over the
frequency and its fit, without images: each is a spectrum of its own, whose kind is the maker's name for it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import tzinfo
from pathlib import Path
from typing import Final

import numpy as np

from afspm.basics import FileError, si
from afspm.components import Array
from afspm.driver import FileContent, local_ns, text_of
from afspm.model import Region, Scan, Spectrum

_DATA: Final = b"#!"
_CHANNEL: Final = re.compile(r"Gr(\d{1,6})-Ch(\d{1,6})")
_CURVE: Final = re.compile(r"Spec (forward|backward)")
_FREQUENCY: Final = re.compile(r"Spectrum .+|Frequency sweep.*")
_BITS: Final = {8: "<i1", 16: "<i2", 32: "<i4"}

Section = dict[str, str]


def read_nid(path: Path, zone: tzinfo | None) -> FileContent:
    """Read all images and curves of a file.

    Raises:
        FileError: the file has another format, is cut off, or has neither images nor curves.
    """
    head, found, data = path.read_bytes().partition(_DATA)
    sections = _sections(text_of(head))
    if not found or "DataSet" not in sections:
        raise FileError("is not a Nanosurf .nid file")
    channels = list(_channels(sections, data))
    info = sections.get("DataSet-Info", {})
    region = _frame(sections)
    images = (_scan(channel, values, region) for channel, values in channels if _is_image(channel))
    scans = tuple(replace(one, filename=str(path)) for one in images)
    curves = _curves([one for one in channels if _CURVE.match(one[0]["Frame"])])
    frequency = _over_frequency([one for one in channels if _FREQUENCY.fullmatch(one[0]["Frame"])])
    spectra = tuple(replace(one, filename=str(path)) for one in (*curves, *frequency))
    if not (scans or spectra):
        raise FileError("holds neither images nor curves")
    date = f"{info.get('Date', '')} {info.get('Time', '')}".strip()
    start_ns = local_ns(date, "%d-%m-%Y %H:%M:%S", zone) if date else None
    direction = {"Up": True, "Down": False}.get(info.get("Scan direction", ""))
    controller = f"Nanosurf {info.get('Software ver.', '')}".strip()
    return FileContent(controller, scans, spectra, info, start_ns=start_ns, upwards=direction)


def _sections(text: str) -> dict[str, Section]:
    found: dict[str, Section] = {}
    section: Section = {}
    for line in text.splitlines():
        if line.startswith("[") and line.endswith("]"):
            section = found.setdefault(line[1:-1], {})
        else:
            key, _, value = line.partition("=")
            section[key] = value.strip()
    return found


def _channels(sections: Mapping[str, Section], data: bytes) -> Iterator[tuple[Section, Array]]:
    dataset, at = sections["DataSet"], 0
    listed = ((_CHANNEL.fullmatch(key), name) for key, name in dataset.items())
    # The values of channels follow each other in the order of their group and channel numbers.
    for _, name in sorted((tuple(map(int, key.groups())), name) for key, name in listed if key is not None):
        channel = sections[name]
        kind = np.dtype(_BITS[int(channel["SaveBits"])])
        shape = int(channel["Lines"]), int(channel["Points"])
        if min(shape) < 1:
            raise FileError(f"{name} has {shape[0]} lines of {shape[1]} points")
        size = shape[0] * shape[1] * kind.itemsize
        if at + size > len(data):
            raise FileError(f"ends within {name}")
        raw = np.frombuffer(data, kind, shape[0] * shape[1], at).reshape(shape)
        at += size
        # Signed integers span the range Dim2Min to Dim2Min + Dim2Range.
        steps = 2.0 ** (8 * kind.itemsize)
        yield channel, (raw / steps + 0.5) * float(channel["Dim2Range"]) + float(channel["Dim2Min"])


def _is_image(channel: Section) -> bool:
    return "scan " in channel["Frame"].lower()


def _scan(channel: Section, values: Array, frame: Region | None) -> Scan:
    # Only some files have parameters with the frame's centre and angle.
    if min(values.shape) < 2:
        raise FileError("holds an image of less than two lines or columns")
    width, height = float(channel["Dim0Range"]), float(channel["Dim1Range"])
    region = Region((0.0, 0.0) if frame is None else frame.center_m, (width, height), frame.angle_rad if frame else 0.0)
    way = re.sub("scan ", "", channel["Frame"], flags=re.IGNORECASE)
    return Scan(region, f"{channel['Dim2Name']} {way}", channel.get("Dim2Unit", ""), values)


def _frame(sections: Mapping[str, Section]) -> Region | None:
    # `ScanOffset=V[0,0,0]*[m,m,m]`, `ScanRotation=V[0,0,45]*[°,°,°]`.
    imaging = sections.get("DataSet\\Parameters\\Imaging")
    if imaging is None:
        return _frame_in_info(sections.get("DataSet-Info", {}))
    (x, y, _), (width, height, _), (_, _, angle_deg) = (
        _vector(imaging[name]) for name in ("ScanOffset", "ScanRange", "ScanRotation")
    )
    return Region((x, y), (width, height), math.radians(angle_deg))


def _frame_in_info(info: Section) -> Region | None:
    # of older programs: `X-Pos=1.3µm`, `Y-Pos=-166nm`, `Rotation=-45 °`, each without the others in some files
    if not any(name in info for name in ("X-Pos", "Y-Pos", "Rotation")):
        return None
    x, y = (si(info.get(name, "0 m"), "m") for name in ("X-Pos", "Y-Pos"))
    angle = info.get("Rotation", "0").replace("°", " ").strip()
    return Region((x, y), (1.0, 1.0), math.radians(float(angle)))


def _vector(text: str) -> list[float]:
    return [float(number) for number in text[text.index("[") + 1 : text.index("]")].split(",")]


def _curves(channels: list[tuple[Section, Array]]) -> Iterator[Spectrum]:
    ways = sorted({channel["Frame"] for channel, _ in channels}, key=lambda way: "forward" not in way)
    parts = [{channel["Dim2Name"]: (channel, values) for channel, values in channels if channel["Frame"] == way}
             for way in ways]  # fmt: skip
    shared = [name for name in parts[0] if all(name in part for part in parts)] if parts else []
    if not shared:
        return
    first = parts[0][shared[0]][0]
    names = (first["Dim0Name"], *shared)
    units = (first.get("Dim0Unit", ""), *(parts[0][name][0].get("Dim2Unit", "") for name in shared))
    for line in range(len(parts[0][shared[0]][1])):
        swept = np.concatenate([_swept(part[shared[0]][0], line) for part in parts])
        columns = [np.concatenate([_taken(*part[name], line) for part in parts]) for name in shared]
        yield Spectrum(None, "force", names, units, np.column_stack([swept, *columns]))


def _over_frequency(channels: list[tuple[Section, Array]]) -> Iterator[Spectrum]:
    for kind in dict.fromkeys(channel["Frame"] for channel, _ in channels):
        columns = [one for one in channels if one[0]["Frame"] == kind]
        first, values = columns[0]
        names = (first["Dim0Name"], *(channel["Dim2Name"] for channel, _ in columns))
        units = (first.get("Dim0Unit", ""), *(channel.get("Dim2Unit", "") for channel, _ in columns))
        for line in range(len(values)):
            curves = [_taken(channel, taken, line) for channel, taken in columns]
            yield Spectrum(None, kind, names, units, np.column_stack([_swept(first, line), *curves]))


def _swept(channel: Section, line: int) -> Array:
    # The axis may differ from curve to curve.
    prefix = f"LineDim{line}" if f"LineDim{line}Min" in channel else "Dim0"
    low, width = float(channel[f"{prefix}Min"]), float(channel[f"{prefix}Range"])
    return np.linspace(low, low + width, _points(channel, line))


def _taken(channel: Section, values: Array, line: int) -> Array:
    return values[line, : _points(channel, line)]


def _points(channel: Section, line: int) -> int:
    # A curve may have fewer points than its line in the file.
    most = int(channel["Points"])
    points = int(channel.get(f"LineDim{line}Points", most))
    if not 0 <= points <= most:
        raise FileError(f"a curve of {points} points where there are {most}")
    return points
