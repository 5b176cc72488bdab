"""An action whose place has moved in the microscope's coordinates waits until the microscope has been moved there."""

from __future__ import annotations

from dataclasses import dataclass

from afspm.logic.events import RequestIn
from afspm.logic.forwarder import ForwardedRequest
from afspm.logic.watchdog import Watchdog
from afspm.model import Response, ScopeState, ScopeStatus

SETTLED_WITHIN_S = 2.0
"""Real time for which a microscope that tells nothing of a move is waited for after it."""


@dataclass
class _Waiting:
    """An action, the move that it waits for, and until when (real)."""

    event: RequestIn
    job: ForwardedRequest
    states_seen: int
    settled_at_s: float | None = None


class PrePositioner:
    """Knows the action that waits; the owner sends the move and reports its end, and the action when it is `ready`."""

    def __init__(self, watchdog: Watchdog) -> None:
        self._watchdog = watchdog
        self._waiting: _Waiting | None = None

    @property
    def busy(self) -> bool:
        return self._waiting is not None

    def is_passing(self, told: object) -> bool:
        """Whether a state that is told is that of a move before an action. Nobody is told it: the action, which its
        client knows to be under way, would seem to be over before it began, and be asked for again."""
        return self.busy and isinstance(told, ScopeStatus) and told.state in (ScopeState.MOVING, ScopeState.FREE)

    def begin(self, event: RequestIn, job: ForwardedRequest) -> None:
        """An action waits for a move that has been sent."""
        self._waiting = _Waiting(event, job, self._watchdog.states_seen)

    def ended(self, job: ForwardedRequest, response: Response, now_s: float) -> RequestIn | None:
        """A move was answered. Returns the action that can't be done, since it failed."""
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

    def call_back(self, client: str | None) -> RequestIn | None:
        """Forget the action of a client that has lost control; None: of anybody."""
        if self._waiting is None or client not in (None, self._waiting.event.name):
            return None
        event, self._waiting = self._waiting.event, None
        return event

    def due_s(self) -> float | None:
        """When, in real time, `ready` is to be looked at; before that the forwarder watches over the move."""
        return None if self._waiting is None else self._waiting.settled_at_s
