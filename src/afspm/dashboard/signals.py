"""What passes between the component's thread and the page's: wake-ups, and who is still looking."""

from __future__ import annotations

import asyncio
import contextlib
import threading


class Bell:
    """Wakes tasks of the page's loop from any thread. However often it rings, each is woken once."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._event = asyncio.Event()
        self._is_ringing = False

    def attach(self) -> None:
        """Wake tasks of the running loop from now on."""
        self._loop = asyncio.get_running_loop()

    def ring(self) -> None:
        """Wake all tasks that wait. From any thread; never waits."""
        if self._loop is None or self._is_ringing:
            return
        self._is_ringing = True
        with contextlib.suppress(RuntimeError):  # the loop has just been closed
            self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        self._is_ringing = False
        self._event.set()
        self._event = asyncio.Event()

    async def wait(self, timeout_s: float) -> None:
        """Wait until it rings, or the time is up."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._event.wait(), timeout_s)


class Audience:
    """The pages that are open, so that all hear of the end before the server goes. From any thread."""

    def __init__(self) -> None:
        self._pages: set[int] = set()
        self._changed = threading.Condition()

    def join(self, page: object) -> None:
        """Add a page that was opened."""
        with self._changed:
            self._pages.add(id(page))

    def leave(self, page: object) -> None:
        """Remove a page that was closed, or has been told of the end."""
        with self._changed:
            self._pages.discard(id(page))
            self._changed.notify_all()

    def wait_told(self, within_s: float) -> bool:
        """Wait until no page is left that has not been told; return False when the time is up."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._pages, within_s)
