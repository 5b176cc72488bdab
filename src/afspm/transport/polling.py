"""Waits for sockets and for other threads at once."""

from __future__ import annotations

import math
from typing import Any, Generic, TypeVar

import zmq

from afspm.transport.wakeup import WakeUp

S = TypeVar("S")
_LONGEST_MS = 2**31 - 1  # 24 days


def milliseconds(timeout_s: float | None) -> int | None:
    """Round a timeout up, so that a wait does not end just before a deadline; None waits for ever."""
    return None if timeout_s is None else max(0, math.ceil(min(timeout_s * 1000.0, _LONGEST_MS)))


class Poller(Generic[S]):
    """Waits until one of its sockets can be read, or another thread wakes it up."""

    def __init__(self, wake_up: WakeUp[Any]) -> None:
        self._poller = zmq.Poller()
        self._poller.register(wake_up.fileno(), zmq.POLLIN)
        self._sources: dict[Any, S] = {}

    def register(self, socket: zmq.Socket[bytes], source: S) -> None:
        """Wait for `socket` too; `wait` names it by `source`."""
        self._poller.register(socket, zmq.POLLIN)
        self._sources[socket] = source

    def pause(self, socket: zmq.Socket[bytes]) -> None:
        """Leave `socket` alone until it is registered again."""
        self._poller.unregister(socket)

    def wait(self, timeout_ms: int | None) -> tuple[list[S], bool]:
        """Return the sources of the sockets that can be read, and whether we were woken up."""
        ready = [which for which, _ in self._poller.poll(timeout_ms)]
        sources = [self._sources[which] for which in ready if which in self._sources]
        return sources, len(sources) < len(ready)
