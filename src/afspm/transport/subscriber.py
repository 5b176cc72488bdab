"""Receives what one publisher publishes: each packet once, and what was missed before anything newer."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import zmq

from afspm import wire
from afspm.errors import ConfigError, WireError
from afspm.transport.complaints import Complaints
from afspm.transport.frames import readable, receive
from afspm.transport.monitor import CONNECTED, Monitor
from afspm.transport.network import MAX_PACKET_BYTES, Network
from afspm.transport.port import CaughtUp, Incoming, Killed, PacketReceived
from afspm.transport.replay import LONGEST, Marker, topic
from afspm.wire import decode_packet

_MOST_ENVELOPES = 10_000
# few: what waits in the library's queue costs nothing, what we hold keeps large buffers from being used again
_BATCH = 16


class Subscriber:
    """A connection to one publisher, ours or of version 1.

    Args:
        name: of this component.
        prefixes: of the envelopes wanted; None for all. The signal KILL always comes.
        since_ns: what is not newer is known already.
        filtered: drop what is not newer than the newest of its envelope, as is right where times always increase. A
            translator's may not, if its clock is set back: then the one who listens has to tell doubles.

    Raises:
        ConfigError: these are too many prefixes.
    """

    def __init__(
        self,
        network: Network,
        name: str,
        address: str,
        prefixes: Sequence[str] | None,
        complaints: Complaints,
        *,
        since_ns: int = -1,
        filtered: bool = True,
    ) -> None:
        self._filtered = filtered
        self._name = name
        self.address = address
        self._prefixes = _with_kill(prefixes)
        _check(self._prefixes, name)
        self._complaints = complaints
        self._newest_ns = since_ns
        self._newest_of: dict[str, int] = {}
        self._started_ns = since_ns
        self._nonces = itertools.count()
        self._marker: Marker | None = None
        self.touched = True
        # unlike SUB, XSUB takes what is sent to it under any topic, and lets the marker through as it is
        self.socket = network.socket(zmq.XSUB, max_bytes=MAX_PACKET_BYTES)
        self.monitor = Monitor(network, self.socket, CONNECTED)
        for prefix in self._prefixes:
            self.socket.send(b"\1" + prefix.encode())
        network.connect(self.socket, address)

    def receive(self) -> list[Incoming]:
        """What has come, a batch at a time: the rest is still there for the next call."""
        socket = self.socket
        found: list[Incoming] = []
        while frames := receive(socket):
            try:
                incoming = self._interpret(frames)
            except WireError as error:
                self._complaints.say(f"dropped a packet from {self.address}: {error}")
            else:
                if incoming is not None:
                    found.append(incoming)
            if not readable(socket):
                break
            if len(found) == _BATCH:
                self.touched = True
                break
        return found

    def follow(self) -> list[Incoming]:
        """Connections were made: what was missed is asked for."""
        if self.monitor.drain():
            self._ask_for_missed()
        return []

    def _ask_for_missed(self) -> None:
        """A connection was made, the first or another: say what we have, and be sent the rest."""
        self.touched = True
        self._forget_marker()
        self._marker = Marker(topic(self._name, next(self._nonces)), self._newest_ns, self._prefixes)
        self.socket.send(b"\1" + self._marker.encode())

    def _forget_marker(self) -> None:
        """Else the socket would ask for the same again when the connection is next made."""
        if self._marker is not None:
            self.touched = True
            self.socket.send(b"\0" + self._marker.encode())
            self._marker = None

    def _interpret(self, frames: list[bytes | memoryview]) -> Incoming | None:
        # The calls that are made for every packet are few: each costs a microsecond where many subscribers share a
        # processor, since its code is in no cache.
        if len(frames) != 3 or frames[0][:1] == b"\0" or not frames[2]:
            signal, frames = self._signal(frames)
            if not frames:
                return signal
        packet = decode_packet(frames)
        time_ns = packet.time_ns
        if time_ns is not None:
            if self._filtered:
                known = self._newest_of
                if time_ns <= known.get(packet.envelope, self._started_ns):
                    return None
                known[packet.envelope] = time_ns
                if len(known) > _MOST_ENVELOPES:
                    del known[next(iter(known))]
            if time_ns > self._newest_ns or not self._filtered:
                self._newest_ns = time_ns
        return PacketReceived(packet, self.address)

    def _signal(self, frames: list[bytes | memoryview]) -> tuple[Incoming | None, list[bytes | memoryview]]:
        """What the rarer messages say, or the packet in them: one that was missed, or has no time."""
        if frames[0][:1] == b"\0":
            if self._marker is None or frames[0] != self._marker.topic:
                return None, []  # of an earlier connection
            frames = frames[1:]
            if not frames:
                self._forget_marker()
                return CaughtUp(self.address), []
        elif len(frames) == 1 and frames[0] == wire.KILL:
            return Killed(), []
        # the timestamp that is empty is none
        return None, [frames[0], *(frames[1:2] or [b""]), *(frame for frame in frames[2:] if frame)]

    def close(self) -> None:
        self.monitor.close()
        self.socket.close()


def _check(prefixes: tuple[str, ...], name: str) -> None:
    if len(Marker(topic(name, 10**9), 10**18, prefixes).encode()) > LONGEST:
        raise ConfigError(
            f"{len(prefixes)} prefixes are more than a publisher takes: {LONGEST} bytes",
            where=name,
            hint="subscribe to what the envelopes have in common, or to all of them",
        )


def _with_kill(prefixes: Sequence[str] | None) -> tuple[str, ...]:
    if prefixes is None or "" in prefixes:
        return ("",)
    kill = wire.KILL.decode()
    covered = any(kill.startswith(prefix) for prefix in prefixes)
    return tuple(prefixes) if covered else (*prefixes, kill)
