"""Translator, scheduler and emulated controller as real processes, which checks can start, kill and restart."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable, Sequence
from queue import Empty, SimpleQueue

from afspm.basics.clock import Clock
from afspm.experiment import ProcessStart
from afspm.supervisor.child_output import OutputLine
from afspm.supervisor.log import LineReader, RunLog
from afspm.supervisor.process import ChildEvent, ChildProcess, from_start
from afspm.supervisor.supervision.supervisor_events import Exited, describe_exit

ASKED_S, KILLED_S = 5.0, 3.0


class Processes:
    """A set of running processes, whose ends and complaints are recorded.

    Args:
        log: receives the output of the processes.
        woken: called, from any thread, after the end of a process.
        complaints: receives the warnings and errors, each with the name of its process.
    """

    def __init__(self, log: RunLog, clock: Clock, woken: Callable[[], None], complaints: list[str]) -> None:
        self._log, self._clock, self._woken, self._complaints = log, clock, woken, complaints
        self._readers: dict[str, LineReader] = {}
        self._exits: SimpleQueue[Exited] = SimpleQueue()
        self._writing = threading.Lock()
        self._ended: dict[str, str] = {}
        self._running: dict[str, ChildProcess] = {}
        self._starts: dict[str, ProcessStart] = {}

    def start(self, starts: Sequence[ProcessStart]) -> None:
        """Start processes.

        Raises:
            AfspmError: a process can't be started.
        """
        self._readers |= {start.launch.name: LineReader() for start in starts}
        self._starts |= {start.launch.name: start for start in starts}
        for start in starts:
            task = from_start(start)
            self._running[task.name] = ChildProcess(task, self._handle_event)

    def kill(self, name: str) -> None:
        """Kill a process, and wait for its end, at most `KILLED_S`."""
        self._running[name].kill()
        self._await(KILLED_S, lambda: name in self._ended)

    def start_again(self, name: str) -> None:
        """Start a process that has ended.

        Raises:
            AfspmError: the process can't be started.
        """
        del self._ended[name]
        self.start([self._starts[name]])

    @property
    def ended(self) -> str:
        """A description of all ended processes; empty while all run."""
        return "; ".join(f"the process {name} {how}" for name, how in self._ended.items())

    @property
    def errors(self) -> str:
        """The last logged error of each process, or warning: a controller that was never reached is a warning."""
        errors = {name: reader.last_error or reader.last_warning for name, reader in self._readers.items()}
        return "; ".join(f"{name}: {error}" for name, error in errors.items() if error)

    def close(self) -> None:
        """Request the end of all running processes, and kill any that remain."""
        for process in self._running.values():
            process.close_stdin()
        self._await(ASKED_S, self._all_ended)
        for name, process in self._running.items():
            if name not in self._ended:
                self._write(name, logging.WARNING, "does not end: killed")
                process.kill()
        self._await(KILLED_S, self._all_ended)

    def _all_ended(self) -> bool:
        return len(self._ended) == len(self._running)

    def _await(self, within_s: float, done: Callable[[], bool]) -> None:
        until_s = self._clock.monotonic_s() + within_s
        while not done() and (left_s := until_s - self._clock.monotonic_s()) > 0.0:
            with contextlib.suppress(Empty):
                self._exits.get(timeout=left_s)

    def _handle_event(self, event: ChildEvent) -> None:
        # runs in the threads of the processes
        match event:
            case OutputLine():
                level, text = self._readers[event.name].read(event.stream, event.line)
                self._write(event.name, level, text)
                if level >= logging.WARNING:
                    self._complaints.append(f"{event.name}: {logging.getLevelName(level)} {text}")
            case Exited():
                error = self._readers[event.name].last_error
                self._ended[event.name] = f"{describe_exit(event.code)}{f' ({error})' if error else ''}"
                self._exits.put(event)
                self._woken()

    def _write(self, name: str, level: int, text: str) -> None:
        with self._writing:
            self._log.write(name, level, text)
