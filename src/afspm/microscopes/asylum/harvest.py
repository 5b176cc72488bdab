"""What comes of a measurement: the file that Asylum saves of it, once it is whole.

Everything that must outlive the process is in `kept`: which measurement is running, which has ended and whose file is
awaited, and which results there are.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from afspm.errors import AfspmError, FileError
from afspm.files import read
from afspm.model import Region, Scan, Spectrum

SCAN: Final = "scan"
_LISTED: Final = 16
_PRINTED: Final = 1e-4
"""Relative: what a note has of a number, of which it prints five digits."""
_NUMBERED: Final = re.compile(r".*\d{4}\.ibw", re.IGNORECASE)

Content = list[Scan | Spectrum]


@dataclass(frozen=True)
class Target:
    """Where Asylum will save next.

    Attributes:
        folder: as seen from here.
        base, suffix: of the name; it is `<base><suffix as four digits>.ibw`.
    """

    folder: Path
    base: str
    suffix: int

    @property
    def path(self) -> Path:
        return self.folder / f"{self.base}{self.suffix:04d}.ibw"


class Harvest:
    """The measurement that is running or has just ended, and the results.

    Args:
        kept: JSON-able, and lasts.
    """

    def __init__(self, kept: dict[str, Any], log: logging.Logger) -> None:
        self._kept = kept
        self._log = log
        self._read: dict[str, Content] = {}
        self.broken_off = False
        """Whether what came last was a part of an image; until `results` is called again."""
        for key, empty in (("running", None), ("ended", None), ("results", []), ("taken", 0)):
            kept.setdefault(key, empty)

    @property
    def what(self) -> str:
        """Which measurement is running: `SCAN`, the kind of a spectrum, or nothing."""
        running = self._kept["running"]
        return running["what"] if running else ""

    def begin(self, what: str, target: Target, taken: Mapping[str, Any]) -> None:
        """A measurement begins.

        Args:
            taken: "frame" (x, y, width, height, angle) of a scan, "position" of a spectrum, None if it is not known.
        """
        self._kept["running"] = {
            "what": what,
            "folder": str(target.folder),
            "base": target.base,
            "suffix": target.suffix,
            "there_ns": _modified_ns(target.path),
            "newest_ns": max(map(_modified_ns, _files(target.folder)), default=0),
            **taken,
        }
        self._kept["ended"] = None

    def forget(self) -> None:
        """What is running or has ended was broken off: nothing comes of it."""
        self._kept["running"] = self._kept["ended"] = None

    def end(self, now_ns: int) -> None:
        """It has ended."""
        running = self._kept["running"]
        if running is not None:
            self._kept["running"], self._kept["ended"] = None, {**running, "end_ns": now_ns}

    def has_file(self) -> bool:
        """Whether the file of what is running has appeared."""
        running = self._kept["running"]
        return running is not None and _file(running) is not None

    def results(self, now_ns: int) -> list[str]:
        """The last results, oldest first."""
        self.broken_off = False
        ended, running = self._kept["ended"], self._kept["running"]
        if ended is not None and self._take(ended):
            self._kept["ended"] = None
        elif running is not None and running["what"] == SCAN and self._take({**running, "end_ns": now_ns}):
            # it goes on with the next image
            running["suffix"] += 1
            running["there_ns"] = _modified_ns(_target(running).path)
            running["newest_ns"] = max(map(_modified_ns, _files(Path(running["folder"]))), default=0)
        return [entry["result"] for entry in self._kept["results"]]

    def load(self, result: str) -> Content:
        """Read one of the results, with the parameters that it was taken with.

        Raises:
            FileError: it is no result any more, or its file is another one by now.
        """
        entry = next((entry for entry in self._kept["results"] if entry["result"] == result), None)
        if entry is None:
            raise FileError("is not among the last results", where=result)
        if result not in self._read:
            path = Path(entry["file"])
            if _modified_ns(path) != entry["modified_ns"]:
                raise FileError("was overwritten or has gone", where=str(path))
            self._read = {result: _content(path, entry)}
        return self._read[result]

    def _take(self, measured: Mapping[str, Any]) -> bool:
        """Whether all is known of what has ended: its file is a result, or no image."""
        path = _file(measured)
        if path is None:
            return False
        modified_ns = _modified_ns(path)
        try:
            content = _content(path, measured)
        except (AfspmError, OSError):
            return False  # not yet whole
        if _modified_ns(path) != modified_ns:
            return False
        if any(_unfinished(one) for one in content):
            self.broken_off = True
            return True
        self._warn_of_frame(path, content[0], measured)
        self._kept["taken"] += 1
        # numbered, since Asylum may overwrite a file by one of the same name
        result = f"{self._kept['taken']}: {path.name}"
        entry: dict[str, Any] = {"result": result, "file": str(path), "modified_ns": modified_ns}
        entry |= {key: measured[key] for key in ("what", "frame", "position", "end_ns") if key in measured}
        self._kept["results"] = [*self._kept["results"], entry][-_LISTED:]
        self._read = {result: content}
        return True

    def _warn_of_frame(self, path: Path, one: Scan | Spectrum, measured: Mapping[str, Any]) -> None:
        """If Asylum scanned another frame than was set: the file is right then."""
        if isinstance(one, Scan) and one.region != _frame(measured):
            told = f"{path.name} says a frame of {one.region}, and not of {_frame(measured)} as was in force"
            self._log.warning("%s: it is delivered as the file says", told)


def _target(measured: Mapping[str, Any]) -> Target:
    return Target(Path(measured["folder"]), measured["base"], measured["suffix"])


def _file(measured: Mapping[str, Any]) -> Path | None:
    """The file of a measurement, if it is there: the one that was to come, or a new one of another name."""
    expected = _target(measured).path
    if _modified_ns(expected) not in (0, measured["there_ns"]):
        return expected
    new = [(_modified_ns(path), path) for path in _files(expected.parent)]
    new = [(time_ns, path) for time_ns, path in new if time_ns > measured["newest_ns"]]
    return max(new)[1] if new else None


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.glob("*.ibw") if _NUMBERED.fullmatch(path.name)] if folder.is_dir() else []


def _modified_ns(path: Path) -> int:
    """0: it is not there."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def _content(path: Path, measured: Mapping[str, Any]) -> Content:
    found = read(path)
    content: Sequence[Scan | Spectrum] = found.scans if measured["what"] == SCAN else found.spectra
    if not content:
        raise FileError(f"holds no {measured['what']}", where=str(path))
    return [_as_taken(one, measured) for one in content]


def _as_taken(one: Scan | Spectrum, measured: Mapping[str, Any]) -> Scan | Spectrum:
    """With the frame or position that was set, of which the note has five digits, and our time."""
    time_ns = measured["end_ns"]
    if isinstance(one, Scan):
        region = _frame(measured)
        return replace(one, region=region if _same(region, one.region) else one.region, time_ns=time_ns)
    place = measured["position"]
    position_m = one.position_m if place is None else (place[0], place[1])
    return replace(one, kind=measured["what"], position_m=position_m, time_ns=time_ns)


def _frame(measured: Mapping[str, Any]) -> Region:
    x, y, width, height, angle = measured["frame"]
    return Region((x, y), (width, height), angle)


def _same(a: Region, b: Region) -> bool:
    scale_m = _PRINTED * max(*map(abs, a.center_m), *a.size_m)
    close = np.allclose([*a.center_m, *a.size_m], [*b.center_m, *b.size_m], rtol=0.0, atol=scale_m)
    return bool(close and abs(math.remainder(a.angle_rad - b.angle_rad, math.tau)) <= _PRINTED * math.tau)


def _unfinished(one: Scan | Spectrum) -> bool:
    """Whether an image has lines without any value: it was saved when the scan was broken off."""
    return isinstance(one, Scan) and bool(np.isnan(one.values).all(axis=1).any())
