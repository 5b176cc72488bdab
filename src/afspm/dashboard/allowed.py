"""What the limits of the experiment allow, out of the file in the run's folder."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from afspm.errors import AfspmError
from afspm.model import Region
from afspm.record.run_json import EXPERIMENT_FILE
from afspm.units import si


def allowed_region(folder: Path) -> Region | None:
    """The region of [limits] in the expanded experiment file, in tip coordinates; None where there is none."""
    try:
        table = tomllib.loads((folder / EXPERIMENT_FILE).read_text(encoding="utf-8"))
        box = table.get("limits", {}).get("region")
        return None if box is None else _region(box)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, AfspmError):
        return None  # it is only drawn: the scheduler, which enforces it, has read it by itself


def _region(box: dict[str, Any]) -> Region:
    if "x" in box:
        (left, right), (low, high) = (tuple(si(v, "m") for v in box[axis]) for axis in "xy")
        return Region(((left + right) / 2, (low + high) / 2), (right - left, high - low))
    center, size = (tuple(si(v, "m") for v in box[key]) for key in ("center", "size"))
    return Region((center[0], center[1]), (size[0], size[1]), si(box.get("angle", 0.0), "rad"))
