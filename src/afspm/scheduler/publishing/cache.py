"""Cache of the latest packets for late joiners: ordered, bounded in size, without duplicates."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

from afspm.model import LoggedPacket, Packet, PacketHeader
from afspm.scheduler.publishing.envelopes import Envelopes

TIME_STEP_NS = 1_000
"""The least time between two packets: peers that count in microseconds must see them in order."""

_OVERHEAD_BYTES = 300  # of a cached packet beside its payload: a flood of empty packets must be bounded, too
_TIMES_REMEMBERED = 4096
_RECENT = 64  # part of each saved state, so few
_NEVER_NS = 0
"""Placeholder for the time of a packet that is deliberately not published, even after a restart."""
_NEWEST = 16
_FUTURE_NS = 3600 * 10**9  # a translator's clock further ahead is wrong: its times would put off all later packets


@dataclass(slots=True)
class Kept:
    """A packet in the cache, with its size in bytes, including a fixed overhead."""

    logged: LoggedPacket
    size: int

    @property
    def packet(self) -> Packet:
        return self.logged.packet


class PacketCache:
    """The latest packets of each envelope, oldest first over all envelopes.

    Args:
        envelopes: the envelope of each packet, and the number of packets kept for each envelope.
        max_bytes: total size. Beyond it, the oldest packet whose envelope has a newer packet is dropped; without such a
            packet, the oldest of all. A larger single packet is not cached.
    """

    def __init__(self, envelopes: Envelopes | None = None, max_bytes: int = 512 * 2**20) -> None:
        self._envelopes = envelopes or Envelopes()
        self._max_bytes = max_bytes
        self._kept: dict[int, Kept] = {}  # by time, which increases: insertion order is the order in time
        self._times: dict[str, deque[int]] = {}
        self._several = 0  # envelopes with more than one packet
        self._bytes = 0
        self._last_ns = 0
        self._sources: OrderedDict[int, None] = OrderedDict()
        self._newest_source_ns = -1
        self._recent: deque[tuple[int, int]] = deque(maxlen=_RECENT)
        self._first_times: dict[int, int] = {}

    @property
    def last_ns(self) -> int:
        return self._last_ns

    @property
    def newest_source_ns(self) -> int:
        """The translator's time of the packet that it sent last, cached or not; -1 if there is none."""
        return self._newest_source_ns

    @property
    def size(self) -> int:
        """Size of all packets in bytes, including a fixed overhead for each."""
        return self._bytes

    def take(self, packet: Packet, header: PacketHeader, now_ns: int) -> tuple[Packet, int] | None:
        """Return the packet to publish, and how many packets of its envelope are kept (0: not this packet).

        The packet keeps the translator's time. Without a time, or with a time more than 1 h ahead, it gets the present
        time. Either time is moved to just after the newest published time if it is not later, as after a clock was set
        back. A packet that was published before a restart gets its first time again.

        Returns:
            None if the packet is a duplicate, or was passed over before a restart.
        """
        source_ns = packet.time_ns
        if source_ns is not None:
            if source_ns in self._sources:
                return None
            self._note_source(source_ns)
        envelope, history = self._envelopes.of(header)
        first_ns = None if source_ns is None else self._first_times.pop(source_ns, None)
        if first_ns == _NEVER_NS:
            return None
        if source_ns is not None and first_ns is not None:
            return self._keep_again(Packet(envelope, packet.payload, first_ns), source_ns, history)
        has_time = source_ns is not None and source_ns <= now_ns + _FUTURE_NS
        out = Packet(
            envelope, packet.payload, self._next_ns(source_ns if has_time and source_ns is not None else now_ns)
        )
        kept = self._keep(out, source_ns, history)
        if source_ns is not None and out.time_ns is not None and history:
            self._recent.append((source_ns, out.time_ns))
        return out, kept

    def pass_over(self, packet: Packet) -> bool:
        """Register a packet of the translator that is not published; return False for a duplicate."""
        if packet.time_ns is None:
            return True
        is_new = packet.time_ns not in self._sources and self._first_times.pop(packet.time_ns, None) != _NEVER_NS
        self._note_source(packet.time_ns)
        self._recent.append((packet.time_ns, _NEVER_NS))
        return is_new

    def newest(self) -> dict[str, int]:
        """Return the time of the newest cached packet of each envelope."""
        return {envelope: times[-1] for envelope, times in self._times.items()}

    def recent(self) -> list[tuple[int, int]]:
        """Return (translator's time, published time) of the last packets, for `remember` after a restart.

        The published time is 0 for a packet that was passed over.
        """
        return [*self._first_times.items(), *self._recent]

    def remember(self, recent: Iterable[tuple[int, int]]) -> None:
        """Store the times of packets that were published before a restart.

        A packet that arrives again, because it was not in the log yet, keeps its first time. Subscribers recognise a
        duplicate by this time.
        """
        self._first_times = {source_ns: first_ns for source_ns, first_ns in recent if source_ns not in self._sources}

    def stamp(self, envelope: str, payload: bytes, now_ns: int) -> tuple[Packet, int]:
        """Stamp and cache a packet of the scheduler itself.

        Returns:
            The packet, and how many packets of its envelope are kept (0: not this packet).
        """
        out = Packet(envelope, payload, self._next_ns(now_ns))
        message = envelope.partition("_")[0]  # no message of the scheduler has an underscore in its name
        return out, self._keep(out, None, self._envelopes.history(message))

    def restore(self, packets: Iterable[LoggedPacket]) -> None:
        """Restore packets published before a restart, oldest first; skip packets out of this order."""
        newest_ns = next(reversed(self._kept), 0)
        for packet, source_ns, history in packets:
            if packet.time_ns is None or packet.time_ns <= newest_ns:
                continue
            newest_ns = packet.time_ns
            self.not_before(newest_ns)
            if source_ns is not None:
                self._note_source(source_ns)
            self._keep(packet, source_ns, history)

    def holds(self, envelope: str, payload: bytes) -> bool:
        """Return whether one of the newest packets of an envelope has this payload."""
        newest = islice(reversed(self._times.get(envelope, ())), _NEWEST)
        return any(self._kept[time_ns].packet.payload == payload for time_ns in newest)

    def not_before(self, time_ns: int) -> None:
        """Give every further packet a time after `time_ns`."""
        self._last_ns = max(self._last_ns, time_ns)

    def replay(self, prefixes: Iterable[str], since_ns: int) -> tuple[Packet, ...]:
        """Return the cached packets newer than `since_ns`, oldest first over all envelopes.

        Args:
            prefixes: beginnings of the wanted envelopes.
        """
        starts = tuple(prefixes)
        return tuple(
            kept.packet
            for time_ns, kept in self._kept.items()
            if time_ns > since_ns and kept.packet.envelope.startswith(starts)
        )

    def _keep_again(self, packet: Packet, source_ns: int, history: int) -> tuple[Packet, int]:
        assert packet.time_ns is not None
        self._recent.append((source_ns, packet.time_ns))
        kept = self._keep(packet, source_ns, history)
        # its first time may lie before packets cached since
        self._kept = dict(sorted(self._kept.items()))
        for envelope, times in self._times.items():
            self._times[envelope] = deque(sorted(times))
        return packet, kept

    def __iter__(self) -> Iterator[LoggedPacket]:
        return iter([kept.logged for kept in self._kept.values()])

    def __len__(self) -> int:
        return len(self._kept)

    def _next_ns(self, time_ns: int) -> int:
        self._last_ns = max(time_ns, self._last_ns + TIME_STEP_NS)
        return self._last_ns

    def _note_source(self, source_ns: int) -> None:
        self._newest_source_ns = source_ns
        self._sources[source_ns] = None
        if len(self._sources) > _TIMES_REMEMBERED:
            self._sources.popitem(last=False)

    def _keep(self, packet: Packet, source_ns: int | None, history: int) -> int:
        payload = packet.payload
        size = (payload.nbytes if isinstance(payload, memoryview) else len(payload)) + _OVERHEAD_BYTES
        if size > self._max_bytes or not history:
            return 0
        assert packet.time_ns is not None
        self._kept[packet.time_ns] = Kept(LoggedPacket(packet, source_ns, history), size)
        self._bytes += size
        times = self._times.setdefault(packet.envelope, deque())
        times.append(packet.time_ns)
        self._several += len(times) == 2
        while len(times) > history:
            self._drop(times[0])
        while self._bytes > self._max_bytes:
            self._drop(self._next_to_evict())
        return history

    def _next_to_evict(self) -> int:
        # the oldest packet with a newer one under its envelope, so that a late joiner gets the newest of each envelope
        if self._several:
            return next(t for t, kept in self._kept.items() if len(self._times[kept.packet.envelope]) > 1)
        return next(iter(self._kept))

    def _drop(self, time_ns: int) -> None:
        kept = self._kept.pop(time_ns)
        self._bytes -= kept.size
        times = self._times[kept.packet.envelope]
        times.popleft()
        self._several -= len(times) == 1
        if not times:
            del self._times[kept.packet.envelope]
