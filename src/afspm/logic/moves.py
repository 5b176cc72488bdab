"""An action whose place has moved in the microscope's coordinates waits until the microscope has been moved there."""

from __future__ import annotations

from dataclasses import dataclass

from afspm.logic.events import RequestIn
from afspm.logic.forwarding import Forwarder, Job
from afspm.logic.frame import Mapped
from afspm.logic.watchdog import Watchdog
from afspm.model import Response, ScopeState

SETTLED_WITHIN_S = 2.0
"""Real time for which a microscope that tells nothing of a move is waited for after it."""


@dataclass
class _Waiting:
    """An action, the move that it waits for, and until when (real)."""

    event: RequestIn
    job: Job
    states_seen: int
    settled_at_s: float | None = None


class Mover:
    """Sends the move before the action; the owner reports how that ended, and sends the action when it is `ready`."""

    def __init__(self, forwarder: Forwarder, watchdog: Watchdog) -> None:
        self._forwarder = forwarder
        self._watchdog = watchdog
        self._waiting: _Waiting | None = None

    @property
    def busy(self) -> bool:
        return self._waiting is not None

    def begin(self, event: RequestIn, move: Mapped, now_s: float) -> bool:
        """Send a move; False: the microscope can't be asked."""
        job = self._forwarder.ask_own(move.request, now_s)
        if job is None:
            return False
        job.mapped = move
        self._waiting = _Waiting(event, job, self._watchdog.states_seen)
        return True

    def ended(self, job: Job, response: Response, now_s: float) -> RequestIn | None:
        """A request of the scheduler's own was answered. Returns the action that can't be done for it."""
        waiting = self._waiting
        if waiting is None or job is not waiting.job:
            return None
        if response.ok:
            waiting.settled_at_s = min(now_s + SETTLED_WITHIN_S, job.deadline_s)
            return None
        self._waiting = None
        return waiting.event

    def ready(self, now_s: float) -> tuple[RequestIn, float] | None:
        """The action that may be sent now, which it is from then on, and its deadline.

        That is when the microscope has told that it is free after the move: while it moves it would refuse.
        """
        waiting = self._waiting
        if waiting is None or waiting.settled_at_s is None:
            return None
        is_free = self._watchdog.state is ScopeState.FREE and self._watchdog.states_seen > waiting.states_seen
        if not is_free and now_s < waiting.settled_at_s:
            return None
        self._waiting = None
        return waiting.event, waiting.job.deadline_s

    def call_back(self, client: str) -> RequestIn | None:
        """Forget the action of a client that has lost control."""
        if self._waiting is None or self._waiting.event.name != client:
            return None
        event, self._waiting = self._waiting.event, None
        return event

    def owns(self, job: Job) -> bool:
        return self._waiting is not None and job is self._waiting.job

    def due_s(self) -> float | None:
        """When, in real time, `ready` is to be looked at; before that the forwarder watches over the move."""
        return None if self._waiting is None else self._waiting.settled_at_s
