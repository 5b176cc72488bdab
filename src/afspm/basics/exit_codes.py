"""Exit codes: the reason why a process ends, for its supervisor."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of afspm's processes. Any other code or a signal is a crash: the process is restarted."""

    DONE = 0
    """Finished on purpose: there is nothing more to do."""
    CRASHED = 1
    """An exception without a handler; its traceback is in the log."""
    # EX_CONFIG of sysexits.h
    CONFIG = 78
    """The settings can't work: a restart would fail the same way."""
    ENDED = 80
    """The experiment ended (KILL)."""
    OWN_FAULT = 82
    """An exception of the component's own code, written to `<name>.fault.json`: restarted while there is progress."""
    ORPHAN = 81
    """The parent is gone, or closed the standard input of this process to stop it."""
