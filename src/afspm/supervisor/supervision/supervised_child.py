"""State of one supervised process: its starts, its heartbeats, and its exits."""

from __future__ import annotations

from dataclasses import dataclass

from afspm.basics.exit_codes import ExitCode
from afspm.model import Role
from afspm.supervisor.supervision.child import ChildWatch, HeartbeatReport
from afspm.supervisor.supervision.liveness import LivenessPolicy

LATE_START_S = 15.0
"""Real time for a process that restarts during the end to send its first heartbeat, and then to receive missed packets.

A process that is seen to work before its first heartbeat may take longer."""
CLOSES_WITHIN_S = 1.5
"""Processor time that a process may use to end, after the request to end."""


@dataclass(frozen=True)
class ChildSpec:
    """A process to supervise.

    Attributes:
        beats: whether it sends heartbeats; without heartbeats only an exit shows that a process is dead.
        leaves_last: whether it stays until the other components have ended, to record their last packets.
        acts: whether it follows a plan of its own, as a series does (True if unknown), or only reacts.
        has_user_code: whether its class, or its program, is not part of afspm.
    """

    name: str
    role: Role = Role.COMPONENT
    beats: bool = True
    leaves_last: bool = False
    acts: bool = False
    has_user_code: bool = False

    @property
    def essential(self) -> bool:
        """Whether the experiment can't go on without the process."""
        return self.role is not Role.COMPONENT


@dataclass(slots=True)
class ChildLife:
    """One life of a child: a running process, from its start to its exit.

    Attributes:
        beat: its last heartbeat, at `beat_s`; None before the first.
        first_beat_s: time of its first heartbeat.
        works: whether it was observed to work although it sends no heartbeats; None: unknown.
        processor_s: processor time used since its start.
        asked_processor_s: value of `processor_s` at the request to end.
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
        """Return the time from which the process counts as overdue, and is sampled; None before its first heartbeat."""
        if self.beat is None:
            return None
        return self.beat_s + (liveness.closing_s if self.beat.closing else liveness.silence_s) / 2.0

    def is_overdue(self, now_s: float, liveness: LivenessPolicy) -> bool:
        due_s = self.overdue_s(liveness)
        return due_s is not None and now_s >= due_s

    def is_busy(self, now_s: float, liveness: LivenessPolicy) -> bool:
        """Return whether heartbeats or samples show the process at work on a step, within its declared limit."""
        if self.beat is None or self.beat.closing:
            return False
        longest_s, age_s = self.beat.longest_step_s or liveness.longest_step_s, self.beat.step_age_s or 0.0
        silent_s = now_s - self.beat_s
        if silent_s >= liveness.silence_s:
            return bool(self.works) and age_s + silent_s <= longest_s
        return 0.0 < age_s <= longest_s

    @property
    def is_ending(self) -> bool:
        """Whether the process still works on closing: on a busy computer one second of work may take ten.

        A process in an endless loop uses up its allowance of processor time quickly if the computer is idle.
        """
        if not self.works or self.processor_s is None or self.asked_processor_s is None:
            return False
        return self.processor_s - self.asked_processor_s < CLOSES_WITHIN_S

    def is_cut_short(self, code: int) -> bool:
        """Return whether the exit after a request to end interrupted a step."""
        beat = self.beat
        return code == ExitCode.ORPHAN and beat is not None and not beat.closing and bool(beat.step_age_s)

    def is_silent(self, now_s: float, liveness: LivenessPolicy) -> bool:
        """Return whether the heartbeat is long overdue, and the process is not at work."""
        beating = self.beat is not None and not self.beat.closing
        return beating and now_s - self.beat_s >= liveness.silence_s and not self.is_busy(now_s, liveness)


@dataclass(slots=True)
class SupervisedChild:
    """A supervised process over all its restarts.

    Attributes:
        starts, ordered: number of starts, and number of restarts ordered by a person.
        rescued: whether the process was started once more after the end of the experiment.
        advised: whether the remedy for a crash has been logged.
        last_exit: description of the last exit.
        unfinished: description of a stop before the process had finished; otherwise empty.
        misconfigured: whether the last exit was for settings that can't work.
    """

    spec: ChildSpec
    watch: ChildWatch
    life: ChildLife | None = None
    starts: int = 0
    ordered: int = 0
    rescued: bool = False
    given_up: bool = False
    advised: bool = False
    last_exit: str = ""
    unfinished: str = ""
    misconfigured: bool = False

    @property
    def is_over(self) -> bool:
        return self.given_up or self.watch.over

    def may_still_finish(self, now_s: float, liveness: LivenessPolicy, *, can_hear: bool) -> bool:
        """Return whether the process may have work left.

        True if a component with heartbeats is starting, is late with a heartbeat and can still be restarted, or was
        restarted a short time ago and may still receive missed packets.
        """
        life = self.life
        if life is None or not self.spec.beats or self.spec.role is not Role.COMPONENT:
            return False
        if life.beat is None:
            return bool(life.works) or now_s - life.started_s < LATE_START_S
        given_up = self.rescued and life.is_silent(now_s, liveness)
        # between two steps of its start it looks idle
        is_restarting = can_hear and self.starts > 1 and now_s - life.first_beat_s < LATE_START_S
        is_late = now_s - life.beat_s > 1.5 * liveness.beat_period_s
        return not life.is_closing and not given_up and (is_restarting or is_late)


@dataclass(frozen=True)
class ProcessReport:
    """Summary of one process for the end of a run.

    Attributes:
        ordered: number of restarts ordered by a person.
        misconfigured: whether it was given up for settings that can't work.
    """

    name: str
    starts: int
    given_up: bool
    last_exit: str
    ordered: int = 0
    unfinished: str = ""
    misconfigured: bool = False
