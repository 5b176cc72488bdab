"""Low priority for observing processes, so that processes of the experiment run first."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

STEPS_BACK = 10
"""POSIX niceness: with all cores busy the process gets about a tenth of a core, otherwise as much as it needs."""


def step_back() -> None:
    """Lower the priority of this process below the ordinary one, if the system allows it.

    Call it before threads are started: on Linux existing threads keep their priority, and heartbeats need theirs.
    """
    with suppress(OSError):
        if sys.platform == "win32":
            import psutil

            psutil.Process().nice(psutil.BELOW_NORMAL_PRIORITY_CLASS)
        else:
            os.nice(STEPS_BACK)
