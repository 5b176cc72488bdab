"""`LongCall`: a command that runs until the instrument is done, on a separate connection."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final, Protocol

from afspm.basics.errors import AfspmError, Refused
from afspm.translator.driver_base import ControllerSilent

ANSWERS_S: Final = 0.5
"""Real time within which a controller reports that it refuses a command; one that runs longer is a long command."""
SHOWS_S: Final = 10.0
"""Longest real time in which a controller shows nothing of a command that it has not answered either."""


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
        is_seen: returns whether the controller shows the command running; without it, `link` has answered a question.

    Attributes:
        value: the content of the reply, after its arrival.
    """

    def __init__(
        self,
        what: str,
        link: LongLink,
        is_unfinished: Callable[[Any], bool] = lambda value: False,
        is_seen: Callable[[], bool] = lambda: True,
    ) -> None:
        self.what = what
        self.value: Any = None
        self._link, self._is_unfinished, self._is_seen = link, is_unfinished, is_seen
        self._unseen_s: float | None = None
        self._came = False

    def running(self) -> bool:
        """Return whether the command is still running.

        Raises:
            the controller's error, or ControllerLost; ControllerSilent: it shows nothing of the command for `SHOWS_S`.
        """
        if not self._came:
            self._came, self.value = self._link.reply(self.what)
        if not self._came:
            self._require_seen()
        return not self._came or self._is_unfinished(self.value)

    def _require_seen(self) -> None:
        # a controller that takes a command and loses it would be waited for without an end
        now_s = time.monotonic()
        if self._is_seen():
            self._unseen_s = None
        elif self._unseen_s is None:  # the time counts from a look, since this process may have been busy before it
            self._unseen_s = now_s
        elif now_s - self._unseen_s >= SHOWS_S:
            problem = f"the {self.what} has no answer, and has not run for {SHOWS_S:g} s: it never began, or is over"
            raise ControllerSilent(problem, hint="look at the controller's screen, and at the tip")

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
