"""Takes in the requests of all components: who asks, by which connection, and which connections there are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import zmq

from afspm.transport.complaints import Complaints
from afspm.transport.frames import readable, receive, user_of
from afspm.transport.monitor import CONNECTED, DISCONNECTED, Monitor
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
        self.monitor = Monitor(self.socket, CONNECTED | DISCONNECTED)
        self.address = network.bind(self.socket, address)

    def receive(self) -> list[RouterEvent]:
        """What has come, a batch at a time, each disconnection after what came by the connection before."""
        messages: list[list[zmq.Frame]] = []
        while len(messages) < _BATCH and readable(self.socket):
            messages.append(receive(self.socket))
        found: list[RouterEvent] = []
        # after the messages: every connection that they came by is known then
        dying = self._follow_connections(found)
        for frames in messages:
            peer = self._sender(frames[0], dying)
            if peer is None:
                continue
            if len(frames) < 2 or len(frames[1]):
                self._complaints.say(f"dropped a request of {peer.name or 'somebody'}: no empty frame before it")
                continue
            body = [frame.bytes for frame in frames[2:]]
            found.append(PeerAsked(peer.connection, peer.name, peer.user, body))
        for peer in dying.values():
            found.append(self._gone(peer))
        return found

    def reply(self, connection: int, frames: Sequence[bytes]) -> None:
        """Answer by `connection`, if it is still there. Never blocks."""
        identity = self._identities.get(connection)
        if identity is not None:
            self.socket.send_multipart([identity, b"", *frames], zmq.NOBLOCK)

    def _follow_connections(self, found: list[RouterEvent]) -> dict[int, _Peer]:
        """Take in the monitor's events; returns those that are gone, whose messages may still have to be read."""
        dying: dict[int, _Peer] = {}
        for kind, descriptor in self.monitor.drain():
            gone = self._by_descriptor.pop(descriptor, None)
            if gone is not None:
                if (earlier := dying.get(descriptor)) is not None:
                    found.append(self._gone(earlier))
                dying[descriptor] = gone
            if kind == CONNECTED:
                found.append(PeerConnected(self._new_peer(descriptor).connection))
        return dying

    def _new_peer(self, descriptor: int) -> _Peer:
        self._connections += 1
        peer = self._by_descriptor[descriptor] = _Peer(self._connections)
        return peer

    def _gone(self, peer: _Peer) -> PeerDisconnected:
        self._identities.pop(peer.connection, None)
        return PeerDisconnected(peer.connection)

    def _sender(self, first: zmq.Frame, dying: dict[int, _Peer]) -> _Peer | None:
        identity = first.bytes
        descriptor = int(first.get(zmq.SRCFD))
        peer = dying.get(descriptor)
        if peer is None or peer.identity not in (identity, None):
            peer = self._by_descriptor.get(descriptor)
        if peer is None:
            return None  # its connection went long ago
        if peer.identity is None:
            peer.identity = self._identities[peer.connection] = identity
            peer.name = _name(identity)
            peer.user = user_of(first) if self._with_keys else None
        elif peer.identity != identity:
            return None  # left over from another connection that had the same descriptor
        return peer

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
