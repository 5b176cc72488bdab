"""Values of other instruments over time, thinned, with the bands that [conditions] allows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.drawing.timeline import DrawnBand, TimelineCurve
from afspm.record import AllowedBands
from afspm.record.allowed_bands import WrittenBand, number_in

MOST_POINTS = 4000


@dataclass(slots=True)
class ReadingCurve:
    """Values over time; NaN where the value was unknown.

    Attributes:
        step_ns: the least time between two points; a nearer point replaces the last. The step grows with the run.
    """

    unit: str = ""
    times_ns: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    step_ns: int = 0

    def add(self, time_ns: int, value: float) -> None:
        """Add a value; thin a long curve to every second point, but keep its gaps."""
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


def instrument_curves(instruments: Mapping[str, ReadingCurve], bands: AllowedBands) -> list[TimelineCurve]:
    """Return a curve, with its allowed bands, for each parameter of other instruments."""
    curves = []
    for name, one in sorted(instruments.items()):
        converted = (_converted(band, one.unit) for band in bands.get(name, ()))
        shown = [band for band in converted if band is not None]
        curves.append(TimelineCurve(name, one.unit, one.times_ns, one.values, shown))
    return curves


def _converted(band: WrittenBand, unit: str) -> DrawnBand | None:
    # None: no band in this unit; a drawing without a band is better than none, and the scheduler refuses such a file
    low, high = number_in(band.low, unit), number_in(band.high, unit)
    if (low is None and high is None) or (low, high).count(None) != (band.low, band.high).count(None):
        return None
    low, high = -math.inf if low is None else low, math.inf if high is None else high
    return DrawnBand(band.condition, low, high) if low < high else None
