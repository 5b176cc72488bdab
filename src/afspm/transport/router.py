"""Takes in the requests of all components: who asks, by which connection, and which connections there are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import zmq

from afspm.transport.complaints import Complaints
from afspm.transport.frames import readable, receive, user_of
from afspm.transport.monitor import ACCEPTED, DISCONNECTED, Monitor
from afspm.transport.network import Network

_BATCH = 256


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

    __slots__ = ("connection", "identity", "name", "user")

    def __init__(self, connection: int) -> None:
        self.connection = connection
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
        self._by_descriptor: dict[int, _Peer] = {}
        self._identities: dict[int, bytes] = {}
        self.socket = network.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.ROUTER_HANDOVER, 1)
        self.monitor = Monitor(self.socket, ACCEPTED | DISCONNECTED)
        self.address = network.bind(self.socket, address)

    def receive(self) -> list[RouterEvent]:
        """What has come, a batch at a time: connections in the order in which they came and went, and what came by
        one that is gone before its going."""
        messages: list[list[zmq.Frame]] = []
        while len(messages) < _BATCH and readable(self.socket):
            messages.append(receive(self.socket))
        # after the messages: every connection that they came by is known then
        changes = self._follow_connections()
        dying = {peer: descriptor for descriptor, peer, came in changes if not came}
        asked: list[tuple[_Peer, RouterEvent]] = []
        for frames in messages:
            peer = self._sender(frames[0], dying)
            if peer is not None and (event := self._interpret(peer, frames)) is not None:
                asked.append((peer, event))
        if not changes:
            return [event for _, event in asked]
        found: list[RouterEvent] = []
        for _, peer, came in changes:
            if came:
                found.append(PeerConnected(peer.connection))
                continue
            found += [event for asker, event in asked if asker is peer]
            found.append(PeerDisconnected(peer.connection))
            self._identities.pop(peer.connection, None)
        return found + [event for asker, event in asked if asker not in dying]

    def reply(self, connection: int, frames: Sequence[bytes]) -> None:
        """Answer by `connection`, if it is still there. Never blocks."""
        identity = self._identities.get(connection)
        if identity is not None:
            self.socket.send_multipart([identity, b"", *frames], zmq.NOBLOCK)

    def _interpret(self, peer: _Peer, frames: list[zmq.Frame]) -> PeerAsked | None:
        if len(frames) < 2 or len(frames[1]):
            self._complaints.say(f"dropped a request of {peer.name or 'somebody'}: no empty frame before it")
            return None
        return PeerAsked(peer.connection, peer.name, peer.user, [frame.bytes for frame in frames[2:]])

    def _follow_connections(self) -> list[tuple[int, _Peer, bool]]:
        """Take in the monitor's events: (descriptor, peer, whether it came or went), in order."""
        changes = []
        for kind, descriptor in self.monitor.drain():
            gone = self._by_descriptor.pop(descriptor, None)
            if gone is not None:
                changes.append((descriptor, gone, False))
            if kind == ACCEPTED:
                self._connections += 1
                peer = self._by_descriptor[descriptor] = _Peer(self._connections)
                changes.append((descriptor, peer, True))
        return changes

    def _sender(self, first: zmq.Frame, dying: dict[_Peer, int]) -> _Peer | None:
        """Whose message this is; None if its connection is long gone."""
        identity = first.bytes
        descriptor = int(first.get(zmq.SRCFD))
        # a descriptor is given out again at once: what an earlier connection said may still have been waiting
        for peer, old in dying.items():
            if old == descriptor and peer.identity in (identity, None):
                return self._named(peer, first, identity)
        current = self._by_descriptor.get(descriptor)
        return None if current is None else self._named(current, first, identity)

    def _named(self, peer: _Peer, first: zmq.Frame, identity: bytes) -> _Peer | None:
        if peer.identity is None:
            peer.identity = self._identities[peer.connection] = identity
            peer.name = _name(identity)
            peer.user = user_of(first) if self._with_keys else None
        return peer if peer.identity == identity else None

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
