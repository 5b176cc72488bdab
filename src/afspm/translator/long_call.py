"""`LongCall`: a command that runs until the instrument is done, on a connection of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol


class LongLink(Protocol):
    """A connection on which a command was begun."""

    def reply(self, what: str) -> tuple[bool, Any]:
        """Return whether the reply has come, and what is in it. Raises the controller's error, or ControllerLost."""

    def close(self) -> None:
        """Let go of it."""


class LongCall:
    """A command that was begun.

    Args:
        what: it does.
        is_unfinished: tells from what is in the reply whether the instrument goes on all the same.

    Attributes:
        value: what is in the reply, once it has come.
    """

    def __init__(self, what: str, link: LongLink, is_unfinished: Callable[[Any], bool] = lambda value: False) -> None:
        self.what = what
        self.value: Any = None
        self._link, self._is_unfinished = link, is_unfinished
        self._came = False

    def running(self) -> bool:
        """Return whether it goes on. Raises the controller's error: it failed. ControllerLost."""
        if not self._came:
            self._came, self.value = self._link.reply(self.what)
        return not self._came or self._is_unfinished(self.value)

    def close(self) -> None:
        """Wait for it no longer."""
        self._link.close()
