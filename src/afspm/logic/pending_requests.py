"""Requests that are not sent yet: each waits for a value, a move of the microscope, or a connection to close."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.logic.events import RequestIn
from afspm.logic.forwarder import ForwardedRequest
from afspm.logic.frozen import replace
from afspm.logic.microscope_status import MicroscopeStatus
from afspm.model import ScopeState, ScopeStatus

SETTLED_WITHIN_S = 2.0
"""Real time for which a microscope that tells nothing of a move is waited for after it."""
_UNCLEAR_S = 0.5  # real; the closing of a connection is seen within milliseconds


@dataclass(frozen=True)
class PendingRead:
    """A request that waits for the values its limits depend on.

    Attributes:
        number: of the read, to find it again.
        names: of the values that are still to come.
        deadline_s: when (real) it must be answered.
    """

    number: int
    event: RequestIn
    names: frozenset[str]
    deadline_s: float


@dataclass(frozen=True)
class PrePositioner:
    """An action whose place has moved in the microscope's coordinates: it waits until the microscope was moved there.

    Attributes:
        move: the request that moves it.
        states_seen: states told before the move.
        settled_at_s: until when (real) the microscope is waited for after the move.
    """

    event: RequestIn
    move: ForwardedRequest
    states_seen: int
    settled_at_s: float | None = None

    def hides(self, told: object) -> bool:
        """Return whether a state is only that of the move, and not published.

        The action, which its client knows to be under way, would seem to be over before it began.
        """
        return isinstance(told, ScopeStatus) and told.state in (ScopeState.MOVING, ScopeState.FREE)

    def moved(self, now_s: float) -> PrePositioner:
        """Wait until the microscope is free: the move has succeeded."""
        return replace(self, settled_at_s=min(now_s + SETTLED_WITHIN_S, self.move.deadline_s))

    def is_ready(self, microscope: MicroscopeStatus, now_s: float) -> bool:
        """Return whether the action may be sent: while the microscope moves it would refuse."""
        if self.settled_at_s is None:
            return False
        is_free = microscope.state is ScopeState.FREE and microscope.states_seen > self.states_seen
        return is_free or now_s >= self.settled_at_s


@dataclass(frozen=True)
class PendingRequests:
    """All that wait.

    Attributes:
        unclear: requests from a second connection under a name, by that name, and until when they are not answered.
        refused: connections that were refused, which is logged once for each.
    """

    reads: tuple[PendingRead, ...] = ()
    move: PrePositioner | None = None
    unclear: Mapping[str, tuple[RequestIn, float]] = field(default_factory=dict)
    refused: frozenset[int] = frozenset()

    def read(self, number: int) -> PendingRead | None:
        return next((one for one in self.reads if one.number == number), None)

    def without_read(self, number: int, *instead: PendingRead) -> PendingRequests:
        return replace(self, reads=(*(one for one in self.reads if one.number != number), *instead))

    def called_back(self, client: str | None) -> tuple[PendingRequests, list[RequestIn]]:
        """Take back the requests of a client that has lost control; None: of all."""
        gone = [one for one in self.reads if client in (None, one.event.name)]
        events = [one.event for one in gone]
        move = self.move
        if move is not None and client in (None, move.event.name):
            events.append(move.event)
            move = None
        return replace(self, reads=tuple(one for one in self.reads if one not in gone), move=move), events

    def with_unclear(self, event: RequestIn, now_s: float) -> PendingRequests:
        return replace(self, unclear={**self.unclear, event.name: (event, now_s + _UNCLEAR_S)})

    def clear_up(self, name: str) -> tuple[PendingRequests, RequestIn | None]:
        """Return the request parked while an older connection with this name was closing."""
        if name not in self.unclear:
            return self, None
        rest = {other: one for other, one in self.unclear.items() if other != name}
        return replace(self, unclear=rest), self.unclear[name][0]

    def still_unclear(self, now_s: float) -> list[str]:
        """Return the names for which both connections go on: they are two."""
        return [name for name, (_, until_s) in self.unclear.items() if now_s >= until_s]

    def due_s(self) -> float | None:
        """Return when, in real time, there is something to do; before that the forwarder watches over the move."""
        dues = [until_s for _, until_s in self.unclear.values()]
        if self.move is not None and self.move.settled_at_s is not None:
            dues.append(self.move.settled_at_s)
        return min(dues, default=None)


def refused_again(pending: PendingRequests, connection: int) -> tuple[PendingRequests, bool]:
    """Return whether a connection was refused before; from now on it was."""
    if connection in pending.refused:
        return pending, True
    return replace(pending, refused=pending.refused | {connection}), False
