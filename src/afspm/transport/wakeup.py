"""How another thread ends the wait of a poller, and what it says."""

from __future__ import annotations

import contextlib
import socket
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class WakeUp(Generic[T]):
    """A queue with a descriptor to poll: `post` from any thread, `take` from the thread that polls.

    A pair of sockets and not a pipe, since Windows can only wait on sockets.
    """

    def __init__(self) -> None:
        self._items: deque[T] = deque()
        self._reader, self._writer = socket.socketpair()
        self._reader.settimeout(0)
        self._writer.settimeout(0)

    def fileno(self) -> int:
        """The descriptor that becomes readable when `post` was called."""
        return self._reader.fileno()

    def writer_fileno(self) -> int:
        """The descriptor that `signal.set_wakeup_fd` may write to."""
        return self._writer.fileno()

    def post(self, item: T | None = None) -> None:
        """Wake the poller up, with something to take or for nothing."""
        if item is not None:
            self._items.append(item)
        # full: it will wake up anyway; closed: nobody is left to wake up
        with contextlib.suppress(BlockingIOError, OSError):
            self._writer.send(b"\0")

    def take(self) -> list[T]:
        """What was posted since the last call, oldest first. What comes meanwhile waits for the next."""
        with contextlib.suppress(BlockingIOError, OSError):
            while len(self._reader.recv(4096)) == 4096:
                pass
        return [self._items.popleft() for _ in range(len(self._items))]

    def close(self) -> None:
        self._reader.close()
        self._writer.close()
