"""The scheduler's control socket: who asks, by which connection, and which connections there are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import zmq

from afspm.transport.frames import descriptor_of, is_readable, property_of, receive_frames, send_frames, user_of
from afspm.transport.keys import MARK
from afspm.transport.network import ACCEPTED, DISCONNECTED, REFUSED, Monitor, Network
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.tcp_guard import TcpGuard

_LAST_WORDS = 200
"""Messages looked through for the last words of who has gone."""


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


@dataclass(slots=True)
class _Connection:
    number: int
    descriptor: int
    identity: bytes | None = None
    name: str = ""
    user: str | None = None


class Router:
    """REQ and DEALER peers, each known by its connection.

    A name belongs to the newest connection that uses it, so that a restarted component is the same client.
    """

    def __init__(self, network: Network, address: str, log: RateLimitedLog) -> None:
        self._log = log
        keys = network.keys
        self._keys = keys if keys is not None and keys.binds_encrypted(requests=True) else None
        self._has_refused = False
        self._numbers = 0
        self._open: dict[int, _Connection] = {}  # by descriptor
        self._formers: dict[int, _Connection] = {}  # the last to have had a descriptor that is closed, or given anew
        self._identities: dict[int, bytes] = {}  # by number
        self.socket = network.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.ROUTER_HANDOVER, 1)
        self.monitor = Monitor(network, self.socket, ACCEPTED | DISCONNECTED | REFUSED)
        self.address = network.bind(self.socket, address, requests=True)
        self._guard = network.watch(self.address, TcpGuard())

    def receive(self) -> list[RouterEvent]:
        """Return the next request, and the changes of connections that came before it, in order.

        The socket gives one message of each client in turn.
        """
        messages = self._messages(1)
        # drained after the messages were received: so every connection that they came by is known
        changes = self._changes()
        gone = [connection for connection, came in changes if not came]
        if gone:  # what they said last comes before their end
            messages += self._messages(_LAST_WORDS)
        events: list[tuple[_Connection, RouterEvent]] = []
        for frames in messages:
            events += self._interpret(frames, gone, changes)
        told: list[RouterEvent] = []
        for connection, came in changes:
            if came:
                told.append(PeerConnected(connection.number))
            else:
                told += [event for sender, event in events if sender is connection]
                told.append(PeerDisconnected(connection.number))
                self._identities.pop(connection.number, None)
        return told + [event for sender, event in events if all(sender is not one for one in gone)]

    def reply(self, connection: int, frames: Sequence[bytes]) -> None:
        """Answer by `connection`, if it is still there. Never blocks."""
        identity = self._identities.get(connection)
        if identity is not None:
            send_frames(self.socket, [identity, b"", *frames])

    def _messages(self, most: int) -> list[list[zmq.Frame]]:
        """The next messages, at most so many."""
        messages: list[list[zmq.Frame]] = []
        while len(messages) < most and (frames := receive_frames(self.socket)):
            messages.append(frames)
            self._guard.heard(descriptor_of(frames[0]))
        if not is_readable(self.socket):
            self._guard.settle()
        return messages

    def _changes(self) -> list[tuple[_Connection, bool]]:
        """Connections in the order in which they came (True) and went."""
        changes: list[tuple[_Connection, bool]] = []
        for kind, descriptor in self.monitor.drain():
            if kind not in (ACCEPTED, DISCONNECTED):
                self._warn_refused()
                continue
            if (gone := self._open.pop(descriptor, None)) is not None:
                self._guard.closed(descriptor)
                self._formers[descriptor] = gone
                changes.append((gone, False))
            if kind == ACCEPTED:
                self._guard.opened(descriptor)
                changes.append((self._new(descriptor), True))
        return changes

    def _interpret(
        self, frames: list[zmq.Frame], gone: list[_Connection], changes: list[tuple[_Connection, bool]]
    ) -> list[tuple[_Connection, RouterEvent]]:
        sender = self._sender(frames[0], gone, changes)
        if sender is None:
            return []
        content = [frame.bytes for frame in frames]
        if len(content) < 2 or content[1]:
            self._log.warning(f"dropped a request of {sender.name or 'a nameless peer'}: no empty frame before it")
            return []
        return [(sender, PeerAsked(sender.number, sender.name, sender.user, content[2:]))]

    def _sender(
        self, first: zmq.Frame, gone: list[_Connection], changes: list[tuple[_Connection, bool]]
    ) -> _Connection | None:
        """The connection that a message came by; its descriptor may have been given to several, one after the other."""
        identity, descriptor = first.bytes, descriptor_of(first)
        current = self._open.get(descriptor)
        if current is not None and current.identity == identity:
            return current
        former = self._formers.get(descriptor)
        if former is not None and former.identity == identity and not (current and self._is_there(first)):
            return former if former in gone else None  # its last words; None: its end was told before they came
        for connection in (former if former in gone else None, current):
            if connection is not None and connection.identity is None:
                return self._introduced(connection, first)
        if current is None:
            return None
        # it was taken for another, whose last words had been left on this descriptor
        gone.append(current)
        changes += [(current, False), (new := self._new(descriptor), True)]
        return self._introduced(new, first)

    def _is_there(self, first: zmq.Frame) -> bool:
        """Return whether the peer that said this is connected; a REQ peer is taken to be.

        A DEALER peer of ours ignores the empty frame that is sent to find out. A REQ peer would hang up.
        """
        if property_of(first, "Socket-Type") != "DEALER":
            return True
        self.socket.setsockopt(zmq.ROUTER_MANDATORY, 1)
        try:
            return send_frames(self.socket, [first.bytes, b""]) or True  # False: it is there, and takes nothing
        except zmq.ZMQError as error:
            return error.errno != zmq.EHOSTUNREACH
        finally:
            self.socket.setsockopt(zmq.ROUTER_MANDATORY, 0)

    def _new(self, descriptor: int) -> _Connection:
        self._numbers += 1
        connection = self._open[descriptor] = _Connection(self._numbers, descriptor)
        return connection

    def _introduced(self, connection: _Connection, first: zmq.Frame) -> _Connection:
        if connection.identity is None:
            connection.identity = self._identities[connection.number] = first.bytes
            connection.name = _name(first.bytes)
            connection.user = None if self._keys is None else self._keys.user_as(user_of(first), connection.name)
        return connection

    def _warn_refused(self) -> None:
        """Once: a peer that is refused tries again without end."""
        if self._keys is not None and not self._has_refused:
            self._has_refused = True
            self._log.warning(
                f"refused a connection to {self.address}: its key is missing or unknown; [security] plain = true "
                "admits programs without keys"
            )


def _name(identity: bytes) -> str:
    """The peer's own name; the socket gives peers without one an identity that begins with a zero byte."""
    if identity.startswith(b"\0"):
        return ""
    try:
        return identity.partition(MARK)[0].decode()
    except UnicodeDecodeError:
        return ""
