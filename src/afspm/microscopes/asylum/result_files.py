"""The results of measurements: the file that Asylum saves of it, once it is whole."""

from __future__ import annotations

import logging
import math
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Final

from afspm.errors import AfspmError, ConfigError, FileError
from afspm.model import Scan, Spectrum
from afspm.translator.result_files import (
    SCAN,
    Content,
    Entry,
    FilePrecision,
    ResultFiles,
    as_region,
    lines_missing,
    modified_ns,
    newest,
    read_result,
)

_PRECISION: Final = FilePrecision(part=1e-4, angle_rad=1e-4 * math.tau)
"""A note prints five digits of a number."""
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

    def __init__(self, kept: Entry, log: logging.Logger) -> None:
        super().__init__(kept, log)
        kept.setdefault("taken", 0)

    def begin(self, what: str, target: Target, taken: Mapping[str, object]) -> None:
        """A measurement begins.

        Args:
            taken: "frame" of a scan, "position" of a spectrum, None if it is not known.
        """
        there = {"there_ns": modified_ns(target.path), "newest_ns": newest(_files(target.folder))[0]}
        place = {"folder": str(target.folder), "base": target.base, "suffix": target.suffix}
        self._begins(what, {**place, **there, **taken})

    def end(self, now_ns: int) -> None:
        """It has ended."""
        if self._kept["running"] is not None:
            self._ends({"end_ns": now_ns})

    def has_file(self) -> bool:
        """Return True if the file of what is running has appeared."""
        running = self._kept["running"]
        return running is not None and _file(running) is not None

    def results(self, now_ns: int) -> list[str]:
        """Return the last results, oldest first."""
        self.broken_off = False
        ended, running = self._kept["ended"], self._kept["running"]
        if ended is not None and self._take(ended):
            self._kept["ended"] = None
        elif running is not None and running["what"] == SCAN and self._take({**running, "end_ns": now_ns}):
            # it goes on with the next image
            running["suffix"] += 1
            running["there_ns"] = modified_ns(_target(running).path)
            running["newest_ns"] = newest(_files(Path(running["folder"])))[0]
        return self._listed()

    def read(self, entry: Entry) -> Content:
        path = Path(entry["file"])
        if modified_ns(path) != entry["modified_ns"]:
            raise FileError("was overwritten or deleted", where=str(path))
        return _content(path, entry)

    def _take(self, measured: Entry) -> bool:
        """Return True if all is known of what has ended: its file is a result, or no image."""
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
        if lines_missing(content):  # it was saved when the scan was broken off
            self.broken_off = True
            return True
        self._warn_of_frame(path, content[0], measured)
        self._kept["taken"] += 1
        # numbered, since Asylum may overwrite a file by one of the same name
        facts = {"file": str(path), "modified_ns": written_ns}
        self._add(f"{self._kept['taken']}: {path.name}", measured, facts, content)
        return True

    def _warn_of_frame(self, path: Path, one: Scan | Spectrum, measured: Entry) -> None:
        """Warn if Asylum scanned another frame than was set: the file is right then."""
        if isinstance(one, Scan) and one.region != (wanted := as_region(measured["frame"])):
            told = f"{path.name} holds a frame of {one.region} instead of {wanted}, which was set"
            self._log.warning("%s; the scan is published as the file has it", told)


def free_suffix(folder: Path, base: str) -> int:
    """Return the first number that no file of this base name has, nor any that follows."""
    named = re.compile(rf"{re.escape(base)}(\d{{4,}})\.ibw", re.IGNORECASE)
    taken = [int(match[1]) for path in _files(folder) if (match := named.fullmatch(path.name))]
    return max(taken, default=-1) + 1


def local(igor_path: str, folders: Mapping[str, str]) -> Path:
    """A path of Igor's, "C:Users:Me:Data:", here.

    Args:
        folders: beginnings of such paths, and where those are from here; the longest that fits counts.

    Raises:
        ConfigError: it is on another computer, and nothing says where to see it from here.
    """
    parts = _parts(igor_path)
    fitting = [(start, here) for start, here in folders.items() if _begins(parts, _parts(start))]
    if fitting:
        start, here = max(fitting, key=lambda one: len(_parts(one[0])))
        return Path(here, *parts[len(_parts(start)) :])
    if igor_path.startswith(":"):  # a computer without drives
        return Path("/", *parts)
    if sys.platform != "win32" or len(parts[0]) != 1:
        hint = f'folders = {{ "{igor_path}" = "/where/it/is/mounted" }}'
        raise ConfigError(f"Asylum saves to {igor_path!r}, which is not on this computer", where="folders", hint=hint)
    return Path(str(PureWindowsPath(f"{parts[0]}:/", *parts[1:])))


def _begins(parts: list[str], start: list[str]) -> bool:
    """Windows does not tell upper from lower case."""
    return [part.casefold() for part in parts[: len(start)]] == [part.casefold() for part in start]


def _parts(igor_path: str) -> list[str]:
    """Also of a path as Windows writes it."""
    return [part for part in igor_path.replace("\\", ":").split(":") if part]


def _target(measured: Entry) -> Target:
    return Target(Path(measured["folder"]), measured["base"], measured["suffix"])


def _file(measured: Entry) -> Path | None:
    """Return the file of a measurement, if it is there: the one that was to come, or a new one of another name."""
    expected = _target(measured).path
    if modified_ns(expected) not in (0, measured["there_ns"]):
        return expected
    return newest(_files(expected.parent), measured["newest_ns"])[1]


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.glob("*.ibw") if _NUMBERED.fullmatch(path.name)] if folder.is_dir() else []


def _content(path: Path, measured: Entry) -> Content:
    found = read_result(path)
    content: Sequence[Scan | Spectrum] = found.scans if measured["what"] == SCAN else found.spectra
    if not content:
        raise FileError(f"holds no {measured['what']}", where=str(path))
    return [_PRECISION.as_set(one, measured) for one in content]
