r"""Packets that a publisher keeps for late joiners, and the marker with which a subscriber requests them.

A subscriber of afspm subscribes to a marker: a topic for this subscriber that also holds its request:

    \0replay/<name>/<nonce> \0 <since_ns> \0 <prefix> \0 <prefix> …

The publisher sends the kept packets as `[topic, envelope, message, timestamp]` and finally `[topic]` alone; the topic
is the first part of the marker, to which only this subscriber is subscribed.

From then on the subscriber also gets a beacon each second, `[\0newest, <envelope> \0 <time_ns> \0 <envelope> …]`: the
newest kept packet of each envelope. A beacon comes through the same pipe as the packets, after all that were published
before it. So a packet that it names and that has not arrived was dropped, and is requested by a marker of its own.

The publisher's socket (XPUB in manual mode) subscribes the peer to its topic and its prefixes at once, between two
packets. So replayed and new packets come through one pipe, in order and without a gap. A snapshot over the request
socket would have to be joined with the live packets by time, and a replay to all subscribers reaches every component.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping
from heapq import nlargest
from typing import NamedTuple

from afspm.basics.clock import Clock
from afspm.basics.errors import WireError
from afspm.model import Packet
from afspm.wire import Buffer

History = Callable[[Hashable, tuple[str, ...], int], Iterable[Packet]]
"""(subscriber, prefixes, since_ns) -> later packets under these prefixes, oldest first."""

Newest = Callable[[], Mapping[str, int]]
"""() -> time of the newest kept packet of each envelope, ns."""

BEACON = b"\0newest"
"""Topic of a publisher's beacon."""
LONGEST = 8 << 10
"""Longest marker, in bytes."""
_BEGIN = b"\0replay/"
_LONGEST_NONCE = 9
_MOST_PREFIXES = 1000
_MOST_PACKETS = 1000
_MOST_BYTES = 256 << 20
_MOST_IN_BEACON = 64

# An envelope is text, so it begins with one of these bytes. They replace the empty prefix ("everything"), which would
# also match the replays for other subscribers.
FIRST_BYTES = tuple(bytes([n]) for n in (*range(0x20, 0x7F), *range(0xC2, 0xF5)))


class Marker(NamedTuple):
    """A subscriber's request for a replay.

    Attributes:
        topic: topic of the replayed packets.
        since_ns: time up to which the subscriber has every packet.
        prefixes: prefixes of the wanted envelopes.
    """

    topic: bytes
    since_ns: int
    prefixes: tuple[str, ...]

    def encode(self) -> bytes:
        return b"\0".join([self.topic, b"%d" % self.since_ns, *(prefix.encode() for prefix in self.prefixes)])

    @classmethod
    def decode(cls, subscription: bytes) -> Marker | None:
        """Return the marker in a subscription; None for an ordinary prefix or a malformed marker."""
        if not subscription.startswith(_BEGIN) or len(subscription) > LONGEST:
            return None
        parts = subscription[1:].split(b"\0")
        if not 3 <= len(parts) <= _MOST_PREFIXES + 2:
            return None
        try:
            since_ns = int(parts[1])
            prefixes = tuple(str(part, "utf-8") for part in parts[2:])
        except ValueError:
            return None
        return cls(b"\0" + parts[0], since_ns, prefixes)

    @property
    def subscriber(self) -> str:
        """Return the name of the subscriber."""
        return self._parts[0].decode("utf-8", "replace")

    @property
    def reconnections(self) -> int:
        """Return how often the subscriber has connected again: its nonce counts its connections."""
        nonce = self._parts[1]
        return int(nonce) if nonce.isdigit() and len(nonce) <= _LONGEST_NONCE else 0

    @property
    def _parts(self) -> tuple[bytes, bytes]:
        name, _, nonce = self.topic.removeprefix(_BEGIN).rpartition(b"/")
        return name, nonce


def topic(name: str, nonce: int | str) -> bytes:
    """Return a topic of the subscriber `name`, different for each request."""
    return _BEGIN + f"{name}/{nonce}".replace("\0", "").encode()


def encode_newest(newest: Mapping[str, int]) -> bytes:
    """Return the content of a beacon: the `_MOST_IN_BEACON` newest of some envelopes, with their times."""
    # an envelope holds texts of the microscope, such as names of channels, and a NUL would end it here
    readable = ((time_ns, envelope) for envelope, time_ns in newest.items() if "\0" not in envelope)
    return "\0".join(f"{envelope}\0{time_ns}" for time_ns, envelope in nlargest(_MOST_IN_BEACON, readable)).encode()


def decode_newest(content: bytes) -> dict[str, int]:
    """Return the times in a beacon, by envelope.

    Raises:
        WireError: the bytes are no beacon.
    """
    if not content:
        return {}
    try:
        parts = content.decode().split("\0")
        return dict(zip(parts[::2], map(int, parts[1::2]), strict=True))
    except ValueError as error:
        raise WireError(f"a beacon can't be read: {error}") from None


def is_reserved(subscription: bytes) -> bool:
    """Return whether a subscription begins like a marker, even if malformed."""
    return subscription.startswith(b"\0")


def spelled_out(prefixes: Iterable[bytes]) -> list[bytes]:
    """Return the prefixes to subscribe a socket to; an empty prefix becomes all possible first bytes of envelopes."""
    found: list[bytes] = []
    for prefix in prefixes:
        found.extend([prefix] if prefix else FIRST_BYTES)
    return found


class PublishedHistory:
    """The kept packets of a publisher, which also assigns times to packets.

    Kept are the last packet of each envelope, and the newest packets of all envelopes. `most_packets` limits the number
    of both, `most_bytes` the size of the newest packets.
    """

    def __init__(self, clock: Clock, *, most_packets: int = _MOST_PACKETS, most_bytes: int = _MOST_BYTES) -> None:
        self._clock = clock
        self._most_packets = most_packets
        self._most_bytes = most_bytes
        self._packets: deque[Packet] = deque()
        self._bytes = 0
        self._last: dict[str, Packet] = {}
        self._newest_ns = 0

    def stamp(self, envelope: str, payload: Buffer, time_ns: int | None = None, *, keep: bool = True) -> Packet:
        """Return a packet with a time later than all earlier packets, and keep it unless `keep` is False.

        Args:
            time_ns: the time of a packet that already has one.
        """
        self._newest_ns = max(self._clock.now_ns() if time_ns is None else time_ns, self._newest_ns + 1)
        packet = Packet(envelope, payload, self._newest_ns)
        if keep:
            self._keep(packet)
        return packet

    def _keep(self, packet: Packet) -> None:
        self._packets.append(packet)
        self._bytes += len(packet.payload)
        self._last.pop(packet.envelope, None)
        self._last[packet.envelope] = packet
        while len(self._packets) > self._most_packets or (self._bytes > self._most_bytes and len(self._packets) > 1):
            self._bytes -= len(self._packets.popleft().payload)
        while len(self._last) > self._most_packets:
            del self._last[next(iter(self._last))]

    def last(self, prefixes: tuple[str, ...]) -> list[Packet]:
        """Return the last packet of every envelope under `prefixes`, oldest first."""
        return [packet for envelope, packet in self._last.items() if envelope.startswith(prefixes)]

    def newest(self) -> dict[str, int]:
        """Return the time of the last packet of each envelope."""
        return {envelope: packet.time_ns or 0 for envelope, packet in self._last.items()}

    def __call__(self, _who: Hashable, prefixes: tuple[str, ...], since_ns: int) -> list[Packet]:
        """Return the kept packets under `prefixes` after `since_ns`, oldest first."""
        kept = {packet.time_ns or 0: packet for packet in (*self._last.values(), *self._packets)}
        return [
            kept[time_ns]
            for time_ns in sorted(kept)
            if time_ns > since_ns and kept[time_ns].envelope.startswith(prefixes)
        ]
