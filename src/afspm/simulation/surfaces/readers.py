"""Heights from files: pictures, arrays, and scans of real microscopes.

Another format is a function from a path to a `Heightmap`, put into `READERS` under its suffix.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from afspm import files
from afspm.errors import FileError
from afspm.simulation.fields import Array


@dataclass(frozen=True)
class Heightmap:
    """Heights [y, x], both ascending.

    Attributes:
        height_m: in m if `size_m` is known, else in any unit (a picture's grey levels).
        size_m: (x, y) from first to last pixel; None if the file does not say.
    """

    height_m: Array
    size_m: tuple[float, float] | None = None


Reader = Callable[[Path], Heightmap]


def read(path: Path) -> Heightmap:
    """The heights in a file, gaps (lines that were not scanned) filled with the mean.

    Raises:
        FileError: missing, not readable, or a format without a reader.
    """
    if not path.is_file():
        raise FileError("no such file", where=str(path))
    reader = READERS.get(path.suffix.lower(), read_picture)
    try:
        found = reader(path)
    except FileError:
        raise
    except Exception as error:  # a reader may stumble in any way over a broken file
        raise FileError(f"not readable as {path.suffix or 'a picture'}: {error}", where=str(path)) from error
    heights = np.asarray(found.height_m, dtype=np.float64)
    if heights.ndim != 2 or min(heights.shape) < 2 or not np.isfinite(heights).any():
        raise FileError(f"holds no picture of heights (shape {heights.shape})", where=str(path))
    return Heightmap(np.where(np.isfinite(heights), heights, np.nanmean(heights)), found.size_m)


def read_picture(path: Path) -> Heightmap:
    """Any picture that pillow reads: bright is high, its top at large y."""
    try:
        from PIL import Image
    except ImportError:
        raise FileError(
            "reading pictures needs pillow", where=str(path), hint="pip install afspm[simulation]"
        ) from None
    with Image.open(path) as image:
        grey = image if image.mode in ("F", "I", "I;16", "L") else image.convert("L")
        return Heightmap(np.asarray(grey, dtype=np.float64)[::-1])


def read_array(path: Path) -> Heightmap:
    """A numpy file of heights [y, x]."""
    return Heightmap(np.load(path, allow_pickle=False))


def read_scan(path: Path) -> Heightmap:
    """The heights of a scan file of any controller that afspm reads."""
    content = files.read(path)
    scan = content.topography
    if scan is None:
        channels = ", ".join(f"{scan.channel} ({scan.unit})" for scan in content.scans) or "no scan at all"
        raise FileError(f"holds no heights: {channels}", where=str(path))
    return Heightmap(scan.values, scan.region.size_m)


READERS: dict[str, Reader] = {".npy": read_array, **dict.fromkeys(files.FORMATS, read_scan)}
