"""Reception from one publisher: each packet once, and missed packets before newer ones."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence

import zmq

from afspm import wire
from afspm.basics.errors import ConfigError, WireError
from afspm.basics.formatting import counted
from afspm.transport.frames import contents, receive_frames
from afspm.transport.late_joiners import BEACON, LONGEST, Marker, decode_newest, topic
from afspm.transport.network import CONNECTED, MAX_PACKET_BYTES, Monitor, Network
from afspm.transport.port import CaughtUp, Incoming, Killed, PacketReceived
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.wire import Buffer, decode_packet

_MOST_ENVELOPES = 10_000  # names come from peers, and memory must stay bounded
# small: a packet that waits in libzmq's queue costs nothing, but a received one keeps its large buffer from reuse
_BATCH = 16
_MOST_NAMED = 3
_ANSWERED_WITHIN_S = 5.0
"""Time after which a request for packets is repeated: its answer may have been dropped, too.

It doubles each time, since over a slow link the answer may only wait behind other packets.
"""


class Subscriber:
    """A connection to one publisher.

    By the publisher's beacons it finds packets that were dropped on their way, and requests them again.

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
        self._asked_s = 0.0
        self._patience_s = _ANSWERED_WITHIN_S
        self._is_caught_up = False
        self._lacking: dict[str, int] = {}  # times by envelope, of the packets that the present marker requests
        self._lost: dict[str, int] = {}
        self._found_lacking = 0
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
            self._patience_s = _ANSWERED_WITHIN_S
            self._request_missed()
        return []

    def request_since(self, since_ns: int) -> None:
        """Request all packets after `since_ns` again; repeated ones are dropped."""
        if self._marker is None:
            self._request(since_ns, self._prefixes, f"{next(self._nonces)} again")

    def _request_missed(self) -> None:
        self._is_caught_up = False
        self._lacking.clear()
        self._request(self._newest_ns, self._prefixes, next(self._nonces))

    def _request(self, since_ns: int, prefixes: tuple[str, ...], nonce: int | str) -> None:
        self._forget_marker()
        self._marker = Marker(topic(self._name, nonce), since_ns, prefixes)
        self._asked_s = time.monotonic()
        self.socket.send(b"\1" + self._marker.encode())

    def _forget_marker(self) -> None:
        # otherwise the socket repeats the old request at the next connection
        if self._marker is not None:
            self.socket.send(b"\0" + self._marker.encode())
            self._marker = None

    def _interpret(self, frames: list[Buffer]) -> Incoming | None:
        if frames[0][:1] == b"\0":
            if frames[0] == BEACON and len(frames) == 2:
                self._compare(decode_newest(bytes(frames[1])))
                return None
            if self._marker is None or frames[0] != self._marker.topic:
                return None  # a replay for an earlier connection
            del frames[0]
            if not frames:
                return self._answered()
        elif len(frames) == 1 and frames[0] == wire.KILL:
            return Killed()
        if len(frames) == 3 and not frames[2]:
            del frames[2]  # a replayed packet without a time
        packet = decode_packet(frames)
        return PacketReceived(packet, self.address) if self._is_new(packet.envelope, packet.time_ns) else None

    def _answered(self) -> CaughtUp | None:
        self._forget_marker()
        self._patience_s = _ANSWERED_WITHIN_S
        if lost := self._without_arrived(self._lacking):
            self._lost.update(lost)
            self._log.warning(f"{self._name}: {self.address} no longer keeps {_named(lost)}: lost")
        self._lacking.clear()
        if self._is_caught_up:
            return None
        self._is_caught_up = True
        return CaughtUp(self.address)

    def _compare(self, newest: Mapping[str, int]) -> None:
        # A beacon comes after all packets that it names, so a packet that has not arrived by then was dropped. While a
        # request is under way, the packet may be in its answer.
        if self._marker is None:
            lacking = {
                envelope: time_ns
                for envelope, time_ns in self._without_arrived(newest).items()
                if envelope.startswith(self._prefixes) and self._lost.get(envelope) != time_ns
            }
            if lacking:
                self._request_lacking(lacking)
        elif time.monotonic() - self._asked_s >= self._patience_s:
            self._patience_s *= 2.0
            if self._is_caught_up:
                self._request(self._marker.since_ns, self._marker.prefixes, f"{next(self._nonces)} again")
            else:
                self._request_missed()

    def _request_lacking(self, lacking: dict[str, int]) -> None:
        self._found_lacking += len(lacking)
        self._lacking = lacking
        self._log.warning(
            f"{self._name} lacks {_named(lacking)} of {self.address}, dropped on the way: requested again, "
            f"{counted(self._found_lacking, 'packet')} so far; if this repeats, look for a slow link or too many "
            "subscribers"
        )
        since_ns = min(self._newest_of.get(envelope, self._started_ns) for envelope in lacking)
        prefixes = tuple(lacking) if _fits(tuple(lacking), self._name) else self._prefixes
        self._request(since_ns, prefixes, f"{next(self._nonces)} again")

    def _without_arrived(self, newest: Mapping[str, int]) -> dict[str, int]:
        return {
            envelope: time_ns
            for envelope, time_ns in newest.items()
            if time_ns > self._newest_of.get(envelope, self._started_ns)
        }

    def _is_new(self, envelope: str, time_ns: int | None) -> bool:
        if time_ns is None:
            return True
        if self._filtered and time_ns <= self._newest_of.get(envelope, self._started_ns):
            return False
        self._newest_of.pop(envelope, None)  # so that the envelope without news for longest comes first
        self._newest_of[envelope] = time_ns
        if len(self._newest_of) > _MOST_ENVELOPES:
            del self._newest_of[next(iter(self._newest_of))]
        if time_ns > self._newest_ns or not self._filtered:
            self._newest_ns = time_ns
        return True


def _named(packets: Mapping[str, int]) -> str:
    names = list(packets)
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return f"the newest packet of {', '.join(names[:_MOST_NAMED])}{more}"


def _fits(prefixes: tuple[str, ...], name: str) -> bool:
    return len(Marker(topic(name, f"{10**9} again"), 10**18, prefixes).encode()) <= LONGEST


def _check(prefixes: tuple[str, ...], name: str) -> None:
    if not _fits(prefixes, name):
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
