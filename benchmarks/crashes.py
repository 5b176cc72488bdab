"""Crashes of processes, which no test sends: the supervisor starts a crashed process again, and so hides its crash."""

from __future__ import annotations

import re
import signal
import subprocess
from pathlib import Path
from typing import Any

from afspm.supervisor.supervision.supervisor_events import describe_exit

_SIGNALS = ("SIGSEGV", "SIGABRT", "SIGBUS", "SIGILL", "SIGFPE")
_WINDOWS = (0xC0000005, 0xC00000FD, 0xC0000374, 0xC0000409)
_CODES = (*_WINDOWS, *(-getattr(signal, name) for name in _SIGNALS if hasattr(signal, name)))
_KILLED = describe_exit(-9)


class CrashWatch:
    """A finder of the crashes since its creation, and of kills if the system has run out of memory since then."""

    def __init__(self) -> None:
        self._before = _out_of_memory()

    def in_logs(self, folder: Path) -> list[str]:
        """Return the lines about crashes in the logs of all runs below `folder`."""
        return [
            line
            for file in folder.rglob("log.txt")
            if file.is_file()
            for line in file.read_text(encoding="utf-8", errors="replace").splitlines()
            if re.search(self._pattern, line)
        ]

    def of(self, process: subprocess.Popen[Any]) -> list[str]:
        """Return the crash of a process, if it has crashed."""
        how = "" if process.poll() is None else describe_exit(process.returncode)
        return [f"{process.args!r}: {how}"] if re.search(self._pattern, how) else []

    @property
    def _pattern(self) -> str:
        reasons = [describe_exit(code) for code in _CODES]
        if _out_of_memory() > self._before:
            reasons.append(_KILLED)
        return "|".join(map(re.escape, reasons))


def _out_of_memory() -> int:
    # the kills for lack of memory so far (Linux); elsewhere 0
    try:
        found = re.search(r"^oom_kill (\d+)", Path("/proc/vmstat").read_text(encoding="ascii"), re.MULTILINE)
    except OSError:
        return 0
    return int(found[1]) if found else 0
