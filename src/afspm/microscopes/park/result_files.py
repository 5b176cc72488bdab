"""SmartScan's files: of one scan, a TIFF for each channel and direction."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Final

from afspm.errors import AfspmError, FileError
from afspm.plain_data import Plain
from afspm.translator.folder_files import FolderFiles
from afspm.translator.result_files import Content, Entry, FilePrecision, lines_missing, modified_ns, read_result

SETTLE_S: Final = 1.0
"""So long, in real time, no other file may have come before a scan's are taken: how many there will be is not known."""


class ParkFiles(FolderFiles):
    """The files of the scan that is running or has just ended, and the results.

    Args:
        monotonic_s: real time.
    """

    pattern = "**/*.tif*"
    precision = FilePrecision(part=1e-9, angle_rad=1e-9)

    def __init__(self, kept: Plain, log: logging.Logger, monotonic_s: Callable[[], float]) -> None:
        super().__init__(kept, log)
        self._monotonic_s = monotonic_s
        self._seen: tuple[list[tuple[str, int]], float] = ([], 0.0)

    def read(self, entry: Entry) -> Content:
        files = [(Path(name), written_ns) for name, written_ns in entry["files"]]
        for path, written_ns in files:
            if modified_ns(path) != written_ns:
                raise FileError("was overwritten or deleted", where=str(path))
        return self._scans_of([path for path, _ in files], entry)

    def _take(self, measured: Entry) -> bool:
        """Take the files as a result once no more come and all are whole."""
        listed = [(str(path), modified_ns(path)) for path in self._files(Path(measured["folder"]))]
        files = sorted(one for one in listed if one[1] > measured["newest_ns"])
        now_s = self._monotonic_s()
        if files != self._seen[0]:
            self._seen = (files, now_s)
        if not files or now_s - self._seen[1] < SETTLE_S:
            return False
        try:
            content = self._scans_of([Path(name) for name, _ in files], measured)
        except (AfspmError, OSError):
            return False  # not yet whole
        if lines_missing(content):  # it was saved when the scan was broken off
            self.broken_off = True
        else:
            self._add(files[0][0], measured, {"files": [list(one) for one in files]}, content)
        return True

    def _scans_of(self, paths: list[Path], measured: Entry) -> Content:
        return [self.precision.as_set(one, measured) for path in paths for one in read_result(path).scans]
