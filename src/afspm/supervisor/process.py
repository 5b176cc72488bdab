"""One child process: started, fed its launch line, read, waited for and killed. Every platform difference is here."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal

from afspm.clock import ExperimentClock
from afspm.errors import AfspmError
from afspm.exit_codes import ExitCode
from afspm.supervisor.output_limit import PAUSE_S, OutputLimit
from afspm.supervisor.windows_job import WindowsJob

LONGEST_LINE = 1 << 16  # a child that prints without end of line must not fill our memory
FED_S = 0.2  # a pipe takes a launch line at once, unless it is long and the child does not read
LAST_WORDS_S = 3.0  # how long its output may still be read after an exit; a grandchild that left can hold the pipe open

Stream = Literal["stdout", "stderr"]


@dataclass(frozen=True, slots=True)
class Printed:
    """A child wrote a line."""

    name: str
    pid: int
    stream: Stream
    line: str


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A child writes more than can be kept: so many lines of it are left out here."""

    name: str
    lines: int


@dataclass(frozen=True, slots=True)
class Exited:
    """A child is gone; a negative code is the number of the signal that ended it, as in `subprocess`."""

    name: str
    pid: int
    code: int


ChildEvent = Printed | LeftOut | Exited


class ChildProcess:
    """A running child. Its output and its exit are told to `tell`, from threads of this object.

    The child lives in a process group of its own: Ctrl-C in the terminal reaches the supervisor alone, and killing
    takes what the child itself has started along. Its stdin stays open until `close_stdin`: the end of it means to the
    child that its parent wants it to stop, or is dead (then the system closes it).

    Args:
        environment: what it gets besides our own; hidden: what it does not get of that.
        has_tip: it may have a tip to see to when we are killed.
        may_begin: awaited before the launch line is given to it; None: it may at once.

    Raises:
        AfspmError: the program can't be started.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        first_line: str,
        tell: Callable[[ChildEvent], None],
        environment: Mapping[str, str],
        folder: Path | None = None,
        hidden: Collection[str] = (),
        *,
        has_tip: bool = False,
        may_begin: threading.Event | None = None,
    ) -> None:
        self.name = name
        self._may_begin = may_begin
        self._tell = tell
        ours = {key: value for key, value in os.environ.items() if key not in hidden}
        try:
            self._popen = _start(command, {**ours, **environment}, folder)
        except (OSError, ValueError) as error:
            raise AfspmError(
                f"{command[0]} can't be started: {error}", where=name, hint="is it installed and executable?"
            ) from error
        self.pid = self._popen.pid
        self._job = WindowsJob(self._popen, has_tip=has_tip)
        self._fed = threading.Event()
        readers = [self._reader("stdout", self._popen.stdout), self._reader("stderr", self._popen.stderr)]
        threading.Thread(
            target=self._feed_and_wait, args=(first_line, readers), name=f"{name}-wait", daemon=True
        ).start()

    def close_stdin(self) -> None:
        """Ask the child to end. One that hasn't even taken its launch line is killed instead."""
        if not self._fed.wait(FED_S):
            self.kill()
        elif self._popen.stdin is not None:
            with contextlib.suppress(OSError):
                self._popen.stdin.close()

    def kill(self) -> None:
        """End the child and everything in its process group, now. A child that is gone already is left in peace."""
        if sys.platform == "win32":
            with contextlib.suppress(OSError):
                self._popen.kill()
            self._job.kill()
        else:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, signal.SIGKILL)

    def _feed_and_wait(self, first_line: str, readers: list[threading.Thread]) -> None:
        # here and not in __init__: a child that doesn't read must not block the supervisor
        assert self._popen.stdin is not None
        if self._may_begin is not None:
            self._may_begin.wait()
        with contextlib.suppress(OSError, ValueError):  # gone already: its exit says so
            self._popen.stdin.write(first_line.encode() + b"\n")
            self._popen.stdin.flush()
        self._fed.set()
        code = self._popen.wait()
        self.kill()  # what the child started and left behind must not live on beside its successor
        self._job.close()
        for reader in readers:
            reader.join(LAST_WORDS_S)
        self.close_stdin()
        self._tell(Exited(self.name, self.pid, code))

    def _reader(self, stream: Stream, pipe: IO[bytes] | None) -> threading.Thread:
        thread = threading.Thread(target=self._read, args=(stream, pipe), name=f"{self.name}-{stream}", daemon=True)
        thread.start()
        return thread

    def _read(self, stream: Stream, pipe: IO[bytes] | None) -> None:
        assert pipe is not None
        output = _Output(self.name, self.pid, stream, self._tell)
        with contextlib.suppress(OSError, ValueError), pipe:
            while line := pipe.readline(LONGEST_LINE):
                output.take(line)
        output.end()


class _Output:
    """Tells what a stream of a child says, as far as that can be kept.

    The child never has to wait for us: a driver that says much must not become slow.
    """

    def __init__(self, name: str, pid: int, stream: Stream, tell: Callable[[ChildEvent], None]) -> None:
        self._name, self._pid, self._stream, self._tell = name, pid, stream, tell
        self._clock = ExperimentClock.real()
        self._thinning = OutputLimit(self._clock.monotonic_s())
        self._lock = threading.Lock()
        self._pause: threading.Timer | None = None

    def take(self, line: bytes) -> None:
        with self._lock:
            was_pausing = self._thinning.pausing
            if self._thinning.passes(line, self._clock.monotonic_s()):
                self._tell_line(line)
            elif not was_pausing:
                # a timer, and not the next line: after a flood there may be silence
                self._pause = threading.Timer(PAUSE_S, self._go_on)
                self._pause.daemon = True
                self._pause.start()

    def end(self) -> None:
        """Nothing more comes."""
        if self._pause is not None:
            self._pause.cancel()
        self._go_on()

    def _go_on(self) -> None:
        with self._lock:
            left_out, last = self._thinning.go_on()
            if left_out:
                self._tell(LeftOut(self._name, left_out))
            for line in last:
                self._tell_line(line)

    def _tell_line(self, line: bytes) -> None:
        text = line.decode("utf-8", errors="replace").rstrip("\r\n")
        self._tell(Printed(self._name, self._pid, self._stream, text))


_IN_WORDS = {
    ExitCode.DONE: "done",
    ExitCode.CRASHED: "crashed",
    ExitCode.CONFIG: "its settings can't work",
    ExitCode.ENDED: "ended with the experiment",
    ExitCode.ORPHAN: "ended as it was asked to",
}


def describe_exit(code: int) -> str:
    """Why a process ended, as its exit code says."""
    if code < 0:
        try:
            return f"killed by {signal.Signals(-code).name}"
        except ValueError:
            return f"killed by signal {-code}"
    return next((words for known, words in _IN_WORDS.items() if known == code), f"exit code {code}")


def _start(command: Sequence[str], environment: Mapping[str, str], folder: Path | None) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=folder,
        env={"PYTHONUNBUFFERED": "1", "PYTHONUTF8": "1", **environment},
        start_new_session=sys.platform != "win32",
        creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
    )
