"""Processes that only look on let those of the experiment go first."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

STEPS_BACK = 10
"""Of POSIX' niceness: leaves about a tenth of a core where all cores are busy, and as much as is wanted elsewhere."""


def step_back() -> None:
    """Take the processor only where no process of ordinary priority wants it, if the system allows that.

    Call it before threads are started: on Linux those that are there keep their priority, and heartbeats theirs.
    """
    with suppress(OSError):
        if sys.platform == "win32":
            import psutil

            psutil.Process().nice(psutil.BELOW_NORMAL_PRIORITY_CLASS)
        else:
            os.nice(STEPS_BACK)
