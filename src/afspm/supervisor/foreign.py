"""`python -m afspm.supervisor.foreign [--] command …` runs a component written in another language.

The command gets the launch line on its standard input. When the standard input of this process closes, or its parent
dies, the command's standard input is closed, too; a command that still runs is terminated, then killed. The exit code
is the command's, or `ExitCode.ORPHAN` if the command was ended by a signal from here.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading

from afspm.basics.exit_codes import ExitCode
from afspm.transport import leave_interrupts_to_parent
from afspm.transport.process.parent import call_at_signal, end_within, take_standard_input

ASK_S = 0.6  # from the end of standard input to SIGTERM
TERMINATE_S = 0.4  # from SIGTERM to SIGKILL
_CHUNK = 1 << 16


def main(arguments: list[str]) -> int:
    """Run the command; return its exit code (128 + n for signal n, as shells do), CONFIG if it can't start."""
    command = arguments[1:] if arguments[:1] == ["--"] else arguments
    if not command:
        sys.stderr.write("ERROR foreign: no command given\n")
        return ExitCode.CONFIG
    leave_interrupts_to_parent()
    # a signal that arrives before the command has started must still end it
    wished = threading.Event()
    call_at_signal(signal.SIGTERM, wished.set)
    try:
        # in our process group, so that a supervisor that kills us, or finds us killed, kills the command too
        child = subprocess.Popen(command, stdin=subprocess.PIPE)
    except (OSError, ValueError) as error:
        sys.stderr.write(f"ERROR {command[0]} can't be started: {error} (is it installed and executable?)\n")
        return ExitCode.CONFIG
    program = _ForeignProgram(child, take_standard_input())
    threading.Thread(target=program.end_when, args=(wished,), name="end", daemon=True).start()
    threading.Thread(target=program.pass_on, name="stdin", daemon=True).start()
    code = child.wait()
    program.sweep()
    # the supervisor must see that the command was stopped; on Windows its exit code alone does not show that
    if program.stopped and (code < 0 or sys.platform == "win32"):
        return ExitCode.ORPHAN
    return 128 - code if code < 0 else code


class _ForeignProgram:
    """A child program that gets this process's standard input, and is ended when that input ends.

    Attributes:
        stopped: whether the child was terminated or killed because it outlived its standard input.
    """

    def __init__(self, child: subprocess.Popen[bytes], pipe: int) -> None:
        self._child = child
        self._pipe = pipe
        self._parent = os.getppid()
        self.stopped = False

    def pass_on(self) -> None:
        """Copy standard input to the child until it ends, then end the child."""
        assert self._child.stdin is not None
        with contextlib.suppress(OSError, ValueError):
            while chunk := os.read(self._pipe, _CHUNK):
                with contextlib.suppress(BrokenPipeError):  # a command that does not read its input may still run
                    self._child.stdin.write(chunk)
                    self._child.stdin.flush()
        self._end()

    def end_when(self, wished: threading.Event) -> None:
        """Wait for the event, then end the child."""
        wished.wait()
        self._end()

    def sweep(self) -> None:
        """Kill processes that the command left behind, if the parent is dead; a living parent does that itself."""
        if sys.platform != "win32" and os.getppid() != self._parent and os.getpgrp() == os.getpid():
            os.killpg(0, signal.SIGKILL)  # us too: the parent, who would read the exit code, is dead

    def _end(self) -> None:
        assert self._child.stdin is not None
        with contextlib.suppress(OSError, ValueError):
            self._child.stdin.close()
        for seconds, harder in ((ASK_S, self._child.terminate), (TERMINATE_S, self._child.kill)):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._child.wait(seconds)
                return
            self.stopped = True
            with contextlib.suppress(OSError):
                harder()


if __name__ == "__main__":
    exit_code = int(main(sys.argv[1:]))
    end_within(1.0, exit_code)
    sys.exit(exit_code)
