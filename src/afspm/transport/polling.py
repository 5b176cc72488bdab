"""Waits for several sockets at once."""

from __future__ import annotations

import math
import select
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import zmq

from afspm.transport.frames import readable
from afspm.transport.wakeup import WakeUp

if TYPE_CHECKING:
    Socket = zmq.Socket[bytes]

S = TypeVar("S")


def milliseconds(timeout_s: float | None) -> int | None:
    """Rounded up: whoever is woken up before a deadline would only come back."""
    return None if timeout_s is None else max(0, math.ceil(timeout_s * 1000.0))


class Sender(Protocol):
    """Sets `sent` whenever it has sent something."""

    sent: bool


class Poller(Generic[S]):
    """Waits until one of its sockets can be received from, or it is woken up; names them by `source`.

    A socket of ZeroMQ has a descriptor that tells of news, but only once: news may also be taken notice of while
    sending or receiving. Whoever asks each socket again before waiting may wait on the descriptors, which takes a
    tenth of the time of zmq_poll. Only those need to be asked that were touched since: read from after the last wait,
    or sent on.
    """

    def __init__(self, wake_up: WakeUp[Any]) -> None:
        self._wake_up = wake_up.fileno()
        self._sources: dict[int, tuple[Socket, S]] = {}
        self._senders: list[tuple[Sender, tuple[Socket, S]]] = []
        self._touched: list[tuple[Socket, S]] = []
        self._poll = select.poll()
        self._poll.register(self._wake_up, select.POLLIN)

    def register(self, socket: Socket, source: S, sender: Sender | None = None) -> None:
        """Wait for `socket` too. `sender`: who also sends on it."""
        descriptor = int(socket.getsockopt(zmq.FD))
        self._sources[descriptor] = (socket, source)
        self._poll.register(descriptor, select.POLLIN)
        self._touched.append((socket, source))
        if sender is not None:
            self._senders.append((sender, (socket, source)))

    def wait(self, timeout_ms: int | None) -> tuple[list[S], bool]:
        """The sources of the sockets that can be received from, and whether we were woken up."""
        touched = self._touched
        for sender, entry in self._senders:
            if sender.sent:
                sender.sent = False
                if entry not in touched:
                    touched.append(entry)
        self._touched = found = [entry for entry in touched if readable(entry[0])]
        woken = False
        for descriptor, _ in self._poll.poll(0 if found else timeout_ms):
            known = self._sources.get(descriptor)
            if known is None:
                woken = True
            elif known not in found and readable(known[0]):
                found.append(known)
        return [source for _, source in found], woken


class PortablePoller(Generic[S]):
    """The same where the system can't wait on many descriptors (Windows)."""

    def __init__(self, wake_up: WakeUp[Any]) -> None:
        self._sources: dict[object, S] = {}
        self._poller = zmq.Poller()
        self._poller.register(wake_up.fileno(), zmq.POLLIN)

    def register(self, socket: Socket, source: S, sender: Sender | None = None) -> None:
        self._sources[socket] = source
        self._poller.register(socket, zmq.POLLIN)

    def wait(self, timeout_ms: int | None) -> tuple[list[S], bool]:
        ready = [which for which, _ in self._poller.poll(timeout_ms)]
        sources = [self._sources[which] for which in ready if which in self._sources]
        return sources, len(sources) < len(ready)


def poller(wake_up: WakeUp[Any]) -> Poller[Any] | PortablePoller[Any]:
    """The best one of this system."""
    return Poller(wake_up) if hasattr(select, "poll") else PortablePoller(wake_up)
