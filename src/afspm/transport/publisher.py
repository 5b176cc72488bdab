"""Publishing, with the replay of missed packets to late subscribers."""

from __future__ import annotations

import zmq

from afspm import wire
from afspm.basics.formatting import counted
from afspm.model import Packet
from afspm.transport.frames import property_of, receive_frames, send_packet
from afspm.transport.late_joiners import LONGEST, History, Marker, is_reserved, spelled_out
from afspm.transport.network import Network
from afspm.transport.rate_limited_log import RateLimitedLog

_BATCH, _MOST_REPLAYS = 100, 5
"""Limit of received messages and sent replays in one turn, so that other sockets get a turn."""


class Publisher:
    """A publishing socket that handles subscriptions.

    A subscriber of afspm gets its missed packets under its own topic (see `late_joiners`), so that no other subscriber
    gets them twice; then every packet, without a gap. A plain SUB socket gets the kept packets as ordinary packets,
    which all subscribers with the same subscription receive again.

    The publisher waits for no subscriber. A subscriber that stops reading is disconnected; when it reads again, it
    reconnects and gets the missed packets.

    Args:
        history: returns earlier packets for a new subscriber.
        log: gets a warning for each subscriber that has lost its connection and lacks packets.
    """

    def __init__(self, network: Network, address: str, history: History, log: RateLimitedLog) -> None:
        self.history = history
        self._log = log
        self._bytes_again = 0
        self.socket = network.socket(zmq.XPUB, max_bytes=LONGEST + 1)
        self.socket.setsockopt(zmq.XPUB_MANUAL, 1)
        self.socket.setsockopt(zmq.XPUB_VERBOSER, 1)
        self.address = network.bind(self.socket, address)

    def publish(self, packet: Packet) -> None:
        """Send a packet to all subscribers of its envelope. Never blocks."""
        send_packet(self.socket, packet, None if packet.time_ns is None else wire.encode_time(packet.time_ns))

    def kill(self) -> None:
        """Send the signal KILL: the experiment has ended."""
        self.socket.send(wire.KILL)

    def serve(self) -> int:
        """Process a batch of subscriptions; return the number of subscribers that joined."""
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
        # the XSUB of afspm's subscribers repeats its prefixes at a reconnection by itself, before their marker: only
        # the marker counts, else live packets would overtake the missed ones
        if is_reserved(subscription) or property_of(frame, "Socket-Type") == "XSUB":
            return 0
        for prefix in spelled_out([subscription]):
            self.socket.setsockopt(zmq.SUBSCRIBE, prefix)
        for packet in self.history(None, (subscription.decode("utf-8", "replace"),), -1):
            self.publish(packet)
        return 1

    def _replay(self, marker: Marker) -> None:
        socket, topic = self.socket, marker.topic
        # in XPUB_MANUAL mode setsockopt subscribes the peer of the last received message
        socket.setsockopt(zmq.SUBSCRIBE, topic)
        for prefix in spelled_out(prefix.encode() for prefix in marker.prefixes):
            socket.setsockopt(zmq.SUBSCRIBE, prefix)
        count = size = 0
        for packet in self.history(topic, marker.prefixes, marker.since_ns):
            stamp = b"" if packet.time_ns is None else wire.encode_time(packet.time_ns)
            send_packet(socket, packet, stamp, topic=topic)
            count, size = count + 1, size + len(packet.payload)
        socket.send(topic)
        socket.setsockopt(zmq.UNSUBSCRIBE, topic)
        if count and marker.reconnections:
            self._warn_again(marker, count, size)

    def _warn_again(self, marker: Marker, count: int, size: int) -> None:
        # without this line, a link that breaks within each packet would carry the same bytes for a night unnoticed
        self._bytes_again += size
        self._log.warning(
            f"{marker.subscriber} has lost its connection to {self.address} (reconnection {marker.reconnections}): "
            f"{counted(count, 'packet')} ({size / 1e6:.1f} MB) had not arrived and are sent again, "
            f"to all subscribers so far {self._bytes_again / 1e6:.1f} MB; "
            "if this repeats, look for a link that breaks or a process that hangs"
        )
