"""A log that writes a few warnings and counts the rest, so that a flood does not fill the log."""

from __future__ import annotations

import logging

from afspm.basics.clock import Clock

_BURST = 5  # warnings in one period
_PERIOD_S = 10.0  # real time


class RateLimitedLog:
    """A log of at most five warnings in ten seconds; the next period begins with the number of dropped warnings."""

    def __init__(self, log: logging.Logger, clock: Clock) -> None:
        self._log = log
        self._clock = clock
        self._since_s = clock.monotonic_s()
        self._passed = 0
        self._dropped = 0

    def warning(self, text: str) -> None:
        """Log `text`, or only count it after too many warnings."""
        now_s = self._clock.monotonic_s()
        if now_s - self._since_s > _PERIOD_S:
            if self._dropped:
                self._log.warning("dropped %d more warnings of this kind", self._dropped)
            self._since_s, self._passed, self._dropped = now_s, 0, 0
        if self._passed < _BURST:
            self._passed += 1
            self._log.warning("%s", text)
        else:
            self._dropped += 1
