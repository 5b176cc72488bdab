"""Log lines on their way from processes, perhaps on other computers, to the one that collects them."""

from __future__ import annotations

from typing import NamedTuple

import zmq

from afspm.clock import Clock
from afspm.model import component_of
from afspm.transport.frames import descriptor_of, receive_small, user_of
from afspm.transport.monitor import ACCEPTED, DISCONNECTED, Monitor
from afspm.transport.network import Network
from afspm.transport.polling import milliseconds

LONGEST_LINE_BYTES = 64 * 1024
MOST_LINES = 1000
"""That are taken in at once."""


class LogLine(NamedTuple):
    """What one process had to say.

    Attributes:
        name: of the process.
        level: that of `logging`.
        time_ns: in the experiment, by the sender's clock.
        text: perhaps several lines (a traceback).
    """

    name: str
    level: int
    time_ns: int
    text: str


class LogSender:
    """Sends lines to a collector; what is said while it is not there is lost, and nobody waits for it.

    Called under the lock of a logging handler, so that one thread at a time uses the socket.
    """

    def __init__(self, network: Network, address: str, name: str) -> None:
        self._network = network
        self._name = name.encode()
        self._socket = network.socket(zmq.PUB)
        network.connect(self._socket, address)

    def send(self, level: int, time_ns: int, text: str) -> None:
        """One record."""
        cut = text.encode(errors="backslashreplace")[:LONGEST_LINE_BYTES]  # a file may have a name that is no text
        self._socket.send_multipart([self._name, str(level).encode(), str(time_ns).encode(), cut], zmq.NOBLOCK)

    def close(self) -> None:
        self._network.close()


class LogReceiver:
    """Binds an address that processes send their lines to."""

    def __init__(self, network: Network, address: str) -> None:
        self._network = network
        self._socket = network.socket(zmq.SUB)
        self._socket.setsockopt(zmq.SUBSCRIBE, b"")
        self._monitor = Monitor(network, self._socket, ACCEPTED | DISCONNECTED)
        self._connected: set[int] = set()
        self.address = network.bind(self._socket, address, requests=True)

    def take(self) -> list[LogLine]:
        """The next of what has come, a batch at most; does not wait."""
        lines: list[LogLine] = []
        heard: set[int] = set()
        for _ in range(MOST_LINES):
            first, frames = receive_small(self._socket)
            if first is None:
                self._network.connections.settled(heard)
                break
            heard.add(descriptor_of(first) or -1)
            if (line := read_line(frames)) is not None and self._is_own(line.name, first):
                lines.append(line)
        return lines

    def take_rest(self, timeout_s: float, clock: Clock, *, staying: int = 0) -> list[LogLine]:
        """What comes until all but `staying` senders have gone, for at most `timeout_s`: the last words of a night."""
        until_s = clock.monotonic_s() + timeout_s
        poller = zmq.Poller()
        for socket in (self._socket, self._monitor.socket):
            poller.register(socket, zmq.POLLIN)
        lines = self.take()
        while self._count() > staying and (left_s := until_s - clock.monotonic_s()) > 0.0:
            poller.poll(milliseconds(left_s))
            lines += self.take()
        while more := self.take():
            lines += more
        return lines

    def _is_own(self, name: str, first: zmq.Frame) -> bool:
        """Whether the name is the sender's, as far as there are keys to tell."""
        keys = self._network.keys
        return keys is None or not keys.binds_encrypted(requests=True) or user_of(first) == component_of(name)

    def _count(self) -> int:
        """How many senders there are."""
        for kind, descriptor in self._monitor.drain():
            (self._connected.add if kind == ACCEPTED else self._connected.discard)(descriptor)
        return len(self._connected)

    def close(self) -> None:
        self._network.close()


def read_line(frames: list[bytes]) -> LogLine | None:
    """A line; None if the frames are none."""
    try:
        name, level, time_ns, text = frames
        return LogLine(name.decode(), int(level), int(time_ns), text.decode(errors="replace"))
    except ValueError:
        return None
