"""Publishes, and gives those who join late what they missed."""

from __future__ import annotations

import zmq

from afspm import wire
from afspm.model import Packet
from afspm.transport.frames import property_of, receive_frames, send_packet
from afspm.transport.late_joiners import LONGEST, History, Marker, is_reserved, spelled_out
from afspm.transport.network import Network

_BATCH, _MOST_REPLAYS = 100, 5
"""Messages taken in, and replays made, before everything else is looked at again."""


class Publisher:
    """A publishing socket that sees who subscribes.

    A subscriber of ours is sent what it missed under a topic of its own (see `replay`), so that nobody else is sent it
    again, and from then on everything, without a gap. To a plain SUB socket what was kept is sent as ordinary packets,
    which all others with such a subscription are sent again.

    The publisher waits for no subscriber. One that stands still is disconnected: once it takes something again, it
    connects anew and gets what it missed.

    Args:
        history: what was published before; asked when somebody subscribes.
    """

    def __init__(self, network: Network, address: str, history: History) -> None:
        self.history = history
        self.socket = network.socket(zmq.XPUB, max_bytes=LONGEST + 1)
        self.socket.setsockopt(zmq.XPUB_MANUAL, 1)
        self.socket.setsockopt(zmq.XPUB_VERBOSER, 1)
        self.address = network.bind(self.socket, address)

    def publish(self, packet: Packet) -> None:
        """Send to all who subscribed to the packet's envelope. Never blocks."""
        send_packet(self.socket, packet, None if packet.time_ns is None else wire.encode_time(packet.time_ns))

    def kill(self) -> None:
        """Tell everyone that the experiment has ended."""
        self.socket.send(wire.KILL)

    def serve(self) -> int:
        """Serve new subscriptions; return how many subscribers joined."""
        joined = 0
        for _ in range(_BATCH):
            frames = receive_frames(self.socket) if joined < _MOST_REPLAYS else []
            if not frames:
                break
            kind, subscription = frames[0].bytes[:1], frames[0].bytes[1:]
            if kind == b"\1":
                joined += self._subscribed(subscription, frames[0])
            elif kind == b"\0" and not is_reserved(subscription):
                for prefix in spelled_out([subscription]):
                    self.socket.setsockopt(zmq.UNSUBSCRIBE, prefix)
        return joined

    def _subscribed(self, subscription: bytes, frame: zmq.Frame) -> int:
        marker = Marker.decode(subscription)
        if marker is not None:
            self._replay(marker)
            return 1
        # our own subscribers repeat their prefixes by themselves when a connection is made again, before they can say
        # what they have: they are subscribed by the marker, and only by it, so that they miss nothing
        if is_reserved(subscription) or property_of(frame, "Socket-Type") == "XSUB":
            return 0
        for prefix in spelled_out([subscription]):
            self.socket.setsockopt(zmq.SUBSCRIBE, prefix)
        for packet in self.history(None, (subscription.decode("utf-8", "replace"),), -1):
            self.publish(packet)
        return 1

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
