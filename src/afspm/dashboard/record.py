"""Scans that are not in memory any more, out of the record of the run."""

from __future__ import annotations

import logging
from pathlib import Path

from afspm.dashboard.frames import Frame


class Archive:
    """Reads what the recorder has written into the run's folder. From any thread.

    Args:
        folder: of the run; None where it is on another computer.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._log = logging.getLogger("afspm.dashboard")

    def frame(self, time_ns: int, channel: str) -> Frame | None:
        """A finished channel by its time; None if it is not in the record, or there is none."""
        return None
