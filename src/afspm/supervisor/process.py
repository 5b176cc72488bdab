"""One child process: start, launch line, output, exit and kill, on each platform."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from afspm.basics import python_environment
from afspm.basics.errors import AfspmError, NoThread
from afspm.basics.interpreter import python_command
from afspm.basics.launch import Launch
from afspm.experiment import ProcessStart
from afspm.model import Role
from afspm.supervisor.child_output import ChildOutput, OutputDropped, OutputLine, Stream
from afspm.supervisor.supervision.supervisor_events import Exited

LONGEST_LINE = 1 << 16  # a child that prints no line ends must not fill our memory
FED_S = 0.2  # a pipe takes a launch line at once, unless it is long and the child does not read
LAST_WORDS_S = 3.0  # limit on reading its output after its exit: a detached grandchild can keep the pipe open

_EXTENDED_LIMITS = 9  # JobObjectExtendedLimitInformation
_KILL_ON_CLOSE = 0x2000  # JOB_OBJECT_LIMIT_KILL_ON_JOB_CLOSE
_KILLED = 1

ChildEvent = OutputLine | OutputDropped | Exited
HOST = "afspm.supervisor.host"
GUARD = "afspm.supervisor.foreign"


@dataclass(frozen=True)
class Task:
    """One process to start, watch and restart.

    Attributes:
        launch: launch line, written to the process's standard input; the supervisor adds the address for heartbeats.
        command: program and arguments.
        role: scheduler, translator or component; the experiment can't go on without the first two.
        folder: working directory; None: the supervisor's.
        environment: variables in addition to the supervisor's.
        hidden: variables of the supervisor that the process does not get.
        beats: whether the process sends heartbeats; without heartbeats only an exit shows that a process is dead.
        leaves_last: whether the process stays until the other components have ended, to record their last packets.
        acts: whether the process follows a plan of its own (True if unknown), or only reacts.
    """

    launch: Launch
    command: tuple[str, ...]
    role: Role = Role.COMPONENT
    folder: Path | None = None
    environment: Mapping[str, str] = field(default_factory=dict)
    beats: bool = True
    leaves_last: bool = False
    acts: bool = False
    hidden: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.launch.name

    @property
    def essential(self) -> bool:
        """Whether the experiment can't go on without the process."""
        return self.role is not Role.COMPONENT

    @property
    def has_user_code(self) -> bool:
        """Whether the class, or the program, is not part of afspm."""
        return not self.launch.class_.startswith("afspm.")


def from_start(start: ProcessStart) -> Task:
    """Return the task for a process to start: Python classes run in `host`, other languages under `foreign`."""
    # modules come from beside the experiment file, never from the directory where the run was started
    ours = (*python_command(GUARD), "--", *start.command) if start.command else python_command(HOST)
    before = [*start.python_path, *filter(None, [os.environ.get("PYTHONPATH", "")])]
    return Task(
        launch=start.launch,
        command=ours,
        role=start.role,
        folder=start.folder if start.command else None,
        environment={**python_environment(), **({"PYTHONPATH": os.pathsep.join(before)} if before else {})},
        beats=start.beats,
        leaves_last=start.leaves_last,
        acts=start.acts,
        hidden=start.hidden,
    )


class ChildProcess:
    """A running child, whose output and exit are passed to `tell`, from threads of this object.

    The child has a process group of its own: Ctrl-C in the terminal reaches the supervisor alone, and killing includes
    the child's own children. The end of its standard input asks the child to stop: closed by `close_stdin`, or by the
    system after the death of the supervisor.

    Args:
        has_tip: whether the child may have to retract a tip after the supervisor was killed.
        may_begin: event to wait for before the launch line is sent; None: send it at once.

    Raises:
        AfspmError: the program can't be started.
    """

    def __init__(
        self,
        task: Task,
        tell: Callable[[ChildEvent], None],
        *,
        has_tip: bool = False,
        may_begin: threading.Event | None = None,
    ) -> None:
        self.name = name = task.name
        self._may_begin = may_begin
        self._report = tell
        ours = {key: value for key, value in os.environ.items() if key not in task.hidden}
        try:
            self._popen = _start(task.command, {**ours, **task.environment}, task.folder)
        except (OSError, ValueError) as error:
            raise AfspmError(
                f"{task.command[0]} can't be started: {error}", where=name, hint="is it installed and executable?"
            ) from error
        self.pid = self._popen.pid
        self._job = _WindowsJob(self._popen, has_tip=has_tip)
        self._fed = threading.Event()
        try:
            readers = [self._reader("stdout", self._popen.stdout), self._reader("stderr", self._popen.stderr)]
            feeding = (task.launch.to_json(), readers)
            threading.Thread(target=self._feed_and_wait, args=feeding, name=f"{name}-wait", daemon=True).start()
        except RuntimeError as error:  # Python has no type of its own for a thread that can't start
            with self._popen:  # closes its pipes, and waits for it
                self.kill()
            raise NoThread(
                f"the system starts no thread for the output of {name}",
                hint="raise its limit of processes, as with `ulimit -u 4096`",
            ) from error

    def close_stdin(self) -> None:
        """Ask the child to end. A child that has not read its launch line yet is killed."""
        if not self._fed.wait(FED_S):
            self.kill()
        elif self._popen.stdin is not None:
            with contextlib.suppress(OSError):
                self._popen.stdin.close()

    def kill(self) -> None:
        """Kill the child and its process group now, also processes that the child has left behind."""
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
        with contextlib.suppress(OSError, ValueError):  # it has exited already, which is reported below
            self._popen.stdin.write(first_line.encode() + b"\n")
            self._popen.stdin.flush()
        self._fed.set()
        code = self._popen.wait()
        self.kill()  # processes that the child left behind must not run beside its successor
        self._job.close()
        for reader in readers:
            reader.join(LAST_WORDS_S)
        self.close_stdin()
        self._report(Exited(self.name, self.pid, code))

    def _reader(self, stream: Stream, pipe: IO[bytes] | None) -> threading.Thread:
        thread = threading.Thread(target=self._read, args=(stream, pipe), name=f"{self.name}-{stream}", daemon=True)
        thread.start()
        return thread

    def _read(self, stream: Stream, pipe: IO[bytes] | None) -> None:
        assert pipe is not None
        output = ChildOutput(self.name, self.pid, stream, self._report)
        with contextlib.suppress(OSError, ValueError), pipe:
            while line := pipe.readline(LONGEST_LINE):
                output.take(line)
        output.end()


def _start(command: Sequence[str], environment: Mapping[str, str], folder: Path | None) -> subprocess.Popen[bytes]:
    # unbuffered, so that a kill loses no line of output; UTF-8, since the output is decoded as UTF-8
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=folder,
        env={"PYTHONUNBUFFERED": "1", "PYTHONUTF8": "1", **environment},
        start_new_session=sys.platform != "win32",
        # on Windows Ctrl-Break or closing the console must not kill a child that retracts a tip
        creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0) | getattr(subprocess, "CREATE_NO_WINDOW", 0),
    )


class _JobLimits(ctypes.Structure):
    """JOBOBJECT_EXTENDED_LIMIT_INFORMATION; only its flags are set."""

    _fields_ = (
        ("per_process_user_time", ctypes.c_int64),
        ("per_job_user_time", ctypes.c_int64),
        ("flags", ctypes.c_uint32),
        ("minimum_working_set", ctypes.c_size_t),
        ("maximum_working_set", ctypes.c_size_t),
        ("active_processes", ctypes.c_uint32),
        ("affinity", ctypes.c_size_t),
        ("priority", ctypes.c_uint32),
        ("scheduling", ctypes.c_uint32),
        ("counters", ctypes.c_uint64 * 6),
        ("memory", ctypes.c_size_t * 4),
    )


class _WindowsJob:
    """Windows job object of a child and its own children; elsewhere `reaper` does its work.

    Args:
        has_tip: whether the child retracts a tip first, and so is not ended with the supervisor.
    """

    def __init__(self, child: subprocess.Popen[bytes], *, has_tip: bool) -> None:
        self._handle = 0
        self._kernel: Any = None
        if sys.platform != "win32":
            return
        kernel = ctypes.WinDLL("kernel32", use_last_error=True)
        kernel.CreateJobObjectW.restype = ctypes.c_void_p
        self._kernel = kernel
        self._handle = kernel.CreateJobObjectW(None, None) or 0
        limits = _JobLimits(flags=0 if has_tip else _KILL_ON_CLOSE)
        job = ctypes.c_void_p(self._handle)
        kernel.SetInformationJobObject(job, _EXTENDED_LIMITS, ctypes.byref(limits), ctypes.sizeof(limits))
        kernel.AssignProcessToJobObject(job, ctypes.c_void_p(int(child._handle)))

    def kill(self) -> None:
        if self._handle:
            self._kernel.TerminateJobObject(ctypes.c_void_p(self._handle), _KILLED)

    def close(self) -> None:
        """Close the job; processes left in the job end, unless the child has a tip."""
        if self._handle:
            handle, self._handle = self._handle, 0
            with contextlib.suppress(OSError):
                self._kernel.CloseHandle(ctypes.c_void_p(handle))
