"""End of a run: the times to ask processes to end, to kill them, and to leave them. Decisions only."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from enum import Enum, auto

from afspm.model import Role
from afspm.supervisor.supervision.child import ChildPhase
from afspm.supervisor.supervision.liveness import LivenessPolicy
from afspm.supervisor.supervision.supervised_child import SupervisedChild

OWN_PACE_S = 1.5  # after the announcement of the end, for a component to finish a file
AGAIN_S = 0.25  # a process is busy within its limit: look again
FAREWELL_S = 60.0  # limit on waiting for busy processes before they are asked
KILL_AFTER_S = 1.5  # after being asked, or after finishing
TIP_S = 15.0  # after being asked, for a process that retracts the tip, or is seen to work on its end
LEAVE_AFTER_S = 3.0  # after being killed


class EndReason(Enum):
    EXPERIMENT_ENDED = auto()
    ALL_DONE = auto()
    STOPPED = auto()
    LOST = auto()
    """An essential process was given up, or all processes were."""
    PLANS_DONE = auto()
    """All components with plans are done, and none ended the experiment."""
    PLANS_LOST = auto()
    """The last component with a plan was given up."""

    @property
    def is_announced(self) -> bool:
        """Whether the scheduler announces the end to all processes, which then finish by themselves."""
        return self in (EndReason.EXPERIMENT_ENDED, EndReason.PLANS_DONE)

    @property
    def is_final(self) -> bool:
        """Whether the run can't be resumed."""
        return self in (EndReason.EXPERIMENT_ENDED, EndReason.ALL_DONE, EndReason.PLANS_DONE)

    @property
    def exit_code(self) -> int:
        """Exit code of `afspm run`."""
        return _EXIT_CODES[self]


_EXIT_CODES = {
    EndReason.EXPERIMENT_ENDED: 0,
    EndReason.ALL_DONE: 0,
    EndReason.LOST: 1,
    EndReason.PLANS_DONE: 3,
    EndReason.PLANS_LOST: 4,
    EndReason.STOPPED: 130,
}


class EndStep(Enum):
    """One step in ending the processes that still run."""

    ASK = auto()
    """Close the processes' standard input, so that they end cleanly."""
    KILL = auto()
    LEAVE = auto()
    """Log the processes that survive the kill (a driver hangs in the kernel), and leave them."""


@dataclass(frozen=True, slots=True)
class RunEnd:
    """A run that is ending: processes that still run are asked to end, then killed, then left.

    Attributes:
        ask_s, kill_s: times to ask and to kill, real monotonic.
        latest_s: deadline for busy processes; then they are asked to end.
        last: the last step taken; None before the first.
        in_haste: whether a person has asked to end the run at once.
        busy_s: time at which a process was last busy after the request to end.
        began_s: time at which the end began.
    """

    why: EndReason
    text: str
    ask_s: float
    kill_s: float
    latest_s: float
    last: EndStep | None = None
    in_haste: bool = False
    busy_s: float = -math.inf
    began_s: float = 0.0

    @classmethod
    def begin(cls, why: EndReason, text: str, now_s: float) -> RunEnd:
        """Return the first state of an end that begins now.

        After an announced end, processes first have OWN_PACE_S to close by themselves.
        """
        if not why.is_announced:
            return cls(why, text, ask_s=now_s, kill_s=now_s + KILL_AFTER_S, latest_s=now_s, began_s=now_s)
        ask_s = now_s + OWN_PACE_S
        return cls(why, text, ask_s, ask_s + KILL_AFTER_S, latest_s=now_s + FAREWELL_S, began_s=now_s)

    def hurried(self, now_s: float) -> RunEnd:
        """Return a faster end: processes are asked to end now, or killed if already asked."""
        if self.last in (EndStep.KILL, EndStep.LEAVE):
            return self
        if self.last is None and self.why is not EndReason.STOPPED:
            return replace(self, ask_s=now_s, kill_s=now_s + KILL_AFTER_S, latest_s=now_s)
        return replace(self, kill_s=now_s, last=EndStep.ASK, in_haste=True)

    def deadline_s(self) -> float | None:
        """Return the time of the next `step`, real monotonic; None: never again."""
        match self.last:
            case None:
                return self.ask_s
            case EndStep.ASK:
                return self.kill_s
            case EndStep.KILL:
                return self.kill_s + LEAVE_AFTER_S
            case EndStep.LEAVE:
                return None

    def step(self, now_s: float, *, busy: bool = False) -> tuple[RunEnd, EndStep | None]:
        """Return the next state of the end, and the step that is due now, if any.

        Args:
            busy: whether `unfinished` processes remain. Before the request to end, these are components at work on a
                step (drawing a picture of the night, say); afterwards translators, which do not leave before the tip is
                safe, and processes at work on their end.
        """
        deadline_s = self.deadline_s()
        seen = replace(self, busy_s=now_s) if busy and self.last is EndStep.ASK else self
        if deadline_s is None or now_s < deadline_s:
            return seen, None
        if self.last is None and busy and now_s < self.latest_s:
            ask_s = min(now_s + AGAIN_S, self.latest_s)
            return replace(self, ask_s=ask_s, kill_s=ask_s + KILL_AFTER_S), None
        if self.last is EndStep.ASK and not self.in_haste:
            kill_s = min(now_s + AGAIN_S, self.ask_s + TIP_S) if busy else self.busy_s + KILL_AFTER_S
            if now_s < kill_s:
                return replace(seen, kill_s=kill_s), None
        do = {None: EndStep.ASK, EndStep.ASK: EndStep.KILL, EndStep.KILL: EndStep.LEAVE}[self.last]
        return replace(self, last=do), do


def unfinished(
    ending: RunEnd, children: Mapping[str, SupervisedChild], now_s: float, liveness: LivenessPolicy
) -> list[str]:
    """Return the processes still at work; after the request to end, only closing processes and busy translators."""
    is_asked, has_ended = ending.last is not None, ending.why.is_announced
    # a scheduler on another computer counts as alive
    can_hear = all(child.life for child in children.values() if child.spec.role is Role.SCHEDULER)
    found = []
    for name, child in children.items():
        is_busy = child.life is not None and child.life.is_busy(now_s, liveness)
        may_finish = has_ended and child.may_still_finish(now_s, liveness, can_hear=can_hear)
        sees_to_tip = is_busy and child.spec.role is Role.TRANSLATOR
        is_ending = child.life is not None and child.life.is_ending
        if (sees_to_tip or is_ending) if is_asked else (is_busy or may_finish):
            found.append(name)
    return found


IDLE_AFTER_S = 10.0  # real time; for a component to end the experiment after its last scan, or to begin a repair
# a person may hold the microscope for hours: ask at this interval
ASK_AGAIN_S = 5.0


@dataclass(slots=True)
class IdleWatch:
    """A detector of an idle run, in which no process with a plan is left.

    Attributes:
        ends: whether an idle run ends.
        since_s: begin of the idle time, real monotonic; None: not idle.
        asked_s: time of the last question to the scheduler whether the microscope is in use.
        is_logged, is_postponed: whether idleness, and its postponement, were logged.
        is_ending: whether the scheduler was asked to end the experiment.
        starts: number of process starts at the last `look`.
    """

    ends: bool = False
    since_s: float | None = None
    asked_s: float = -math.inf
    is_logged: bool = False
    is_postponed: bool = False
    is_ending: bool = False
    starts: int = 0

    def look(self, children: Collection[SupervisedChild], now_s: float, liveness: LivenessPolicy) -> bool:
        """Return whether the run has been idle for IDLE_AFTER_S, or is ending because it was idle."""
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
        """Return whether to ask the scheduler now about the use of the microscope; if so, note the time."""
        if not self.ends or self.is_ending or now_s < self.asked_s + ASK_AGAIN_S:
            return False
        self.asked_s = now_s
        return True

    def deadline_s(self) -> float | None:
        """Return the time of the next `look`; None if only an event can change anything."""
        if self.since_s is None or self.is_ending or (self.is_logged and not self.ends):
            return None
        return max(self.since_s + IDLE_AFTER_S, self.asked_s + ASK_AGAIN_S)


def describe_idle(children: Collection[SupervisedChild]) -> str:
    """Return the outcomes of all components with plans, as in "series is done, grid was given up"."""
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
