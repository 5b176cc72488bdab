"""Which measurement is running, which has ended and is awaited, and which results there are: what every controller
that saves files needs to remember, also over a restart of the translator."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from afspm.errors import FileError
from afspm.model import Region, Scan, Spectrum

SCAN: Final = "scan"
"""What a measurement is called that is no spectrum; of a spectrum it is the kind."""
_LISTED: Final = 16
_OF_A_RESULT: Final = ("what", "frame", "position", "end_ns")

Content = list[Scan | Spectrum]


class ResultFiles:
    """To be derived from by what knows one controller's files.

    Args:
        kept: JSON-able, and lasts. What is "running" or has "ended" is there with "what" it is, "frame" (`as_list`) or
            "position" as they were set, "end_ns" once it has ended, and whatever else a controller needs; "results"
            have a name, by "result", and the same.

    Attributes:
        broken_off: it turned out that what has ended was broken off at the controller; until results are asked for.
    """

    def __init__(self, kept: dict[str, Any], log: logging.Logger) -> None:
        self._kept = kept
        self._log = log
        self.broken_off = False
        for key, empty in (("running", None), ("ended", None), ("results", [])):
            kept.setdefault(key, empty)

    @property
    def what(self) -> str:
        """Which measurement is running: `SCAN`, the kind of a spectrum, or nothing."""
        running = self._kept["running"]
        return running["what"] if running else ""

    def forget(self) -> None:
        """What is running or has ended was broken off: nothing comes of it."""
        self._kept["running"] = self._kept["ended"] = None

    def _begins(self, what: str, facts: Mapping[str, Any]) -> None:
        self._kept["running"], self._kept["ended"] = {"what": what, **facts}, None

    def _ends(self, facts: Mapping[str, Any]) -> None:
        self._kept["running"], self._kept["ended"] = None, {**self._kept["running"], **facts}

    def _comes(self, result: str, measured: Mapping[str, Any], facts: Mapping[str, Any]) -> None:
        """It is a result, by this name."""
        taken = {key: measured[key] for key in _OF_A_RESULT if key in measured}
        self._kept["results"] = [*self._kept["results"], {"result": result, **taken, **facts}][-_LISTED:]

    def _listed(self) -> list[str]:
        """The last results, oldest first."""
        return [entry["result"] for entry in self._kept["results"]]

    def _found(self, result: str) -> dict[str, Any]:
        """What is known of a result. Raises FileError: it is none, or no longer."""
        for entry in self._kept["results"]:
            if entry["result"] == result:
                found: dict[str, Any] = entry
                return found
        raise FileError("is not among the last results", where=result)


def as_list(region: Region) -> list[float]:
    """A frame as it is kept."""
    return [*region.center_m, *region.size_m, region.angle_rad]


def as_region(kept: Sequence[float]) -> Region:
    """The reverse of `as_list`."""
    x, y, width, height, angle_rad = kept
    return Region((x, y), (width, height), angle_rad)


def region_of(measured: Mapping[str, Any]) -> Region:
    """The frame that a scan was to be of."""
    return as_region(measured["frame"])


def as_set(scan: Scan, measured: Mapping[str, Any], *, part: float, angle_rad: float) -> Scan:
    """A scan out of a file with our time, and with the frame that was set where the file has the same.

    Args:
        part: of the largest length, what the file leaves out of each.
        angle_rad: what it leaves out of the angle.
    """
    wanted, told = region_of(measured), scan.region
    lengths_m = [*told.center_m, *told.size_m]
    scale_m = part * max(*map(abs, wanted.center_m), *wanted.size_m)
    close = np.allclose([*wanted.center_m, *wanted.size_m], lengths_m, rtol=0.0, atol=scale_m)
    turned_rad = abs(math.remainder(wanted.angle_rad - told.angle_rad, math.tau))
    region = wanted if close and turned_rad <= angle_rad else told
    return replace(scan, region=region, time_ns=measured["end_ns"])


def lines_missing(one: Scan | Spectrum) -> int:
    """How many lines of a scan have no value at all: it was broken off."""
    return one.lines_missing if isinstance(one, Scan) else 0


def modified_ns(path: Path) -> int:
    """When a file was written last; 0: it is not there."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0
