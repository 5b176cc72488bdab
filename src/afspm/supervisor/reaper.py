"""The reaper: a process that waits for the supervisor's end, and kills processes left behind by a killed supervisor.

A child normally ends by itself at the end of its standard input. A child that can't notice that (a library holds
Python's lock), or that has children of its own, is killed from here some seconds later. Linux's parent-death signal
would leave no time to retract the tip, and macOS has none.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

if __name__ != "__main__":  # as a script it starts without site packages, to be ready fast
    from afspm.transport.process.parent import END_WITHIN_S, TIP_WITHIN_S

GRACE_S = 1.0
"""Real time added to the time that a process has to end by itself."""
CLOSED_WITHIN_S = 1.0
"""Real time that the reaper has to end after its input is closed."""


class Reaper:
    """The supervisor's connection to the reaper process, which is sent the running process groups.

    Windows has a job object instead, see `process`.
    """

    def __init__(self) -> None:
        self._popen: subprocess.Popen[bytes] | None = None

    def begin(self) -> None:
        """Start the reaper process. If that fails (too many processes), the run goes on without a reaper."""
        if sys.platform == "win32":
            return
        with contextlib.suppress(OSError):
            self._popen = subprocess.Popen(
                (sys.executable, "-I", "-S", str(Path(__file__))),
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # closing the terminal must not end the reaper first
            )

    def watch(self, pid: int, *, has_tip: bool) -> None:
        """Register a process group to kill after the supervisor's end, with a longer delay if it may retract a tip."""
        self._send(f"{pid} {(TIP_WITHIN_S if has_tip else END_WITHIN_S) + GRACE_S}")

    def forget(self, pid: int) -> None:
        """Unregister an ended process group: the system may reuse its number."""
        self._send(f"{pid} 0")

    def close(self) -> None:
        """End the reaper process; groups still registered must have been killed."""
        if self._popen is not None and self._popen.stdin is not None:
            with contextlib.suppress(OSError):
                self._popen.stdin.close()
            try:
                self._popen.wait(CLOSED_WITHIN_S)
            except subprocess.TimeoutExpired:  # on a busy computer; the supervisor has killed its processes itself
                self._popen.kill()
                self._popen.wait()

    def _send(self, line: str) -> None:
        if self._popen is not None and self._popen.stdin is not None:
            with contextlib.suppress(OSError, ValueError):
                self._popen.stdin.write(line.encode() + b"\n")
                self._popen.stdin.flush()


def main() -> None:
    """Wait for the end of standard input, then kill each registered group once its time is up."""
    assert sys.platform != "win32"
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    left_s: dict[int, float] = {}
    for line in sys.stdin.buffer:
        pid, within_s = line.split()
        left_s[int(pid)] = float(within_s)
    passed_s = 0.0
    for within_s, pid in sorted((within_s, pid) for pid, within_s in left_s.items() if within_s):
        signal.setitimer(signal.ITIMER_REAL, max(within_s - passed_s, 1e-3))
        signal.sigwait({signal.SIGALRM})
        passed_s = within_s
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(pid, signal.SIGKILL)


if __name__ == "__main__":
    main()
