"""The clock on the wall, against that of the run: somebody may set it, or the computer sleep."""

from __future__ import annotations

from collections.abc import Callable

from afspm.clock import ExperimentClock
from afspm.formatting import duration_text

PARTED_S = 5.0


class ClockCheck:
    """Says once that the two have parted; of a simulated time that passes faster nobody expects them to agree.

    Args:
        tell: called with what is to be said.
    """

    def __init__(self, clock: ExperimentClock, tell: Callable[[str], None]) -> None:
        self._clock = clock
        self._tell = tell
        self._is_told = clock.speed != 1.0

    def look(self) -> None:
        """Compare them now."""
        if self._is_told or abs(ahead_s := self._clock.wall_ahead_s()) < PARTED_S:
            return
        self._is_told = True
        way = "ahead of" if ahead_s > 0.0 else "behind"
        self._tell(
            f"the clock on the wall is {duration_text(abs(ahead_s))} {way} that of the run: it was set, or the "
            "computer slept; the run goes on by its own, in all that it records"
        )
