"""A simulated microscope whose sample is a picture, or a scan of another microscope."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from afspm.basics import Length, PlainMapping
from afspm.emulation import Simulator

__all__ = ["ImageMicroscope"]

# An ideal instrument shows the picture as it is; settings add noise, drift or a blunt tip.
_IDEAL: Mapping[str, PlainMapping] = {
    "tip": {"radius_m": 1e-12, "half_angle_deg": 1.0, "spread": 0.0},
    "noise": dict.fromkeys(
        ("white_m", "one_over_f_m", "line_offset_m", "scar_probability", "amplitude_v", "phase_deg", "current_a"), 0.0
    ),
    "scanner": {"band_limit_px": 0.0},
    "tip_changes": {"per_hour": 0.0},
}


class ImageMicroscope(Simulator):
    """An ideal simulated microscope whose sample has the heights of a file.

    The middle of the picture is at the origin; beyond its borders the sample continues mirrored.

    Args:
        file: a picture (bright is high), a numpy array, or a scan in any format that `afspm.read` reads.
        width: distance from the first to the last pixel; not needed for a scan.
        height: distance from the lowest to the highest value; not needed for a scan.
        settings: settings of the Simulator: `noise`, `drift`, `tip` … make the instrument less than ideal.
    """

    def __init__(self, file: Path, *, width: Length = 0.0, height: Length = 0.0, **settings: Any) -> None:
        surface = {"kind": "file", "path": str(file), "width_m": width, "height_range_m": height}
        for name, ideal in _IDEAL.items():
            settings[name] = {**ideal, **(settings.get(name) or {})}
        super().__init__(surface=surface, **settings)
