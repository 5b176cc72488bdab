"""Waits for several sockets at once."""

from __future__ import annotations

import math
import select
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import zmq
from zmq.backend import zmq_poll

from afspm.transport.frames import readable
from afspm.transport.wakeup import WakeUp

if TYPE_CHECKING:
    Socket = zmq.Socket[bytes]

S = TypeVar("S")

_LONGEST_MS = 2**31 - 1  # 24 days


def milliseconds(timeout_s: float | None) -> int | None:
    """Rounded up: whoever is woken up before a deadline would only come back. At most what a poller can wait for."""
    return None if timeout_s is None else max(0, math.ceil(min(timeout_s * 1000.0, _LONGEST_MS)))


class Touching(Protocol):
    """Owns a socket. `touched` is true if it has sent, or has not received all that there was, since it was last false:
    its socket may then have something to receive without telling so again."""

    touched: bool


class Poller(Generic[S]):
    """Waits until one of its sockets has news, or it is woken up; names them by `source`.

    A socket of ZeroMQ has a descriptor that tells of news, but only once: news may also be taken notice of while
    sending or receiving. Whoever asks the sockets that were touched again before waiting may wait on the descriptors,
    which takes a tenth of the time of zmq_poll.
    """

    def __init__(self, wake_up: WakeUp[Any]) -> None:
        self._by_descriptor: dict[int, S] = {}
        self._by_socket: dict[Any, S] = {}
        self._owners: list[tuple[Touching, tuple[Socket, int]]] = []
        self._found: list[S] = []
        self._poll, self._urgent = select.poll(), select.poll()
        for poll in (self._poll, self._urgent):
            poll.register(wake_up.fileno(), select.POLLIN)

    def register(self, socket: Socket, source: S, owner: Touching | None, *, urgent: bool = True) -> None:
        """Wait for `socket` too.

        Args:
            owner: None: nothing is sent by it, and everything received at once.
            urgent: whether its news end a `rest`.
        """
        descriptor = int(socket.getsockopt(zmq.FD))
        self._by_descriptor[descriptor] = source
        if owner is not None:
            self._by_socket[socket] = source
            self._owners.append((owner, (socket, int(zmq.POLLIN))))
        elif readable(socket):
            self._found.append(source)
        self._poll.register(descriptor, select.POLLIN)
        if urgent:
            self._urgent.register(descriptor, select.POLLIN)

    def rest(self, rest_ms: int) -> None:
        """Wait so long, or until something urgent comes; not at all if something is known to be there."""
        if not self._found and not any(owner.touched for owner, _ in self._owners):
            self._urgent.poll(rest_ms)

    def wait(self, timeout_ms: int | None) -> tuple[list[S], bool]:
        """The sources of the sockets that have news, mostly something to receive, and whether we were woken up."""
        found, self._found = self._found, []
        touched = []
        for owner, item in self._owners:
            if owner.touched:
                owner.touched = False
                touched.append(item)
        if touched:
            for socket, _ in zmq_poll(touched, 0):
                found.append(self._by_socket[socket])
        woken = False
        known = self._by_descriptor
        for descriptor, _ in self._poll.poll(0 if found else timeout_ms):
            if descriptor not in known:
                woken = True
            elif (source := known[descriptor]) not in found:
                found.append(source)
        return found, woken


class PortablePoller(Generic[S]):
    """The same where the system can't wait on many descriptors (Windows)."""

    def __init__(self, wake_up: WakeUp[Any]) -> None:
        self._sources: dict[object, S] = {}
        self._poller, self._urgent = zmq.Poller(), zmq.Poller()
        for one in (self._poller, self._urgent):
            one.register(wake_up.fileno(), zmq.POLLIN)

    def register(self, socket: Socket, source: S, owner: Touching | None, *, urgent: bool = True) -> None:
        self._sources[socket] = source
        for one in (self._poller, self._urgent) if urgent else (self._poller,):
            one.register(socket, zmq.POLLIN)

    def rest(self, rest_ms: int) -> None:
        self._urgent.poll(rest_ms)

    def wait(self, timeout_ms: int | None) -> tuple[list[S], bool]:
        ready = [which for which, _ in self._poller.poll(timeout_ms)]
        sources = [self._sources[which] for which in ready if which in self._sources]
        return sources, len(sources) < len(ready)


def poller(wake_up: WakeUp[Any]) -> Poller[Any] | PortablePoller[Any]:
    """The best one of this system."""
    return Poller(wake_up) if hasattr(select, "poll") else PortablePoller(wake_up)
