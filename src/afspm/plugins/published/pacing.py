"""Spaces messages in time, for peers that look at one message a poll and see only the last state."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from afspm.model import Packet, ScopeState
from afspm.wire.messages import FEEDBACK, PROBE_POSITION, SCAN, SCAN_PARAMETERS

PAUSE_S: Final = 0.4
"""Real time; the published implementation polls every 0.38 s."""
MOST_WAITING: Final = 1000
"""Packets; an experiment that runs faster than real time produces more than can be spaced."""
_PASSING = (ScopeState.MOVING, ScopeState.INTERRUPTED)
_SETTINGS = (SCAN_PARAMETERS.name, FEEDBACK.name, PROBE_POSITION.name)


class Pacing:
    """Keeps packets in order, and each back until its predecessor has been seen.

    Scans go out `PAUSE_S` apart. The state after SS_MOVING or SS_INTERRUPTED goes out `PAUSE_S` after it, and after the
    last settings that came in between. Above `MOST_WAITING` packets the oldest go out at once.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[Packet, str, ScopeState | None]] = deque()
        self._held_until_s = -math.inf
        self._scan_s = self._passing_s = -math.inf
        self._passes = False

    def put(self, packet: Packet, message: str, state: ScopeState | None) -> None:
        """Add a packet; `state` is the one that it publishes."""
        self._waiting.append((packet, message, state))

    def hold(self, until_s: float) -> None:
        """Keep everything back until then: a late joiner is still to get what went out before."""
        self._held_until_s = max(self._held_until_s, until_s)

    def take(self, now_s: float) -> list[Packet]:
        """Return the packets that are due, oldest first."""
        due: list[Packet] = []
        while self._waiting and (len(self._waiting) > MOST_WAITING or self.due_s <= now_s):
            packet, message, state = self._waiting.popleft()
            self._went_out(message, state, now_s)
            due.append(packet)
        return due

    def take_all(self) -> list[Packet]:
        """Return all packets, at the end of the experiment."""
        rest = [packet for packet, _, _ in self._waiting]
        self._waiting.clear()
        return rest

    @property
    def due_s(self) -> float:
        """When the next packet goes out; infinity: none waits."""
        if not self._waiting:
            return math.inf
        _, message, state = self._waiting[0]
        after_s = -math.inf
        if message == SCAN.name:
            after_s = self._scan_s
        elif state is not None and self._passes:
            after_s = self._passing_s
        return max(self._held_until_s, after_s + PAUSE_S)

    def _went_out(self, message: str, state: ScopeState | None, now_s: float) -> None:
        if message == SCAN.name:
            self._scan_s = now_s
        elif state is not None:
            self._passes, self._passing_s = state in _PASSING, now_s
        elif self._passes and message in _SETTINGS:
            self._passing_s = now_s
