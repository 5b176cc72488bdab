"""Layout of Park's TIFF files: private tags that contain a header of an image, or of curves.

The layout comes from pspylib 0.1.2, the maker's own reader; images were compared with Gwyddion, curves with AtomicJ.
"""

from __future__ import annotations

import re
from typing import Final

import numpy as np

MAGIC: Final = 0x0E031301
VERSIONS: Final = {0x1000001: 356, 0x1000002: 580}
"""Shortest header by version, in bytes."""
MAGIC_TAG, VERSION_TAG, DATA_TAG, HEADER_TAG = 50432, 50433, 50434, 50435
CURVES_TAG, CURVES_DATA_TAG = 50438, 50439
DATE_TAG: Final = 306
STRIPS, STRIP_SIZES = 273, 279
IMAGE, SPECTROSCOPY = 0, 2
MICROMETRE: Final = 1e-6
NUMBERS: Final = {0: "<i2", 1: "<i4", 2: "<f4"}
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
"""Beginning of a header. The fields from `z_gain` on belong to the second version; in the first, numbers are <i2."""

CHANNELS: Final = 8
CURVE_KINDS: Final = {1: "indentation", 2: "force", 3: "IV", 4: "indentation", 5: "photo-current"} | {
    6: "ID",
    7: "TA",
    8: "AD",
    9: "PE",
}
"""Kinds of curves by number; older files have 0 for force and IV."""
_CHANNEL: Final = np.dtype([("name", "V64"), ("unit", "V16"), ("gain", "<f8"), ("is_x", "<i4"), ("is_y", "<i4")])
CURVES: Final = np.dtype(
    [("channels", _CHANNEL, CHANNELS), ("channel_count", "<i4"), ("average", "<i4"), ("numbers_each", "<i4")]
    + [("points", "<i4"), ("driving", "<i4"), ("forward_s", "<f4"), ("backward_s", "<f4")]
    + [("forward_speed", "<f4"), ("backward_speed", "<f4"), ("grid", "<i4")]
    + [("offsets", "<f8", CHANNELS), ("logarithmic", "<i4", CHANNELS), ("squared", "<i4", CHANNELS)]
    + [("grid_columns", "<i4"), ("reference_image", "<i4")]
    + [(name, "<f8") for name in ("grid_width_um", "grid_height_um", "grid_x_um", "grid_y_um")]
    + [("spring_n_per_m", "<f8"), ("sensitivity_v_per_um", "<f8"), ("force_limit_v", "<f4"), ("interval_s", "<f4")]
    + [(name, "<f4") for name in ("max_v", "min_v", "start_v", "end_v", "delay_s")]
    + [("z_servo", "<i4"), ("source_gain", "<f8"), ("source_unit", "V16"), ("extended", "<i4"), ("kind", "<i4")]
    + [("of_kind", "<f4", 13), ("numbers", "<i4"), ("setpoint", "<f4"), ("setpoint_unit", "<f4"), ("unused", "<i4", 22)]
)
OLD_CURVES: Final = CURVES.fields["grid_columns"][1] if CURVES.fields else 0
"""Shortest header of curves, in older files, in bytes; the positions of curves follow only the newer header."""
POINT: Final = np.dtype([("x_um", "<f4"), ("y_um", "<f4"), ("time_s", "<f4")])


def text(raw: np.void) -> str:
    """Return a text of a header, which has two bytes for each character and zeros at its end."""
    return raw.tobytes().decode("utf-16-le", "replace").partition("\0")[0].strip()


def in_si(unit: str) -> tuple[str, float]:
    """Return the unit without its prefix, and the prefix as a factor; an unknown unit unchanged, and 1."""
    found = _UNIT.fullmatch(unit)
    return (found[2], _PREFIX[found[1]]) if found else (unit, 1.0)
