"""What comes of a measurement: the file that Asylum saves of it, once it is whole."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from afspm.errors import AfspmError, FileError
from afspm.files import read
from afspm.model import Scan, Spectrum
from afspm.translator.result_files import SCAN, Content, ResultFiles, as_set, lines_missing, modified_ns, region_of

_PRINTED: Final = 1e-4
"""Relative: what a note has of a number, of which it prints five digits."""
_NUMBERED: Final = re.compile(r".*\d{4}\.ibw", re.IGNORECASE)


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


class AsylumFiles(ResultFiles):
    """The measurement that is running or has just ended, and the results."""

    def __init__(self, kept: dict[str, Any], log: logging.Logger) -> None:
        super().__init__(kept, log)
        self._read: dict[str, Content] = {}
        kept.setdefault("taken", 0)

    @property
    def frame(self) -> list[float] | None:
        """Of the scan that is running (`as_list`); None: none is."""
        running = self._kept["running"]
        return None if running is None else running.get("frame")

    def begin(self, what: str, target: Target, taken: Mapping[str, Any]) -> None:
        """A measurement begins.

        Args:
            taken: "frame" of a scan, "position" of a spectrum, None if it is not known.
        """
        there = {"there_ns": modified_ns(target.path), "newest_ns": _newest_ns(target.folder)}
        place = {"folder": str(target.folder), "base": target.base, "suffix": target.suffix}
        self._begins(what, {**place, **there, **taken})

    def end(self, now_ns: int) -> None:
        """It has ended."""
        if self._kept["running"] is not None:
            self._ends({"end_ns": now_ns})

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
            running["there_ns"] = modified_ns(_target(running).path)
            running["newest_ns"] = _newest_ns(Path(running["folder"]))
        return self._listed()

    def load(self, result: str) -> Content:
        """Read one of the results, with the parameters that it was taken with.

        Raises:
            FileError: it is no result any more, or its file is another one by now.
        """
        entry = self._found(result)
        if result not in self._read:
            path = Path(entry["file"])
            if modified_ns(path) != entry["modified_ns"]:
                raise FileError("was overwritten or has gone", where=str(path))
            self._read = {result: _content(path, entry)}
        return self._read[result]

    def _take(self, measured: Mapping[str, Any]) -> bool:
        """Whether all is known of what has ended: its file is a result, or no image."""
        path = _file(measured)
        if path is None:
            return False
        written_ns = modified_ns(path)
        try:
            content = _content(path, measured)
        except (AfspmError, OSError):
            return False  # not yet whole
        if modified_ns(path) != written_ns:
            return False
        if any(map(lines_missing, content)):  # it was saved when the scan was broken off
            self.broken_off = True
            return True
        self._warn_of_frame(path, content[0], measured)
        self._kept["taken"] += 1
        # numbered, since Asylum may overwrite a file by one of the same name
        result = f"{self._kept['taken']}: {path.name}"
        self._comes(result, measured, {"file": str(path), "modified_ns": written_ns})
        self._read = {result: content}
        return True

    def _warn_of_frame(self, path: Path, one: Scan | Spectrum, measured: Mapping[str, Any]) -> None:
        """If Asylum scanned another frame than was set: the file is right then."""
        if isinstance(one, Scan) and one.region != region_of(measured):
            told = f"{path.name} says a frame of {one.region}, and not of {region_of(measured)} as was in force"
            self._log.warning("%s: it is delivered as the file says", told)


def free_suffix(folder: Path, base: str) -> int:
    """The first number that no file of this base name has, nor any that follows."""
    named = re.compile(rf"{re.escape(base)}(\d{{4,}})\.ibw", re.IGNORECASE)
    taken = [int(match[1]) for path in _files(folder) if (match := named.fullmatch(path.name))]
    return max(taken, default=-1) + 1


def _target(measured: Mapping[str, Any]) -> Target:
    return Target(Path(measured["folder"]), measured["base"], measured["suffix"])


def _file(measured: Mapping[str, Any]) -> Path | None:
    """The file of a measurement, if it is there: the one that was to come, or a new one of another name."""
    expected = _target(measured).path
    if modified_ns(expected) not in (0, measured["there_ns"]):
        return expected
    new = [(modified_ns(path), path) for path in _files(expected.parent)]
    new = [(time_ns, path) for time_ns, path in new if time_ns > measured["newest_ns"]]
    return max(new)[1] if new else None


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.glob("*.ibw") if _NUMBERED.fullmatch(path.name)] if folder.is_dir() else []


def _newest_ns(folder: Path) -> int:
    return max(map(modified_ns, _files(folder)), default=0)


def _content(path: Path, measured: Mapping[str, Any]) -> Content:
    found = read(path)
    content: Sequence[Scan | Spectrum] = found.scans if measured["what"] == SCAN else found.spectra
    if not content:
        raise FileError(f"holds no {measured['what']}", where=str(path))
    return [_as_taken(one, measured) for one in content]


def _as_taken(one: Scan | Spectrum, measured: Mapping[str, Any]) -> Scan | Spectrum:
    """With the frame or position that was set, of which the note has five digits, and our time."""
    if isinstance(one, Scan):
        return as_set(one, measured, part=_PRINTED, angle_rad=_PRINTED * math.tau)
    place = measured["position"]
    position_m = one.position_m if place is None else (place[0], place[1])
    return replace(one, kind=measured["what"], position_m=position_m, time_ns=measured["end_ns"])
