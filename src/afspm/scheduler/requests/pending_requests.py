"""Waiting requests: the next request during its reads and moves, and requests whose sender is not clear yet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.basics.frozen import replace
from afspm.model import (
    Parameter,
    Response,
    ScopeState,
    ScopeStatus,
)
from afspm.model.microscope_status import MicroscopeStatus
from afspm.model.requests import Setting
from afspm.scheduler.events import RequestIn
from afspm.scheduler.requests.forwarder import ForwardedRequest

SETTLED_WITHIN_S = 2.0
"""The longest wait, real, after a move: a microscope may not report that it moves."""
_UNCLEAR_S = 0.5  # real; the closing of a connection is seen within milliseconds


@dataclass(frozen=True)
class PrePositioner:
    """The move before an action whose place has moved in the microscope's coordinates.

    Attributes:
        move: the request that moves the microscope.
        states_seen: number of states reported before the move.
        settled_at_s: the real time at which the wait after the move ends; None: the move is not answered yet.
    """

    move: ForwardedRequest
    states_seen: int
    settled_at_s: float | None = None

    def hides(self, published: object) -> bool:
        """Return whether a state reported during the move must not be published.

        The client has started the action: FREE after the move would look like the end of the action.
        """
        return isinstance(published, ScopeStatus) and published.state in (ScopeState.MOVING, ScopeState.FREE)

    def moved(self, now_s: float) -> PrePositioner:
        """Start to wait for a free microscope after the move has succeeded."""
        return replace(self, settled_at_s=min(now_s + SETTLED_WITHIN_S, self.move.deadline_s))

    def is_ready(self, microscope: MicroscopeStatus, now_s: float) -> bool:
        """Return whether the action may be sent: a moving microscope would refuse the action."""
        if self.settled_at_s is None:
            return False
        is_free = microscope.state is ScopeState.FREE and microscope.states_seen > self.states_seen
        return is_free or now_s >= self.settled_at_s


@dataclass(frozen=True)
class WayStep:
    """A setting on the way of a loan.

    Attributes:
        key: the key of the loan.
        target: the last value of the way, which may need several steps.
        lender: the component that lends it; empty on the way back.
    """

    key: str
    target: Parameter
    lender: str = ""


@dataclass(frozen=True)
class Lending:
    """The settings before a measurement: the values read, the values to be sent, and the wait after them.

    Attributes:
        compared: the translator's answers by name.
        now: the values in force by name.
        stated: what the measurement states, or what takes the place of it.
        way: the values to be set, in order; None: the values in force are being read.
        kind: the present kind of curve; empty: the microscope shows none.
        kind_before: the kind to be set back at the end; empty: none.
        sent: the value on its way to the microscope.
        has_set: whether a value was set: a way back that gives way to other requests takes one step at least.
        changes_loop: whether something was changed after which the feedback settles.
        settles_ns: the experiment time until which it settles; None: no wait.
        later: the refusal of a return by a limit on time; None: none.
        is_done: whether the settings are as the measurement states them.
    """

    compared: Mapping[str, Setting] = field(default_factory=dict)
    now: Mapping[str, Parameter] = field(default_factory=dict)
    stated: tuple[Parameter, ...] = ()
    way: tuple[WayStep, ...] | None = None
    kind: str = ""
    kind_before: str = ""
    sent: Parameter | None = None
    has_set: bool = False
    changes_loop: bool = False
    settles_ns: int | None = None
    later: Response | None = None
    is_done: bool = False


@dataclass(frozen=True)
class Turn:
    """The settings, the reads and the move before one request is sent.

    Attributes:
        number: the number of the request in the forwarder's queue.
        awaited: parameters being read; None: reading has not begun.
        values: the read values, by parameter; None where the microscope answered without a value.
        move: the move before an action; None: no move so far.
        lending: the settings of a measurement; None: they were not looked at.
    """

    number: int
    awaited: frozenset[str] | None = None
    values: Mapping[str, Parameter | None] = field(default_factory=dict)
    move: PrePositioner | None = None
    lending: Lending | None = None

    def reading(self, names: frozenset[str]) -> Turn:
        return replace(self, awaited=names, values={})

    def was_read(self, name: str, answered: Parameter | None) -> Turn:
        """Store the value of a parameter; None: the microscope answered without a value."""
        return replace(self.lacks(name), values={**self.values, name: answered})

    def lacks(self, name: str) -> Turn:
        """Continue without a parameter that the microscope does not have."""
        return replace(self, awaited=(self.awaited or frozenset()) - {name})

    def moving(self, move: PrePositioner) -> Turn:
        """Register a move to wait for, after which the values are read again."""
        return Turn(self.number, move=move, lending=self.lending)

    def is_ready(self, microscope: MicroscopeStatus, now_s: float, now_ns: int) -> bool:
        """Return whether the request can be decided now."""
        settles_ns = None if self.lending is None else self.lending.settles_ns
        if self.awaited or (settles_ns is not None and now_ns < settles_ns):
            return False
        return self.move is None or self.move.is_ready(microscope, now_s)


@dataclass(frozen=True)
class PendingRequests:
    """The requests that wait for a read, a move, or the closing of another connection.

    Attributes:
        turn: the reads and the move of the next request.
        unclear: requests of a second connection under a name, by name, with the end (real) of the wait for the first.
        refused: connections whose refusal was logged, once for each.
    """

    turn: Turn | None = None
    unclear: Mapping[str, tuple[RequestIn, float]] = field(default_factory=dict)
    refused: frozenset[int] = frozenset()

    @property
    def move(self) -> PrePositioner | None:
        return None if self.turn is None else self.turn.move

    @property
    def settles_ns(self) -> int | None:
        """The experiment time until which a change of settings settles; None: no wait."""
        return None if self.turn is None or self.turn.lending is None else self.turn.lending.settles_ns

    def with_unclear(self, event: RequestIn, now_s: float) -> PendingRequests:
        return replace(self, unclear={**self.unclear, event.name: (event, now_s + _UNCLEAR_S)})

    def clear_up(self, name: str) -> tuple[PendingRequests, RequestIn | None]:
        """Remove and return the request of a second connection that waited for the first of this name to close."""
        if name not in self.unclear:
            return self, None
        rest = {other: one for other, one in self.unclear.items() if other != name}
        return replace(self, unclear=rest), self.unclear[name][0]

    def still_unclear(self, now_s: float) -> list[str]:
        """Return the names with two open connections after the wait: they belong to two processes."""
        return [name for name, (_, until_s) in self.unclear.items() if now_s >= until_s]

    def due_s(self, *, line_is_free: bool) -> float | None:
        """Return the real time at which the next wait ends; None: no wait.

        `Forwarder.deadline_s` has the deadline of a move in flight.
        """
        dues = [until_s for _, until_s in self.unclear.values()]
        if line_is_free and self.move is not None and self.move.settled_at_s is not None:
            dues.append(self.move.settled_at_s)
        return min(dues, default=None)


def refused_again(pending: PendingRequests, connection: int) -> tuple[PendingRequests, bool]:
    """Return whether a connection was refused before, and mark it as refused."""
    if connection in pending.refused:
        return pending, True
    return replace(pending, refused=pending.refused | {connection}), False
