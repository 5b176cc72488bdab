"""Publishing, with the replay of missed packets to late subscribers, and the beacon that shows a lost packet."""

from __future__ import annotations

import math
import time
from collections import deque

import zmq

from afspm import wire
from afspm.basics.formatting import counted
from afspm.model import Packet
from afspm.transport.frames import property_of, receive_frames, send_packet
from afspm.transport.late_joiners import (
    BEACON,
    LONGEST,
    History,
    Marker,
    Newest,
    encode_newest,
    is_reserved,
    spelled_out,
)
from afspm.transport.network import QUEUE_LENGTH, Network
from afspm.transport.rate_limited_log import RateLimitedLog

_BATCH, _MOST_REPLAYS = 100, 5
"""Limit of received messages and sent replays in one turn, so that other sockets get a turn."""
_BEACON_S = 1.0
_SETTLED_S = 0.05  # a SUB socket sends its prefixes one by one
_TOGETHER_S = 1.0  # from one shared replay to the next: subscribers that join in between share it
_MARK_EACH = QUEUE_LENGTH // 40  # packets of a shared replay
_PAUSE_S = 0.05  # libzmq needs less to send half a queue on this computer
_STUCK_S = 10.0  # twice the time after which a peer that reads nothing is disconnected


class Publisher:
    """A publishing socket that handles subscriptions.

    A subscriber of afspm gets its missed packets under its own topic (see `late_joiners`), so that no other subscriber
    gets them twice. From then on it also gets a beacon each second, which names the newest packets: one that has not
    arrived by then was dropped. A plain SUB socket gets the kept packets as ordinary packets, see `_SharedReplay`.

    The publisher waits for no subscriber. A subscriber that stops reading is disconnected; when it reads again, it
    reconnects and gets the missed packets. For a slow one `QUEUE_LENGTH` packets wait, and further ones are dropped.

    Call `serve` whenever the socket is readable or `due_s` has passed.

    Args:
        history: returns earlier packets for a new subscriber.
        newest: returns the time of the newest kept packet of each envelope.
        log: gets a warning for each subscriber that has lost its connection and lacks packets.
    """

    def __init__(self, network: Network, address: str, history: History, newest: Newest, log: RateLimitedLog) -> None:
        self.history = history
        self.newest = newest
        self._log = log
        self._bytes_again = 0
        self._has_ended = False
        self._beacon_s = math.inf  # until a subscriber of afspm joins
        self._beacon = b""
        self._is_beacon_old = True
        self.socket = network.socket(zmq.XPUB, max_bytes=LONGEST + 1)
        self.socket.setsockopt(zmq.XPUB_MANUAL, 1)
        self.socket.setsockopt(zmq.XPUB_VERBOSER, 1)
        self.address = network.bind(self.socket, address)
        self._shared = _SharedReplay(self.socket, self.address, log)

    @property
    def due_s(self) -> float:
        """Real monotonic time at which `serve` must be called even if the socket is not readable."""
        return min(self._beacon_s, self._shared.due_s)

    def publish(self, packet: Packet) -> None:
        """Send a packet to all subscribers of its envelope. Never blocks."""
        self._is_beacon_old = True
        send_packet(self.socket, packet, None if packet.time_ns is None else wire.encode_time(packet.time_ns))

    def kill(self) -> None:
        """Send the signal KILL, also to each subscriber that joins later: the experiment has ended."""
        self._shared.hurry()  # a subscriber that connects at this moment gets the last packets and the end, too
        self.serve()
        self._has_ended = True
        self.socket.send(wire.KILL)

    def serve(self) -> int:
        """Process a batch of subscriptions, then due replays and beacons; return the number of replays sent."""
        replays = self._subscriptions()
        now_s = time.monotonic()
        if now_s >= self._shared.due_s:
            replays += self._shared.go_on(now_s, self.history)
        if now_s >= self._beacon_s:
            # at multiples of the period, like the heartbeats: the computer wakes up once for all processes
            self._beacon_s = now_s - now_s % _BEACON_S + _BEACON_S
            self._send_beacon()
        elif replays and self._has_ended:
            self.socket.send(wire.KILL)
        return replays

    def _subscriptions(self) -> int:
        replays = 0
        for _ in range(_BATCH):
            frames = receive_frames(self.socket) if replays < _MOST_REPLAYS else []
            if not frames:
                break
            kind, subscription = frames[0].bytes[:1], frames[0].bytes[1:]
            if kind == b"\1":
                replays += self._subscribed(subscription, frames[0])
            elif kind == b"\0" and not is_reserved(subscription):
                for prefix in spelled_out([subscription]):
                    self.socket.setsockopt(zmq.UNSUBSCRIBE, prefix)
        return replays

    def _send_beacon(self) -> None:
        if self._has_ended:
            self.socket.send(wire.KILL)  # the first one may have been dropped
            return
        if self._is_beacon_old:
            self._beacon, self._is_beacon_old = encode_newest(self.newest()), False
        self.socket.send_multipart([BEACON, self._beacon])

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
        self._shared.join(subscription.decode("utf-8", "replace"))
        return 0

    def _replay(self, marker: Marker) -> None:
        socket, topic = self.socket, marker.topic
        # in XPUB_MANUAL mode setsockopt subscribes the peer of the last received message
        for prefix in (topic, BEACON, *spelled_out(prefix.encode() for prefix in marker.prefixes)):
            socket.setsockopt(zmq.SUBSCRIBE, prefix)
        self._beacon_s = min(self._beacon_s, time.monotonic() + _BEACON_S)
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


class _SharedReplay:
    """The replay of kept packets to plain SUB sockets, one for all that join within a second.

    A plain SUB socket accepts a packet only under its envelope, and libzmq sends it to each subscriber of this
    envelope. So a replay of `n` packets to each of `m` sockets would send `n m²` packets, and fill the queues of all
    subscribers until newer packets are dropped. Instead, sockets that join together share a replay, and it pauses while
    its packets fill half of the queue of any subscriber.

    Attributes:
        due_s: real monotonic time of the next call of `go_on`; infinity without a replay.
    """

    def __init__(self, socket: zmq.Socket[bytes], address: str, log: RateLimitedLog) -> None:
        self._socket, self._address, self._log = socket, address, log
        self.due_s = math.inf
        self._joined: set[str] = set()
        self._prefixes: tuple[str, ...] = ()  # of the replay under way
        self._left: deque[Packet] = deque()
        self._next_s = self._give_up_s = -math.inf
        self._sent = 0
        self._marks: deque[zmq.MessageTracker] = deque()  # of each _MARK_EACH-th packet, in order

    def join(self, prefix: str) -> None:
        """Let the next replay include the packets under `prefix`."""
        self._joined.add(prefix)
        if not self._prefixes:
            self.due_s = min(self.due_s, max(time.monotonic() + _SETTLED_S, self._next_s))

    def hurry(self) -> None:
        """Begin a waiting replay with the next call of `go_on`."""
        if self._joined or self._prefixes:
            self.due_s = -math.inf

    def go_on(self, now_s: float, history: History) -> bool:
        """Send the packets that have room in all queues; return whether the replay is complete."""
        if not self._prefixes:
            self._prefixes, self._joined = tuple(self._joined), set()
            self._next_s, self._give_up_s = now_s + _TOGETHER_S, now_s + _STUCK_S
            self._left.extend(history(None, self._prefixes, -1))
            has_paused = False
        else:
            has_paused = True
        while self._left:
            newest_ns, count = self._left[-1].time_ns, len(self._left)
            self._send()
            if self._left and (len(self._left) < count or now_s < self._give_up_s):
                self._give_up_s = now_s + _STUCK_S if len(self._left) < count else self._give_up_s
                self.due_s = now_s + _PAUSE_S
                return False
            if self._left:
                self._give_up()
            elif has_paused:
                # packets published in a pause have overtaken older ones, and a receiver believes the last state
                self._left.extend(history(None, self._prefixes, newest_ns or -1))
                has_paused = False
        self._prefixes = ()
        self.due_s = self._next_s if self._joined else math.inf
        return True

    def _send(self) -> None:
        # SNDHWM stays as it is: libzmq 4.3.5 jumps into freed memory if it is changed while subscribers come and go.
        # With XPUB_NODROP a send fails while the queue of any receiver is full. A queue that was found full by a live
        # packet drops this packet as it does any other.
        self._socket.setsockopt(zmq.XPUB_NODROP, 1)
        try:
            while self._left and self._has_room():
                packet = self._left[0]
                stamp = None if packet.time_ns is None else wire.encode_time(packet.time_ns)
                tracker = send_packet(self._socket, packet, stamp, track=self._sent % _MARK_EACH == 0)
                if tracker is not None:
                    self._marks.append(tracker)
                self._sent += 1
                self._left.popleft()
        except zmq.Again:
            pass
        finally:
            self._socket.setsockopt(zmq.XPUB_NODROP, 0)

    def _has_room(self) -> bool:
        # libzmq frees a packet, and so its mark, once it has left the last queue: queues keep the order
        while self._marks and self._marks[0].done:
            self._marks.popleft()
        return len(self._marks) * _MARK_EACH < QUEUE_LENGTH // 2

    def _give_up(self) -> None:
        self._log.warning(
            f"plain subscribers that joined at {self._address} lack {counted(len(self._left), 'kept packet')}: for "
            f"{_STUCK_S:.0f} s the queue of a slow subscriber has been more than half full; "
            "start them again when the link is faster"
        )
        self._left.clear()
        self._marks.clear()  # a subscriber that reads nothing must not hold up the next replay, too
