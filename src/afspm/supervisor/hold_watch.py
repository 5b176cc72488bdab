"""Watch on the processes for which simulated time waits: a dead or hanging process must not slow the run for ever."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import psutil

from afspm.basics.clock import NS_PER_S, ExperimentClock
from afspm.basics.formatting import counted, duration_text
from afspm.basics.shared_time import LONGEST_HOLD_S, SharedTime, TimeHold


@dataclass(frozen=True)
class Drop:
    """A hold to be dropped, its process `is_dead` or not."""

    hold: TimeHold
    is_dead: bool


def drops(shared: SharedTime, real_ns: int, is_alive: Callable[[int], bool]) -> Iterator[Drop]:
    """Yield the holds that must not slow time any more: of dead processes, and beyond `LONGEST_HOLD_S`."""
    for hold in shared.holds:
        is_dead = not is_alive(hold.pid)
        if is_dead or (hold.until_ns and hold.until_ns <= real_ns):
            yield Drop(hold, is_dead)


class HoldWatch:
    """A watch that drops holds, and logs and counts the waits that were given up.

    Args:
        log: writes a line with a level.
        names: returns the names of the run's processes by their process ids.
        every_s: real time from one look to the next.
        long_s: real time after which a wait is logged. On a quiet computer a wait takes a second.

    Attributes:
        given_up: number of waits for a living process that were given up, or for which there was no room.
    """

    def __init__(
        self,
        clock: ExperimentClock,
        log: Callable[[int, str], None],
        names: Callable[[], dict[int, str]],
        *,
        every_s: float = 1.0,
        long_s: float = 60.0,
    ) -> None:
        self._every_s, self._long_s = every_s, long_s
        self._clock, self._log, self._names = clock, log, names
        self._next_s = -math.inf
        self._logged: set[tuple[int, int]] = set()
        self._refused = 0
        self.given_up = 0

    def look(self) -> None:
        """Look at the holds, at most every `every_s`. Never waits for another process."""
        now_s = self._clock.monotonic_s()
        if now_s < self._next_s or (shared := self._clock.holds()) is None:
            return
        self._next_s = now_s + self._every_s
        real_ns = int(now_s * NS_PER_S)
        for drop in drops(shared, real_ns, psutil.pid_exists):
            if self._clock.drop(drop.hold):
                self._on_dropped(drop, real_ns)
        self._log_long_waits(shared, real_ns)
        if shared.refused > self._refused:
            count = shared.refused - self._refused
            self._log(
                logging.WARNING, f"simulated time did not wait {counted(count, 'time')}: too many processes are behind"
            )
            self.given_up += count
        self._refused = shared.refused

    def _on_dropped(self, drop: Drop, real_ns: int) -> None:
        name, waited_s = self._name(drop.hold), drop.hold.waited_s(real_ns)
        if not drop.is_dead:
            self.given_up += 1
            self._log(
                logging.WARNING,
                f"simulated time has waited {duration_text(LONGEST_HOLD_S)} for {name}, and goes on without it: "
                "scans may be late or missed. Does the process hang? Otherwise lower the speed in [clock]",
            )
        elif waited_s >= 1.0:
            self._log(logging.INFO, f"{name} has ended: simulated time, which waited for it, goes on")

    def _log_long_waits(self, shared: SharedTime, real_ns: int) -> None:
        long = {
            (one.begun_ns, one.pid): one
            for one in shared.holds
            if one.until_ns > real_ns and one.waited_s(real_ns) >= self._long_s
        }
        for key in long.keys() - self._logged:
            waited = duration_text(long[key].waited_s(real_ns))
            self._log(logging.INFO, f"simulated time has waited {waited} for {self._name(long[key])}")
        self._logged = set(long)

    def _name(self, hold: TimeHold) -> str:
        return self._names().get(hold.pid, f"process {hold.pid}")
