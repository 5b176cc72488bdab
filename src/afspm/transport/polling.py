"""Waiting for sockets and for other threads at once."""

from __future__ import annotations

import contextlib
import math
import socket
from collections import deque
from typing import Any, Generic, TypeVar

import zmq

S = TypeVar("S")
T = TypeVar("T")
_LONGEST_MS = 2**31 - 1  # 24 days


def milliseconds(timeout_s: float | None) -> int | None:
    """Return a timeout in ms, rounded up to avoid waking before a deadline; None for no limit."""
    return None if timeout_s is None else max(0, math.ceil(min(timeout_s * 1000.0, _LONGEST_MS)))


class WakeUp(Generic[T]):
    """A queue with a descriptor to poll: `post` from any thread, `take` in the polling thread.

    It uses a pair of sockets instead of a pipe: Windows can wait only on sockets.
    """

    def __init__(self) -> None:
        self._items: deque[T] = deque()
        self._reader, self._writer = socket.socketpair()
        self._reader.settimeout(0)
        self._writer.settimeout(0)

    def fileno(self) -> int:
        """Return the descriptor that is readable after `post`."""
        return self._reader.fileno()

    def writer_fileno(self) -> int:
        """Return the descriptor for `signal.set_wakeup_fd`."""
        return self._writer.fileno()

    def post(self, item: T | None = None) -> None:
        """Wake the poller up, with or without an item."""
        if item is not None:
            self._items.append(item)
        # a full socket wakes the poller anyway; a closed socket has no poller any more
        with contextlib.suppress(BlockingIOError, OSError):
            self._writer.send(b"\0")

    def take(self) -> list[T]:
        """Return the items posted since the last call, oldest first; items posted later wait for the next call."""
        with contextlib.suppress(BlockingIOError, OSError):
            while len(self._reader.recv(4096)) == 4096:
                pass
        return [self._items.popleft() for _ in range(len(self._items))]

    def close(self) -> None:
        self._reader.close()
        self._writer.close()


class Poller(Generic[S]):
    """A wait for readable sockets, which another thread can end through a `WakeUp`."""

    def __init__(self, wake_up: WakeUp[Any]) -> None:
        self._poller = zmq.Poller()
        self._poller.register(wake_up.fileno(), zmq.POLLIN)
        self._sources: dict[object, S] = {}

    def register(self, socket: zmq.Socket[bytes], source: S) -> None:
        """Add `socket`; `wait` returns `source` for it."""
        self._poller.register(socket, zmq.POLLIN)
        self._sources[socket] = source

    def pause(self, socket: zmq.Socket[bytes]) -> None:
        """Ignore `socket` until it is registered again."""
        self._poller.unregister(socket)

    def forget(self, socket: zmq.Socket[bytes]) -> None:
        """Remove `socket` before it is closed."""
        self._poller.unregister(socket)
        del self._sources[socket]

    def wait(self, timeout_ms: int | None) -> tuple[list[S], bool]:
        """Return the sources of readable sockets, and whether `WakeUp.post` was called."""
        ready = [which for which, _ in self._poller.poll(timeout_ms)]
        sources = [self._sources[which] for which in ready if which in self._sources]
        return sources, len(sources) < len(ready)
