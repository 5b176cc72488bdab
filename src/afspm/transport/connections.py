"""The peers of a process's bound sockets, and how many bytes each may leave unfinished, unread or untaken.

libzmq bounds queues in messages, not in bytes, and not at all while a message has more parts to come. TCP knows what it
has received from a peer and what the peer has acknowledged (`TCP_INFO`); the difference to what was taken, or sent, is
what waits. A peer for which too much waits is disconnected, as if it had hung up. Only Linux tells: elsewhere, and for
addresses other than tcp://, the queues' lengths and `TCP_MAXRT` are the only bounds.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

MOST_UNREAD_BYTES = 8 << 20
"""Received from one peer, and not yet taken as whole messages."""
UNFINISHED_BYTES, UNFINISHED_S = 256 << 10, 5.0
"""As much may be received of a message that is not finished for longer than this."""
PERIOD_S = 0.2
_IDLE_BYTES_PER_S = 100.0
"""Heartbeats of ZMTP, which are no messages."""
_TELLS = sys.platform == "linux"
_INFO_BYTES = 160
_UNACKED, _COUNTS, _NOT_SENT = struct.Struct("=I"), struct.Struct("=QQ"), struct.Struct("=I")
_UNACKED_AT, _COUNTS_AT, _NOT_SENT_AT = 24, 120, 144  # in Linux's `struct tcp_info`
_AT_ONCE = struct.pack("ii", 1, 0)
_log = logging.getLogger("afspm.transport")


class TcpInfo(NamedTuple):
    """The state of a TCP connection.

    Attributes:
        acked: bytes that the peer has acknowledged.
        received: bytes that came from it.
        all_sent: nothing waits in the system to be sent or acknowledged.
    """

    acked: int
    received: int
    all_sent: bool


class Unread:
    """The bytes of one peer of a bound socket: `base` of them are accounted for."""

    __slots__ = ("base", "began_s", "since_s")

    def __init__(self, now_s: float) -> None:
        self.base = 0.0
        self.since_s = self.began_s = now_s

    def is_too_much(self, received: int, now_s: float, *, settled: bool) -> bool:
        """True if more waits than may. `settled`: since the last call nothing was left to receive, after a message of
        this peer."""
        self.base = min(float(received), self.base + _IDLE_BYTES_PER_S * (now_s - self.since_s))
        self.since_s = now_s
        if settled:
            self.base = float(received)
        waiting = received - self.base
        if waiting < UNFINISHED_BYTES:
            self.began_s = now_s
        return waiting > MOST_UNREAD_BYTES or now_s - self.began_s > UNFINISHED_S


class Connections:
    """Watches over the peers of the sockets that a process has bound, in a thread, since the process may be busy."""

    def __init__(self) -> None:
        self._bound: frozenset[int] = frozenset()
        self._peers: dict[tuple[int, str], Unread | None] = {}  # None: not of a bound socket
        self._settled: set[int] = set()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def guard(self, address: str) -> None:
        """Watch over those who connect to a bound address."""
        scheme, _, rest = address.partition("://")
        if scheme != "tcp" or not _TELLS:
            return
        self._bound |= {int(rest.rpartition(":")[2])}
        self._peers = {}
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="connections", daemon=True)
            self._thread.start()

    def settled(self, descriptors: Iterable[int]) -> None:
        """Nothing is left to receive, after messages by these connections."""
        self._settled.update(descriptors)

    def close(self) -> None:
        """Safe to repeat."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(PERIOD_S):
            self.check(time.monotonic())

    def check(self, now_s: float) -> None:
        """Disconnect those of which too much waits."""
        settled, self._settled = self._settled, set()
        former, self._peers = self._peers, {}
        for key in _sockets():
            descriptor, name = key
            if key not in former:
                former[key] = Unread(now_s) if self._is_ours(descriptor) else None
            peer = self._peers[key] = former[key]
            info = tcp_info(descriptor) if peer is not None else None
            if peer and info and peer.is_too_much(info.received, now_s, settled=descriptor in settled):
                _log.warning("disconnected %s: too much of what it sends is unfinished or unread", _peer(descriptor))
                disconnect(descriptor, name)

    def _is_ours(self, descriptor: int) -> bool:
        """True if this is the connection of somebody to an address that is guarded."""
        with contextlib.suppress(OSError), _borrowed(descriptor) as connection:
            tcp = connection.family in (socket.AF_INET, socket.AF_INET6) and connection.type == socket.SOCK_STREAM
            return tcp and connection.getsockname()[1] in self._bound and connection.getpeername() is not None
        return False


def name_of(descriptor: int) -> str:
    """The system's name of the connection that has this descriptor, which no other ever has; "": there is none."""
    with contextlib.suppress(OSError):
        return os.readlink(f"/proc/self/fd/{descriptor}")  # noqa: PTH115 (a Path costs more than the call)
    return ""


def tcp_info(descriptor: int) -> TcpInfo | None:
    """None: it is no connection of TCP (any more), or the system does not tell."""
    if not _TELLS:
        return None
    try:
        with _borrowed(descriptor) as connection:
            told = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _INFO_BYTES)
    except OSError:
        return None
    if len(told) < _NOT_SENT_AT + _NOT_SENT.size:
        return None
    acked, received = _COUNTS.unpack_from(told, _COUNTS_AT)
    (unacked,), (not_sent,) = _UNACKED.unpack_from(told, _UNACKED_AT), _NOT_SENT.unpack_from(told, _NOT_SENT_AT)
    return TcpInfo(acked, received, all_sent=not unacked and not not_sent)


def disconnect(descriptor: int, name: str) -> None:
    """End a connection as if the peer had hung up, if it is still the one of that name."""
    with contextlib.suppress(OSError), _borrowed(descriptor) as connection:
        if name and name_of(descriptor) == name:  # else the descriptor was given to somebody else since
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _AT_ONCE)  # what is on its way is dropped
            connection.shutdown(socket.SHUT_RDWR)


def _sockets() -> Iterator[tuple[int, str]]:
    """Descriptor and name of every open socket of this process."""
    with contextlib.suppress(OSError):
        for entry in os.listdir("/proc/self/fd"):  # noqa: PTH208
            name = name_of(int(entry))
            if name.startswith("socket:"):
                yield int(entry), name


@contextlib.contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """The library's connection, which stays open after. Raises OSError if there is none."""
    connection = socket.socket(fileno=descriptor)
    try:
        yield connection
    finally:
        connection.detach()


def _peer(descriptor: int) -> str:
    with contextlib.suppress(OSError), _borrowed(descriptor) as connection:
        return str(connection.getpeername())
    return "a peer"
