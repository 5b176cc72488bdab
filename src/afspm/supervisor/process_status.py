"""How it is with each process, as the others are told it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from afspm.clock import Clock
from afspm.logic.supervision.child import ChildPhase, ChildWatch, HeartbeatReport
from afspm.logic.supervision.liveness import LivenessPolicy
from afspm.model import ProcessCondition, ProcessState
from afspm.supervisor.task import Task

SILENT_PERIODS = 2.5
"""So many periods without a beat, and a process counts as silent; a little later it is killed."""


class Running(Protocol):
    """A process that runs."""

    @property
    def pid(self) -> int: ...


class Child(Protocol):
    """What the supervisor knows of one of its processes."""

    @property
    def task(self) -> Task: ...
    @property
    def watch(self) -> ChildWatch: ...
    @property
    def process(self) -> Running | None: ...
    @property
    def up(self) -> bool: ...
    @property
    def beat(self) -> HeartbeatReport | None: ...
    @property
    def beat_s(self) -> float: ...
    @property
    def works(self) -> bool | None: ...
    @property
    def starts(self) -> int: ...
    @property
    def given_up(self) -> bool: ...
    @property
    def last_exit(self) -> str: ...


class ProcessStatus:
    """Knows since when each process is in the condition that it is in."""

    def __init__(self, clock: Clock, liveness: LivenessPolicy) -> None:
        self._clock = clock
        self._liveness = liveness
        self._since: dict[str, tuple[tuple[object, ...], int]] = {}

    def of(self, children: Iterable[Child], now_s: float) -> tuple[tuple[ProcessState, ...], bool]:
        """How it is now with each, and whether anything has changed since the last time."""
        found, changed = [], False
        for child in children:
            name, condition = child.task.name, self.condition(child, now_s)
            pid = child.process.pid if child.process is not None else 0
            facts = (condition, child.starts, pid, child.last_exit)
            before, since_ns = self._since.get(name, ((), 0))
            if facts != before:
                since_ns = since_ns if before[:1] == facts[:1] else self._clock.now_ns()
                self._since[name], changed = (facts, since_ns), True
            age_s = self._step_age_s(child, now_s) if condition is ProcessCondition.BUSY else 0.0
            role = child.task.role.value
            found.append(ProcessState(name, role, condition, since_ns, age_s, child.starts, pid, child.last_exit))
        return tuple(found), changed

    def condition(self, child: Child, now_s: float) -> ProcessCondition:
        """In one word."""
        if child.given_up:
            return ProcessCondition.GIVEN_UP
        if child.process is None:
            return _WITHOUT_PROCESS.get(child.watch.phase, ProcessCondition.RESTARTING)
        if child.watch.phase is ChildPhase.KILLING:
            return ProcessCondition.RESTARTING
        if not child.task.beats:
            return ProcessCondition.ALIVE
        if not child.up:
            return ProcessCondition.STARTING
        closing = child.beat is not None and child.beat.closing
        if not closing and now_s - child.beat_s >= SILENT_PERIODS * self._liveness.beat_period_s:
            return ProcessCondition.BUSY if child.works else ProcessCondition.SILENT
        return ProcessCondition.BUSY if self._step_age_s(child, now_s) else ProcessCondition.ALIVE

    @staticmethod
    def _step_age_s(child: Child, now_s: float) -> float:
        age_s = 0.0 if child.beat is None or child.beat.closing else child.beat.step_age_s or 0.0
        return age_s + (now_s - child.beat_s) if age_s else 0.0


_WITHOUT_PROCESS = {
    ChildPhase.IDLE: ProcessCondition.STARTING,
    ChildPhase.STOPPING: ProcessCondition.ENDED,
    ChildPhase.DONE: ProcessCondition.ENDED,
    ChildPhase.GIVEN_UP: ProcessCondition.GIVEN_UP,
}
