"""What happens to the connections of a socket."""

from __future__ import annotations

import itertools
import select
import struct
from typing import Any, NamedTuple

import zmq

from afspm.transport.frames import readable
from afspm.transport.network import Network

CONNECTED = int(zmq.EVENT_HANDSHAKE_SUCCEEDED)
DISCONNECTED = int(zmq.EVENT_DISCONNECTED)
ACCEPTED = int(zmq.EVENT_ACCEPTED)
REFUSED = int(
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)
"""The peer has no key, or one that is not known. One without keys may hang up first, which has no detail."""
_HEADER = struct.Struct("=hi")
_numbers = itertools.count()


class ConnectionEvent(NamedTuple):
    """`kind` is one of the constants above; `value` the connection's descriptor if it was ACCEPTED or DISCONNECTED."""

    kind: int
    value: int


class Monitor:
    """The connection events of one socket, in the order in which they happened.

    Events come from the thread that also delivers the messages: whoever has received a message and then drains the
    monitor knows every event that came before the message.
    """

    def __init__(self, network: Network, socket: zmq.Socket[bytes], events: int) -> None:
        self._watched = socket
        address = f"inproc://monitor-{next(_numbers)}"
        socket.monitor(address, events)
        self.socket = network.socket(zmq.PAIR)
        self.socket.setsockopt(zmq.RCVHWM, 0)
        self.socket.connect(address)
        self._descriptor: Any = None
        if hasattr(select, "poll") and not readable(self.socket):
            self._descriptor = select.poll()
            self._descriptor.register(int(self.socket.getsockopt(zmq.FD)), select.POLLIN)

    def has_news(self) -> bool:
        """Whether `drain` would find anything: mostly not."""
        # nothing is sent by this socket, and all that there is received at once, so its descriptor does not lie: asking
        # that takes a third of the time
        return readable(self.socket) if self._descriptor is None else bool(self._descriptor.poll(0))

    def drain(self) -> list[ConnectionEvent]:
        """All events that have come."""
        events: list[ConnectionEvent] = []
        while readable(self.socket):
            kind, value = _HEADER.unpack(self.socket.recv_multipart(zmq.NOBLOCK)[0])
            events.append(ConnectionEvent(kind & 0xFFFF, value))
        return events

    def close(self) -> None:
        if not self._watched.closed:
            self._watched.disable_monitor()
        self.socket.close()
