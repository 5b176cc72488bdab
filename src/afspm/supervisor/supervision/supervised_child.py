"""The state of one supervised process: its lives, its heartbeats, and how it ended."""

from __future__ import annotations

from dataclasses import dataclass

from afspm.model import Role
from afspm.supervisor.supervision.child import ChildWatch, HeartbeatReport
from afspm.supervisor.supervision.liveness import LivenessPolicy

LATE_START_S = 15.0
"""Time that a process started at the end has to come up, while it is not seen to work; and then to hear what it
missed."""
CLOSES_WITHIN_S = 1.5
"""Processor time that a process has for its end, after it was asked to."""


@dataclass(frozen=True)
class ChildSpec:
    """A process to supervise.

    Attributes:
        beats: whether it sends heartbeats; one that does not is only known by its exit.
        leaves_last: whether it stays until the other components have ended, to record what they say at the end.
        acts: whether it follows a plan of its own, as a series does, or that is not known; the others react.
    """

    name: str
    role: Role = Role.COMPONENT
    beats: bool = True
    leaves_last: bool = False
    acts: bool = False

    @property
    def essential(self) -> bool:
        """True where the experiment can't go on without it."""
        return self.role is not Role.COMPONENT


@dataclass(slots=True)
class ChildLife:
    """A process that runs: one life of a child.

    Attributes:
        beat: its last heartbeat, at `beat_s`; None before the first.
        first_beat_s: when the first came.
        works: whether it is seen to work though it does not beat; None: that is not known.
        processor_s: the processor time that it has used; `asked_processor_s`: had used when it was asked to end.
    """

    pid: int
    started_s: float
    beat: HeartbeatReport | None = None
    beat_s: float = 0.0
    first_beat_s: float = 0.0
    works: bool | None = None
    processor_s: float | None = None
    asked_processor_s: float | None = None

    @property
    def is_closing(self) -> bool:
        return self.beat is not None and self.beat.closing

    def overdue_s(self, liveness: LivenessPolicy) -> float | None:
        """Return when its next beat, or its end, is so late that the operating system is asked what it does."""
        if self.beat is None:
            return None
        return self.beat_s + (liveness.closing_s if self.beat.closing else liveness.silence_s) / 2.0

    def is_overdue(self, now_s: float, liveness: LivenessPolicy) -> bool:
        """Return whether that time has come."""
        due_s = self.overdue_s(liveness)
        return due_s is not None and now_s >= due_s

    def is_busy(self, now_s: float, liveness: LivenessPolicy) -> bool:
        """Return whether it works on a step, as its last beat says or is seen, and for no longer than it declared."""
        if self.beat is None or self.beat.closing:
            return False
        longest_s, age_s = self.beat.longest_step_s or liveness.longest_step_s, self.beat.step_age_s or 0.0
        silent_s = now_s - self.beat_s
        if silent_s >= liveness.silence_s:
            return bool(self.works) and age_s + silent_s <= longest_s
        return 0.0 < age_s <= longest_s

    @property
    def is_ending(self) -> bool:
        """Return whether it still works on its end: on a busy computer what takes a second may take ten.

        One that goes round for ever uses up its processor time at once where the computer is idle.
        """
        if not self.works or self.processor_s is None or self.asked_processor_s is None:
            return False
        return self.processor_s - self.asked_processor_s < CLOSES_WITHIN_S

    def is_silent(self, now_s: float, liveness: LivenessPolicy) -> bool:
        """Return whether it should have beaten long ago, and does not work either."""
        beating = self.beat is not None and not self.beat.closing
        return beating and now_s - self.beat_s >= liveness.silence_s and not self.is_busy(now_s, liveness)


@dataclass(slots=True)
class SupervisedChild:
    """A process over all its lives.

    Attributes:
        starts, ordered: how often it was started, and how often of that by a person's order.
        rescued: it was started once more though the experiment had ended.
        last_exit: how it ended last, in words.
    """

    spec: ChildSpec
    watch: ChildWatch
    life: ChildLife | None = None
    starts: int = 0
    ordered: int = 0
    rescued: bool = False
    given_up: bool = False
    last_exit: str = ""

    @property
    def is_over(self) -> bool:
        return self.given_up or self.watch.over

    def may_still_finish(self, now_s: float, liveness: LivenessPolicy, *, can_hear: bool) -> bool:
        """Return whether it may have something left to do.

        It starts, has not beaten for a moment, is frozen and can be started again, or was started again and has yet to
        hear what it missed, if it still can.
        """
        life = self.life
        if life is None or not self.spec.beats or self.spec.role is not Role.COMPONENT:
            return False
        if life.beat is None:
            return bool(life.works) or now_s - life.started_s < LATE_START_S
        given_up = self.rescued and life.is_silent(now_s, liveness)
        # between two steps of its start it looks as if it had nothing to do
        begins_anew = can_hear and self.starts > 1 and now_s - life.first_beat_s < LATE_START_S
        is_late = now_s - life.beat_s > 1.5 * liveness.beat_period_s
        return not life.is_closing and not given_up and (begins_anew or is_late)


@dataclass(frozen=True)
class ProcessReport:
    """The fate of one process; `ordered` counts the starts that a person ordered."""

    name: str
    starts: int
    given_up: bool
    last_exit: str
    ordered: int = 0
