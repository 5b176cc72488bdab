"""Requests that wait to be handled: each client has its share, and the component in control comes first."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

from afspm.transport.router import PeerAsked, PeerConnected, RouterEvent

MOST_REQUESTS = 1000
MOST_BYTES = 4 << 20
"""What may wait of one connection; what comes beyond is refused."""


class _Waiting:
    """The requests of one connection, oldest first."""

    __slots__ = ("bytes", "requests")

    def __init__(self) -> None:
        self.requests: deque[PeerAsked] = deque()
        self.bytes = 0


class FairQueue:
    """Takes in the events of a router, and gives them back in turn: one request of each connection after the other."""

    def __init__(self, most_requests: int = MOST_REQUESTS, most_bytes: int = MOST_BYTES) -> None:
        self._most_requests = most_requests
        self._most_bytes = most_bytes
        self._changes: deque[RouterEvent] = deque()
        self._waiting: dict[int, _Waiting] = {}

    def __bool__(self) -> bool:
        return bool(self._changes or self._waiting)

    def put(self, events: Iterable[RouterEvent]) -> list[PeerAsked]:
        """Take in what has come; returns the requests that there is no room for.

        A connection's coming and going is handled before any request that waits, but for its own.
        """
        refused = []
        for event in events:
            if isinstance(event, PeerAsked):
                if not self._append(event):
                    refused.append(event)
                continue
            if not isinstance(event, PeerConnected) and (gone := self._waiting.pop(event.connection, None)):
                self._changes.extend(gone.requests)
            self._changes.append(event)
        return refused

    def _append(self, asked: PeerAsked) -> bool:
        size = _size(asked)
        waiting = self._waiting.get(asked.connection)
        if waiting is None:
            waiting = self._waiting[asked.connection] = _Waiting()
        elif len(waiting.requests) >= self._most_requests or waiting.bytes + size > self._most_bytes:
            return False
        waiting.requests.append(asked)
        waiting.bytes += size
        return True

    def take(self, most: int, holder: str | None) -> Iterator[RouterEvent]:
        """At most so many events, those of the component in control first; asked for one after the other."""
        for _ in range(most):
            if self._changes:
                yield self._changes.popleft()
            elif self._waiting:
                yield self._next(holder)
            else:
                return

    def _next(self, holder: str | None) -> PeerAsked:
        connection = next(iter(self._waiting))
        if holder is not None and len(self._waiting) > 1:
            held = (one for one, waiting in self._waiting.items() if waiting.requests[0].name == holder)
            connection = next(held, connection)
        waiting = self._waiting.pop(connection)
        asked = waiting.requests.popleft()
        waiting.bytes -= _size(asked)
        if waiting.requests:
            self._waiting[connection] = waiting  # the last in turn
        return asked


def _size(asked: PeerAsked) -> int:
    return sum(map(len, asked.frames))
