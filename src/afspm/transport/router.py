"""Takes in the requests of all components: who asks, by which connection, and which connections there are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import zmq

from afspm.transport.complaints import Complaints
from afspm.transport.frames import descriptor_of, property_of, readable, receive_small, send, user_of
from afspm.transport.keys import MARK
from afspm.transport.monitor import ACCEPTED, DISCONNECTED, REFUSED, Monitor
from afspm.transport.network import QUEUE_LENGTH, Network
from afspm.wire.version import ANSWER, QUESTION

_MOST_ROUNDS = 100
_BATCH = 100


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
        keys = network.keys
        self._keys = keys if keys is not None and keys.binds_encrypted(requests=True) else None
        self._has_refused = False
        self._guard = network.connections
        self._heard: set[int] = set()
        self._connections = 0
        self.touched = True
        self._by_descriptor: dict[int, _Peer] = {}
        self._formers: dict[int, _Peer] = {}  # whose descriptor it was last, as long as words of theirs may come
        self._identities: dict[int, bytes] = {}
        self.socket = network.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.ROUTER_HANDOVER, 1)
        self.monitor = Monitor(network, self.socket, ACCEPTED | DISCONNECTED | REFUSED)
        self.address = network.bind(self.socket, address, requests=True)

    def receive(self) -> list[RouterEvent]:
        """The next requests, a batch at most; the changes of connections that they have to do with; and all that came
        with those."""
        told: list[RouterEvent] = []
        for _ in range(_BATCH):
            first, frames = self._receive()
            if first is None:
                return told
            peer = self._by_descriptor.get(descriptor_of(first) or -1)
            if peer is None or peer.identity != frames[0] or self.monitor.has_news():
                self.touched = True
                return told + self._settle([(first, frames)])
            told += self._interpret(peer, frames)
        self.touched = True
        return told

    def _receive(self) -> tuple[zmq.Frame | None, list[bytes]]:
        first, frames = receive_small(self.socket)
        if first is None:
            self._guard.settled(self._heard)
            self._heard.clear()
        elif (descriptor := descriptor_of(first)) is not None:
            self._heard.add(descriptor)
        return first, frames

    def follow(self) -> list[RouterEvent]:
        """Connections that came and went, and what came with them."""
        return self._settle([])

    def _settle(self, messages: list[tuple[zmq.Frame, list[bytes]]]) -> list[RouterEvent]:
        """Connections in the order in which they came and went, with what was said by each before it went."""
        changes: list[tuple[_Peer, bool]] = []
        for _ in range(_MOST_ROUNDS):
            while len(messages) < QUEUE_LENGTH and readable(self.socket):
                first, frames = self._receive()
                if first is not None:
                    messages.append((first, frames))
            # The monitor tells everything in order: it knows of every connection that these came by, and once it has
            # nothing new, they are all that was said by those that it said are gone.
            news = self._changes()
            if not news:
                break
            changes += news
        said: list[tuple[_Peer, list[RouterEvent]]] = []
        for first, frames in messages:
            sender = self._sender(first, changes)
            if sender is not None:
                said.append((sender, self._interpret(sender, frames)))
        told: list[RouterEvent] = []
        for peer, came in changes:
            if came:
                told.append(PeerConnected(peer.connection))
                continue
            for sender, events in said:
                if sender is peer:
                    told += events
            told.append(PeerDisconnected(peer.connection))
            self._identities.pop(peer.connection, None)
        gone = {peer.connection for peer, came in changes if not came}
        for sender, events in said:
            if sender.connection not in gone:
                told += events
        if len(messages) < QUEUE_LENGTH:  # all was read that came before the descriptor was given out again
            for peer, came in changes:
                if came:
                    self._formers.pop(peer.descriptor, None)
        return told

    def _sender(self, first: zmq.Frame, changes: list[tuple[_Peer, bool]]) -> _Peer | None:
        """Whose message this is. A descriptor is given out again at once, so several may have had it."""
        identity, descriptor = first.bytes, descriptor_of(first)
        if descriptor is None:
            return None
        current = self._by_descriptor.get(descriptor)
        gone = [peer for peer, came in changes if not came and peer.descriptor == descriptor]
        if current is None or current.identity not in (identity, None):
            former = next((peer for peer in gone if peer.identity in (identity, None)), None)
            if former is not None or current is None:
                return former and self._introduced(former, first, identity)
            # what was left of an earlier connection had been taken for the first words of this one
            changes += [(current, False), (current := self._new(descriptor), True)]
        last = self._formers.get(descriptor)
        if current.identity is None and last and last.identity == identity and not self._lives(first, identity):
            # the last words of who had the descriptor before, and not the first of its next life
            return last if last in gone else None
        unheard = next((peer for peer in gone if peer.identity is None), None)
        return self._introduced(unheard if current.identity is None and unheard else current, first, identity)

    def _lives(self, first: zmq.Frame, identity: bytes) -> bool:
        """Whether anybody has the identity of who said this now. Who has hears an empty frame; of REQ peers, whose
        connection that would end, it is not asked."""
        if property_of(first, "Socket-Type") != "DEALER":
            return True
        self.socket.setsockopt(zmq.ROUTER_MANDATORY, 1)
        try:
            self.socket.send_multipart([identity, b""], zmq.NOBLOCK)
        except zmq.ZMQError as error:
            return error.errno != zmq.EHOSTUNREACH
        finally:
            self.socket.setsockopt(zmq.ROUTER_MANDATORY, 0)
        return True

    def reply(self, connection: int, frames: Sequence[bytes]) -> None:
        """Answer by `connection`, if it is still there. Never blocks."""
        identity = self._identities.get(connection)
        if identity is not None:
            self.touched = True
            send(self.socket, [identity, b"", *frames])

    def _interpret(self, peer: _Peer, frames: list[bytes]) -> list[RouterEvent]:
        if len(frames) < 2 or frames[1]:
            self._complaints.say(f"dropped a request of {peer.name or 'somebody'}: no empty frame before it")
            return []
        if frames[2:] == [*QUESTION]:  # whether we are one of ours; whose name it is does not matter for that
            self.reply(peer.connection, ANSWER)
            return []
        return [PeerAsked(peer.connection, peer.name, peer.user, frames[2:])]

    def _changes(self) -> list[tuple[_Peer, bool]]:
        """The monitor's events: who, and whether it came or went."""
        changes = []
        for kind, descriptor in self.monitor.drain():
            if kind not in (ACCEPTED, DISCONNECTED):
                self._tell_refused()
                continue
            gone = self._by_descriptor.pop(descriptor, None)
            if gone is not None:
                self._formers[descriptor] = gone
                changes.append((gone, False))
            if kind == ACCEPTED:
                changes.append((self._new(descriptor), True))
        return changes

    def _tell_refused(self) -> None:
        """Once: who is refused tries again without end."""
        if self._keys is not None and not self._has_refused:
            self._has_refused = True
            self._complaints.say(
                f"refused a connection to {self.address}: it has shown no key that is known here; programs that know "
                "nothing of keys are let in by [security] plain = true"
            )

    def _new(self, descriptor: int) -> _Peer:
        self._connections += 1
        peer = self._by_descriptor[descriptor] = _Peer(self._connections, descriptor)
        return peer

    def _introduced(self, peer: _Peer, first: zmq.Frame, identity: bytes) -> _Peer:
        if peer.identity is None:
            peer.identity = self._identities[peer.connection] = identity
            peer.name = _name(identity)
            peer.user = None if self._keys is None else self._keys.user_as(user_of(first), peer.name)
        return peer

    def close(self) -> None:
        self.monitor.close()
        self.socket.close()


def _name(identity: bytes) -> str:
    """What a peer calls itself; those that don't are given an identity by the socket that begins with a zero byte."""
    if identity.startswith(b"\0"):
        return ""
    try:
        return identity.partition(MARK)[0].decode()
    except UnicodeDecodeError:
        return ""
