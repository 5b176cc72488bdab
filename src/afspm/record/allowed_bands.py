"""The values that [conditions] allows, for drawings and tables; the scheduler enforces the conditions itself."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from afspm.basics.errors import AfspmError
from afspm.basics.toml import parse_toml
from afspm.basics.units import si
from afspm.model.parameter_names import START_SCAN, START_SPEC
from afspm.record.drawing.timeline import DrawnBand, TimelineCurve
from afspm.record.run_json import EXPERIMENT_FILE


@dataclass(frozen=True)
class WrittenBand:
    """The bounds of one parameter in a condition, as the experiment file has them; None: no bound.

    Attributes:
        within: the largest distance from the target.
        actions: the actions that the condition guards.
    """

    condition: str
    low: str | float | None = None
    high: str | float | None = None
    within: str | float | None = None
    actions: tuple[str, ...] = (START_SCAN, START_SPEC)

    def contains(self, value: float | None, target: float | None, unit: str) -> bool:
        """Return whether a value is inside; an unknown value, or a missing target, is not.

        A bound that can't be converted to `unit` bounds nothing: the scheduler has refused each measurement then.
        """
        if value is None:
            return False
        low, high, within = (_number(bound, unit) for bound in (self.low, self.high, self.within))
        if (low is not None and value < low) or (high is not None and value > high):
            return False
        return within is None or (target is not None and abs(value - target) <= within)


AllowedBands = Mapping[str, tuple[WrittenBand, ...]]
"""The bands of each instrument parameter, by its name."""


def allowed_bands(folder: Path) -> AllowedBands:
    """Return the bands in the expanded experiment file of a run; empty without bands, or without a readable file."""
    try:
        document = parse_toml((folder / EXPERIMENT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    found: dict[str, tuple[WrittenBand, ...]] = {}
    conditions = document.get("conditions")
    for name, condition in conditions.items() if isinstance(conditions, dict) else ():
        actions = tuple(condition.get("while") or WrittenBand.actions) if isinstance(condition, dict) else ()
        for parameter, table in condition.items() if isinstance(condition, dict) else ():
            if isinstance(table, dict):
                band = WrittenBand(name, table.get("from"), table.get("to"), table.get("within"), actions)
                found[parameter] = (*found.get(parameter, ()), band)
    return found


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
    low, high = _number(band.low, unit), _number(band.high, unit)
    if (low is None and high is None) or (low, high).count(None) != (band.low, band.high).count(None):
        return None
    low, high = -math.inf if low is None else low, math.inf if high is None else high
    return DrawnBand(band.condition, low, high) if low < high else None


def _number(bound: str | float | None, unit: str) -> float | None:
    try:
        return None if bound is None else si(bound, unit)
    except AfspmError:
        return None
