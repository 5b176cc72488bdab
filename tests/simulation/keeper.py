"""The decisions of the supervisor: the real `ChildWatch` for each process, with heartbeats that freeze with it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from afspm.model import ProcessCondition, ProcessState
from afspm.supervisor.supervision.child import (
    ChildEffect,
    ChildPhase,
    ChildPolicy,
    ChildWatch,
    GiveUpChild,
    KillChild,
    StartChild,
)
from afspm.testing.components.simulated_process import Process
from afspm.testing.components.simulated_time import SimulatedTime

_OVER = {ChildPhase.DONE: ProcessCondition.ENDED, ChildPhase.GIVEN_UP: ProcessCondition.GIVEN_UP}


@dataclass(frozen=True)
class Beat:
    """See `afspm.transport.heartbeat.Heartbeat`."""

    closing: bool
    step_age_s: float | None
    longest_step_s: float | None = None


class Keeper:
    """Starts all processes and restarts them.

    Attributes:
        given_up: names of processes that it gave up.
    """

    def __init__(self, timeline: SimulatedTime, processes: Iterable[Process], policy: ChildPolicy) -> None:
        self._timeline = timeline
        self._policy = policy
        self._children = {process.name: (process, ChildWatch(policy)) for process in processes}
        self.given_up: list[str] = []
        for process, watch in self._children.values():
            process.exited = lambda code, name=process.name: self._exited(name, code)  # type: ignore[misc]
            self._do(process, watch.begin(timeline.monotonic_s()))
        self._beat()

    def restart(self, name: str) -> None:
        """Restart a process by order."""
        process, watch = self._children[name]
        self._do(process, watch.restart(self._timeline.monotonic_s()))

    def states(self) -> tuple[ProcessState, ...]:
        """Return the states of all processes, with the fields that decisions use."""
        return tuple(
            ProcessState(process.name, "", _OVER.get(watch.phase, ProcessCondition.ALIVE), 0, starts=process.starts)
            for process, watch in self._children.values()
        )

    def _beat(self) -> None:
        now_s = self._timeline.monotonic_s()
        for process, watch in self._children.values():
            if process.alive and not process.frozen:
                self._do(process, watch.beat(Beat(closing=False, step_age_s=process.step_age_s), now_s))
            else:
                self._do(process, watch.tick(now_s))
        self._timeline.after(self._policy.liveness.beat_period_s, self._beat)

    def _exited(self, name: str, code: int) -> None:
        self._timeline.after(0.01, self._heard, name, code)

    def _heard(self, name: str, code: int) -> None:
        process, watch = self._children[name]
        self._do(process, watch.exited(code, self._timeline.monotonic_s()))

    def _do(self, process: Process, effects: Iterable[ChildEffect]) -> None:
        for effect in effects:
            if isinstance(effect, StartChild):
                self._timeline.after(0.3 + 0.5 * self._timeline.random.random(), process.start)
            elif isinstance(effect, KillChild):
                process.kill()
            elif isinstance(effect, GiveUpChild):
                self.given_up.append(process.name)
        watch = self._children[process.name][1]
        if watch.phase is ChildPhase.WAITING and (again_s := watch.deadline_s()) is not None:
            self._timeline.after(again_s - self._timeline.monotonic_s(), self._tick, process.name)

    def _tick(self, name: str) -> None:
        process, watch = self._children[name]
        self._do(process, watch.tick(self._timeline.monotonic_s()))
