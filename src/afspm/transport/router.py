"""The scheduler's control socket: requests with their senders, and the disconnections of senders.

The identity of its socket identifies a sender: its name, a zero byte, and a random text (`keys.routing_id`). So two
processes with one name are two senders, and no answer reaches the wrong process. Sockets with the same bare name as
identity, such as REQ sockets of programs without a client of afspm, share one sender.

ZeroMQ reports the end of a connection without its peer. So each known sender is then probed with an empty message,
which every client ignores: ROUTER refuses to send to a disconnected peer (ROUTER_MANDATORY). A REQ socket would take
the probe for the answer to its request: its end is recognised by the descriptor of its connection.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import zmq

from afspm.basics.clock import Clock
from afspm.transport.frames import descriptor_of, property_of, receive_frames, send_frames, user_of
from afspm.transport.keys import MARK
from afspm.transport.network import CUT, DISCONNECTED, KEY_REFUSED, MISMATCHED, REFUSED, Monitor, Network
from afspm.transport.rate_limited_log import RateLimitedLog

_LAST_WORDS = 200
"""Limit of messages received before the end of a sender is reported."""
_LOOKS_S = (0.0, 0.02, 0.5)
"""Real times after the end of a connection at which all senders are probed: ZeroMQ reports the end a moment before it
forgets the peer."""

_REFUSALS = {
    KEY_REFUSED: "refused a connection: its key is not among the public keys of this experiment",
    MISMATCHED: "refused a connection: it has no key, or an old public key of this process; [security] insecure = true "
    "admits programs without keys",
    CUT: "a connection ended before its key was checked: the link was cut, or a program without keys gave up",
}
"""The warning for each kind of failed handshake. A port scan, too, is CUT: that is no reason to give up keys."""


class PeerConnected(NamedTuple):
    """A peer has connected."""

    connection: int


class PeerDisconnected(NamedTuple):
    """A peer has gone."""

    connection: int


class PeerAsked(NamedTuple):
    """A request, as frames for `wire.decode_request`; without frames it only announces the peer's name.

    Attributes:
        name: name of the peer; "" without a readable name.
        user: owner of the peer's key; None without keys.
    """

    connection: int
    name: str
    user: str | None
    frames: Sequence[bytes]


RouterEvent = PeerConnected | PeerDisconnected | PeerAsked


@dataclass(slots=True)
class _Sender:
    number: int
    identity: bytes
    owner: str | None
    name: str
    user: str | None
    is_req: bool
    descriptor: int = -1  # of its connection, for a REQ socket
    is_gone: bool = False


class Router:
    """A socket for REQ and DEALER peers, each known by its identity."""

    def __init__(self, network: Network, address: str, log: RateLimitedLog, clock: Clock) -> None:
        self._log, self._clock = log, clock
        keys = network.keys
        self._keys = keys if keys is not None and keys.binds_encrypted(address, requests=True) else None
        self._warned: set[int] = set()
        self._numbers = 0
        self._senders: dict[bytes, _Sender] = {}
        self._identities: dict[int, bytes] = {}  # by the sender's number
        self._looks_s: list[float] = []
        self.socket = network.socket(zmq.ROUTER)
        # the newest connection of an identity gets its answers: a client may reconnect before its old connection times
        # out
        self.socket.setsockopt(zmq.ROUTER_HANDOVER, 1)
        self.socket.setsockopt(zmq.ROUTER_MANDATORY, 1)
        self.monitor = Monitor(network, self.socket, DISCONNECTED | REFUSED)
        self.address = network.bind(self.socket, address, requests=True)

    @property
    def due_s(self) -> float:
        """Return the real monotonic time at which `receive` must be called even without a new message."""
        return self._looks_s[0] if self._looks_s else math.inf

    def receive(self) -> list[RouterEvent]:
        """Return the next request, and disconnected senders, each after its last request.

        The socket takes messages from its clients in turn.
        """
        self._follow()
        events: list[RouterEvent] = [*self._messages(1)]
        now_s = self._clock.monotonic_s()
        gone = self._gone() if now_s >= self.due_s else self._former_lives(events)
        self._looks_s = [look_s for look_s in self._looks_s if look_s > now_s]
        if not gone:
            return events
        events += self._messages(_LAST_WORDS)
        for number in gone:
            self._forget(number)
        ended = [*(event for event in events if event.connection in gone), *map(PeerDisconnected, gone)]
        return [*ended, *(event for event in events if event.connection not in gone)]

    def reply(self, connection: int, frames: Sequence[bytes]) -> None:
        """Answer a sender, if it is still connected. Never blocks."""
        sender = self._senders.get(self._identities.get(connection, b""))
        if sender is not None and not self._send([sender.identity, b"", *frames]):
            sender.is_gone = True
            self._look_soon()

    def _send(self, frames: Sequence[bytes]) -> bool:
        try:
            send_frames(self.socket, frames)
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
            return False
        return True

    def _messages(self, most: int) -> list[PeerConnected | PeerAsked]:
        events: list[PeerConnected | PeerAsked] = []
        for _ in range(most):
            if not (frames := receive_frames(self.socket)):
                break
            events += self._interpret(frames)
        return events

    def _interpret(self, frames: list[zmq.Frame]) -> list[PeerConnected | PeerAsked]:
        kind = property_of(frames[0], "Socket-Type")
        if kind is None:
            return []  # a peer older than ZMTP 3, or of a similar protocol
        sender, is_new = self._sender(frames[0], kind)
        events: list[PeerConnected | PeerAsked] = [PeerConnected(sender.number)] if is_new else []
        content = [frame.bytes for frame in frames]
        if len(content) < 2 or content[1]:
            self._log.warning(f"dropped a request of {sender.name or 'a nameless peer'}: no empty frame before it")
        else:
            events.append(PeerAsked(sender.number, sender.name, sender.user, content[2:]))
        return events

    def _sender(self, first: zmq.Frame, kind: str) -> tuple[_Sender, bool]:
        identity, owner = first.bytes, None if self._keys is None else user_of(first)
        sender = self._senders.get(identity)
        descriptor = descriptor_of(first) if kind == "REQ" else -1
        if sender is not None and sender.owner == owner and not sender.is_gone:
            sender.descriptor = descriptor
            return sender, False
        self._numbers += 1
        name = _name(identity)
        user = None if self._keys is None else self._keys.user_as(owner, name)
        sender = self._senders[identity] = _Sender(
            self._numbers, identity, owner, name, user, kind == "REQ", descriptor
        )
        self._identities[sender.number] = identity
        return sender, True

    def _former_lives(self, events: Sequence[RouterEvent]) -> list[int]:
        # a new sender under a known name may be a restarted process: look whether its former life is gone
        if len(events) < 2:
            return []
        names = {event.name for event in events if isinstance(event, PeerAsked)}
        return self._gone() if sum(sender.name in names for sender in self._senders.values()) > 1 else []

    def _gone(self) -> list[int]:
        there = set()
        for sender in self._senders.values():
            if not sender.is_gone and (sender.is_req or self._send([sender.identity, b""])):
                there.add(sender.number)
        return [number for number in self._identities if number not in there]

    def _forget(self, number: int) -> None:
        identity = self._identities.pop(number)
        if (sender := self._senders.get(identity)) is not None and sender.number == number:
            del self._senders[identity]

    def _follow(self) -> None:
        for kind, descriptor in self.monitor.drain():
            if kind == DISCONNECTED:
                for sender in self._senders.values():
                    sender.is_gone |= sender.is_req and sender.descriptor == descriptor
                self._look_soon()
            else:
                self._warn_refused(kind)

    def _look_soon(self) -> None:
        now_s = self._clock.monotonic_s()
        self._looks_s = [now_s + after_s for after_s in _LOOKS_S]

    def _warn_refused(self, kind: int) -> None:
        # each kind only once: a refused peer tries again without end
        if self._keys is not None and kind not in self._warned:
            self._warned.add(kind)
            self._log.warning(f"{self.address}: {_REFUSALS[kind]}")


def _name(identity: bytes) -> str:
    # the socket gives peers without an identity one that begins with a zero byte
    if identity.startswith(b"\0"):
        return ""
    try:
        return identity.partition(MARK)[0].decode()
    except UnicodeDecodeError:
        return ""
