"""A process of an experiment as its host sees it, and the context that it runs in."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from afspm.basics.clock import Clock
from afspm.basics.errors import ConfigError, InvalidValue
from afspm.basics.launch import Launch
from afspm.model import ProblemNames
from afspm.transport.port import Port

DEFAULT_LONGEST_STEP_S = 30.0


class ProcessActivity:
    """The age of the current step, which tells a busy process from a frozen one.

    Written by the process, read by the thread that sends its heartbeats.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.since_s: float | None = None
        self.longest_step_s = DEFAULT_LONGEST_STEP_S

    @contextmanager
    def step(self) -> Iterator[None]:
        """Something is being worked on in this block."""
        before, self.since_s = self.since_s, self._clock.monotonic_s()
        try:
            yield
        finally:
            self.since_s = before

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Within a step: this block only waits. The step counts anew afterwards."""
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
    """Return an identity of this life of a process, with that of its run (empty: none is known)."""
    return "-".join(filter(None, [run, os.urandom(4).hex()]))


def _never(_: Callable[[], object]) -> None:
    """Register nothing: nobody stops a process that has no host."""


@dataclass
class ProcessContext:
    """The context that the host gives to a process.

    Attributes:
        launch: the line that we were started with.
        clock: the experiment's.
        open_port: connects to the experiment as a component does (scheduler and translators have sockets of their own);
            with a tuple of envelopes, hears these instead of those of the launch line.
        log: records go to the supervisor, and to the log collector if there is one.
        activity: to be told of steps that take time.
        when_stopping: registers what is called, from another thread, when the parent has gone or wants us to stop
            (a port made by `open_port` is told by itself).
        tip_in_danger: registers what says, then and from another thread, whether there is a tip to see to, which takes
            longer than an end is given.
        session: differs between two lives of a process, for ids that must not meet.
        problems: the problems of the experiment by name.

    Raises:
        ConfigError: two problems have the same number, say.
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
    """A process that the host can run: a component, a scheduler, a translator, made with its settings as arguments."""

    def run_process(self, context: ProcessContext) -> int:
        """Run until done, ended or stopped; returns an `ExitCode`.

        Called on the main thread. To end within a second of a stop it must wait in one poller that
        `context.when_stopping` (or the port) can wake.
        """
        ...
