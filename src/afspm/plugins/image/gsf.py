"""Gwyddion Simple Field (.gsf): one image, the exchange format of Gwyddion and other programs.

Format: "Gwyddion Simple Field 1.0", lines `name = value`, one to four NUL bytes up to a multiple of four, then float32,
little-endian, from the top left (Gwyddion user guide, "Gwyddion Simple Field").
"""

from __future__ import annotations

from datetime import tzinfo
from pathlib import Path

import numpy as np

from afspm.basics import FileError
from afspm.driver import FileContent, text_of
from afspm.model import Region, Scan

_MAGIC = b"Gwyddion Simple Field 1.0\n"


def read_field(path: Path, zone: tzinfo | None) -> FileContent:
    """Return the image of a file.

    The format's y points down, so its YOffset is the negative upper edge of the region.

    Raises:
        FileError, KeyError, ValueError: the file is broken.
    """
    data = path.read_bytes()
    end = data.find(b"\0")
    if not data.startswith(_MAGIC) or end < 0:
        raise FileError("is not a Gwyddion Simple Field")
    lines = text_of(data[len(_MAGIC) : end]).splitlines()
    header = {key.strip(): value.strip() for key, _, value in (line.partition("=") for line in lines)}
    nx, ny = int(header["XRes"]), int(header["YRes"])
    start = end + 4 - end % 4
    if nx < 2 or ny < 2 or len(data) != start + 4 * nx * ny:
        raise FileError(f"has {len(data) - start} bytes of values, which do not fit {nx} x {ny} pixels")
    if header.get("XYUnits", "") not in ("m", ""):
        raise FileError(f"has its sizes in {header['XYUnits']} instead of m")
    if "XReal" not in header or "YReal" not in header:
        raise FileError("lacks the size of the scan")
    width, height = float(header["XReal"]), float(header["YReal"])
    left, top = float(header.get("XOffset", "0")), -float(header.get("YOffset", "0"))
    # XReal includes the outer halves of the outermost pixels; a region ends at the centres of these pixels
    size_m = (width * (nx - 1) / nx, height * (ny - 1) / ny)
    region = Region((left + width / 2, top - height / 2), size_m)
    values = np.frombuffer(data, "<f4", nx * ny, start).reshape(ny, nx)[::-1].astype(np.float64)
    scan = Scan(region, header.get("Title", ""), header.get("ZUnits", ""), values, filename=str(path))
    return FileContent("Gwyddion", scans=(scan,), header=header)
