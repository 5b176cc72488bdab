"""Condition of each process, as the supervisor publishes it."""

from __future__ import annotations

from collections.abc import Iterable

from afspm.model import ProcessCondition, ProcessState
from afspm.supervisor.supervision.child import ChildPhase
from afspm.supervisor.supervision.liveness import LivenessPolicy
from afspm.supervisor.supervision.supervised_child import ChildLife, SupervisedChild

SILENT_PERIODS = 2.5
"""Beat periods without a heartbeat after which a process is shown as silent; a little later, the process is killed."""

_NOT_BEGUN = (ProcessCondition.STARTING, ProcessCondition.BUSY, ProcessCondition.SILENT)
_WITHOUT_PROCESS = {
    ChildPhase.IDLE: ProcessCondition.STARTING,
    ChildPhase.STOPPING: ProcessCondition.ENDED,
    ChildPhase.DONE: ProcessCondition.ENDED,
    ChildPhase.GIVEN_UP: ProcessCondition.GIVEN_UP,
}


class ProcessStatus:
    """The condition of each process, and the time of its last change."""

    def __init__(self, liveness: LivenessPolicy) -> None:
        self._liveness = liveness
        self._since: dict[str, tuple[tuple[object, ...], int]] = {}
        self._alive: dict[str, tuple[int, int]] = {}
        self._begun: set[str] = set()

    def states(
        self, children: Iterable[SupervisedChild], now_s: float, now_ns: int
    ) -> tuple[tuple[ProcessState, ...], bool]:
        """Return the state of each process, and whether any has changed since the last call.

        Args:
            now_s: real monotonic time.
            now_ns: experiment time.
        """
        found, changed = [], False
        for child in children:
            name, condition = child.spec.name, condition_of(child, now_s, self._liveness)
            pid = 0 if child.life is None else child.life.pid
            facts = (condition, child.starts, pid, child.last_exit)
            before, since_ns = self._since.get(name, ((), 0))
            if facts != before:
                since_ns = since_ns if before[:1] == facts[:1] else now_ns
                if condition in (ProcessCondition.ALIVE, ProcessCondition.BUSY):
                    since_ns = self._alive_since_ns(name, pid, now_ns)
                self._since[name], changed = (facts, since_ns), True
            age_s = _step_age_s(child.life, now_s) if condition is ProcessCondition.BUSY else 0.0
            role = child.spec.role.value
            found.append(ProcessState(name, role, condition, since_ns, age_s, child.starts, pid, child.last_exit))
        return tuple(found), changed

    def all_begun(self, children: Iterable[SupervisedChild], now_s: float) -> bool:
        """Return whether the first start of each process is over; `now_s` as in `states`.

        A start is over at the first idle heartbeat, and for a process that ends or is killed before.
        """
        waits = False
        for child in children:
            # heartbeats begin before the imports, which are the first step: a busy process may still be loading
            if child.starts > 1 or condition_of(child, now_s, self._liveness) not in _NOT_BEGUN:
                self._begun.add(child.spec.name)
            waits |= child.spec.name not in self._begun
        return not waits

    def _alive_since_ns(self, name: str, pid: int, now_ns: int) -> int:
        # a process at work on a step, or late with a beat, counts as alive
        if self._alive.get(name, (0, 0))[0] != pid:
            self._alive[name] = (pid, now_ns)
        return self._alive[name][1]


def condition_of(child: SupervisedChild, now_s: float, liveness: LivenessPolicy) -> ProcessCondition:
    life = child.life
    if child.given_up:
        return ProcessCondition.GIVEN_UP
    if life is None:
        return _WITHOUT_PROCESS.get(child.watch.phase, ProcessCondition.RESTARTING)
    if child.watch.phase is ChildPhase.KILLING:
        return ProcessCondition.RESTARTING
    if not child.spec.beats:
        return ProcessCondition.ALIVE
    if life.beat is None:
        return ProcessCondition.STARTING
    if not life.is_closing and now_s - life.beat_s >= SILENT_PERIODS * liveness.beat_period_s:
        return ProcessCondition.BUSY if life.works else ProcessCondition.SILENT
    return ProcessCondition.BUSY if _step_age_s(life, now_s) else ProcessCondition.ALIVE


def _step_age_s(life: ChildLife | None, now_s: float) -> float:
    if life is None or life.beat is None or life.beat.closing or not life.beat.step_age_s:
        return 0.0
    return life.beat.step_age_s + now_s - life.beat_s
