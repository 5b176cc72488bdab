"""`LongCall`: a command that runs until the instrument is done, on a separate connection."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol


class LongLink(Protocol):
    """A connection on which a command is running."""

    def reply(self, what: str) -> tuple[bool, Any]:
        """Return whether the reply has arrived, and its content.

        Raises:
            the controller's error, or ControllerLost.
        """

    def close(self) -> None:
        """Close the connection."""


class LongCall:
    """A running command.

    Args:
        what: the command, in words.
        is_unfinished: decides from the content of the reply whether the instrument still runs.

    Attributes:
        value: the content of the reply, after its arrival.
    """

    def __init__(self, what: str, link: LongLink, is_unfinished: Callable[[Any], bool] = lambda value: False) -> None:
        self.what = what
        self.value: Any = None
        self._link, self._is_unfinished = link, is_unfinished
        self._came = False

    def running(self) -> bool:
        """Return whether the command is still running.

        Raises:
            the controller's error, or ControllerLost.
        """
        if not self._came:
            self._came, self.value = self._link.reply(self.what)
        return not self._came or self._is_unfinished(self.value)

    def close(self) -> None:
        """Stop waiting for the reply."""
        self._link.close()
