"""Heights from files: pictures, arrays and the SPM formats that need no library of their own.

Another format is a function from a path to a `Heightmap`, put into `READERS` under its suffix.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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

_HDF5 = b"\x89HDF\r\n\x1a\n"


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
    """A GXSM scan, in NetCDF-3 or NetCDF-4 (which is HDF5): heights and lengths are in ångström."""
    with path.open("rb") as file:
        if file.read(len(_HDF5)) == _HDF5:
            return _read_netcdf4(path)
    from scipy.io import netcdf_file  # type: ignore[import-untyped,unused-ignore]

    with netcdf_file(str(path), mmap=False) as file:
        name = "FloatField" if "FloatField" in file.variables else "H"
        _require_heights(getattr(file.variables[name], "ZSrcUnit", b"AA"), path)
        image = np.array(file.variables[name].data[0, 0], dtype=np.float64)
        scale = float(file.variables["dz"].getValue()) * 1e-10
        size_m = tuple(float(file.variables[f"range{axis}"].getValue()) * 1e-10 for axis in "xy")
    return Heightmap(image[::-1] * scale, (size_m[0], size_m[1]))


def _read_netcdf4(path: Path) -> Heightmap:
    with _hdf5(path) as file:
        _require_heights(file["FloatField"].attrs.get("ZSrcUnit", b"AA"), path)
        image = np.array(file["FloatField"][0, 0], dtype=np.float64) * float(file["dz"][()]) * 1e-10
        return Heightmap(image[::-1], (float(file["rangex"][()]) * 1e-10, float(file["rangey"][()]) * 1e-10))


def _require_heights(unit: bytes, path: Path) -> None:
    if bytes(unit) != b"AA":
        raise FileError(f"a channel in {unit.decode('utf-8', 'replace')} and no heights", where=str(path))


def read_hdf5(path: Path) -> Heightmap:
    """The height image of an NSID file, as scans of Asylum's instruments are shared: [x, y], both ascending, in m."""
    with _hdf5(path) as file:
        nodes: list[Any] = []
        file.visititems(lambda _, node: nodes.append(node))
        images = {_quantity(node): node for node in nodes}
        image = next((images[name] for name in sorted(images) if name.startswith(("Height", "ZSensor"))), None)
        if image is None:
            found = ", ".join(sorted(filter(None, images))) or "no images"
            raise FileError(f"holds no image of heights: {found}", where=str(path))
        x, y = (np.asarray(image.parent[axis][()], dtype=np.float64) for axis in "xy")
        size_m = (float(x[-1] - x[0]), float(y[-1] - y[0]))
        return Heightmap(np.asarray(image[()], dtype=np.float64).T, size_m)


def _quantity(node: Any) -> str:
    """What an image of an NSID file shows; empty for what is none."""
    return str(node.attrs.get("quantity", "")) if len(getattr(node, "shape", ())) == 2 else ""


def _hdf5(path: Path) -> Any:
    try:
        import h5py  # type: ignore[import-not-found,import-untyped,unused-ignore]
    except ImportError:
        raise FileError("reading HDF5 needs h5py", where=str(path), hint="pip install h5py") from None
    return h5py.File(path, "r")


def read_igor(path: Path) -> Heightmap:
    """The first layer of an Igor binary wave (version 5), as Asylum's instruments save their scans."""
    data = path.read_bytes()
    order = "<" if data[0] != 0 else ">"
    version, kind = (int(np.frombuffer(data, f"{order}i2", 1, offset)[0]) for offset in (0, 80))
    if version != 5 or kind not in (2, 4):
        raise FileError(f"Igor wave of version {version}, type {kind}: not a scan", where=str(path))
    shape = [int(n) for n in np.frombuffer(data, f"{order}i4", 4, 132) if n > 0]
    units = [data[start : start + 4].strip(b"\0").decode("latin-1") for start in (216, 220)]
    if len(shape) < 2 or units != ["m", "m"]:
        raise FileError("an Igor wave that is no image over lengths: a curve?", where=str(path))
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
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
}
