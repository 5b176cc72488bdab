"""Disconnects a subscriber for which too much waits: what waits is bounded in bytes, too.

The library bounds how many messages wait for a subscriber, but 4,000 scans may be more than any memory; and how much
waits for whom it does not tell. So every few megabytes a probe is sent along to each: an empty message under a topic
of its connection alone, whose buffer the library gives back once all before it has gone out. Subscribers of ours drop
what comes under topics that they do not know. Those of version 1 might not, and are sent none: for them it is
the length of the queue that counts, and the time for which they may stand still (see `network`).
"""

from __future__ import annotations

import contextlib
import logging
import socket
import sys
from collections import deque
from collections.abc import Iterator
from typing import Any

import zmq

from afspm.transport.frames import descriptor_of

MOST_WAITING_BYTES = 512 * 2**20
"""As much as a scheduler's cache holds. All that wait share the same buffers: so it is that much for all together."""
_STEP_BYTES = 8 * 2**20
_BEGIN = b"\0probe/"
_log = logging.getLogger("afspm.transport")


class _Lane:
    """The way to one subscriber, and the probes that are on it, with how much had been published before each step."""

    __slots__ = ("descriptor", "name", "peer", "probes", "topic")

    def __init__(self, name: str, topic: bytes, descriptor: int, peer: Any) -> None:
        self.name = name
        self.topic = topic
        self.descriptor = descriptor
        self.peer = peer
        self.probes: deque[tuple[zmq.MessageTracker, int]] = deque()

    def oldest(self, published: int) -> int:
        """Up to where, in bytes of all that was published, everything has gone out."""
        while self.probes and self.probes[0][0].done:
            self.probes.popleft()
        return self.probes[0][1] if self.probes else published


class Laggards:
    """Watches over the subscribers of one XPUB socket in manual mode.

    Args:
        most_bytes: how much may wait for one of them.
    """

    def __init__(self, publisher: zmq.Socket[bytes], most_bytes: int = MOST_WAITING_BYTES) -> None:
        self._socket = publisher
        self._most_bytes = most_bytes
        self._published = 0
        self._probed = 0
        self._joined = 0
        # by descriptor, so that there are never more than there were connections at a time. Nothing waits for one that
        # is gone: its probes come back at once.
        self._lanes: dict[int, _Lane] = {}

    def joined(self, name: str, frame: zmq.Frame) -> None:
        """A subscriber of ours has come. To be called right after `frame`, its subscription, was received."""
        descriptor = descriptor_of(frame)
        peer = None if descriptor is None else _peer(descriptor)
        if descriptor is None or peer is None:
            return
        known = self._lanes.get(descriptor)
        if known is None or known.peer != peer:
            self._joined += 1
            lane = self._lanes[descriptor] = _Lane(name, _BEGIN + b"%d" % self._joined, descriptor, peer)
            self._socket.setsockopt(zmq.SUBSCRIBE, lane.topic)

    def published(self, count: int) -> None:
        """So many bytes more were published."""
        self._published += count
        if self._published - self._probed < _STEP_BYTES:
            return
        for lane in [*self._lanes.values()]:
            self._probe(lane)
            waiting = self._published - lane.oldest(self._published)
            if waiting > self._most_bytes:
                del self._lanes[lane.descriptor]
                _log.warning("%d MB wait for %.100r, which takes none of it: disconnected", waiting >> 20, lane.name)
                _disconnect(lane)
        self._probed = self._published

    def _probe(self, lane: _Lane) -> None:
        # only a buffer that is not copied is given back
        probe = zmq.Frame(b"\0", track=True, copy=False, copy_threshold=0)
        self._socket.send(lane.topic, zmq.SNDMORE)
        tracker = self._socket.send(probe, copy=False, track=True)
        lane.probes.append((tracker, self._probed))


@contextlib.contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """The library's connection, which stays open after. Raises OSError if there is none."""
    connection = socket.socket(fileno=descriptor)
    try:
        yield connection
    finally:
        connection.detach()


def _peer(descriptor: int) -> Any:
    """The address at the other end; None: there is none (any more)."""
    with contextlib.suppress(OSError), _borrowed(descriptor) as connection:
        return connection.getpeername()
    return None


def _disconnect(lane: _Lane) -> None:
    """As if the subscriber had hung up: once it goes on, it connects again and asks for what it missed."""
    if sys.platform == "win32":
        return  # there the library ends the process over a connection that was shut down for it
    with contextlib.suppress(OSError), _borrowed(lane.descriptor) as connection:
        if connection.getpeername() == lane.peer:  # else the descriptor was given to somebody else since
            connection.shutdown(socket.SHUT_RDWR)
