"""What a publisher remembers of what it has published."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable

from afspm.clock import Clock
from afspm.model import Packet

MOST_PACKETS = 1000
MOST_BYTES = 256 * 1024 * 1024


class Published:
    """Gives packets their time, and keeps the last of them for those who come later.

    Kept is the last packet of every envelope, and of all others as many of the newest as fit the bounds.
    """

    def __init__(self, clock: Clock, *, most_packets: int = MOST_PACKETS, most_bytes: int = MOST_BYTES) -> None:
        self._clock = clock
        self._most_packets = most_packets
        self._most_bytes = most_bytes
        self._packets: deque[Packet] = deque()
        self._bytes = 0
        self._last: dict[str, Packet] = {}
        self._newest_ns = 0

    def stamp(self, envelope: str, payload: bytes, time_ns: int | None = None, *, keep: bool = True) -> Packet:
        """A packet that is newer than all before it, now remembered, unless it is not to be.

        Args:
            time_ns: a time that was given out already.
        """
        self._newest_ns = max(self._clock.now_ns() if time_ns is None else time_ns, self._newest_ns + 1)
        packet = Packet(envelope, payload, self._newest_ns)
        if not keep:
            return packet
        self._packets.append(packet)
        self._bytes += len(payload)
        self._last.pop(envelope, None)
        self._last[envelope] = packet
        while len(self._packets) > self._most_packets or (self._bytes > self._most_bytes and len(self._packets) > 1):
            self._bytes -= len(self._packets.popleft().payload)
        while len(self._last) > self._most_packets:
            del self._last[next(iter(self._last))]
        return packet

    def __call__(self, _who: Hashable, prefixes: tuple[str, ...], since_ns: int) -> list[Packet]:
        """What is kept under `prefixes` and newer than `since_ns`, oldest first."""
        kept = {packet.time_ns or 0: packet for packet in (*self._last.values(), *self._packets)}
        return [
            kept[time_ns]
            for time_ns in sorted(kept)
            if time_ns > since_ns and kept[time_ns].envelope.startswith(prefixes)
        ]
