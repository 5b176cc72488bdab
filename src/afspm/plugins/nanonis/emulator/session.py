"""The session folder: its path on the controller's computer, file names, and writing with faults."""

from __future__ import annotations

import logging
from pathlib import Path, PureWindowsPath
from typing import Final

from afspm.basics import InvalidValue
from afspm.emulation import ControllerClock, Faults

_NO_FILE_NAME: Final = frozenset('\\/:*?"<>|') | {chr(number) for number in range(32)}
_LONGEST_NAME: Final = 200


class SessionFolder:
    """The folder of scans and spectra.

    Attributes:
        folder: local path.
        path: path on the controller's computer, as clients see it.
    """

    def __init__(
        self, folder: Path, path: str, faults: Faults, file_clock: ControllerClock, log: logging.Logger
    ) -> None:
        self.folder, self.path = folder, path or str(folder)
        self._root, self._root_path = self.folder, self.path
        self._faults, self._file_clock, self._log = faults, file_clock, log
        self._numbers: dict[tuple[str, str], int] = {}
        self._late: list[tuple[float, Path, bytes]] = []

    def change(self, path: str) -> None:
        """Change to the initial folder or a folder in it. Raises InvalidValue: another folder, or an invalid name."""
        root = self._root_path.rstrip("\\/")
        if path.rstrip("\\/") != root and not path.startswith((f"{root}/", f"{root}\\")):
            raise InvalidValue(f"Session Path not valid: {path!r}", hint=f"{root}, or a folder in it")
        folder = self._root
        for name in filter(None, path[len(root) :].replace("\\", "/").strip("/").split("/")):
            folder = folder / checked_name(name)
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.path = folder, path

    def next_name(self, base: str, digits: int, suffix: str) -> str:
        """Return the next file name with a free number."""
        while True:
            number = self._numbers[base, suffix] = self._numbers.get((base, suffix), 0) + 1
            name = f"{base}{number:0{digits}d}{suffix}"
            if not (self.folder / name).exists():
                return name

    def path_of(self, name: str) -> str:
        """Return a file's path on the controller's computer."""
        windows = "\\" in self.path
        return str(PureWindowsPath(self.path) / name) if windows else str(Path(self.path) / name)

    def save(self, name: str, content: bytes, now_s: float) -> bool:
        """Write a file, subject to faults; return True if the controller reports its path."""
        path = self.folder / name
        if self._faults.strikes("file-missing", now_s):
            return True
        late, half = self._faults.strikes("file-late", now_s), self._faults.strikes("half-file", now_s)
        fault = late or half
        if fault is not None:
            self._late.append((now_s + fault.duration_s, path, content))
        return late is not None or self._write(path, content[: len(content) // 2] if half else content)

    def read(self, path: str) -> bytes:
        """Read a file by its path on the controller's computer.

        Raises:
            InvalidValue: the path is not in the session folder. OSError: the file can't be read.
        """
        name = PureWindowsPath(path).name
        if path != self.path_of(name):
            raise InvalidValue(f"{path!r} is not in the session folder", hint=self.path)
        return (self.folder / checked_name(name)).read_bytes()

    def write_late(self, now_s: float) -> float | None:
        """Write the late files that are due; return the time of the next late file, None if there is none."""
        due = [late for late in self._late if late[0] <= now_s]
        self._late = [late for late in self._late if late[0] > now_s]
        for _, path, content in due:
            self._write(path, content)
        return min((late[0] for late in self._late), default=None)

    def _write(self, path: Path, content: bytes) -> bool:
        try:
            path.write_bytes(content)
            self._file_clock.date(path)
        except OSError as error:
            self._log.warning("%s can't be written: %s", path, error)
            return False
        return True


def checked_name(text: str) -> str:
    """Return a part of a file name unchanged. Raises InvalidValue: Windows, the controller's system, forbids it."""
    if not _NO_FILE_NAME.isdisjoint(text) or len(text) > _LONGEST_NAME or text.strip(". ") != text:
        raise InvalidValue(f"{text!r} can't be part of a file's name")
    return text
