"""`ReadingCurve`: the values of one parameter of another instrument over a run, with a bounded number of points."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

MOST_POINTS = 4000


@dataclass(slots=True)
class ReadingCurve:
    """Values over time; NaN where the value was unknown.

    Attributes:
        step_ns: a point nearer to the last one replaces it; it grows with the length of the run.
    """

    unit: str = ""
    times_ns: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    step_ns: int = 0

    def add(self, time_ns: int, value: float) -> None:
        """Add a value; of a long run every second point is kept, again and again, and each gap."""
        is_near = len(self.times_ns) > 1 and time_ns - self.times_ns[-2] < self.step_ns
        if is_near and (value != value) == (self.values[-1] != self.values[-1]):
            self.times_ns[-1], self.values[-1] = time_ns, value
            return
        self.times_ns.append(time_ns)
        self.values.append(value)
        if len(self.times_ns) > MOST_POINTS:
            kept = [k for k in range(len(self.values)) if k % 2 == 0 or self._begins_or_ends_gap(k)]
            self.times_ns = [self.times_ns[k] for k in kept]
            self.values = [self.values[k] for k in kept]
            self.step_ns = 2 * max(self.step_ns, (self.times_ns[-1] - self.times_ns[0]) // MOST_POINTS)

    def _begins_or_ends_gap(self, k: int) -> bool:
        # a gap whose only point is dropped would be drawn as a line through it
        return k > 0 and math.isnan(self.values[k]) != math.isnan(self.values[k - 1])
