"""Reception from one publisher: each packet once, and missed packets before newer ones."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import zmq

from afspm import wire
from afspm.basics.errors import ConfigError, WireError
from afspm.transport.frames import contents, receive_frames
from afspm.transport.late_joiners import LONGEST, Marker, topic
from afspm.transport.network import CONNECTED, MAX_PACKET_BYTES, Monitor, Network
from afspm.transport.port import CaughtUp, Incoming, Killed, PacketReceived
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.wire import Buffer, decode_packet

_MOST_ENVELOPES = 10_000
# small: a packet that waits in libzmq's queue costs nothing, but a received one keeps its large buffer from reuse
_BATCH = 16


class Subscriber:
    """A connection to one publisher.

    Args:
        name: name of this component.
        prefixes: prefixes of the wanted envelopes; None for all. The signal KILL always comes.
        since_ns: time up to which the receiver has all packets.
        filtered: whether to drop packets not newer than the newest packet of their envelope. False for packets of a
            translator, whose clock may be set back: then the receiver must drop repeated packets.

    Raises:
        ConfigError: the prefixes are too long for one marker.
    """

    def __init__(
        self,
        network: Network,
        name: str,
        address: str,
        prefixes: Sequence[str] | None,
        log: RateLimitedLog,
        *,
        since_ns: int = -1,
        filtered: bool = True,
    ) -> None:
        self._filtered = filtered
        self._name = name
        self.address = address
        self._prefixes = _with_kill(prefixes)
        _check(self._prefixes, name)
        self._log = log
        self._newest_ns = self._started_ns = since_ns
        self._newest_of: dict[str, int] = {}
        self._nonces = itertools.count()
        self._marker: Marker | None = None
        # XSUB, not SUB: it accepts messages under any topic, and sends the marker unchanged
        self.socket = network.socket(zmq.XSUB, max_bytes=MAX_PACKET_BYTES)
        self.monitor = Monitor(network, self.socket, CONNECTED)
        for prefix in self._prefixes:
            self.socket.send(b"\1" + prefix.encode())
        network.connect(self.socket, address)

    def receive(self) -> list[Incoming]:
        """Return the next batch of packets; further ones stay for the next call."""
        found: list[Incoming] = []
        for _ in range(_BATCH):
            frames = receive_frames(self.socket)
            if not frames:
                break
            try:
                incoming = self._interpret(contents(frames))
            except WireError as error:
                self._log.warning(f"dropped a packet from {self.address}: {error}")
            else:
                if incoming is not None:
                    found.append(incoming)
        return found

    def follow(self) -> list[Incoming]:
        """Request the missed packets after each connection."""
        if self.monitor.drain():
            self._forget_marker()
            self._marker = Marker(topic(self._name, next(self._nonces)), self._newest_ns, self._prefixes)
            self.socket.send(b"\1" + self._marker.encode())
        return []

    def _forget_marker(self) -> None:
        # otherwise the socket repeats the old request at the next connection
        if self._marker is not None:
            self.socket.send(b"\0" + self._marker.encode())
            self._marker = None

    def _interpret(self, frames: list[Buffer]) -> Incoming | None:
        if frames[0][:1] == b"\0":
            if self._marker is None or frames[0] != self._marker.topic:
                return None  # a replay for an earlier connection
            del frames[0]
            if not frames:
                self._forget_marker()
                return CaughtUp(self.address)
        elif len(frames) == 1 and frames[0] == wire.KILL:
            return Killed()
        if len(frames) == 3 and not frames[2]:
            del frames[2]  # a replayed packet without a time
        packet = decode_packet(frames)
        return PacketReceived(packet, self.address) if self._is_new(packet.envelope, packet.time_ns) else None

    def _is_new(self, envelope: str, time_ns: int | None) -> bool:
        if time_ns is None:
            return True
        if self._filtered:
            if time_ns <= self._newest_of.get(envelope, self._started_ns):
                return False
            self._newest_of[envelope] = time_ns
            if len(self._newest_of) > _MOST_ENVELOPES:
                del self._newest_of[next(iter(self._newest_of))]
        if time_ns > self._newest_ns or not self._filtered:
            self._newest_ns = time_ns
        return True


def _check(prefixes: tuple[str, ...], name: str) -> None:
    if len(Marker(topic(name, 10**9), 10**18, prefixes).encode()) > LONGEST:
        raise ConfigError(
            f"{len(prefixes)} prefixes are longer than the {LONGEST} bytes that a publisher takes",
            where=name,
            hint="subscribe to a common beginning of the envelopes, or to all envelopes",
        )


def _with_kill(prefixes: Sequence[str] | None) -> tuple[str, ...]:
    if prefixes is None or "" in prefixes:
        return ("",)
    kill = wire.KILL.decode()
    covered = any(kill.startswith(prefix) for prefix in prefixes)
    return tuple(prefixes) if covered else (*prefixes, kill)
