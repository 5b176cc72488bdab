"""A reader: a text file of numbers, a micrometre wide."""

from __future__ import annotations

from datetime import tzinfo
from pathlib import Path

import numpy as np

from afspm.driver import FileContent
from afspm.model import Region, Scan


def read_example(path: Path, zone: tzinfo | None) -> FileContent:
    """Return the one scan of a file."""
    region = Region((0.0, 0.0), (1e-6, 1e-6))
    return FileContent("Example", scans=(Scan(region, "Height", "m", np.loadtxt(path), filename=str(path)),))
