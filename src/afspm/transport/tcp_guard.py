"""Bounds in bytes: disconnects peers that leave too much unread, unfinished or unsent.

libzmq bounds its queues in messages, and not at all while a message has more parts to come. TCP knows how much it has
received from a peer, and how much the peer has acknowledged (`TCP_INFO`): what is beyond that waits in a queue. Linux
alone tells; elsewhere, and for addresses other than tcp://, the length of the queues and `TCP_MAXRT` are all bounds.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

MOST_UNREAD_BYTES = 8 << 20
"""Received from one client, and not yet taken as whole messages."""
MOST_SUBSCRIBED_BYTES = 64 << 10
"""Received from one subscriber in all: its prefixes, and what it asks to have repeated."""
UNFINISHED_BYTES, UNFINISHED_S = 256 << 10, 5.0
"""So much of a message may be received for no longer than this without its end."""
MOST_UNSENT_BYTES = 512 << 20
"""Waiting for one subscriber. All subscribers share the same buffers, so that it is as much for all together."""
PERIOD_S = 0.2
_STEP_BYTES = 8 << 20
"""Published between two looks at what waits."""
_IDLE_BYTES_PER_S = 100.0
"""Heartbeats of ZMTP, which are no messages."""
_HAS_TCP_INFO = sys.platform == "linux"
_INFO_BYTES = 160
_UNACKED_AT, _COUNTS_AT, _NOT_SENT_AT = 24, 120, 144  # in Linux's `struct tcp_info`
_RESET = struct.pack("ii", 1, 0)
_log = logging.getLogger("afspm.transport")


class TcpInfo(NamedTuple):
    """Bytes that a peer has acknowledged, bytes that came from it, and whether all that was sent has arrived."""

    acked: int
    received: int
    all_arrived: bool


@dataclass(slots=True)
class ConnectionBacklog:
    """The bytes that wait on one connection: `taken` of the received ones are accounted for, and `sent` at `acked`."""

    now_s: float
    taken: float = 0.0
    began_s: float = 0.0
    acked: int = 0
    sent: int = 0

    def __post_init__(self) -> None:
        self.began_s = self.now_s

    def unread(self, received: int, now_s: float, *, settled: bool) -> int:
        """Return how many bytes wait to be taken; `settled`: all whole messages were taken just now."""
        idle = _IDLE_BYTES_PER_S * (now_s - self.now_s)
        self.taken = float(received) if settled else min(received, self.taken + idle)
        self.now_s = now_s
        waiting = round(received - self.taken)
        if waiting < UNFINISHED_BYTES:
            self.began_s = now_s
        return waiting

    def is_unfinished(self) -> bool:
        """True if a message has been coming for too long."""
        return self.now_s - self.began_s > UNFINISHED_S

    def unsent(self, info: TcpInfo, sent: int) -> int:
        """Return how many bytes wait to be sent; `sent`: all bytes ever given to the socket for this peer."""
        if info.all_arrived:  # a queue that is not empty keeps the system's buffer filled
            self.acked, self.sent = info.acked, sent
        return (sent - self.sent) - (info.acked - self.acked)


class TcpGuard:
    """Watches the connections of one bound socket, in a thread of its own, since the process may be busy.

    The owner of the socket tells which connections there are, and what it has taken and sent.

    Args:
        most_unread: bytes that may wait to be read of one peer.
        most_unsent: bytes that may wait to be sent to one peer.
    """

    def __init__(self, most_unread: int = MOST_UNREAD_BYTES, most_unsent: int = MOST_UNSENT_BYTES) -> None:
        self._most_unread, self._most_unsent = most_unread, most_unsent
        self._port = 0
        self._backlogs: dict[int, ConnectionBacklog] = {}
        self._replayed: dict[int, int] = {}
        self._heard: set[int] = set()
        self._settled: set[int] = set()
        self._published = self._unchecked = 0
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tcp-guard", daemon=True)

    def start(self, address: str) -> None:
        """Watch those who connect to a bound address."""
        if address.startswith("tcp://") and _HAS_TCP_INFO:
            self._port = int(address.rpartition(":")[2])
            self._thread.start()

    def opened(self, descriptor: int) -> None:
        """A peer has connected."""
        with self._lock:
            backlog = self._backlogs[descriptor] = ConnectionBacklog(time.monotonic())
            self._replayed[descriptor] = 0
            if (info := tcp_info(descriptor)) is not None:
                backlog.acked, backlog.sent = info.acked, self._published

    def closed(self, descriptor: int) -> None:
        """A peer has gone."""
        with self._lock:
            self._backlogs.pop(descriptor, None)

    def heard(self, descriptor: int) -> None:
        """Note that whole messages were taken of a connection."""
        self._heard.add(descriptor)

    def settle(self) -> None:
        """Nothing is left to receive, after the messages that were heard."""
        with self._lock:
            self._settled |= self._heard
        self._heard.clear()

    def published(self, count: int) -> None:
        """So many bytes were sent to all subscribers."""
        self._published += count
        self._unchecked += count
        if self._unchecked >= _STEP_BYTES:
            self.check(time.monotonic())

    def replayed(self, descriptor: int, count: int) -> None:
        """So many bytes were sent to one subscriber."""
        self._replayed[descriptor] = self._replayed.get(descriptor, 0) + count

    def close(self) -> None:
        """Stop watching. Safe to repeat."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(PERIOD_S):
            self.check(time.monotonic())

    def check(self, now_s: float) -> None:
        """Disconnect those of which too much waits."""
        with self._lock:
            self._unchecked = 0
            settled, self._settled = self._settled, set()
            for descriptor, backlog in self._backlogs.items():
                info = tcp_info(descriptor)
                if info is not None and (why := self._excess(descriptor, backlog, info, now_s, descriptor in settled)):
                    _disconnect(descriptor, self._port, why)

    def _excess(self, descriptor: int, backlog: ConnectionBacklog, info: TcpInfo, now_s: float, settled: bool) -> str:
        unread = backlog.unread(info.received, now_s, settled=settled and self._most_unread > MOST_SUBSCRIBED_BYTES)
        if unread > self._most_unread or backlog.is_unfinished():
            return f"{unread >> 10} kB that it sent are unread or incomplete"
        unsent = backlog.unsent(info, self._published + self._replayed[descriptor])
        return f"{unsent >> 20} MB wait to be sent to it" if unsent > self._most_unsent else ""


def tcp_info(descriptor: int) -> TcpInfo | None:
    """Return the state of a TCP connection; None if it is none (any more), or the system does not tell."""
    if not _HAS_TCP_INFO:
        return None
    try:
        with _borrowed(descriptor) as connection:
            info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO_BYTES)
    except OSError:
        return None
    if len(info) < _NOT_SENT_AT + 4:
        return None
    (unacked,), (not_sent,) = struct.unpack_from("=I", info, _UNACKED_AT), struct.unpack_from("=I", info, _NOT_SENT_AT)
    acked, received = struct.unpack_from("=QQ", info, _COUNTS_AT)
    return TcpInfo(acked, received, not unacked and not not_sent)


def _disconnect(descriptor: int, port: int, why: str) -> None:
    """End a connection to `port` as if the peer had hung up; what is on its way is dropped."""
    with contextlib.suppress(OSError), _borrowed(descriptor) as connection:
        if connection.getsockname()[1] == port:  # else the number was given to another connection since
            _log.warning("disconnected the client %s: %s", connection.getpeername(), why)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            connection.shutdown(socket.SHUT_RDWR)


@contextlib.contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """The library's connection, which stays open. Raises OSError if there is none."""
    connection = socket.socket(fileno=descriptor)
    try:
        yield connection
    finally:
        connection.detach()
