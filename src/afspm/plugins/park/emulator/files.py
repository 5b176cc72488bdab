"""The files that SmartScan saves: a TIFF for each channel and direction, with private tags."""

from __future__ import annotations

import io
import math
from collections.abc import Collection, Iterator, Mapping
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from afspm.components import Array
from afspm.emulation import RETRACE, ScanActivity, SpectrumActivity
from afspm.plugins.park.file_header import (
    CURVE_KINDS,
    CURVES,
    CURVES_DATA_TAG,
    CURVES_TAG,
    DATA_TAG,
    DATE_TAG,
    HEADER,
    HEADER_TAG,
    MAGIC,
    MAGIC_TAG,
    MICROMETRE,
    POINT,
    SPECTROSCOPY,
    STRIP_SIZES,
    VERSION_TAG,
    VERSIONS,
)

_VERSION = max(VERSIONS)
_FLOATS = 2
_GAIN = 0.5
"""Gain of curves, other than 1 so that tests notice a reader that ignores the gain."""
_UNITS = {"m": ("um", 1e-6), "A": ("nA", 1e-9), "N": ("nN", 1e-9)}
"""Units in files, with their SI value."""
_BYTES, _ASCII, _LONG = 1, 2, 4
_ROWS_PER_STRIP = 278
Picture = np.ndarray[tuple[int, int], np.dtype[np.uint8]]


def images(
    scan: ScanActivity, now_s: float, mode: str, recorded: Collection[str] | None = None
) -> Iterator[tuple[str, bytes]]:
    """Yield each channel and direction, as "Height_Forward", with the bytes of its file.

    Args:
        recorded: the saved channels; None: all.
    """
    for name, (unit, values) in scan.channels(scan.end_s if scan.stopped_s is not None else None).items():
        forward = not name.endswith(RETRACE)
        source = name.removesuffix(RETRACE)
        if recorded is not None and source not in recorded:
            continue
        way = "Forward" if forward else "Backward"
        yield f"{source}_{way}", _image(scan, source, unit, values, now_s, mode, forward=forward)


def _image(
    scan: ScanActivity, source: str, unit: str, values: Array, now_s: float, mode: str, *, forward: bool
) -> bytes:
    header = np.zeros((), HEADER)
    rows, columns = scan.shape
    (width, height), (x, y) = scan.region.size_m, scan.region.center_m
    fields = {
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
    for name, value in fields.items():
        header[name] = value
    numbers = (values / MICROMETRE if unit == "m" else values).astype("<f4")
    return _tiff(header, {DATA_TAG: numbers.tobytes()}, _shown(values), now_s)


def curve(spectrum: SpectrumActivity, now_s: float, mode: str) -> bytes:
    """Encode the file of a curve: its channels, each forward and then backward."""
    there, back = spectrum.both_ways()
    layout = np.zeros((), CURVES)
    columns = []
    for number, (name, (unit, values)) in enumerate(there.items()):
        shown, factor = _UNITS.get(unit, (unit, 1.0))
        layout["channels"][number] = (_wide(name, 32), _wide(shown, 8), _GAIN, number == 0, number > 0)
        columns.append(np.concatenate([values, back[name][1]]) / factor / _GAIN)
    layout["channel_count"], layout["points"], layout["driving"] = len(there), 1, 0
    layout["numbers_each"], layout["numbers"] = len(columns[0]), _FLOATS
    layout["kind"] = next(number for number, kind in CURVE_KINDS.items() if kind == spectrum.kind)
    x, y = spectrum.position_m
    point = np.array((x / MICROMETRE, y / MICROMETRE, 0.0), POINT)
    header = np.zeros((), HEADER)
    header["kind"], header["mode"], header["source"] = SPECTROSCOPY, _wide(mode, 8), _wide(spectrum.kind, 32)
    data = {CURVES_TAG: layout.tobytes() + point.tobytes(), CURVES_DATA_TAG: np.array(columns, "<f4").tobytes()}
    return _tiff(header, data, _shown(np.array(columns)), now_s)


def _tiff(header: NDArray[np.void], data: Mapping[int, bytes], shown: Picture, now_s: float) -> bytes:
    # The maker's own reader, pspylib, needs a picture with a palette, in several strips: the tags of a single strip are
    # not parsed.
    from PIL import Image, TiffImagePlugin

    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, kind, value in (
        (MAGIC_TAG, _LONG, MAGIC),
        (VERSION_TAG, _LONG, _VERSION),
        (HEADER_TAG, _BYTES, header.tobytes().ljust(VERSIONS[_VERSION], b"\0")),
        (DATE_TAG, _ASCII, datetime.fromtimestamp(now_s, UTC).astimezone().strftime("%Y:%m:%d %H:%M:%S")),
        (STRIP_SIZES, _LONG, (0, 0)),
        (_ROWS_PER_STRIP, _LONG, (len(shown) + 1) // 2),
        *((tag, _BYTES, content) for tag, content in data.items()),
    ):
        tags.tagtype[tag] = kind
        tags[tag] = value
    picture = Image.fromarray(shown)
    picture.putpalette([level for level in range(256) for _ in range(3)])
    content = io.BytesIO()
    picture.save(content, "TIFF", tiffinfo=tags)
    return content.getvalue()


def _shown(values: Array) -> Picture:
    # For other programs: 255 is highest, and the top row has the largest y. A single line is doubled.
    low, high = np.nanmin(values, initial=np.inf), np.nanmax(values, initial=-np.inf)
    scaled = (values - low) / (high - low) * 255.0 if high > low else np.zeros_like(values)
    picture = np.nan_to_num(scaled[::-1]).astype(np.uint8)
    return np.vstack([picture, picture]) if len(picture) == 1 else picture


def _wide(text: str, characters: int) -> np.void:
    return np.void(text[: characters - 1].encode("utf-16-le").ljust(2 * characters, b"\0"))
