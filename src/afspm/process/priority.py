"""Processes that only look on let those of the experiment go first."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

STEPS_BACK = 10
"""Of POSIX' niceness: about a tenth of a core is left where all cores are busy with others, and as much as is wanted
where they are not."""


def step_back() -> None:
    """Take the processor only where no process of ordinary priority wants it.

    To be called before threads are started: on Linux those that are there keep their priority, and heartbeats theirs.
    Where it can't be done, nothing is: it is a courtesy.
    """
    if sys.platform == "win32":
        import ctypes

        below_normal = 0x4000  # BELOW_NORMAL_PRIORITY_CLASS
        with suppress(OSError):
            ctypes.windll.kernel32.SetPriorityClass(ctypes.windll.kernel32.GetCurrentProcess(), below_normal)
    else:
        with suppress(OSError):
            os.nice(STEPS_BACK)
