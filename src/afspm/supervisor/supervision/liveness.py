"""Liveness of a process, judged by its heartbeats.

A busy process counts as alive, as does a process with late heartbeats after this computer slept. A process without
heartbeats counts as alive while it works, since some code keeps the heartbeat thread from running.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto


class ProcessHealth(Enum):
    """Health of a process, by its heartbeats and its activity."""

    STARTING = auto()
    ALIVE = auto()
    SLOW_START = auto()
    """No first heartbeat within the limit for a start."""
    BUSY = auto()
    """Heartbeats have stopped, but the process works, within the limit for one step."""
    SILENT = auto()
    """Heartbeats have stopped: the whole process hangs."""
    FROZEN = auto()
    """Its current step exceeds the limit for one step."""
    NOT_CLOSING = auto()
    """The process announced its end, but still runs."""


@dataclass(frozen=True)
class LivenessPolicy:
    """Time limits for a process; all in real seconds.

    Attributes:
        beat_period_s: time between two heartbeats.
        missed_beats: number of missing heartbeats after which the process counts as dead.
        start_s: limit until the first heartbeat.
        longest_step_s: limit for one step, unless the process declares its own.
        closing_s: limit from the announcement of an end to the exit.
    """

    beat_period_s: float = 1.0
    missed_beats: int = 3
    start_s: float = 30.0
    longest_step_s: float = 30.0
    closing_s: float = 5.0

    @property
    def silence_s(self) -> float:
        return self.beat_period_s * self.missed_beats


class Liveness:
    """The liveness of a process from one start to its exit.

    Args:
        beats: whether it sends heartbeats; without heartbeats only an exit shows that a process is dead.
    """

    def __init__(self, policy: LivenessPolicy, now_s: float, *, beats: bool = True) -> None:
        self._policy = policy
        self._beats = beats
        self._vital = ProcessHealth.STARTING
        self._deadline_s = now_s + policy.start_s
        self._checked_s = now_s
        self._step_began_s = now_s
        self._longest_s = policy.longest_step_s
        self._frozen = False

    def beat(self, now_s: float, step_age_s: float = 0.0, longest_step_s: float | None = None) -> None:
        """Process a heartbeat, with the age of the current step and the limit for one step.

        A heartbeat after `closing` cancels the announcement: it came from another process, or by mistake.
        """
        longest_s = self._policy.longest_step_s if longest_step_s is None else longest_step_s
        self._vital = ProcessHealth.ALIVE
        self._frozen = step_age_s > longest_s
        self._step_began_s, self._longest_s = now_s - step_age_s, longest_s  # an idle process may begin a step now
        self._deadline_s = now_s + self._policy.silence_s

    def waits(self, now_s: float) -> None:
        """Extend the time limit of the start, since the process must still wait."""
        if self._vital is ProcessHealth.STARTING:
            self._deadline_s = now_s + self._policy.start_s

    def closing(self, now_s: float) -> None:
        """Process the announcement of an end on purpose."""
        self._vital = ProcessHealth.NOT_CLOSING
        self._step_began_s, self._longest_s = now_s, self._policy.longest_step_s
        self._deadline_s = now_s + self._policy.closing_s

    def check(self, now_s: float, *, works: bool | None = None) -> ProcessHealth:
        """Return the health. Call this at least once a beat period: a longer gap counts as sleep of this computer.

        Args:
            works: whether the process was observed to work recently; None: unknown.
        """
        asleep_s = now_s - self._checked_s - self._policy.beat_period_s
        self._checked_s = now_s
        # this computer was suspended: heartbeats wait to be read, or the process slept, too
        if asleep_s > self._policy.beat_period_s:
            self._deadline_s += asleep_s
            self._step_began_s += asleep_s
        if self._frozen and self._vital is ProcessHealth.ALIVE:
            return ProcessHealth.FROZEN
        if self._has_no_deadline:
            return ProcessHealth.ALIVE
        if now_s < self._deadline_s:
            return ProcessHealth.STARTING if self._vital is ProcessHealth.STARTING else ProcessHealth.ALIVE
        if works and self._vital is not ProcessHealth.STARTING and now_s - self._step_began_s <= self._longest_s:
            return ProcessHealth.BUSY
        if works and self._vital is ProcessHealth.ALIVE:
            return ProcessHealth.FROZEN
        return {ProcessHealth.STARTING: ProcessHealth.SLOW_START, ProcessHealth.ALIVE: ProcessHealth.SILENT}.get(
            self._vital, self._vital
        )

    def next_check_s(self) -> float:
        """Return the latest time for the next `check`, real monotonic."""
        next_s = self._checked_s + self._policy.beat_period_s
        # a deadline that has passed was handled: the process works on without heartbeats
        is_due = not self._has_no_deadline and self._deadline_s > self._checked_s
        return min(self._deadline_s, next_s) if is_due else next_s

    @property
    def _has_no_deadline(self) -> bool:
        return not self._beats and self._vital is not ProcessHealth.NOT_CLOSING
