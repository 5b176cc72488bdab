"""End of a run that is idle: all plans are done, or the last one was given up. Decisions only."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

from afspm.supervisor.supervision.child import ChildPhase
from afspm.supervisor.supervision.liveness import LivenessPolicy
from afspm.supervisor.supervision.supervised_child import SupervisedChild

IDLE_AFTER_S = 10.0  # real time; for a component to end the experiment after its last scan, or to begin a repair
# a person may hold the microscope for hours: ask at this interval
ASK_AGAIN_S = 5.0


@dataclass(slots=True)
class IdleWatch:
    """Watch for an idle run: no process with a plan is left.

    Attributes:
        ends: whether an idle run ends.
        since_s: since when the run is idle, in real monotonic time; None: it is not.
        asked_s: when the scheduler was last asked whether the microscope is in use.
        is_logged, is_postponed: whether idleness, and its postponement, were logged.
        is_ending: whether the scheduler was asked to end the experiment.
        starts: number of process starts up to then.
    """

    ends: bool = False
    since_s: float | None = None
    asked_s: float = -math.inf
    is_logged: bool = False
    is_postponed: bool = False
    is_ending: bool = False
    starts: int = 0

    def look(self, children: Collection[SupervisedChild], now_s: float, liveness: LivenessPolicy) -> bool:
        """Return whether the run has been idle for IDLE_AFTER_S."""
        acting = [child for child in children if child.spec.acts]
        starts_before, self.starts = self.starts, sum(child.starts for child in children)
        if not acting or not all(child.is_over for child in acting):
            self.since_s, self.is_logged, self.is_postponed, self.is_ending = None, False, False, False
            return False
        if self.is_ending:  # components are finishing
            return True
        if self.starts != starts_before or any(_is_at_work(child, now_s, liveness) for child in children):
            self.since_s = None
            return False
        if self.since_s is None:
            self.since_s = now_s
        return now_s >= self.since_s + IDLE_AFTER_S

    def asks(self, now_s: float) -> bool:
        """Return whether to ask now if the microscope is in use, and note the time."""
        if not self.ends or self.is_ending or now_s < self.asked_s + ASK_AGAIN_S:
            return False
        self.asked_s = now_s
        return True

    def deadline_s(self) -> float | None:
        """Return when to look again; None if only an event can change anything."""
        if self.since_s is None or self.is_ending or (self.is_logged and not self.ends):
            return None
        return max(self.since_s + IDLE_AFTER_S, self.asked_s + ASK_AGAIN_S)


def describe_idle(children: Collection[SupervisedChild]) -> str:
    """Return why nothing is left to run: "series is done, grid was given up"."""
    acting = [child for child in children if child.spec.acts]
    return ", ".join(f"{child.spec.name} {'was given up' if child.given_up else 'is done'}" for child in acting)


def _is_at_work(child: SupervisedChild, now_s: float, liveness: LivenessPolicy) -> bool:
    if child.is_over or child.spec.acts:
        return False
    if child.life is None or child.watch.phase is not ChildPhase.RUNNING:
        return True
    if not child.spec.beats:
        return False
    is_busy = not child.spec.essential and child.life.is_busy(now_s, liveness)
    return child.life.beat is None or is_busy or child.life.is_silent(now_s, liveness)
