"""Wakes who waits in the page's thread, when something has changed in the component's."""

from __future__ import annotations

import asyncio
import contextlib


class Bell:
    """For any number that wait. However often it rings, each is woken once."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._event = asyncio.Event()
        self._is_ringing = False

    def hang_up(self) -> None:
        """Called in the loop whose tasks wait, before anybody does."""
        self._loop = asyncio.get_running_loop()

    def ring(self) -> None:
        """Something has changed. From any thread; never waits."""
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
        """Until it rings, or the time is up."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._event.wait(), timeout_s)
