"""Simulated time: an ordered queue of events and a clock."""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Callable

from afspm.basics.clock import NeverLate

START_S = 1_750_000_000.0
"""Experiment time at the beginning."""

_START_NS = int(START_S) * 10**9
_STUCK = 10_000


class GoesInCircles(Exception):
    """The error for events that repeat while time stands still."""


class Timer:
    """A future event, which can be cancelled."""

    __slots__ = ("args", "cancelled", "do")

    def __init__(self, do: Callable[..., None], args: tuple[object, ...]) -> None:
        self.do = do
        self.args = args
        self.cancelled = False

    def cancel(self) -> None:
        self.cancelled = True


class SimulatedTime(NeverLate):
    """A queue of future events in the order of their times, which is a `Clock` as well.

    Args:
        seed: seed of all random choices.
        speed: experiment seconds per real (simulated) second.
    """

    def __init__(self, seed: int, speed: float = 1.0) -> None:
        self.random = random.Random(seed)
        self.speed = speed
        self.happened = 0
        self._time_s = 0.0
        self._order = 0
        self._moving = 0
        self._until_s = -math.inf
        self._coming: list[tuple[float, int, Timer]] = []

    # --- the clock ---

    def monotonic_s(self) -> float:
        return self._time_s

    def now_ns(self) -> int:
        return self.at_ns(self._time_s)

    def at_ns(self, time_s: float) -> int:
        """Return the experiment time in ns at a moment of real (simulated) time."""
        return _START_NS + round(time_s * self.speed * 1e9)

    def now_s(self) -> float:
        return START_S + self._time_s * self.speed

    def real_s(self, experiment_s: float) -> float:
        return experiment_s / self.speed

    # --- what happens ---

    def after(self, delay_s: float, do: Callable[..., None], *args: object) -> Timer:
        """Call `do(*args)` after `delay_s` real seconds; calls at the same time run in the order of registration."""
        return self.at(self._time_s + delay_s if delay_s > 0.0 else self._time_s, do, args)

    def at(self, time_s: float, do: Callable[..., None], args: tuple[object, ...]) -> Timer:
        """Call `do(*args)` at a time that has not passed."""
        timer = Timer(do, args)
        self._order = order = self._order + 1
        heapq.heappush(self._coming, (time_s, order, timer))
        return timer

    def step(self) -> bool:
        """Run the next event; return False if there is none.

        Raises:
            GoesInCircles: thousands of events have passed at the same time.
        """
        while self._coming:
            time_s, _, timer = heapq.heappop(self._coming)
            if timer.cancelled:
                continue
            self._moving = 0 if time_s > self._time_s else self._moving + 1
            if self._moving > _STUCK:
                raise GoesInCircles(f"time stands still at {time_s} s: a waiting process goes round in circles")
            self._time_s = time_s
            self.happened += 1
            timer.do(*timer.args)
            return True
        return False

    def run_until(self, time_s: float) -> None:
        """Run all events up to `time_s`, and advance to this time."""
        self._until_s = time_s
        try:
            while (next_s := self._next_s()) is not None and next_s <= time_s:
                self.step()
        finally:
            self._until_s = -math.inf
        self._time_s = max(self._time_s, time_s)

    def advance(self, delay_s: float) -> bool:
        """Advance by `delay_s` without an event, if no event comes until then and `run_until` goes that far.

        Returns:
            whether time has advanced: then a call planned by `after` would come now, before any other.
        """
        time_s = self._time_s + delay_s
        next_s = self._next_s()
        if not self._time_s < time_s <= self._until_s or (next_s is not None and next_s <= time_s):
            return False
        self._time_s, self._moving = time_s, 0
        return True

    def _next_s(self) -> float | None:
        while self._coming and self._coming[0][2].cancelled:
            heapq.heappop(self._coming)
        return self._coming[0][0] if self._coming else None

    def chance(self, probability: float) -> bool:
        return self.random.random() < probability
