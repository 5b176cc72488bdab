"""The TCP Logger: a stream of signals to every client of a separate port. No sockets here."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Final

USUAL_PORT: Final = 6590
LARGEST_OVERSAMPLING: Final = 1000
MOST_WAITING: Final = 1 << 20
"""Highest number of unread bytes of a reader; until they are read, no further frame is sent."""
_RATE_HZ: Final = 2000.0
_MOST_AT_ONCE: Final = 20
_DISCONNECTED, _IDLE, _RUNNING, _OVERFLOW = 0, 1, 4, 7


class TcpLogger:
    """The TCP Logger: its settings, and the frames that are due.

    Attributes:
        slots: streamed slots of the Signals Manager.
        oversampling: number of samples averaged into a value.
        unread: unread bytes of each reader.
    """

    def __init__(self) -> None:
        self.slots: list[int] = []
        self.oversampling = 1
        self.unread: list[int] = []
        self._started_s: float | None = None
        self._counter = 0

    @property
    def running(self) -> bool:
        """True while the logger is started and has readers."""
        return self._started_s is not None and bool(self.unread)

    def start(self, now_s: float) -> None:
        """Start with the counter at zero."""
        self._started_s, self._counter = now_s, 0

    def stop(self) -> None:
        self._started_s = None

    def status(self) -> int:
        """Return the protocol's status code."""
        if not self.unread:
            return _DISCONNECTED
        if self._started_s is None:
            return _IDLE
        return _OVERFLOW if max(self.unread) >= MOST_WAITING else _RUNNING

    def due(self, now_s: float) -> range:
        """Return the counters of the frames due now, at most the last 20; gaps in the counters show lost frames."""
        if self._started_s is None:
            return range(0)
        until = math.floor((now_s - self._started_s) / self._period_s + 1e-9)
        found = range(max(self._counter, until - _MOST_AT_ONCE), until)
        self._counter = max(self._counter, until)
        return found

    def next_s(self) -> float:
        """Return the time of the next frame; infinite if the logger is stopped."""
        return math.inf if self._started_s is None else self._started_s + self._period_s * (self._counter + 1)

    def frame(self, counter: int, values: Sequence[float]) -> bytes:
        """Encode a frame: number of channels (i), oversampling (f), counter (64 bits), state (H), values (f)."""
        head = struct.pack(">ifqH", len(values), float(self.oversampling), counter, _RUNNING)
        return head + struct.pack(f">{len(values)}f", *values)

    @property
    def _period_s(self) -> float:
        return self.oversampling / _RATE_HZ
