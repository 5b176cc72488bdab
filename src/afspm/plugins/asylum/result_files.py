"""Results of measurements: the files that Asylum saves, once complete."""

from __future__ import annotations

import logging
import math
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Final

from afspm.basics import ConfigError, PlainMapping
from afspm.driver import Entry, FilePrecision, FolderFiles, modified_ns

_NUMBERED: Final = re.compile(r".*\d{4}\.ibw", re.IGNORECASE)


@dataclass(frozen=True)
class Target:
    """The file that Asylum will save next: `<base><suffix as four digits>.ibw`.

    Attributes:
        folder: path on this computer.
    """

    folder: Path
    base: str
    suffix: int

    @property
    def path(self) -> Path:
        return self.folder / f"{self.base}{self.suffix:04d}.ibw"


class AsylumFiles(FolderFiles):
    """The running or just ended measurement, and the results with their files."""

    precision = FilePrecision(part=1e-4, angle_rad=1e-4 * math.tau)
    """Numbers in a note have five digits."""

    def __init__(self, kept: Entry, log: logging.Logger) -> None:
        super().__init__(kept, log)
        kept.setdefault("taken", 0)

    def begin_at(self, what: str, target: Target, taken: PlainMapping) -> None:
        """Register the start of a measurement whose file is expected at `target`.

        Args:
            taken: the place of the measurement: "frame" of a scan, "position" of a force curve.
        """
        place = {"base": target.base, "suffix": target.suffix, "there_ns": modified_ns(target.path)}
        self.begin(what, target.folder, {**place, **taken})

    def result_name(self, path: Path) -> str:
        """Return a unique name, numbered, since a later file may have the same name."""
        self._kept["taken"] += 1
        return f"{self._kept['taken']}: {path.name}"

    def _has_none_yet(self, running: Entry) -> None:
        if modified_ns(_target(running).path) not in (0, running["there_ns"]):
            # Asylum had not saved the scan before, and not counted on, when this scan began
            running["suffix"] += 1
            running["there_ns"] = modified_ns(_target(running).path)
        super()._has_none_yet(running)

    def _goes_on(self, running: Entry) -> None:
        running["suffix"] += 1
        running["there_ns"] = modified_ns(_target(running).path)
        super()._goes_on(running)

    def _file(self, measured: Entry) -> Path | None:
        # A person may change the base name at the panel during a measurement: then any new file counts.
        expected = _target(measured).path
        if modified_ns(expected) not in (0, measured["there_ns"]):
            return expected
        return super()._file(measured)

    def _files(self, folder: Path) -> list[Path]:
        return _numbered(folder)


def free_suffix(folder: Path, base: str) -> int:
    """Return the lowest number above all numbers of files with this base name."""
    named = re.compile(rf"{re.escape(base)}(\d{{4,}})\.ibw", re.IGNORECASE)
    taken = [int(match[1]) for path in _numbered(folder) if (match := named.fullmatch(path.name))]
    return max(taken, default=-1) + 1


def local(igor_path: str, folders: Mapping[str, str]) -> Path:
    """Convert an Igor path, "C:Users:Me:Data:", to a path on this computer.

    Args:
        folders: prefixes of Igor paths with their local folders; the longest matching prefix counts.

    Raises:
        ConfigError: no prefix matches, and the path is not on this computer.
    """
    parts = _parts(igor_path)
    fitting = [(start, here) for start, here in folders.items() if _begins(parts, _parts(start))]
    if fitting:
        start, here = max(fitting, key=lambda one: len(_parts(one[0])))
        return Path(here, *parts[len(_parts(start)) :])
    if igor_path.startswith(":"):  # an emulator on a system without drive letters
        return Path("/", *parts)
    if sys.platform != "win32" or len(parts[0]) != 1:
        hint = f'folders = {{ "{igor_path}" = "/where/it/is/mounted" }}'
        raise ConfigError(f"Asylum saves to {igor_path!r}, which is not on this computer", where="folders", hint=hint)
    return Path(str(PureWindowsPath(f"{parts[0]}:/", *parts[1:])))


def _begins(parts: list[str], start: list[str]) -> bool:
    # Windows ignores the case of folder names.
    return [part.casefold() for part in parts[: len(start)]] == [part.casefold() for part in start]


def _parts(igor_path: str) -> list[str]:
    # Igor writes "C:Users:Me:"; a user may write `folders` in the form of Windows.
    return [part for part in igor_path.replace("\\", ":").split(":") if part]


def _target(measured: Entry) -> Target:
    return Target(Path(measured["folder"]), measured["base"], measured["suffix"])


def _numbered(folder: Path) -> list[Path]:
    return [path for path in folder.glob("*.ibw") if _NUMBERED.fullmatch(path.name)] if folder.is_dir() else []
