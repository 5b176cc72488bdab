"""Publishes, and gives those who come late what they missed."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable

import zmq

from afspm import wire
from afspm.model import Packet
from afspm.transport.frames import descriptor_of, property_of, readable, send_packet
from afspm.transport.network import Network
from afspm.transport.plain_subscribers import PlainSubscribers, meant
from afspm.transport.replay import LONGEST, Marker, is_reserved, spelled_out
from afspm.transport.subscribers import MOST_WAITING_BYTES, Subscribers

_BATCH, _MOST_REPLAYS = 100, 5
"""Messages that are taken in, and replays that are made, before everything else is looked at again."""
_OVERHEAD_BYTES = 24

History = Callable[[Hashable, tuple[str, ...], int], Iterable[Packet]]
"""(who, prefixes, since_ns) -> what was published under these and is newer, oldest first."""


class Publisher:
    """A publishing socket that sees who subscribes.

    A subscriber of ours is sent what it missed under a topic of its own (see `replay`), so that no one else is sent
    it again, and from then on everything, without a gap. A subscriber of version 1 is sent what was kept as ordinary
    packets, which all of that version see; and of all envelopes, which it asks for by the empty prefix, those of
    version 1, since it would end over any other.

    Nobody is waited for. A subscriber for which too much waits is disconnected: once it takes something again, it
    connects anew and gets what it missed.

    Args:
        history: what was published before; asked when somebody subscribes.
        most_waiting_bytes: how much may wait for a subscriber.
    """

    def __init__(
        self, network: Network, address: str, history: History, *, most_waiting_bytes: int = MOST_WAITING_BYTES
    ) -> None:
        self.history = history
        self.touched = True
        self.socket = network.socket(zmq.XPUB, max_bytes=LONGEST + 1)
        self.socket.setsockopt(zmq.XPUB_MANUAL, 1)
        self.socket.setsockopt(zmq.XPUB_VERBOSER, 1)
        self._guard = network.connections
        self._subscribers = Subscribers(most_waiting_bytes)
        self.plain = PlainSubscribers(network, self.socket)
        self.address = network.bind(self.socket, address)

    def publish(self, packet: Packet) -> None:
        """Send to all who subscribed to the packet's envelope. Never blocks."""
        tail = None if packet.time_ns is None else wire.encode_time(packet.time_ns)
        self.touched = True
        send_packet(self.socket, [packet.envelope.encode()], packet.payload, tail)
        self._subscribers.published(packet.envelope, _size(packet))

    def kill(self) -> None:
        """The experiment has ended: tell everyone to close."""
        self.socket.send(wire.KILL)

    def serve(self) -> int:
        """Take in who subscribed and who left; returns how many joined."""
        self.touched = True  # perhaps: what was kept
        joined = 0
        heard: set[int] = set()
        plain: dict[int | None, list[bytes]] = {}
        for _ in range(_BATCH):
            if joined == _MOST_REPLAYS:
                break
            if not readable(self.socket):
                self._guard.settled(heard)
                break
            frame = self.socket.recv(zmq.NOBLOCK, copy=False)
            descriptor, subscription = descriptor_of(frame), frame.bytes
            if descriptor is not None:
                heard.add(descriptor)
            if subscription[:1] == b"\1":
                joined += self._subscribed(subscription[1:], frame, descriptor, plain)
            elif subscription[:1] == b"\0":
                self._unsubscribed(subscription[1:], frame, descriptor)
            # anything else is no subscription: nobody has a reason to send that here
        for descriptor, prefixes in plain.items():
            # all of one peer's prefixes together: peers of version 1 lose what comes out of order
            if not self._subscribers.may_replay(descriptor):
                continue
            wanted = tuple(one.decode() for prefix in prefixes for one in meant(prefix))
            for packet in self.history(None, wanted, -1):
                self.publish(packet)
        return joined + len(plain)

    def _subscribed(
        self, subscription: bytes, frame: zmq.Frame, descriptor: int | None, plain: dict[int | None, list[bytes]]
    ) -> int:
        marker = Marker.decode(subscription)
        ours = is_reserved(subscription) or property_of(frame, "Socket-Type") == "XSUB"
        if marker is not None:
            prefixes = marker.prefixes
        elif ours:
            prefixes = (subscription.decode("utf-8", "replace"),)
        else:
            prefixes = tuple(one.decode() for one in meant(subscription))
        if not self._subscribers.subscribed(descriptor, prefixes, len(subscription)):
            return 0
        if marker is not None:
            if self._subscribers.may_replay(descriptor):
                self._replay(marker, descriptor)
                return 1
        # our own subscribers repeat their prefixes by themselves when a connection is made again, before they can say
        # what they have: they are subscribed by the marker, and only by it, so that they miss nothing
        elif not ours:
            for prefix in self.plain.subscribed(frame, subscription):
                self.socket.setsockopt(zmq.SUBSCRIBE, prefix)
            plain.setdefault(descriptor, []).append(subscription)
        return 0

    def _unsubscribed(self, subscription: bytes, frame: zmq.Frame, descriptor: int | None) -> None:
        self._subscribers.unsubscribed(descriptor, len(subscription))
        if not is_reserved(subscription):
            for prefix in self.plain.unsubscribed(frame, subscription):
                self.socket.setsockopt(zmq.UNSUBSCRIBE, prefix)

    def _replay(self, marker: Marker, descriptor: int | None) -> None:
        socket, topic = self.socket, marker.topic
        # in this mode a subscription is for the one peer whose message was received last
        socket.setsockopt(zmq.SUBSCRIBE, topic)
        for prefix in spelled_out(prefix.encode() for prefix in marker.prefixes):
            socket.setsockopt(zmq.SUBSCRIBE, prefix)
        for packet in self.history(topic, marker.prefixes, marker.since_ns):
            tail = b"" if packet.time_ns is None else wire.encode_time(packet.time_ns)
            send_packet(socket, [topic, packet.envelope.encode()], packet.payload, tail)
            self._subscribers.sent(descriptor, len(topic) + _size(packet))
        socket.send(topic)
        socket.setsockopt(zmq.UNSUBSCRIBE, topic)


def _size(packet: Packet) -> int:
    """About as many bytes as a packet takes on its way."""
    return len(packet.envelope) + len(packet.payload) + _OVERHEAD_BYTES
