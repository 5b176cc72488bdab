"""The results of measurements: the file that Asylum saves of it, once it is whole."""

from __future__ import annotations

import logging
import math
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Final

from afspm.basics.errors import ConfigError
from afspm.basics.plain_data import PlainMapping
from afspm.model import Scan, Spectrum
from afspm.translator.folder_files import FolderFiles
from afspm.translator.result_files import Entry, FilePrecision, as_region, modified_ns

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


class AsylumFiles(FolderFiles):
    """The measurement that is running or has just ended, and the results."""

    precision = FilePrecision(part=1e-4, angle_rad=1e-4 * math.tau)
    """A note prints five digits of a number."""

    def __init__(self, kept: Entry, log: logging.Logger) -> None:
        super().__init__(kept, log)
        kept.setdefault("taken", 0)

    def begin_at(self, what: str, target: Target, taken: PlainMapping) -> None:
        """A measurement begins, which is to be saved as a target."""
        place = {"base": target.base, "suffix": target.suffix, "there_ns": modified_ns(target.path)}
        self.begin(what, target.folder, {**place, **taken})

    def result_name(self, path: Path) -> str:
        """Return a name with a number, since Asylum may overwrite a file by one of the same name."""
        self._kept["taken"] += 1
        return f"{self._kept['taken']}: {path.name}"

    def check(self, path: Path, one: Scan | Spectrum, measured: Entry) -> None:
        """Warn if Asylum scanned another frame than was set: the file is right then."""
        if isinstance(one, Scan) and one.region != (wanted := as_region(measured["frame"])):
            told = f"{path.name} holds a frame of {one.region} instead of {wanted}, which was set"
            self._log.warning("%s; the scan is published as the file has it", told)

    def _goes_on(self, running: Entry) -> None:
        running["suffix"] += 1
        running["there_ns"] = modified_ns(_target(running).path)
        super()._goes_on(running)

    def _file(self, measured: Entry) -> Path | None:
        """Return the file of a measurement, if it is there: the one that was to come, or a new one of another name."""
        expected = _target(measured).path
        if modified_ns(expected) not in (0, measured["there_ns"]):
            return expected
        return super()._file(measured)

    def _files(self, folder: Path) -> list[Path]:
        return _numbered(folder)


def free_suffix(folder: Path, base: str) -> int:
    """Return the first number that no file of this base name has, nor any that follows."""
    named = re.compile(rf"{re.escape(base)}(\d{{4,}})\.ibw", re.IGNORECASE)
    taken = [int(match[1]) for path in _numbered(folder) if (match := named.fullmatch(path.name))]
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


def _numbered(folder: Path) -> list[Path]:
    return [path for path in folder.glob("*.ibw") if _NUMBERED.fullmatch(path.name)] if folder.is_dir() else []
