"""What other threads and signals tell the supervisor, in one queue that its poller can wait on."""

from __future__ import annotations

import contextlib
import socket
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Inbox(Generic[T]):
    """A queue with a file descriptor: `put` from any thread or signal handler, `take_all` from the owner.

    A pair of sockets and not a pipe, since Windows can only wait on sockets.
    """

    def __init__(self) -> None:
        self._items: deque[T] = deque()
        self._reader, self._writer = socket.socketpair()
        self._reader.settimeout(0)
        self._writer.settimeout(0)

    def fileno(self) -> int:
        """The descriptor that becomes readable when there is something to take."""
        return self._reader.fileno()

    def wakeup_fd(self) -> int:
        """The descriptor that `signal.set_wakeup_fd` may write to."""
        return self._writer.fileno()

    def put(self, item: T) -> None:
        """Append `item` and wake the owner. Never blocks."""
        self._items.append(item)
        # full: the owner will wake anyway; closed: there is no owner any more
        with contextlib.suppress(BlockingIOError, OSError):
            self._writer.send(b"\0")

    def take_all(self) -> list[T]:
        """Everything put so far, oldest first."""
        with contextlib.suppress(BlockingIOError, OSError):
            while len(self._reader.recv(4096)) == 4096:
                pass
        items = []
        while self._items:
            items.append(self._items.popleft())
        return items

    def close(self) -> None:
        """Give the descriptors back."""
        self._reader.close()
        self._writer.close()
