"""Differences of the operating systems for tests."""

from __future__ import annotations

import ctypes
import signal
import subprocess
import sys
from typing import Any, Final

import psutil
import pytest
from deadlines import DEADLINE_S

WINDOWS: Final = sys.platform == "win32"
WINE: Final = sys.platform == "win32" and hasattr(ctypes.WinDLL("ntdll"), "wine_get_version")
"""A Windows Python runs the tests, but Windows' own functions are those of Wine."""
PATIENCE: Final = 4.0 if WINE else 1.0
"""Factor of timeouts under Wine, where the start of a process takes seconds."""
KILLED: Final = 1 if WINDOWS else -9
"""The exit code of a process after Popen.kill."""
KILLED_FROM_OUTSIDE: Final = 15 if WINDOWS else -9
"""The exit code of a process after `kill`."""
HAS_CONSOLE: Final = sys.platform != "win32" or bool(ctypes.WinDLL("kernel32").GetConsoleWindow())

can_interrupt = pytest.mark.skipif(not HAS_CONSOLE, reason="without a console nobody can press Ctrl-C in it")


def not_on_wine(reason: str) -> pytest.MarkDecorator:
    """Skip a test under Wine, for a reason that does not hold on a real Windows."""
    return pytest.mark.skipif(WINE, reason=f"Wine: {reason}")


def kill(pid: int) -> None:
    """Kill a process from outside, without any chance to react."""
    psutil.Process(pid).kill()


def freeze(pid: int) -> None:
    """Suspend a process, with its connections open."""
    psutil.Process(pid).suspend()


def interrupt(process: subprocess.Popen[Any]) -> None:
    """Press Ctrl-C for a process that shares this console.

    On Windows every process of the console receives it, so this process ignores it from now on.
    """
    if sys.platform == "win32":
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        assert ctypes.WinDLL("kernel32").GenerateConsoleCtrlEvent(signal.CTRL_C_EVENT, 0)
    else:
        process.send_signal(signal.SIGINT)


def wait_until_gone(pids: dict[str, int]) -> None:
    """Wait for the end of processes started by others; fail with the names of the remaining ones."""
    processes = {psutil.Process(pid): name for name, pid in pids.items() if psutil.pid_exists(pid)}
    _, alive = psutil.wait_procs(processes, DEADLINE_S)
    assert not alive, f"{[processes[process] for process in alive]} live on"
