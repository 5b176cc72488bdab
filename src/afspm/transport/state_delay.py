"""Delays "free" after a passing state, for peers of version 1, which look only at the last state that has come."""

from __future__ import annotations

from collections import deque

from afspm.errors import WireError
from afspm.model import Packet, ScopeState
from afspm.wire import decode, message_of
from afspm.wire.messages import SCOPE_STATE

DELAY_S = 0.1
"""Real time that a passing state lasts at least."""
_PASSING = (ScopeState.MOVING, ScopeState.INTERRUPTED)


class StateDelay:
    """Keeps SS_FREE back after a passing state, and in order whatever comes after it.

    Attributes:
        due_s: when, in real monotonic time, the kept packets go out; None: there are none.
    """

    def __init__(self) -> None:
        self.due_s: float | None = None
        self._passing_s: float | None = None
        self._kept: deque[Packet] = deque()

    def take(self, packet: Packet, now_s: float, *, wanted: bool) -> list[Packet]:
        """Take a packet that is to be published; return those that go out now.

        Args:
            wanted: whether there are peers for which a state is delayed.
        """
        state = _state(packet)
        ends_s = None if self._passing_s is None else self._passing_s + DELAY_S
        if state is not None:
            self._passing_s = now_s if state in _PASSING else None
        if self.due_s is None and state is ScopeState.FREE and wanted and ends_s is not None and now_s < ends_s:
            self.due_s = ends_s
        if self.due_s is None:
            return [packet]
        self._kept.append(packet)
        return []

    def release(self, now_s: float = float("inf")) -> list[Packet]:
        """Return the packets that were kept for long enough, oldest first; without a time: all."""
        if self.due_s is None or now_s < self.due_s:
            return []
        self.due_s = None
        kept, self._kept = list(self._kept), deque()
        return kept


def _state(packet: Packet) -> ScopeState | None:
    """The state that a packet tells; None: it tells none."""
    if not packet.envelope.startswith(SCOPE_STATE.name):
        return None
    try:
        state: ScopeState = decode(message_of(packet.envelope), packet.payload).state
    except WireError:
        return None
    return state
