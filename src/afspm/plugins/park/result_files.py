"""SmartScan's files: a TIFF for each channel and direction of a scan, and one TIFF for a curve."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Final

from afspm.basics import Plain
from afspm.driver import Entry, FilePrecision, FolderFiles, modified_ns
from afspm.plugins.park.scan_files import is_foreign

SETTLE_S: Final = 1.0
"""Real time without a new file before a scan counts as complete: the number of its files is unknown."""


class ParkFiles(FolderFiles):
    """The files of the running or just ended measurement, and the results.

    Args:
        monotonic_s: returns real time.
    """

    pattern = "**/*.tif*"
    precision = FilePrecision(part=1e-9, angle_rad=1e-9)

    def __init__(self, kept: Plain, log: logging.Logger, monotonic_s: Callable[[], float]) -> None:
        super().__init__(kept, log)
        self._monotonic_s = monotonic_s
        self._seen: tuple[list[tuple[str, int]], float] = ([], 0.0)

    def files_of(self, measured: Entry) -> list[tuple[str, int]]:
        """Return all new files of SmartScan once no file has appeared or changed for `SETTLE_S`; until then none."""
        listed = [(str(path), modified_ns(path)) for path in self._files(Path(measured["folder"]))]
        # By time and not by name: SmartScan's names can be chosen freely.
        files = sorted(one for one in listed if one[1] > measured["newest_ns"])
        now_s = self._monotonic_s()
        if files != self._seen[0]:
            self._seen = (files, now_s)
        settled = now_s - self._seen[1] >= SETTLE_S
        # pictures of other programs are left out: a screenshot would otherwise count as a part of the scan
        return [one for one in files if not is_foreign(Path(one[0]))] if settled else []
