"""`LongCall`: a command that runs until the instrument is done, on a separate connection."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Protocol

from afspm.basics.errors import AfspmError, Refused

ANSWERS_S: Final = 0.5
"""Real time within which a controller reports that it refuses a command; one that runs longer is a long command."""


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

    def require_accepted(self, failure: type[AfspmError], program: str, code: int) -> None:
        """Refuse the command if the controller has reported an error of the type `failure` already.

        Args:
            program: the controller, in words.

        Raises:
            Refused: with `code`. ControllerLost.
        """
        try:
            self.running()
        except BaseException as error:  # Ctrl-C, too: nothing else closes this connection
            self.close()
            if isinstance(error, failure):
                raise Refused(code, f"{program} refused the {self.what}: {error}") from error
            raise

    def close(self) -> None:
        """Stop waiting for the reply."""
        self._link.close()
