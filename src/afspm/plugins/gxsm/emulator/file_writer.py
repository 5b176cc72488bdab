"""Writing of GXSM's files, which have numbers and appear late, one after the other, and in two parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from afspm.emulation import ControllerClock, Faults

FAULT_KINDS: Final[Mapping[str, str]] = {
    "file-late": "a file appears only after the duration",
    "half-file": "a file is half written, and whole only after the duration",
    "file-missing": "a file is never written",
}
# Measured: files appear 0.1 s after the scanning bit drops, one by one, and are seen half written.
_FIRST_S, _APART_S, _HALF_S = 0.1, 0.05, 0.02


@dataclass(frozen=True)
class _Write:
    at_s: float
    path: Path
    content: bytes


class GxsmFileWriter:
    """A writer of files to one folder.

    Attributes:
        folder: folder of scans and spectra, which a person may change at the panel.
        done_s: time at which all files are written, without faults.
    """

    def __init__(self, folder: Path, faults: Faults, file_clock: ControllerClock) -> None:
        self.folder = folder
        self._file_clock = file_clock
        self._faults = faults
        self._writes: list[_Write] = []
        self.counter = 1
        """Number of the next scan: 1 at each start of GXSM, even if files with this number exist."""
        self.done_s = 0.0

    def next_number(self) -> int:
        """Return the number of a starting scan, which is used up even if the scan is never saved."""
        self.counter += 1
        return self.counter - 1

    def named(self, ending: str, counter: int) -> Path:
        """Return the path of a scan's file."""
        return self.folder / f"scan{counter:03d}-{ending}"

    def free(self, ending: str, number: int) -> Path:
        """Return the path with the channel's first free number from `number` on, among existing and due files."""
        counter = number
        while (path := self.named(ending, counter)).exists() or any(write.path == path for write in self._writes):
            counter += 1
        return path

    def counted(self, files: list[Path]) -> None:
        """Raise the counter above the numbers of saved files."""
        numbers = (int(file.name.removeprefix("scan").partition("-")[0]) for file in files)
        self.counter = max(self.counter, *(number + 1 for number in numbers))

    def write(self, contents: list[tuple[Path, bytes]], now_s: float) -> None:
        """Schedule the writing of files in reverse order, as GXSM does."""
        for k, (path, content) in enumerate(reversed(contents)):
            at_s = now_s + _FIRST_S + k * _APART_S
            self.done_s = at_s + _HALF_S
            if self._faults.strikes("file-missing", now_s):
                continue
            late, half = self._faults.strikes("file-late", now_s), self._faults.strikes("half-file", now_s)
            at_s += late.duration_s if late else 0.0
            self._writes.append(_Write(at_s, path, content[: len(content) // 2]))
            self._writes.append(_Write(at_s + (half.duration_s if half else _HALF_S), path, content))

    def advance(self, now_s: float) -> float | None:
        """Write the files that are due; return the time of the next write, None if there is none."""
        due = sorted((write for write in self._writes if write.at_s <= now_s), key=lambda write: write.at_s)
        self._writes = [write for write in self._writes if write.at_s > now_s]
        for write in due:
            write.path.write_bytes(write.content)
            self._file_clock.date(write.path)
        return min((write.at_s for write in self._writes), default=None)
