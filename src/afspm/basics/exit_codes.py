"""Exit codes, by which a process tells its supervisor why it ends."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of our processes. Every other code, and every signal, is a crash: restart it."""

    DONE = 0
    """Finished on purpose: there is nothing more to do."""
    CRASHED = 1
    """An exception nobody handled; its traceback is in the log."""
    CONFIG = 78
    """The settings can't work: a restart would fail the same way."""
    ENDED = 80
    """The experiment ended (KILL)."""
    OWN_FAULT = 82
    """An exception of the component's own code, told in `<name>.fault.json`: restart it unless it makes no progress."""
    ORPHAN = 81
    """The parent went away, or asked us to stop by closing our standard input."""
