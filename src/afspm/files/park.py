"""Park's TIFF files: one channel in one direction each, in private tags.

From pspylib 0.1.2, the maker's own reader, and against Gwyddion: rows ascend, lengths are in micrometres, a value is
gain · (number · scale + offset) in a unit of its own. Offsets are taken as the centre of the frame, a rotation as
counter-clockwise, and backward lines as not mirrored (!). Curves are not read.
"""

from __future__ import annotations

import math
import re
from datetime import tzinfo
from pathlib import Path
from typing import Any, Final

import numpy as np

from afspm.errors import FileError
from afspm.files.content import FileContent, local_ns
from afspm.model import Region, Scan

MAGIC: Final = 0x0E031301
VERSIONS: Final = {0x1000001: 356, 0x1000002: 580}
"""The shortest header of each version."""
MAGIC_TAG, VERSION_TAG, DATA_TAG, HEADER_TAG = 50432, 50433, 50434, 50435
DATE_TAG: Final = 306
_STRIPS, _STRIP_SIZES = 273, 279
IMAGE: Final = 0
MICROMETRE: Final = 1e-6
_DATE: Final = "%Y:%m:%d %H:%M:%S"
_NUMBERS: Final = {0: "<i2", 1: "<i4", 2: "<f4"}
_UNIT: Final = re.compile(r"([fpnuµμmk]?)(m|V|A|N|Hz)")
_PREFIX: Final = {"": 1.0, "f": 1e-15, "p": 1e-12, "n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "k": 1e3}

HEADER: Final = np.dtype(
    [("kind", "<u4"), ("source", "V64"), ("mode", "V16"), ("low_pass", "<f8"), ("flattened", "<u4"), ("ac", "<u4")]
    + [("columns", "<u4"), ("rows", "<u4"), ("angle_deg", "<f8"), ("sine", "<u4"), ("overscan", "<f8")]
    + [("forward", "<u4"), ("upwards", "<u4"), ("swapped", "<u4")]
    + [(name, "<f8") for name in ("width_um", "height_um", "x_um", "y_um", "rate_hz", "setpoint")]
    + [("setpoint_unit", "V16"), ("tip_bias_v", "<f8"), ("sample_bias_v", "<f8")]
    + [("gain", "<f8"), ("scale", "<f8"), ("offset", "<f8"), ("unit", "V16")]
    + [("lowest", "<i4"), ("highest", "<i4"), ("mean", "<i4")]
    + [("compressed", "<u4"), ("logarithmic", "<u4"), ("squared", "<u4")]
    + [("z_gain", "<f8"), ("z_range", "<f8"), ("xy_voltage", "V16"), ("z_voltage", "V16"), ("xy_servo", "V16")]
    + [("numbers", "<u4")]
)
"""The beginning of a header; version 1 ends before `z_gain`, and its numbers are of the first kind."""


def read_tiff(path: Path, zone: tzinfo | None) -> FileContent:
    """The image of a file. Raises FileError: not whole, or another kind of TIFF."""
    tags = _tags(path)
    version, raw = int(tags.get(VERSION_TAG, 0)), bytes(tags.get(HEADER_TAG, b""))
    if tags.get(MAGIC_TAG) != MAGIC:
        raise FileError("is not a TIFF of a Park microscope")
    if len(raw) < VERSIONS.get(version, math.inf):
        raise FileError(f"has a header of {len(raw)} bytes in version {version:#x}, which afspm does not know")
    header = np.frombuffer(raw, HEADER, 1)[0]
    if header["kind"] != IMAGE:
        raise FileError("holds a line or a curve; afspm reads Park's images alone")
    if header["compressed"] or header["swapped"]:
        raise FileError("is compressed, or scanned along y, which afspm does not read")
    unit, factor = _in_si(text(header["unit"]) or "um")
    scale = float(header["scale"]) or 1.0
    numbers = _numbers(header, bytes(tags.get(DATA_TAG, b"")), newer=version == max(VERSIONS))
    values = factor * float(header["gain"]) * (numbers * scale + float(header["offset"]))
    size = (abs(float(header["width_um"])) * MICROMETRE, abs(float(header["height_um"])) * MICROMETRE)
    center = (float(header["x_um"]) * MICROMETRE, float(header["y_um"]) * MICROMETRE)
    region = Region(center, size, math.radians(float(header["angle_deg"])))
    channel = f"{text(header['source'])} {'Forward' if header['forward'] else 'Backward'}"
    told = {name: _plain(header[name]) for name in HEADER.names or ()}
    date = str(tags.get(DATE_TAG, "")).strip("\0 ")
    return FileContent(
        f"Park {text(header['mode'])}".strip(),
        (Scan(region, channel, unit, values, filename=str(path)),),
        header=told,
        start_ns=local_ns(date, _DATE, zone) if date else None,
        upwards=bool(header["upwards"]),
    )


def text(raw: np.void) -> str:
    """Return a text of a header: two bytes a character, and zeros behind it."""
    return raw.tobytes().decode("utf-16-le", "replace").partition("\0")[0].strip()


def _tags(path: Path) -> dict[int, Any]:
    from PIL import Image, TiffImagePlugin, UnidentifiedImageError

    try:
        with Image.open(path, formats=("TIFF",)) as image:
            if not isinstance(image, TiffImagePlugin.TiffImageFile):
                raise FileError("is not a TIFF")
            tags = dict(image.tag_v2)
    except UnidentifiedImageError as error:
        raise FileError("is not a TIFF") from error
    ends = [at + size for at, size in zip(tags.get(_STRIPS, ()), tags.get(_STRIP_SIZES, ()), strict=True)]
    if max(ends, default=0) > path.stat().st_size:
        raise FileError("ends within the picture")
    return tags


def _numbers(header: np.void, data: bytes, *, newer: bool) -> np.ndarray[Any, np.dtype[np.float64]]:
    kind = np.dtype(_NUMBERS[int(header["numbers"]) if newer else 0])
    rows, columns = int(header["rows"]), int(header["columns"])
    if not rows * columns or len(data) < rows * columns * kind.itemsize:
        raise FileError(f"has {len(data)} bytes of data for {columns} x {rows} pixels")
    return np.frombuffer(data, kind, rows * columns).reshape(rows, columns).astype(np.float64)


def _in_si(unit: str) -> tuple[str, float]:
    """Return the unit without its prefix, and what to multiply with."""
    found = _UNIT.fullmatch(unit)
    return (found[2], _PREFIX[found[1]]) if found else (unit, 1.0)


def _plain(value: Any) -> object:
    return text(value) if isinstance(value, np.void) else value.item()
