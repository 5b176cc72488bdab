"""The files that SmartScan saves: a TIFF for each channel and direction, with the maker's private tags."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from datetime import UTC, datetime

import numpy as np

from afspm.emulators.activities import RETRACE, ScanActivity
from afspm.files.park import DATA_TAG, DATE_TAG, HEADER, HEADER_TAG, MAGIC, MAGIC_TAG, MICROMETRE, VERSION_TAG, VERSIONS
from afspm.simulation.fields import Array

_VERSION = max(VERSIONS)
_FLOATS = 2


def images(scan: ScanActivity, now_s: float, mode: str) -> Iterator[tuple[str, bytes]]:
    """Yield the name of each channel with its direction, and its file."""
    for name, (unit, values) in scan.channels(scan.end_s if scan.stopped_s is not None else None).items():
        forward = not name.endswith(RETRACE)
        source = name.removesuffix(RETRACE)
        way = "Forward" if forward else "Backward"
        yield f"{source}_{way}", _image(scan, source, unit, values, now_s, mode, forward=forward)


def _image(
    scan: ScanActivity, source: str, unit: str, values: Array, now_s: float, mode: str, *, forward: bool
) -> bytes:
    from PIL import Image, TiffImagePlugin

    header = np.zeros((), HEADER)
    rows, columns = scan.shape
    (width, height), (x, y) = scan.region.size_m, scan.region.center_m
    told = {
        "mode": _wide(mode, 8),
        "source": _wide(source, 32),
        "columns": columns,
        "rows": rows,
        "angle_deg": math.degrees(scan.region.angle_rad),
        "forward": forward,
        "upwards": scan.upwards,
        "width_um": width / MICROMETRE,
        "height_um": height / MICROMETRE,
        "x_um": x / MICROMETRE,
        "y_um": y / MICROMETRE,
        "rate_hz": 1.0 / scan.line_s,
        "setpoint": scan.feedback.setpoint or 0.0,
        "setpoint_unit": _wide("V", 8),
        "sample_bias_v": scan.bias_v,
        "gain": 1.0,
        "scale": 1.0,
        "unit": _wide("um" if unit == "m" else unit, 8),
        "numbers": _FLOATS,
    }
    for name, value in told.items():
        header[name] = value
    numbers = (values / MICROMETRE if unit == "m" else values).astype("<f4")
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, kind, value in (
        (MAGIC_TAG, 4, MAGIC),
        (VERSION_TAG, 4, _VERSION),
        (DATA_TAG, 1, numbers.tobytes()),
        (HEADER_TAG, 1, header.tobytes().ljust(VERSIONS[_VERSION], b"\0")),
        (DATE_TAG, 2, datetime.fromtimestamp(now_s, UTC).astimezone().strftime("%Y:%m:%d %H:%M:%S")),
    ):
        tags.tagtype[tag] = kind
        tags[tag] = value
    content = io.BytesIO()
    Image.fromarray(_shown(values)).save(content, "TIFF", tiffinfo=tags)
    return content.getvalue()


def _shown(values: Array) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    """The picture that other programs see: 255 is highest, and the top row has the largest y."""
    low, high = np.nanmin(values, initial=np.inf), np.nanmax(values, initial=-np.inf)
    scaled = (values - low) / (high - low) * 255.0 if high > low else np.zeros_like(values)
    return np.nan_to_num(scaled[::-1]).astype(np.uint8)


def _wide(text: str, characters: int) -> np.void:
    return np.void(text[: characters - 1].encode("utf-16-le").ljust(2 * characters, b"\0"))
