"""Log lines about what others do wrong, few enough to be read."""

from __future__ import annotations

import logging

from afspm.clock import Clock

_BURST = 5
_PERIOD_S = 10.0


class Complaints:
    """Lets a handful of lines through every ten seconds and counts the others: a flood must not fill the log."""

    def __init__(self, log: logging.Logger, clock: Clock) -> None:
        self._log = log
        self._clock = clock
        self._since_s = clock.monotonic_s()
        self._told = 0
        self._untold = 0

    def say(self, text: str) -> None:
        """Log `text` as a warning, or count it as one of many."""
        now_s = self._clock.monotonic_s()
        if now_s - self._since_s > _PERIOD_S:
            if self._untold:
                self._log.warning("… and %d more malformed messages were dropped", self._untold)
            self._since_s, self._told, self._untold = now_s, 0, 0
        if self._told < _BURST:
            self._told += 1
            self._log.warning("%s", text)
        else:
            self._untold += 1
