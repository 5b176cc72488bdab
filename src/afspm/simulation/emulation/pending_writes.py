"""Files that an emulated controller writes late, and in two parts."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

from afspm.simulation.emulation.controller_clock import ControllerClock


@dataclass(frozen=True)
class FilePart:
    """A part of a file, due at a time (experiment s)."""

    at_s: float
    path: Path
    content: bytes
    begins: bool = True


class PendingWrites:
    """The file parts to be written."""

    def __init__(self, file_clock: ControllerClock) -> None:
        self._file_clock = file_clock
        self._writes: list[FilePart] = []

    def save(self, path: Path, content: bytes, at_s: float, rest_at_s: float) -> None:
        """Schedule the first half of a file at one time and the second half at another."""
        half = len(content) // 2
        self._writes += [FilePart(at_s, path, content[:half]), FilePart(rest_at_s, path, content[half:], begins=False)]
        self._writes.sort(key=lambda write: write.at_s)

    def advance(self, now_s: float, *, there: bool) -> float | None:
        """Write all due parts, or drop them if the drive is missing (`there` is False).

        Returns:
            the time of the next part; None without one.
        """
        while self._writes and self._writes[0].at_s <= now_s:
            write = self._writes.pop(0)
            with contextlib.suppress(OSError):
                if there:
                    write.path.parent.mkdir(parents=True, exist_ok=True)
                    with write.path.open("wb" if write.begins else "ab") as file:
                        file.write(write.content)
                    self._file_clock.date(write.path)
        return self._writes[0].at_s if self._writes else None
