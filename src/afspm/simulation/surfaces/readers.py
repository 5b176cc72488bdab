"""Heights from files: pictures, arrays and the SPM formats that need no library of their own.

Another format is a function from a path to a `Heightmap`, put into `READERS` under its suffix.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

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


def read_nanonis(path: Path) -> Heightmap:
    """The forward Z image of a Nanonis .sxm file."""
    head, _, data = path.read_bytes().partition(b":SCANIT_END:")
    text = head.decode("latin-1")
    nx, ny = (int(value) for value in _field(text, "SCAN_PIXELS").split())
    width, height = (float(value) for value in _field(text, "SCAN_RANGE").split())
    rows = [line.split("\t") for line in _field(text, "DATA_INFO").splitlines() if line.strip()][1:]
    images = [line[2].strip() + d for line in map(_clean, rows) for d in (["", "<"] if line[4] == "both" else [""])]
    start = data.index(b"\x1a\x04") + 2
    values = np.frombuffer(data, dtype=">f4", offset=start).reshape(-1, ny, nx)
    image = values[images.index("Z")].astype(np.float64)
    upwards = _field(text, "SCAN_DIR").strip() == "up"
    return Heightmap(image if upwards else image[::-1], (width, height))


def read_netcdf(path: Path) -> Heightmap:
    """A GXSM scan in NetCDF-3: heights and lengths are in ångström."""
    from scipy.io import netcdf_file  # type: ignore[import-untyped,unused-ignore]

    with netcdf_file(str(path), mmap=False) as file:
        name = "FloatField" if "FloatField" in file.variables else "H"
        image = np.array(file.variables[name].data[0, 0], dtype=np.float64)
        scale = float(file.variables["dz"].getValue()) * 1e-10
        size_m = tuple(float(file.variables[f"range{axis}"].getValue()) * 1e-10 for axis in "xy")
    return Heightmap(image[::-1] * scale, (size_m[0], size_m[1]))


def read_igor(path: Path) -> Heightmap:
    """The first layer of an Igor binary wave (version 5), as Asylum's instruments save their scans."""
    data = path.read_bytes()
    order = "<" if data[0] != 0 else ">"
    version, kind = (int(np.frombuffer(data, f"{order}i2", 1, offset)[0]) for offset in (0, 80))
    if version != 5 or kind not in (2, 4):
        raise FileError(f"Igor wave of version {version}, type {kind}: not a scan", where=str(path))
    shape = [int(n) for n in np.frombuffer(data, f"{order}i4", 4, 132) if n > 0]
    steps = np.frombuffer(data, f"{order}f8", 4, 148)
    values = np.frombuffer(data, f"{order}f{2 * kind}", math.prod(shape), 384).reshape(shape, order="F")
    image = values[:, :, 0] if values.ndim == 3 else values
    return Heightmap(image.T.astype(np.float64), (float(steps[0]) * (shape[0] - 1), float(steps[1]) * (shape[1] - 1)))


def _field(text: str, name: str) -> str:
    found = re.search(rf"^:{name}:\r?\n(.*?)(?=^:)", text + "\n:", re.MULTILINE | re.DOTALL)
    if not found:
        raise ValueError(f"no field {name}")
    return found[1]


def _clean(columns: list[str]) -> list[str]:
    return [column.strip() for column in columns]


READERS: dict[str, Reader] = {
    ".npy": read_array,
    ".sxm": read_nanonis,
    ".nc": read_netcdf,
    ".ibw": read_igor,
}
