"""Publishes, and gives those who join late what they missed."""

from __future__ import annotations

import zmq

from afspm import wire
from afspm.model import Packet
from afspm.transport.frames import descriptor_of, property_of, receive_frames, send_packet
from afspm.transport.late_joiners import LONGEST, History, Marker, is_reserved, spelled_out
from afspm.transport.network import DISCONNECTED, Monitor, Network
from afspm.wire.protocol import prefixes_of_version_1

_BATCH, _MOST_REPLAYS = 100, 5
"""Messages taken in, and replays made, before everything else is looked at again."""


class Publisher:
    """A publishing socket that sees who subscribes.

    A subscriber of ours is sent what it missed under a topic of its own (see `replay`), so that nobody else is sent it
    again, and from then on everything, without a gap. A plain SUB socket is taken for one of version 1: it is sent what
    was kept as ordinary packets, which all of that version see; and of all envelopes, which it asks for by the empty
    prefix, those of version 1, since it would end over any other.

    The publisher waits for no subscriber. One that stands still is disconnected: once it takes something again, it
    connects anew and gets what it missed.

    Args:
        history: what was published before; asked when somebody subscribes.
    """

    def __init__(self, network: Network, address: str, history: History) -> None:
        self.history = history
        self._plain: dict[int, set[bytes]] = {}  # subscriptions of version 1, by connection
        self.socket = network.socket(zmq.XPUB, max_bytes=LONGEST + 1)
        self.socket.setsockopt(zmq.XPUB_MANUAL, 1)
        self.socket.setsockopt(zmq.XPUB_VERBOSER, 1)
        self.monitor = Monitor(network, self.socket, DISCONNECTED)
        self.address = network.bind(self.socket, address)

    def publish(self, packet: Packet) -> None:
        """Send to all who subscribed to the packet's envelope. Never blocks."""
        send_packet(self.socket, packet, None if packet.time_ns is None else wire.encode_time(packet.time_ns))

    def kill(self) -> None:
        """Tell everyone that the experiment has ended."""
        self.socket.send(wire.KILL)

    def has_plain_subscriber(self, envelope: str) -> bool:
        """Return whether a peer of version 1 subscribes to an envelope."""
        wanted = tuple(meant for prefixes in self._plain.values() for prefix in prefixes for meant in _meant(prefix))
        return envelope.encode().startswith(wanted)

    def follow(self) -> None:
        """Take in which connections came and went."""
        for _, descriptor in self.monitor.drain():
            self._plain.pop(descriptor, None)

    def serve(self) -> int:
        """Take in who subscribed and who left; return how many joined."""
        self.follow()
        joined = 0
        new: dict[int, list[bytes]] = {}
        for _ in range(_BATCH):
            frames = receive_frames(self.socket) if joined < _MOST_REPLAYS else []
            if not frames:
                break
            kind, subscription = frames[0].bytes[:1], frames[0].bytes[1:]
            if kind == b"\1":
                joined += self._subscribed(subscription, frames[0], new)
            elif kind == b"\0" and not is_reserved(subscription):
                self._unsubscribed(subscription, descriptor_of(frames[0]))
        for prefixes in new.values():
            # all of one peer's prefixes together: peers of version 1 lose what comes out of order
            for packet in self.history(None, tuple(m.decode() for prefix in prefixes for m in _meant(prefix)), -1):
                self.publish(packet)
        return joined + len(new)

    def _subscribed(self, subscription: bytes, frame: zmq.Frame, new: dict[int, list[bytes]]) -> int:
        if (marker := Marker.decode(subscription)) is not None:
            self._replay(marker)
            return 1
        # our own subscribers repeat their prefixes by themselves when a connection is made again, before they can say
        # what they have: they are subscribed by the marker, and only by it, so that they miss nothing
        if not is_reserved(subscription) and property_of(frame, "Socket-Type") != "XSUB":
            self.follow()  # what an earlier connection of this number wanted is forgotten
            descriptor = descriptor_of(frame)
            self._plain.setdefault(descriptor, set()).add(subscription)
            for prefix in _meant(subscription):
                self.socket.setsockopt(zmq.SUBSCRIBE, prefix)
            new.setdefault(descriptor, []).append(subscription)
        return 0

    def _unsubscribed(self, subscription: bytes, descriptor: int) -> None:
        others = self._plain.get(descriptor, set())
        others.discard(subscription)
        still = {prefix for other in others for prefix in _meant(other)}
        for prefix in _meant(subscription):
            if prefix not in still:
                self.socket.setsockopt(zmq.UNSUBSCRIBE, prefix)

    def _replay(self, marker: Marker) -> None:
        socket, topic = self.socket, marker.topic
        # in this mode a subscription is for the one peer whose message was received last
        socket.setsockopt(zmq.SUBSCRIBE, topic)
        for prefix in spelled_out(prefix.encode() for prefix in marker.prefixes):
            socket.setsockopt(zmq.SUBSCRIBE, prefix)
        for packet in self.history(topic, marker.prefixes, marker.since_ns):
            stamp = b"" if packet.time_ns is None else wire.encode_time(packet.time_ns)
            send_packet(socket, packet, stamp, topic=topic)
        socket.send(topic)
        socket.setsockopt(zmq.UNSUBSCRIBE, topic)


def _meant(prefix: bytes) -> list[bytes]:
    """The prefixes that a peer of version 1 means by one; none if it is no text."""
    try:
        return [one.encode() for one in prefixes_of_version_1([prefix.decode()])]
    except UnicodeDecodeError:
        return []
