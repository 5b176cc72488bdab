"""Park's TIFF files: each has one channel of a scan in one direction, or curves.

Images: rows ascend, lengths are in µm, and a value is gain · (number · scale + offset) in the channel's unit. Offsets
are taken as the centre of the frame, a rotation as counter-clockwise, and backward lines as not mirrored
(! offset-is-centre, angle-counter-clockwise, tiff-rows, tiff-backward, tiff-values).

Curves: the numbers of a channel follow each other, forward and then backward; a value is gain · number, as in pspylib
and AtomicJ. Positions are taken as positions of the scanner, in µm (! curve-offsets, curve-positions).
"""

from __future__ import annotations

import math
from datetime import tzinfo
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from afspm.basics import FileError
from afspm.driver import SENSITIVITY, SPRING_CONSTANT, FileContent, OtherFormat, local_ns, stated_settings
from afspm.model import XY, Region, Scan, Spectrum
from afspm.plugins.park.file_header import (
    CURVE_KINDS,
    CURVES,
    CURVES_DATA_TAG,
    CURVES_TAG,
    DATA_TAG,
    DATE_TAG,
    HEADER,
    HEADER_TAG,
    IMAGE,
    MAGIC,
    MAGIC_TAG,
    MICROMETRE,
    NUMBERS,
    OLD_CURVES,
    POINT,
    SPECTROSCOPY,
    STRIP_SIZES,
    STRIPS,
    VERSION_TAG,
    VERSIONS,
    in_si,
    text,
)

_DATE: Final = "%Y:%m:%d %H:%M:%S"
Tags = dict[int, Any]


def read_tiff(path: Path, zone: tzinfo | None) -> FileContent:
    """Read the image or the curves of a file. Raises FileError: the file is damaged, or another kind of TIFF."""
    tags = _tags(path)
    version, raw = int(tags.get(VERSION_TAG, 0)), bytes(tags.get(HEADER_TAG, b""))
    if tags.get(MAGIC_TAG) != MAGIC:
        raise OtherFormat("is not a TIFF of a Park microscope")
    if len(raw) < VERSIONS.get(version, math.inf):
        raise FileError(f"has a header of {len(raw)} bytes in version {version:#x}, which afspm does not know")
    header = np.frombuffer(raw.ljust(HEADER.itemsize, b"\0"), HEADER, 1)[0]
    kind = int(header["kind"])
    if kind not in (IMAGE, SPECTROSCOPY):
        raise FileError("holds a line; afspm reads Park's images and curves")
    newer = version == max(VERSIONS)
    fields = {name: _plain(header[name]) for name in HEADER.names or ()}
    date = str(tags.get(DATE_TAG, "")).strip("\0 ")
    return FileContent(
        f"Park {text(header['mode'])}".strip(),
        scans=(_scan(header, tags, path, newer=newer),) if kind == IMAGE else (),
        spectra=_curves(tags, path, newer=newer) if kind == SPECTROSCOPY else (),
        header=fields,
        start_ns=local_ns(date, _DATE, zone) if date else None,
        upwards=bool(header["upwards"]) if kind == IMAGE else None,
    )


def is_foreign(path: Path) -> bool:
    """Return True for a complete TIFF of another program, such as a screenshot."""
    try:
        return _tags(path).get(MAGIC_TAG) != MAGIC
    except Exception:  # broad: Pillow raises errors of any type for a file that is still being written
        return False


def _tags(path: Path) -> Tags:
    from PIL import Image, TiffImagePlugin, UnidentifiedImageError

    try:
        with Image.open(path, formats=("TIFF",)) as image:
            if not isinstance(image, TiffImagePlugin.TiffImageFile):
                raise FileError("is not a TIFF")
            tags = dict(image.tag_v2)
    except UnidentifiedImageError as error:
        raise FileError("is not a TIFF") from error
    # Pillow reads the tags only, and does not notice a truncated picture.
    ends = [at + size for at, size in zip(tags.get(STRIPS, ()), tags.get(STRIP_SIZES, ()), strict=True)]
    if max(ends, default=0) > path.stat().st_size:
        raise FileError("ends within the picture")
    return tags


def _scan(header: np.void, tags: Tags, path: Path, *, newer: bool) -> Scan:
    if header["compressed"] or header["swapped"]:
        raise FileError("is compressed, or scanned along y, which afspm does not read")
    shape = int(header["rows"]), int(header["columns"])
    numbers = _numbers(tags, DATA_TAG, header, shape, newer=newer)
    unit, factor = in_si(text(header["unit"]) or "um")
    # A scale of 0 is unset.
    scale = float(header["scale"]) or 1.0
    values = factor * float(header["gain"]) * (numbers * scale + float(header["offset"]))
    size = (abs(float(header["width_um"])) * MICROMETRE, abs(float(header["height_um"])) * MICROMETRE)
    center = (float(header["x_um"]) * MICROMETRE, float(header["y_um"]) * MICROMETRE)
    region = Region(center, size, math.radians(float(header["angle_deg"])))
    channel = f"{text(header['source'])} {'Forward' if header['forward'] else 'Backward'}"
    return Scan(region, channel, unit, values, filename=str(path))


def _curves(tags: Tags, path: Path, *, newer: bool) -> tuple[Spectrum, ...]:
    raw = bytes(tags.get(CURVES_TAG, b""))
    if len(raw) < OLD_CURVES:
        raise FileError(f"has a header of {len(raw)} bytes for its curves, not of {OLD_CURVES}")
    header = np.frombuffer(raw.ljust(CURVES.itemsize, b"\0"), CURVES, 1)[0]
    points, count, driving = (int(header[name]) for name in ("points", "channel_count", "driving"))
    if points < 1 or not 0 <= driving < count <= len(header["channels"]):
        raise FileError(f"has {points} curves of {count} channels, driven by number {driving}")
    if header["logarithmic"][:count].any() or header["squared"][:count].any():
        raise FileError("has logarithms or squares of values, which afspm does not read")
    numbers = _numbers(tags, CURVES_DATA_TAG, header, (points, count, int(header["numbers_each"])), newer=newer)
    order = [driving, *(number for number in range(count) if number != driving)]
    channels = [header["channels"][number] for number in order]
    units, factors = zip(*(in_si(text(channel["unit"])) for channel in channels), strict=True)
    values = numbers[:, order] * np.multiply(factors, [channel["gain"] for channel in channels])[:, None]
    kind = CURVE_KINDS.get(int(header["kind"])) or ("IV" if units[0] == "V" else "force")
    names = tuple(text(channel["name"]) for channel in channels)
    # older files have no calibration, and their header is filled with zeros
    spring, sensitivity = float(header["spring_n_per_m"]) or None, float(header["sensitivity_v_per_um"])
    in_force = stated_settings(
        {
            SPRING_CONSTANT: (spring, "N/m"),
            SENSITIVITY: (MICROMETRE / sensitivity if sensitivity else None, "m/V"),
        }
    )
    return tuple(
        Spectrum(place, kind, names, units, curve.T, filename=str(path), in_force=in_force)
        for place, curve in zip(_places(raw[CURVES.itemsize :], points), values, strict=True)
    )


def _places(raw: bytes, count: int) -> list[XY | None]:
    # Files may lack the positions of their curves.
    if len(raw) < count * POINT.itemsize:
        return [None] * count
    points = np.frombuffer(raw, POINT, count)
    places = [(float(one["x_um"]) * MICROMETRE, float(one["y_um"]) * MICROMETRE) for one in points]
    return [place if all(map(math.isfinite, place)) else None for place in places]


def _numbers(tags: Tags, tag: int, header: np.void, shape: tuple[int, ...], *, newer: bool) -> NDArray[np.float64]:
    # The first version of the format has 16-bit integers only.
    data, number = bytes(tags.get(tag, b"")), int(header["numbers"]) if newer else 0
    if number not in NUMBERS:
        raise FileError(f"has numbers of kind {number}, which afspm does not know")
    kind, size = np.dtype(NUMBERS[number]), math.prod(shape)
    if min(shape) < 1 or len(data) < size * kind.itemsize:
        raise FileError(f"has {len(data)} bytes of data for {' x '.join(map(str, shape))} numbers")
    return np.frombuffer(data, kind, size).reshape(shape).astype(np.float64)


def _plain(value: np.generic) -> object:
    return text(value) if isinstance(value, np.void) else value.item()
