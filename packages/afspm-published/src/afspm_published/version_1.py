"""Version 1 of the protocol: the messages that its programs can read, and the pace that they can follow.

Programs of version 1 end on any other envelope or request number.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from afspm.basics import Launch
from afspm.model import ControlRequest, ControlResponse, Packet, Request, Response, ScopeState
from afspm.transport import Network
from afspm.wire import KILL, encode_response, encode_subject
from afspm.wire.messages import (
    CONTROL_STATE,
    FEEDBACK,
    POINTS,
    PROBE_POSITION,
    REGIONS,
    SCAN,
    SCAN_PARAMETERS,
    SCOPE_STATE,
    SPECTRUM,
)

TOPICS: Final = (
    SCAN.name,
    SPECTRUM.name,
    SCOPE_STATE.name,
    CONTROL_STATE.name,
    SCAN_PARAMETERS.name,
    FEEDBACK.name,
    PROBE_POSITION.name,
    REGIONS.name,
    POINTS.name,
)
"""The messages that a cache of version 1 knows."""
PAUSE_S: Final = 0.4
"""Pause between two delayed packets, in real seconds; the published implementation polls every 0.38 s."""
MOST_WAITING: Final = 1000
"""Largest number of delayed packets: an experiment faster than real time produces more packets than fit the pauses."""
_PASSING = (ScopeState.MOVING, ScopeState.INTERRUPTED)
_SETTINGS = (SCAN_PARAMETERS.name, FEEDBACK.name, PROBE_POSITION.name)
_WITHOUT_OBJECT = (ControlRequest.RELEASE_CTRL, ControlRequest.END_EXPERIMENT)


def outside(launch: Launch) -> Network:
    """Return a network for plain sockets, limited to this computer unless [security] insecure is set."""
    return Network(insecure=bool(launch.keys and launch.keys.get("insecure")))


def has_request(number: int) -> bool:
    """Return whether version 1 defines a request number."""
    return ControlRequest.UNDEFINED < number <= ControlRequest.ACTION_SUPPORT


def request_frames(request: Request) -> list[bytes]:
    """Return a request as frames of version 1: number, and object (possibly empty) if this request takes an object."""
    number = bytes([request.kind])
    return [number] if request.kind in _WITHOUT_OBJECT else [number, request.payload or encode_subject(request.subject)]


def answer_frames(asked: int, response: Response, *, reason: bool = False) -> list[bytes]:
    """Return a response as frames of version 1: number, and object if any.

    Args:
        asked: the number of the request; the answer to REQ_PARAM always has an object, possibly empty.
        reason: add the reason as a third frame, for debugging.
    """
    if reason:
        return encode_response(response)[:3]
    number = bytes([response.code])
    return [number, response.payload] if response.payload or asked == ControlRequest.PARAM else [number]


def unknown_request(number: int, whose: str, request_id: str) -> Response:
    """Return the refusal of a request number unknown to version 1, which would end the peer if sent."""
    reason = f"the {whose} is of version 1 of the protocol, which has no request {number}"
    return Response(int(ControlResponse.CMD_NOT_SUPPORTED), b"", reason, request_id)


def topics_meant(prefix: str) -> list[str]:
    """Return the prefixes that a version 1 subscription stands for: all known messages that begin with `prefix`.

    Without such a message, `prefix` itself is returned.

    >>> topics_meant("Scan")
    ['Scan2d', 'ScanParameters2d']
    >>> topics_meant("Scan2d_2"), topics_meant("JournalEntries")
    (['Scan2d_2'], ['JournalEntries'])
    """
    return [name for name in (*TOPICS, KILL.decode()) if name.startswith(prefix)] or [prefix]


class Pacing:
    """Queue that delays packets, in order, for peers that process one message per poll and see only the last state.

    Scans are released `PAUSE_S` apart. The state that follows SS_MOVING or SS_INTERRUPTED is released `PAUSE_S` later,
    counted from the last settings in between, if any. With more than `MOST_WAITING` packets, the oldest are released at
    once.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[Packet, str, ScopeState | None]] = deque()
        self._held_until_s = -math.inf
        self._scan_s = self._passing_s = -math.inf
        self._passes = False

    def put(self, packet: Packet, message: str, state: ScopeState | None) -> None:
        """Add a packet.

        Args:
            message: the name of the packet's message.
            state: the state in a ScopeStateMsg; None for other messages.
        """
        self._waiting.append((packet, message, state))

    def hold(self, until_s: float) -> None:
        """Hold all packets until `until_s`, so that a late joiner first receives earlier packets."""
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
        """Remove and return all packets, at the end of the experiment."""
        rest = [packet for packet, _, _ in self._waiting]
        self._waiting.clear()
        return rest

    @property
    def due_s(self) -> float:
        """The time of the next packet, in real seconds; infinity without waiting packets."""
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
