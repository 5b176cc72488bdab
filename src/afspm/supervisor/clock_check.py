"""Comparison of the clock on the wall with that of the run: a person may set it, or the computer sleep."""

from __future__ import annotations

from afspm.clock import ExperimentClock
from afspm.formatting import duration_text

TOLERANCE_S = 5.0


class ClockCheck:
    """Warns once if the two differ; simulated time that passes faster never agrees with the wall."""

    def __init__(self, clock: ExperimentClock) -> None:
        self._clock = clock
        self._is_done = clock.speed != 1.0

    def warning(self) -> str:
        """Compare them now; returns what to warn of, mostly nothing."""
        if self._is_done or abs(ahead_s := self._clock.wall_ahead_s()) < TOLERANCE_S:
            return ""
        self._is_done = True
        way = "ahead of" if ahead_s > 0.0 else "behind"
        return (
            f"the computer's clock is {duration_text(abs(ahead_s))} {way} that of the run: it was set, or the "
            "computer slept; the record keeps the run's own time"
        )
