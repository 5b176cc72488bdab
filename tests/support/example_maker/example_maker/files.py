"""The maker's files, .acme: read for any program, and written by `afspm export --to acme`."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from datetime import tzinfo
from pathlib import Path
from typing import Any

import numpy as np

from afspm import Run
from afspm.basics import FileError
from afspm.driver import FileContent, OtherFormat, netcdf
from afspm.model import Region, Scan
from afspm.night import ScanRow, SpectrumRow


def packed(scans: Iterable[Scan]) -> bytes:
    """Return the content of a file."""
    content = io.BytesIO()
    for scan in scans:
        about: list[Any] = [*scan.region.center_m, *scan.region.size_m, scan.region.angle_rad, scan.time_ns]
        np.save(content, np.array([scan.channel, scan.unit, *map(repr, map(float, about))]))
        np.save(content, scan.values)
    return content.getvalue()


def read_acme(path: Path, zone: tzinfo | None) -> FileContent:
    """Return the channels of a file."""
    content, scans = io.BytesIO(path.read_bytes()), []
    try:
        while content.tell() < content.getbuffer().nbytes:
            channel, unit, *about = np.load(content).tolist()
            x, y, width, height, angle, time = map(float, about)
            region = Region((x, y), (width, height), angle)
            scans.append(Scan(region, channel, unit, np.load(content), int(time), str(path)))
    except (ValueError, EOFError) as error:
        raise FileError(f"is incomplete: {error}") from error
    return FileContent("Acme", tuple(scans), end_ns=scans[0].time_ns if scans else None)


def read_netcdf(path: Path, zone: tzinfo | None) -> FileContent:
    """Return the version in a NetCDF file of the maker's older program; other makers use this format, too."""
    about = netcdf.read(path).attributes
    if about.get("program") != "Acme":
        raise OtherFormat("Acme did not write it")
    return FileContent("Acme", header=about)


def write(run: Run, row: ScanRow | SpectrumRow) -> Iterator[tuple[str, bytes]]:
    """Yield the file of a scan."""
    if isinstance(row, ScanRow):
        yield ".acme", packed(run.scan(row).values())
