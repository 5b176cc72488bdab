"""`FileContent`: the content of a controller's file, with helpers for its times and column names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, tzinfo
from typing import Any

from afspm.basics.errors import FileError
from afspm.model import Scan, Spectrum

_UNIT = re.compile(r"\s*\(((?:[^()]|\([^()]*\))*)\)")  # nested parentheses occur: A/sqrt(Hz)
_TOPOGRAPHY = ("height", "zsensor", "topo", "zs-topo", "z")


class OtherFormat(FileError):
    """The error that a file has another format with the same suffix; the next reader of the suffix is tried."""

    code = "file-format"


@dataclass(frozen=True, eq=False)
class FileContent:
    """The content of one file, in the model's geometry and the controller's units (lengths in m).

    Attributes:
        controller: the controller that wrote it, e.g. "Nanonis".
        scans: one scan for each channel.
        spectra: the spectra of the file; in most formats one.
        header: all further entries, unchanged.
        start_ns, end_ns: start and end of the measurement, ns since the Unix epoch; None if unknown.
        upwards: whether small y was scanned first; None if unknown.
        left_out: what of the file was not read, each with its reason.
        stated_place: place of the frame in the file's own words, where their origin, signs or angle are unknown; empty
            if the file states none. Regions are then about (0, 0). None: the regions are where the frame was.
    """

    controller: str
    scans: tuple[Scan, ...] = ()
    spectra: tuple[Spectrum, ...] = ()
    header: Mapping[str, Any] = field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int | None = None
    upwards: bool | None = None
    left_out: tuple[str, ...] = ()
    stated_place: str | None = None

    def __iter__(self) -> Iterator[Scan | Spectrum]:
        yield from self.scans
        yield from self.spectra

    @property
    def topography(self) -> Scan | None:
        """The scan in m with a usual name of a height channel, else the only scan if in m; None without any."""
        heights = [scan for scan in self.scans if scan.unit == "m"]
        for start in _TOPOGRAPHY:
            for scan in heights:
                if scan.channel.casefold().startswith(start):
                    return scan
        return heights[0] if len(self.scans) == 1 and heights else None


def name_and_unit(column: str) -> tuple[str, str]:
    """Return a column's name without its unit, and the unit: the last text in parentheses, or empty.

    "Current (A) [filt]" is ("Current [filt]", "A"), and "Current PSD (A/sqrt(Hz))" is ("Current PSD", "A/sqrt(Hz)").
    """
    found = list(_UNIT.finditer(column))
    if not found:
        return column.strip(), ""
    unit = found[-1]
    return (column[: unit.start()] + column[unit.end() :]).strip(), unit[1].strip()


def text_of(raw: bytes | bytearray | memoryview) -> str:
    """Decode a text of unknown encoding (a µ in a name): as UTF-8, otherwise as cp1252 of Windows."""
    raw = bytes(raw)
    for encoding in ("utf-8", "cp1252"):
        try:
            return raw.decode(encoding)
        except UnicodeDecodeError:
            pass
    return raw.decode("latin-1")  # five bytes have no meaning in cp1252


def local_ns(text: str, layout: str, zone: tzinfo | None, *, fold: int = 0) -> int:
    """Return a date and time of the controller's clock in ns since the Unix epoch.

    Args:
        fold: 1: the second reading of an hour that the end of summer time repeats.

    Raises:
        ValueError: the text does not follow the layout (as in `datetime.strptime`).
    """
    return clock_ns(datetime.strptime(text.strip(), layout).replace(fold=fold), zone)  # noqa: DTZ007  (the zone comes next)


def clock_ns(time: datetime, zone: tzinfo | None) -> int:
    """Return a time of the controller's clock in ns since the Unix epoch; `zone` None: this computer's zone."""
    moment = time.astimezone() if zone is None else time.replace(tzinfo=zone)
    return round(moment.timestamp() * 1e6) * 1000
