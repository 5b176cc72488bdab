"""`ControllerClock`: the clock of the controller's computer, whose times stand in the files of the maker's program."""

from __future__ import annotations

import math
import os
from pathlib import Path


class ControllerClock:
    """A clock that may differ from the experiment's clock, and may be set at any time.

    Only the times that the maker's program writes come from this clock. All other times of an emulated controller are
    experiment time.

    Args:
        off_s: lead of the clock in seconds; negative: the clock is behind.
        dates_files: True if the files lie on a disk of the controller's computer, which then gives them their
            modification times. False: on the computer of afspm, or on a server.
    """

    def __init__(self, off_s: float = 0.0, *, dates_files: bool = False) -> None:
        self._offsets_s = [(-math.inf, off_s)]
        self._dates_files = dates_files

    @property
    def off_s(self) -> float:
        """The present lead of the clock in seconds."""
        return self._offsets_s[-1][1]

    def jump(self, by_s: float, now_s: float) -> None:
        """Set the clock ahead, or back by a negative time. Times shown before stay as they were."""
        self._offsets_s.append((now_s, self.off_s + by_s))

    def shown_s(self, time_s: float) -> float:
        """Return the time that the clock showed at an experiment time."""
        return time_s + next(off_s for since_s, off_s in reversed(self._offsets_s) if since_s <= time_s)

    def date(self, path: Path) -> None:
        """Correct the modification time of a file just written. Raises OSError."""
        if self._dates_files:
            modified_s = path.stat().st_mtime + self.off_s
            os.utime(path, (modified_s, modified_s))
