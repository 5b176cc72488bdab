"""The subscribers of one publisher: what each has asked for, and how many bytes wait to be sent to it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable

from afspm.transport.connections import disconnect, name_of, tcp_info

MOST_WAITING_BYTES = 512 << 20
"""As much as a scheduler's cache holds. All that wait share the same buffers: so it is that much for all together."""
MOST_PREFIXES = 1000
LONGEST_PREFIX_BYTES = 1 << 10
MOST_PREFIX_BYTES = 64 << 10
"""Of all prefixes of a subscriber: libzmq keeps some fifty bytes for each of these."""
REPLAY_PERIOD_S, MOST_REPLAYS = 1.0, 10
"""A connection may ask for one replay a second, and for some at once: a plain subscriber names its prefixes one by one,
and one of ours that connects anew repeats what it has asked for before."""
_STEP_BYTES = 8 << 20
"""How much is published between two looks at what waits."""
_log = logging.getLogger("afspm.transport")


class _Subscriber:
    """One connection. `sent` counts its bytes since it came, as TCP counts those that it has acknowledged."""

    __slots__ = ("descriptor", "name", "prefix_bytes", "prefixes", "replayed_s", "replays", "sent")

    def __init__(self, descriptor: int, name: str) -> None:
        self.descriptor = descriptor
        self.name = name
        self.prefixes: tuple[str, ...] = ()
        self.prefix_bytes = 0
        self.replays, self.replayed_s = 0.0, 0.0
        info = tcp_info(descriptor)
        self.sent = info.acked if info else 0

    def waiting(self) -> int:
        """Bytes that were sent to it, and have not arrived."""
        info = tcp_info(self.descriptor)
        if info is None or info.all_sent:  # a queue that is not empty keeps the system's buffer filled
            self.sent = info.acked if info else 0
            return 0
        return self.sent - info.acked


class Subscribers:
    """Disconnects those that ask for too much, or take too little of it. Connected again they ask for what they missed.

    Args:
        most_bytes: how much may wait for one of them.
    """

    def __init__(self, most_bytes: int = MOST_WAITING_BYTES, monotonic_s: Callable[[], float] = time.monotonic) -> None:
        self._most_bytes = most_bytes
        self._monotonic_s = monotonic_s
        self._by_descriptor: dict[int, _Subscriber] = {}
        self._unlooked = 0

    def subscribed(self, descriptor: int | None, prefixes: Iterable[str], size: int) -> bool:
        """A connection subscribes by a message of so many bytes; False: to too much, and it is disconnected."""
        peer = self._of(descriptor)
        if peer is None:
            return True
        before, peer.prefixes = peer.prefixes, tuple(dict.fromkeys((*peer.prefixes, *prefixes)))
        peer.prefix_bytes += size
        longest = max(map(len, prefixes), default=0)
        if (
            longest <= LONGEST_PREFIX_BYTES
            and len(peer.prefixes) <= MOST_PREFIXES
            and peer.prefix_bytes <= MOST_PREFIX_BYTES
        ):
            return True
        peer.prefixes = before
        self._end(peer, f"it subscribes to {peer.prefix_bytes} bytes of prefixes, the longest of {longest}")
        return False

    def unsubscribed(self, descriptor: int | None, size: int) -> None:
        """A connection has taken back what it had asked for by a message of so many bytes."""
        if (peer := self._of(descriptor)) is not None:
            peer.prefix_bytes = max(0, peer.prefix_bytes - size)

    def may_replay(self, descriptor: int | None) -> bool:
        """A connection asks for a replay; False: it does so too often, and is disconnected."""
        peer, now_s = self._of(descriptor), self._monotonic_s()
        if peer is None:
            return True
        peer.replays = max(0.0, peer.replays - (now_s - peer.replayed_s) / REPLAY_PERIOD_S) + 1.0
        peer.replayed_s = now_s
        if peer.replays <= MOST_REPLAYS:
            return True
        self._end(peer, "it asks for what was published before again and again")
        return False

    def sent(self, descriptor: int | None, count: int) -> None:
        """So many bytes were sent to one of them."""
        if descriptor is not None and (peer := self._by_descriptor.get(descriptor)) is not None:
            peer.sent += count
            self._look_after(count)

    def published(self, envelope: str, count: int) -> None:
        """So many bytes were sent to each that subscribes to this envelope."""
        for peer in self._by_descriptor.values():
            if envelope.startswith(peer.prefixes):
                peer.sent += count
        self._look_after(count)

    def _look_after(self, count: int) -> None:
        self._unlooked += count
        if self._unlooked < _STEP_BYTES:
            return
        self._unlooked = 0
        for peer in [*self._by_descriptor.values()]:
            if name_of(peer.descriptor) != peer.name:
                del self._by_descriptor[peer.descriptor]
            elif (waiting := peer.waiting()) > self._most_bytes:
                self._end(peer, f"{waiting >> 20} MB wait for it, and it takes none of it")

    def _of(self, descriptor: int | None) -> _Subscriber | None:
        """None: the system does not tell one connection from another."""
        if descriptor is None or not (name := name_of(descriptor)):
            return None
        known = self._by_descriptor.get(descriptor)
        if known is None or known.name != name:
            known = self._by_descriptor[descriptor] = _Subscriber(descriptor, name)
        return known

    def _end(self, peer: _Subscriber, why: str) -> None:
        _log.warning("disconnected a subscriber: %s", why)
        disconnect(peer.descriptor, peer.name)
