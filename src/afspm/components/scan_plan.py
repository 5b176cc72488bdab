"""Plans of scans and the times when they are due, as plain values that need no microscope."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from afspm.basics.errors import InvalidValue
from afspm.basics.formatting import lengths_text
from afspm.model import Region

XY = tuple[float, float]


@dataclass(frozen=True)
class PlanStep:
    """One measurement of a plan.

    Attributes:
        index: its place in the plan, from 0.
        key: names it within its plan, the same in every life of the component: whatever has been asked for under a
            key is not measured again.
        region: where to scan.
        shape: pixels as (rows, columns); None leaves what is set.
        starts_round: whether it waits for the plan's period; the steps that follow in the round do not.
    """

    index: int
    key: str
    region: Region
    shape: tuple[int, int] | None
    starts_round: bool


@dataclass(frozen=True)
class ScanPlan:
    """Regions that are scanned one after the other, in one round or many.

    Attributes:
        regions: those of one round.
        shape: pixels as (rows, columns); None leaves what is set.
        rounds: how often they are gone through; None: without end.
    """

    regions: tuple[Region, ...]
    shape: tuple[int, int] | None = None
    rounds: int | None = 1

    def __post_init__(self) -> None:
        if not self.regions:
            raise InvalidValue("a plan needs a region at least")
        if self.rounds is not None and self.rounds < 1:
            raise InvalidValue(f"a plan is gone through once at least, not {self.rounds} times")

    @property
    def total(self) -> int | None:
        """The number of scans; None: without end."""
        return None if self.rounds is None else self.rounds * len(self.regions)

    def step(self, index: int) -> PlanStep:
        turn, place = divmod(index, len(self.regions))
        key = f"scan-{turn}" if len(self.regions) == 1 else f"scan-{turn}-{place}"
        return PlanStep(index, key, self.regions[place], self.shape, starts_round=place == 0)

    def steps(self, start: int = 0) -> Iterator[PlanStep]:
        index = start
        while self.total is None or index < self.total:
            yield self.step(index)
            index += 1


@dataclass(frozen=True)
class RoundSchedule:
    """The times when the rounds of a plan are due: multiples of a period after the beginning, in experiment time.

    Rounds whose time goes by while one is taken, or waits for the repair of a tip, are missed: the next is due on the
    old beat.

    Attributes:
        start_s: when the first is due.
        period_s: 0 for one right after the other.
    """

    start_s: float
    period_s: float = 0.0

    def __post_init__(self) -> None:
        if not (self.period_s >= 0.0 and math.isfinite(self.period_s)):
            raise InvalidValue(f"a period of {self.period_s} s")

    def next_due_s(self, done_s: float | None) -> float:
        """Return when the round after the one that was done at `done_s` is due; None: none was."""
        if done_s is None or self.period_s == 0.0:
            return self.start_s
        beats = math.floor((done_s - self.start_s) / self.period_s) + 1
        return self.start_s + max(beats, 0) * self.period_s

    def left_out(self, due_s: float, next_due_s: float) -> int:
        """Return how many rounds lie between two that were due one after the other."""
        return max(0, round((next_due_s - due_s) / self.period_s) - 1) if self.period_s else 0

    def too_slow_for(self, left_out: int, pace_s: float) -> int:
        """Return how many of these rounds were left out since one takes `pace_s`, longer than the period."""
        return min(left_out, max(0, math.ceil(pace_s / self.period_s - 1e-9) - 1)) if self.period_s else 0


def grid_centers(center_m: XY, counts: tuple[int, int], spacing_m: XY, angle_rad: float = 0.0) -> tuple[XY, ...]:
    """Return the points of a grid about a centre, from the row of smallest y on; every other row runs backwards.

    Args:
        counts: (columns, rows).
        spacing_m: (x, y) between neighbours, along the axes of the turned grid.
    """
    columns, rows = counts
    if columns < 1 or rows < 1:
        raise InvalidValue(f"a grid of {columns} x {rows} points has none")
    for count, step_m in zip(counts, spacing_m, strict=True):
        if count > 1 and not step_m > 0.0:
            raise InvalidValue(
                f"{count} points of a grid lie {lengths_text([step_m])} apart", hint="spacing is above zero"
            )
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    points = []
    for row in range(rows):
        # there and back: the piezo need not fly over the whole grid, and creeps less
        order = range(columns) if row % 2 == 0 else reversed(range(columns))
        for column in order:
            u = (column - (columns - 1) / 2) * spacing_m[0]
            v = (row - (rows - 1) / 2) * spacing_m[1]
            points.append((center_m[0] + u * cos - v * sin, center_m[1] + u * sin + v * cos))
    return tuple(points)


def rounds_within(duration_s: float, period_s: float) -> int:
    """Return how many rounds begin within a duration; the first begins at once."""
    if period_s <= 0.0:
        raise InvalidValue("a series with a duration needs a period", hint='e.g. every = "15 min"')
    return math.floor(duration_s / period_s * (1 + 1e-12)) + 1
