"""Supervision of one child: start, watch, restart, give up, end."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Protocol

from afspm.basics.exit_codes import ExitCode
from afspm.basics.own_fault import OwnFault
from afspm.supervisor.supervision.liveness import Liveness, LivenessPolicy, ProcessHealth


@dataclass(frozen=True)
class RestartPolicy:
    """Budget and back-off of restarts; all in real seconds.

    Attributes:
        budget: number of restarts allowed within `window_s`; at one more the process is given up.
        first_delay_s: delay before the second restart in a row; the first restart is immediate.
        factor: growth of the delay with each further restart.
        longest_delay_s: upper limit of the delay.
        healthy_s: time that a process must run for the next crash to count as a first failure again.
    """

    budget: int = 10
    window_s: float = 600.0
    first_delay_s: float = 0.25
    factor: float = 2.0
    longest_delay_s: float = 30.0
    healthy_s: float = 30.0


class RestartBudget:
    """The counter of one child's recent restarts, checked against the policy."""

    def __init__(self, policy: RestartPolicy) -> None:
        self._policy = policy
        self._times_s: deque[float] = deque()
        self._row = 0

    def failed(self, now_s: float, lived_s: float) -> float | None:
        """Process a crash after `lived_s`; return the delay before the next start. None: give the process up."""
        policy = self._policy
        while self._times_s and now_s - self._times_s[0] >= policy.window_s:
            self._times_s.popleft()
        if len(self._times_s) >= policy.budget:
            return None
        self._times_s.append(now_s)
        self._row = 0 if lived_s >= policy.healthy_s else self._row
        delay_s = 0.0
        if self._row:
            delay_s = min(policy.first_delay_s * policy.factor ** min(self._row - 1, 60), policy.longest_delay_s)
        self._row += 1
        return delay_s


@dataclass(frozen=True)
class ChildPolicy:
    liveness: LivenessPolicy = field(default_factory=LivenessPolicy)
    restart: RestartPolicy = field(default_factory=RestartPolicy)
    beats: bool = True
    """Whether the child sends heartbeats."""
    final_codes: Collection[int] = frozenset({ExitCode.DONE, ExitCode.CONFIG, ExitCode.ENDED})
    """Exit codes that cause no restart. Not ORPHAN: a child stopped by another program is still needed."""
    quiet_codes: Collection[int] = frozenset({ExitCode.CONFIG, ExitCode.ENDED})
    """Final codes that need no log line here: wrong settings and the experiment's end are logged elsewhere."""


class HeartbeatReport(Protocol):
    """Content of a heartbeat; None for values that the process does not send."""

    @property
    def closing(self) -> bool: ...
    @property
    def step_age_s(self) -> float | None: ...
    @property
    def longest_step_s(self) -> float | None: ...


class ChildPhase(Enum):
    IDLE = auto()
    """Not started yet."""
    RUNNING = auto()
    KILLING = auto()
    """The process was killed, as dead or frozen or for an ordered restart; its exit is awaited."""
    WAITING = auto()
    """The process crashed, and is restarted after the delay."""
    STOPPING = auto()
    """The process was asked to end."""
    DONE = auto()
    """The process has ended, on purpose or as requested."""
    GIVEN_UP = auto()


@dataclass(frozen=True, slots=True)
class StartChild:
    """The effect that starts the process."""


@dataclass(frozen=True, slots=True)
class KillChild:
    """The effect that kills the process; its exit follows as an event."""

    why: str


@dataclass(frozen=True, slots=True)
class GiveUpChild:
    """The effect that gives the process up, with a log line: the process is not restarted any more."""

    why: str


@dataclass(frozen=True, slots=True)
class ChildLog:
    """The effect that logs a line; `level` is a name of `logging`."""

    level: str
    text: str


ChildEffect = StartChild | KillChild | GiveUpChild | ChildLog

_WHY = {
    ProcessHealth.SLOW_START: "it sent no first heartbeat within {start_s:g} s",
    ProcessHealth.SILENT: "no heartbeat for {silence_s:g} s: it hangs",
    ProcessHealth.FROZEN: "a step took longer than its declared longest time: it is frozen",
    ProcessHealth.NOT_CLOSING: "it announced its end and was still running {closing_s:g} s later",
}


class ChildWatch:
    """Supervision of one child over all its restarts. Methods take real monotonic time, and return effects in order."""

    def __init__(self, policy: ChildPolicy | None = None) -> None:
        self._policy = policy or ChildPolicy()
        self._restarts = RestartBudget(self._policy.restart)
        self._liveness: Liveness | None = None
        self._began_s = 0.0
        self._again_s = 0.0
        self._is_ordered = False  # whether a restart was ordered: its exit is expected
        self._fault: OwnFault | None = None  # that ended the previous life
        self.phase = ChildPhase.IDLE

    @property
    def over(self) -> bool:
        """Whether the child has ended and will not be restarted."""
        return self.phase in (ChildPhase.DONE, ChildPhase.GIVEN_UP)

    def died(self, code: int) -> bool:
        """Return whether an exit code means a failure: neither a final code nor a requested end."""
        return code not in (*self._policy.final_codes, ExitCode.ORPHAN)

    def begin(self, now_s: float) -> list[ChildEffect]:
        if self.phase not in (ChildPhase.IDLE, ChildPhase.DONE, ChildPhase.GIVEN_UP):
            return []
        return self._start(now_s)

    def beat(self, beat: HeartbeatReport, now_s: float) -> list[ChildEffect]:
        if self._liveness is None:
            return []
        if beat.closing:
            self._liveness.closing(now_s)
        else:
            self._liveness.beat(now_s, beat.step_age_s or 0.0, beat.longest_step_s)
        return self.tick(now_s)

    def waits(self, now_s: float) -> None:
        """Extend the time limit of the start, since the process still waits for the scheduler."""
        if self._liveness is not None:
            self._liveness.waits(now_s)

    def exited(self, code: int, now_s: float, how: str = "", fault: OwnFault | None = None) -> list[ChildEffect]:
        """Process an exit; a `code` below zero is a signal's number, `how` describes the exit for people."""
        how = how or f"exit code {code}"
        phase, self._liveness = self.phase, None
        if phase in (ChildPhase.STOPPING, ChildPhase.DONE):
            self.phase = ChildPhase.DONE
            return []
        ordered, self._is_ordered = self._is_ordered, False
        if ordered and code not in self._policy.quiet_codes:
            return self._start(now_s)
        if (phase is not ChildPhase.KILLING or ordered) and code in self._policy.final_codes:
            self.phase = ChildPhase.DONE
            return [ChildLog("DEBUG" if code in self._policy.quiet_codes else "INFO", how)]
        before, self._fault = self._fault, fault
        if fault is not None and fault == before:
            return self._give_up(f"failed twice in the same way without progress ({fault})")
        return self._failed(now_s, how)

    def start_failed(self, why: str, now_s: float) -> list[ChildEffect]:
        """Process a start that failed: the command is missing, memory is exhausted …"""
        self._liveness = None
        if self.phase is ChildPhase.STOPPING:
            self.phase = ChildPhase.DONE
            return []
        return self._failed(now_s, f"could not be started: {why}")

    def restart(self, now_s: float) -> list[ChildEffect]:
        """Restart the child on a person's order; the restart counts neither as a failure nor in the budget."""
        if self.phase is ChildPhase.STOPPING:
            return []
        self._fault = None
        said = ChildLog("INFO", "is restarted, as ordered")
        if self.phase in (ChildPhase.RUNNING, ChildPhase.KILLING):
            is_new = not self._is_ordered
            self.phase, self._is_ordered = ChildPhase.KILLING, True
            return [said, KillChild("ordered")] if is_new else []
        return [said, *self._start(now_s)]

    def stop(self, now_s: float) -> list[ChildEffect]:
        """Stop restarting the child; the caller has asked the child to end."""
        if self.phase in (ChildPhase.RUNNING, ChildPhase.KILLING):
            self.phase = ChildPhase.STOPPING
        elif self.phase in (ChildPhase.IDLE, ChildPhase.WAITING):
            self.phase = ChildPhase.DONE
        return []

    def tick(self, now_s: float, *, works: bool | None = None) -> list[ChildEffect]:
        """Process deadlines that have passed.

        Args:
            works: whether the process was seen to work recently although it sends no heartbeats; None: unknown.
        """
        if self.phase is ChildPhase.WAITING and now_s >= self._again_s:
            return self._start(now_s)
        if self.phase is not ChildPhase.RUNNING or self._liveness is None:
            return []
        vital = self._liveness.check(now_s, works=works)
        if vital not in _WHY:
            return []
        self.phase = ChildPhase.KILLING
        liveness = self._policy.liveness
        why = _WHY[vital].format(start_s=liveness.start_s, silence_s=liveness.silence_s, closing_s=liveness.closing_s)
        return [ChildLog("WARNING", f"killed: {why}"), KillChild(why)]

    def deadline_s(self) -> float | None:
        """Return the latest time for the next `tick`; None if there is no deadline."""
        if self.phase is ChildPhase.WAITING:
            return self._again_s
        if self.phase is ChildPhase.RUNNING and self._liveness is not None:
            return self._liveness.next_check_s()
        return None

    def _start(self, now_s: float) -> list[ChildEffect]:
        self.phase = ChildPhase.RUNNING
        self._began_s = now_s
        self._liveness = Liveness(self._policy.liveness, now_s, beats=self._policy.beats)
        return [StartChild()]

    def _failed(self, now_s: float, what: str) -> list[ChildEffect]:
        delay_s = self._restarts.failed(now_s, now_s - self._began_s)
        if delay_s is None:
            restart = self._policy.restart
            return self._give_up(
                f"{what}; it was restarted {restart.budget} times within {restart.window_s:g} s already"
            )
        if delay_s <= 0:
            return [ChildLog("WARNING", f"{what}; restarting"), *self._start(now_s)]
        self.phase = ChildPhase.WAITING
        self._again_s = now_s + delay_s
        return [ChildLog("WARNING", f"{what}; restarting in {delay_s:g} s")]

    def _give_up(self, why: str) -> list[ChildEffect]:
        self.phase = ChildPhase.GIVEN_UP
        return [ChildLog("ERROR", f"given up: {why}"), GiveUpChild(why)]
