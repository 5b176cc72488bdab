"""The frame and the speed as Asylum has them, and as everybody else. Pure; lengths in m.

Asylum's XOffset and YOffset are the centre of the frame (seen in images that were zoomed into). ScanSize is its longer
side, and how long the other one is, is told by two ratios; FastScanSize and SlowScanSize are what comes of it. Its
angles are in degrees, clockwise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from afspm.errors import InvalidValue
from afspm.files.asylum import clockwise, counter_clockwise
from afspm.model import Region, names
from afspm.translator.parameters import Value
from afspm.translator.settings import FRAME, frame

GLOBALS: Final = (
    "XOffset", "YOffset", "FastScanSize", "SlowScanSize", "ScanAngle", "ScanPoints", "ScanLines", "ScanRate",
)  # fmt: skip
NAMES: Final = frozenset({*FRAME, names.SCAN_SPEED})

PATH_OF_A_LINE: Final = 2.5
"""In widths of the frame: there and back, and round the ends (ScanSpeed / (FastScanSize · ScanRate) in all notes)."""


def generic(found: Mapping[str, float]) -> dict[str, Value]:
    """Of Asylum's `GLOBALS`, the generic parameters in SI."""
    size_m = (found["FastScanSize"], found["SlowScanSize"])
    region = Region((found["XOffset"], found["YOffset"]), size_m, counter_clockwise(found["ScanAngle"]))
    return {
        names.SCAN_TOP_LEFT_X: region.top_left_m[0],
        names.SCAN_TOP_LEFT_Y: region.top_left_m[1],
        names.SCAN_SIZE_X: size_m[0],
        names.SCAN_SIZE_Y: size_m[1],
        names.SCAN_ANGLE: region.angle_rad,
        names.SCAN_RESOLUTION_X: round(found["ScanPoints"]),
        names.SCAN_RESOLUTION_Y: round(found["ScanLines"]),
        names.SCAN_SPEED: PATH_OF_A_LINE * found["FastScanSize"] * found["ScanRate"],
    }


def asylums(wanted: Mapping[str, Value], before: Mapping[str, Value]) -> dict[str, float]:
    """What to set at Asylum for generic parameters that are wanted, given all of `NAMES` as they were.

    All that depends on each other is set, as PV does none of what the panel does. Asylum scans by its ScanRate, so
    that is set to keep the speed when the width changes.

    Raises:
        InvalidValue: they describe no frame.
    """
    values = {**before, **wanted}
    region, (rows, columns) = frame(values)
    speed_m_s = float(values[names.SCAN_SPEED])
    fast_m, slow_m = region.size_m
    if speed_m_s <= 0.0:
        raise InvalidValue(f"a scan at {speed_m_s} m/s never ends")
    shorter_m = min(fast_m, slow_m)
    return {
        "XOffset": region.center_m[0],
        "YOffset": region.center_m[1],
        "ScanSize": max(fast_m, slow_m),
        "FastRatio": fast_m / shorter_m,
        "SlowRatio": slow_m / shorter_m,
        "FastScanSize": fast_m,
        "SlowScanSize": slow_m,
        "ScanAngle": clockwise(region.angle_rad),
        "ScanPoints": float(columns),
        "ScanLines": float(rows),
        "ScanRate": speed_m_s / (PATH_OF_A_LINE * fast_m),
        "ScanSpeed": speed_m_s,
    }


def on_image(xy_m: tuple[float, float], image: Region) -> tuple[float, float]:
    """A place of the tip as a spot of Asylum's: from the lower left corner of an image, along its axes."""
    cos, sin = math.cos(image.angle_rad), math.sin(image.angle_rad)
    dx, dy = xy_m[0] - image.center_m[0], xy_m[1] - image.center_m[1]
    return cos * dx + sin * dy + image.size_m[0] / 2, cos * dy - sin * dx + image.size_m[1] / 2


def from_image(spot_m: tuple[float, float], image: Region) -> tuple[float, float]:
    """The reverse of `on_image`."""
    cos, sin = math.cos(image.angle_rad), math.sin(image.angle_rad)
    dx, dy = spot_m[0] - image.size_m[0] / 2, spot_m[1] - image.size_m[1] / 2
    return image.center_m[0] + cos * dx - sin * dy, image.center_m[1] + cos * dy + sin * dx
