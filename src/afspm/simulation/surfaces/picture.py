"""A surface read from a file: an image, or a scan of a real microscope."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from afspm.basics.errors import ConfigError, FileError
from afspm.model.arrays import Array
from afspm.simulation.fields import is_separable
from afspm.simulation.settings import check
from afspm.simulation.surfaces.relief import Relief
from afspm.storage import formats as files


@dataclass(frozen=True)
class Heightmap:
    """Heights [y, x], both ascending.

    Attributes:
        height_m: in m if `size_m` is known, else in any unit (grey levels of an image).
        size_m: (x, y) from first to last pixel; None if the file does not contain the size.
    """

    height_m: Array
    size_m: tuple[float, float] | None = None


Reader = Callable[[Path], Heightmap]


def read(path: Path) -> Heightmap:
    """Return the heights in a file; gaps (lines that were not scanned) are filled with the mean.

    Raises:
        FileError: the file is missing, unreadable, or without heights.
    """
    if not path.is_file():
        raise FileError("no such file", where=str(path))
    reader = _reader(path.suffix.lower())
    try:
        found = reader(path)
    except FileError:
        raise
    except Exception as error:  # a reader may raise anything on a broken file
        raise FileError(f"not readable as {path.suffix or 'a picture'}: {error}", where=str(path)) from error
    heights = np.asarray(found.height_m, dtype=np.float64)
    if heights.ndim != 2 or min(heights.shape) < 2 or not np.isfinite(heights).any():
        raise FileError(f"holds no picture of heights (shape {heights.shape})", where=str(path))
    return Heightmap(np.where(np.isfinite(heights), heights, np.nanmean(heights)), found.size_m)


def read_picture(path: Path) -> Heightmap:
    """Return the heights of an image that Pillow can read: bright is high, the top is at large y."""
    from PIL import Image

    with Image.open(path) as image:
        grey = image if image.mode in ("F", "I", "I;16", "L") else image.convert("L")
        return Heightmap(np.asarray(grey, dtype=np.float64)[::-1])


def read_array(path: Path) -> Heightmap:
    """Return the heights [y, x] of a numpy file."""
    return Heightmap(np.load(path, allow_pickle=False))


def read_scan(path: Path) -> Heightmap:
    """Return the heights of a scan file in any format that afspm reads."""
    content = files.read(path)
    scan = content.topography
    if scan is None:
        channels = ", ".join(f"{scan.channel} ({scan.unit})" for scan in content.scans) or "no scan at all"
        raise FileError(f"holds no heights: {channels}", where=str(path))
    return Heightmap(scan.values, scan.region.size_m)


def _reader(suffix: str) -> Reader:
    if suffix == ".npy":
        return read_array
    return read_scan if suffix in files.suffixes() else read_picture


@dataclass(frozen=True)
class PictureSurface:
    """Heights read from a file, centred at the origin and mirrored at their borders, which avoids seams.

    Attributes:
        path: an image (bright is high), a numpy file or an SPM file.
        width_m: distance from first to last pixel; 0: as in the SPM file. Required for images and numpy files.
        height_range_m: difference of lowest and highest; 0: as in the SPM file. Required for images and numpy files.
    """

    path: str
    width_m: float = 0.0
    height_range_m: float = 0.0

    def __post_init__(self) -> None:
        check(self, from_zero="width_m height_range_m")

    def relief(self, x_m: Array, y_m: Array, resolution_m: float, seed: int) -> Relief:
        levels, size_m = _load(self)
        level = 0
        while level + 1 < len(levels) and size_m[0] / (levels[level].shape[1] - 1) < 0.7 * resolution_m:
            level += 1
        image = levels[level]
        ny, nx = levels[0].shape
        # Averaging 2 x 2 pixels moves the first sample half a pixel inwards each time.
        inset = (2**level - 1) / 2
        u = ((x_m / size_m[0] + 0.5) * (nx - 1) - inset) / 2**level
        v = ((y_m / size_m[1] + 0.5) * (ny - 1) - inset) / 2**level
        height_m = _cubic(image, u, v)
        low, high = levels[0].min(), levels[0].max()
        return Relief(height_m, np.clip((height_m - low) / ((high - low) or 1.0), 0.0, 1.0))

    def load(self) -> None:
        """Read the file now, to detect a wrong path before the first scan."""
        _load(self)


@lru_cache(maxsize=4)
def _load(picture: PictureSurface) -> tuple[tuple[Array, ...], tuple[float, float]]:
    # the picture with its successive halvings, and its size (x, y) in m
    found = read(Path(picture.path))
    heights, size_m = found.height_m, found.size_m
    pixels_y, pixels_x = heights.shape
    if picture.width_m:
        ratio = size_m[1] / size_m[0] if size_m else (pixels_y - 1) / (pixels_x - 1)
        size_m = (picture.width_m, picture.width_m * ratio)
    if size_m is None:
        raise ConfigError("the file does not say how wide it is", where="width_m", hint="set width_m")
    if picture.height_range_m:
        heights = (heights - heights.mean()) * (picture.height_range_m / (np.ptp(heights) or 1.0))
    elif found.size_m is None:
        raise ConfigError("the file does not say how high it is", where="height_range_m", hint="set height_range_m")
    levels = [heights]
    while min(levels[-1].shape) >= 16:
        top = levels[-1]
        even = top[: top.shape[0] // 2 * 2, : top.shape[1] // 2 * 2]
        levels.append((even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]) / 4)
    return tuple(levels), size_m


def _mirrored(index: Array, count: int) -> Array:
    folded = np.mod(index, 2 * count - 2)
    return np.where(folded < count, folded, 2 * count - 2 - folded).astype(np.intp)


def _taps(position: Array, count: int) -> list[tuple[Array, Array]]:
    # indices and weights of the four neighbours (cubic of Catmull and Rom, which passes through the pixels)
    whole = np.floor(position)
    t = position - whole
    weights = (
        t * (-0.5 + t * (1.0 - 0.5 * t)),
        1.0 + t * t * (-2.5 + 1.5 * t),
        t * (0.5 + t * (2.0 - 1.5 * t)),
        t * t * (-0.5 + 0.5 * t),
    )
    return [(_mirrored(whole + k - 1, count), weight) for k, weight in enumerate(weights)]


def _cubic(image: Array, u: Array, v: Array) -> Array:
    rows, columns = _taps(v, image.shape[0]), _taps(u, image.shape[1])
    if is_separable(u, v):
        along = np.asarray(sum(image[:, column[0]] * weight for column, weight in columns))
        return np.asarray(sum(along[row[:, 0]] * weight for row, weight in rows))
    return np.asarray(sum(image[r, c] * (rw * cw) for r, rw in rows for c, cw in columns))
