"""The content of a file of a controller, and the times in it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, tzinfo
from typing import Any

from afspm.basics.errors import FileError
from afspm.model import Scan, Spectrum

_UNIT = re.compile(r"\s*\(((?:[^()]|\([^()]*\))*)\)")  # one pair of parentheses may stand in another: A/sqrt(Hz)
_TOPOGRAPHY = ("height", "zsensor", "topo", "zs-topo", "z")


class OtherFormat(FileError):
    """A file of another format with the same suffix: the next reader of the suffix is tried."""

    code = "file-format"


@dataclass(frozen=True, eq=False)
class FileContent:
    """Everything of one file, in the model's geometry and units of the controller's (lengths in m).

    Attributes:
        controller: who wrote it, e.g. "Nanonis".
        scans: one for each channel.
        spectra: of one file, one in most formats.
        header: what the file says besides, as it says it.
        start_ns, end_ns: when it was begun and finished, ns since the Unix epoch; None if that is not known.
        upwards: whether small y was scanned first; None if that is not known.
    """

    controller: str
    scans: tuple[Scan, ...] = ()
    spectra: tuple[Spectrum, ...] = ()
    header: Mapping[str, Any] = field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int | None = None
    upwards: bool | None = None

    def __iter__(self) -> Iterator[Scan | Spectrum]:
        yield from self.scans
        yield from self.spectra

    @property
    def topography(self) -> Scan | None:
        """The first scan of heights; None if there is none."""
        heights = [scan for scan in self.scans if scan.unit == "m"]
        for start in _TOPOGRAPHY:
            for scan in heights:
                if scan.channel.casefold().startswith(start):
                    return scan
        return heights[0] if len(self.scans) == 1 and heights else None


def name_and_unit(column: str) -> tuple[str, str]:
    """Return a column's name without its unit, and the unit, which is the last text in parentheses; "" if none is.

    "Current (A) [filt]" is ("Current [filt]", "A"), and "Current PSD (A/sqrt(Hz))" is ("Current PSD", "A/sqrt(Hz)").
    """
    found = list(_UNIT.finditer(column))
    if not found:
        return column.strip(), ""
    unit = found[-1]
    return (column[: unit.start()] + column[unit.end() :]).strip(), unit[1].strip()


def local_ns(text: str, layout: str, zone: tzinfo | None) -> int:
    """Return a date and time of the controller's clock in ns since the Unix epoch.

    Raises:
        ValueError: it is not of that layout (as of `datetime.strptime`).
    """
    return clock_ns(datetime.strptime(text.strip(), layout), zone)  # noqa: DTZ007  (the zone comes next)


def clock_ns(time: datetime, zone: tzinfo | None) -> int:
    """Return a time without a zone, of the controller's clock, in ns since the Unix epoch."""
    moment = time.astimezone() if zone is None else time.replace(tzinfo=zone)
    return round(moment.timestamp() * 1e6) * 1000
