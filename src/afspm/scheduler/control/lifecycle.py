"""The start and the end of an experiment: the startup barrier, the end, and the grace period after it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from afspm.basics.frozen import replace
from afspm.model import ControlResponse, ProcessState, ResponseDetail
from afspm.scheduler.control.supervisor_registry import OVER
from afspm.scheduler.events import RequestIn

SHUTDOWN_GRACE_S = 3.0
"""Real time that the scheduler stays after the end, so that late components get the last scans and the end.

The time starts again with each report of a component that still runs, up to `LONGEST_GRACE_S`.
"""
LONGEST_GRACE_S = 20.0
"""Longest real time that the scheduler stays after the end: enough for a supervisor to restart a silent component."""
# bounded, since requests come from peers
_MOST_KEPT = 1000
_OTHERS = ("scheduler", "translator")


@dataclass(frozen=True)
class StartupBarrier:
    """A delay of the first control state until missed packets are published; after a restart, also of control requests.

    After a restart, requests that may change control are delayed, too. Otherwise a repeated packet of the translator
    would get a time after the change, and look new.

    Attributes:
        patience_s: the longest wait, real, unless `put_off` extends the wait.
        until_s: the latest opening of the barrier, in real monotonic time; None: the barrier is open.
        is_restart: whether this scheduler continues a run.
        opened_s: the opening of the barrier, in real monotonic time.
        kept: requests that arrived before the barrier opened.
    """

    patience_s: float
    until_s: float | None = None
    is_restart: bool = False
    opened_s: float = 0.0
    kept: tuple[RequestIn, ...] = ()

    def begin(self, now_s: float, *, is_restart: bool) -> StartupBarrier:
        return replace(self, until_s=now_s + self.patience_s, is_restart=is_restart)

    def put_off(self, until_s: float) -> StartupBarrier:
        """Extend the longest wait to `until_s`: more packets are expected."""
        return self if self.until_s is None else replace(self, until_s=max(self.until_s, until_s))

    def opened(self, now_s: float) -> StartupBarrier:
        return self if self.until_s is None else replace(self, until_s=None, opened_s=now_s)

    def keep(self, event: RequestIn) -> StartupBarrier | None:
        """Keep a request until the barrier opens.

        Returns:
            None if the request is not kept: the barrier is open, this is a first start, or too many requests are kept.
        """
        if self.until_s is None or not self.is_restart or len(self.kept) >= _MOST_KEPT:
            return None
        return replace(self, kept=(*self.kept, event))

    def let_in(self) -> tuple[StartupBarrier, RequestIn | None]:
        """Remove and return the first kept request; None while the barrier is closed, or without kept requests."""
        if not self.kept or self.until_s is not None:
            return self, None
        return replace(self, kept=self.kept[1:]), self.kept[0]

    def due_s(self) -> float | None:
        """Return the real time at which the barrier opens, or a kept request must be decided; None: no deadline."""
        if self.until_s is not None:
            return self.until_s
        return self.opened_s if self.kept else None


KeptAnswer = tuple[RequestIn, ControlResponse, str, ResponseDetail]


@dataclass(frozen=True)
class ExperimentEnd:
    """The end of the experiment, which waits until the tip is out of danger.

    Answers that report the end are delayed until then, since components and supervisors exit on such an answer.
    The scheduler itself stays for a grace period.

    Attributes:
        by_s: the latest end of the experiment, in real monotonic time; None: no end in progress.
        kept: the delayed answers.
        leave_at_s: the real time at which the scheduler exits; inf: the experiment has not ended.
        latest_s: the latest real time at which the scheduler exits.
    """

    by_s: float | None = None
    kept: tuple[KeptAnswer, ...] = ()
    leave_at_s: float = math.inf
    latest_s: float = math.inf

    def begin(self, by_s: float) -> ExperimentEnd:
        return replace(self, by_s=by_s)

    def keep(self, answer: KeptAnswer) -> ExperimentEnd | None:
        """Return the state with an answer kept until the experiment has ended; None if no end is in progress."""
        return None if self.by_s is None else replace(self, kept=(*self.kept, answer))

    def is_due(self, now_s: float, *, waits: bool) -> bool:
        """Return whether the experiment ends now; it waits for a tip in danger, and for settings on their way back."""
        return self.by_s is not None and not (waits and now_s < self.by_s)

    def ended(self, now_s: float) -> ExperimentEnd:
        """Begin the grace period."""
        return ExperimentEnd(None, (), now_s + SHUTDOWN_GRACE_S, now_s + LONGEST_GRACE_S)

    def processes_reported(self, states: Iterable[ProcessState], now_s: float) -> ExperimentEnd:
        """Stay longer while a supervisor reports that a process other than scheduler and translator still runs."""
        if self.leave_at_s == math.inf or not any(map(_is_at_work, states)):
            return self
        leave_at_s = max(self.leave_at_s, min(now_s + SHUTDOWN_GRACE_S, self.latest_s))
        return replace(self, leave_at_s=leave_at_s)


def _is_at_work(state: ProcessState) -> bool:
    # a translator subscribes to nothing, and the scheduler must not wait for itself
    return state.role not in _OTHERS and state.condition not in OVER
