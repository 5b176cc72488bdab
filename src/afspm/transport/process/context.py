"""The interface between a process of an experiment and its host, with the context that the host provides."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from afspm.basics.clock import Clock
from afspm.basics.errors import ConfigError, InvalidValue
from afspm.basics.launch import Launch
from afspm.model import ProblemNames
from afspm.transport.port import Port

DEFAULT_LONGEST_STEP_S = 30.0


class ProcessActivity:
    """The age of the current step, which distinguishes a busy process from a frozen process.

    The process writes it; the thread that sends the heartbeats reads it.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.since_s: float | None = None
        self.longest_step_s = DEFAULT_LONGEST_STEP_S

    @contextmanager
    def step(self) -> Iterator[None]:
        """Count the `with` block as one step, and afterwards go on with the step around it, if any."""
        before, self.since_s = self.since_s, self._clock.monotonic_s()
        try:
            yield
        finally:
            self.since_s = before

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Stop counting the step during the `with` block; afterwards the step's age starts at zero."""
        before, self.since_s = self.since_s, None
        try:
            yield
        finally:
            self.since_s = None if before is None else self._clock.monotonic_s()

    def age_s(self) -> float:
        """Return the real seconds since the current step began; 0 when idle."""
        since_s = self.since_s
        return 0.0 if since_s is None else max(0.0, self._clock.monotonic_s() - since_s)


def new_session(run: str) -> str:
    """Return a random identity for this life of a process; the identity of its run, if known, stands before it."""
    return "-".join(filter(None, [run, os.urandom(4).hex()]))


def _never(_: Callable[[], object]) -> None:
    # a process without a host is never stopped
    ...


@dataclass
class ProcessContext:
    """The context that the host gives to a process.

    Attributes:
        launch: the launch line of the process.
        clock: the experiment's clock.
        open_port: connects to the experiment as a component (scheduler and translators have their own sockets); a tuple
            of envelopes replaces the envelopes of the launch line.
        log: logger of the process; its records go to the supervisor, and to the log collector if there is one.
        activity: marks steps that take time.
        when_stopping: registers a callback, called from another thread when the parent is gone or stops the process (a
            port made by `open_port` gets an event anyway).
        tip_in_danger: registers a function that returns whether the tip needs attention, which takes longer than an
            ordinary end. It is called from another thread at a stop.
        session: differs between two lives of a process, for ids that must not collide.
        problems: the problems of the experiment by name.

    Raises:
        ConfigError: invalid entries, such as two problems with the same number.
    """

    launch: Launch
    clock: Clock
    open_port: Callable[..., Port]
    log: logging.Logger
    activity: ProcessActivity
    when_stopping: Callable[[Callable[[], None]], None] = _never
    tip_in_danger: Callable[[Callable[[], bool]], None] = _never
    session: str = "0"
    problems: ProblemNames = field(init=False)

    def __post_init__(self) -> None:
        try:
            self.problems = ProblemNames(self.launch.problems)
        except InvalidValue as error:
            raise ConfigError(error.what, where=error.where, hint=error.hint) from error

    @property
    def name(self) -> str:
        return self.launch.name


@runtime_checkable
class ExperimentProcess(Protocol):
    """A process that the host can run: a component, scheduler or translator, constructed with its settings."""

    def run_process(self, context: ProcessContext) -> int:
        """Run until done, ended or stopped; return an `ExitCode`.

        Called on the main thread. To end within a second of a stop, the process must wait in one poller that
        `context.when_stopping` (or the port) can wake.
        """
        ...


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
