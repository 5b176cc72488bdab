"""Takes in the requests of all components: who asks, by which connection, and which connections there are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import zmq

from afspm.transport.complaints import Complaints
from afspm.transport.frames import descriptor_of, readable, receive, send, user_of
from afspm.transport.monitor import ACCEPTED, DISCONNECTED, Monitor
from afspm.transport.network import QUEUE_LENGTH, Network


class PeerConnected(NamedTuple):
    connection: int


class PeerDisconnected(NamedTuple):
    connection: int


class PeerAsked(NamedTuple):
    """A request, as frames for `wire.decode_request`; no frames at all: the peer only says its name.

    Attributes:
        name: what the peer calls itself; "" if it has no name that is text.
        user: whose key it is; None without keys.
    """

    connection: int
    name: str
    user: str | None
    frames: Sequence[bytes]


RouterEvent = PeerConnected | PeerDisconnected | PeerAsked


class _Peer:
    """One connection."""

    __slots__ = ("connection", "descriptor", "identity", "name", "user")

    def __init__(self, connection: int, descriptor: int) -> None:
        self.connection = connection
        self.descriptor = descriptor
        self.identity: bytes | None = None
        self.name = ""
        self.user: str | None = None


class Router:
    """The scheduler's control socket. REQ and DEALER peers, ours and of version 1.

    A name belongs to the newest connection that uses it, so that a restarted component is the same client.
    """

    def __init__(self, network: Network, address: str, complaints: Complaints) -> None:
        self._complaints = complaints
        self._with_keys = network.keys is not None
        self._connections = 0
        self.touched = True
        self._by_descriptor: dict[int, _Peer] = {}
        self._identities: dict[int, bytes] = {}
        self.socket = network.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.ROUTER_HANDOVER, 1)
        self.monitor = Monitor(self.socket, ACCEPTED | DISCONNECTED)
        self.address = network.bind(self.socket, address)

    def receive(self) -> list[RouterEvent]:
        """The next request, and what happened to connections if it may have to do with it."""
        self.touched = True
        frames = receive(self.socket)
        if not frames:
            return []
        identity, descriptor = frames[0].bytes, descriptor_of(frames[0])
        if descriptor is None:
            return []
        peer = self._by_descriptor.get(descriptor)
        if peer is not None and peer.identity == identity and not readable(self.monitor.socket):
            return self._interpret(peer, frames)
        # the monitor tells everything in order: it knows of every connection that anything has come by
        changes = self._changes()
        current = self._by_descriptor.get(descriptor)
        gone = next(
            (p for p, came in changes if not came and (p.descriptor, p.identity) == (descriptor, identity)), None
        )
        if current is None or (current.identity not in (identity, None) and gone is not None):
            said = [] if gone is None else self._interpret(gone, frames)
            return said + [self._tell(peer, came=came) for peer, came in changes]
        if current.identity not in (identity, None):
            # what was left of an earlier connection had been taken for the first words of this one
            changes += [(current, False), (current := self._new(descriptor), True)]
        found = [self._tell(peer, came=came) for peer, came in changes]
        self._introduce(current, frames[0], identity)
        return found + self._interpret(current, frames)

    def follow(self) -> list[RouterEvent]:
        """Connections that came and went, in order, after what they said before."""
        found: list[RouterEvent] = []
        for _ in range(QUEUE_LENGTH):
            if not readable(self.socket):
                break
            found += self.receive()
        return found + [self._tell(peer, came=came) for peer, came in self._changes()]

    def reply(self, connection: int, frames: Sequence[bytes]) -> None:
        """Answer by `connection`, if it is still there. Never blocks."""
        identity = self._identities.get(connection)
        if identity is not None:
            self.touched = True
            send(self.socket, [identity, b"", *frames])

    def _interpret(self, peer: _Peer, frames: list[zmq.Frame]) -> list[RouterEvent]:
        if len(frames) < 2 or len(frames[1]):
            self._complaints.say(f"dropped a request of {peer.name or 'somebody'}: no empty frame before it")
            return []
        return [PeerAsked(peer.connection, peer.name, peer.user, [frame.bytes for frame in frames[2:]])]

    def _changes(self) -> list[tuple[_Peer, bool]]:
        """The monitor's events: who, and whether it came or went."""
        changes = []
        for kind, descriptor in self.monitor.drain():
            gone = self._by_descriptor.pop(descriptor, None)
            if gone is not None:
                changes.append((gone, False))
            if kind == ACCEPTED:
                changes.append((self._new(descriptor), True))
        return changes

    def _new(self, descriptor: int) -> _Peer:
        self._connections += 1
        peer = self._by_descriptor[descriptor] = _Peer(self._connections, descriptor)
        return peer

    def _tell(self, peer: _Peer, *, came: bool) -> RouterEvent:
        if came:
            return PeerConnected(peer.connection)
        self._identities.pop(peer.connection, None)
        return PeerDisconnected(peer.connection)

    def _introduce(self, peer: _Peer, first: zmq.Frame, identity: bytes) -> None:
        if peer.identity is None:
            peer.identity = self._identities[peer.connection] = identity
            peer.name = _name(identity)
            peer.user = user_of(first) if self._with_keys else None

    def close(self) -> None:
        self.monitor.close()
        self.socket.close()


def _name(identity: bytes) -> str:
    """What a peer calls itself; those that don't are given an identity by the socket that begins with a zero byte."""
    if identity.startswith(b"\0"):
        return ""
    try:
        return identity.decode()
    except UnicodeDecodeError:
        return ""
