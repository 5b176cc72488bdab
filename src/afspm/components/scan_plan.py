"""Plans of scans, their due times and repetitions: decisions that need no microscope."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, MutableMapping
from dataclasses import dataclass, replace
from typing import Any

from afspm.basics.errors import InvalidValue, Refused
from afspm.basics.formatting import lengths_text
from afspm.model import Region
from afspm.night.bad_scans import BAD

XY = tuple[float, float]
REST_OVERLAP = 2  # rows before the estimated change that are taken again
MOST_UNJUDGED = 16  # scans of a classifier's reference never get a verdict
MOST_REFUSED = 10  # places in a row: after that, the reason is another
FEWEST_ROWS = 8  # of the rest of a scan: fewer rows show too little to be judged or registered


@dataclass(frozen=True)
class PlanStep:
    """One measurement of a plan.

    Attributes:
        index: the place of the measurement in the plan, from 0.
        key: idempotency key, the same after a restart of the component: a measurement is taken only once for each key.
        region: the region to scan.
        shape: pixels as (rows, columns); None leaves them unchanged.
        starts_round: whether the step waits for the plan's period; later steps of the round do not.
    """

    index: int
    key: str
    region: Region
    shape: tuple[int, int] | None
    starts_round: bool

    def again(self, number: int) -> PlanStep:
        """Return the step of a repetition, under its own key."""
        return replace(self, key=f"{self.key}-again-{number}")


@dataclass(frozen=True)
class ScanPlan:
    """Regions that are scanned one after the other, in one or more rounds.

    Attributes:
        regions: the regions of one round.
        shape: pixels as (rows, columns); None leaves them unchanged.
        rounds: number of rounds; None: without end.
    """

    regions: tuple[Region, ...]
    shape: tuple[int, int] | None = None
    rounds: int | None = 1

    def __post_init__(self) -> None:
        if not self.regions:
            raise InvalidValue("a plan needs at least one region")
        if self.rounds is not None and self.rounds < 1:
            raise InvalidValue(f"a plan needs at least 1 round, not {self.rounds}")

    @property
    def total(self) -> int | None:
        """Number of scans; None: without end."""
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
    """Due times of the rounds of a plan: multiples of a period after the start, in experiment time.

    A round is missed if its time passes while another round is taken or waits for a tip repair; the next round is due
    at the next multiple.

    Attributes:
        start_s: the due time of the first round.
        period_s: the time between the starts of two rounds; 0: no pause.
    """

    start_s: float
    period_s: float = 0.0

    def __post_init__(self) -> None:
        if not (self.period_s >= 0.0 and math.isfinite(self.period_s)):
            raise InvalidValue(f"a period of {self.period_s} s")

    def next_due_s(self, done_s: float | None) -> float:
        """Return the due time after a round that ended at `done_s` (None: no round yet); `start_s` without a period."""
        if done_s is None or self.period_s == 0.0:
            return self.start_s
        beats = math.floor((done_s - self.start_s) / self.period_s) + 1
        return self.start_s + max(beats, 0) * self.period_s

    def left_out(self, due_s: float, next_due_s: float) -> int:
        """Return the number of rounds missed between two due times."""
        return max(0, round((next_due_s - due_s) / self.period_s) - 1) if self.period_s else 0

    def too_slow_for(self, left_out: int, pace_s: float) -> int:
        """Return the number of left-out rounds that a round of length `pace_s`, longer than the period, explains."""
        return min(left_out, max(0, math.ceil(pace_s / self.period_s - 1e-9) - 1)) if self.period_s else 0


@dataclass(frozen=True)
class PlanRest:
    """Rows of a scan that are still to be taken, as a scan of its own with fewer rows.

    No supported maker can begin a scan at a row by its interface, and every controller takes a plain scan. The rows
    before stay in the record as an interrupted scan: the parts differ in tip, time and drift, so no file joins them.

    Attributes:
        first, last: indices of the rows in the whole scan.
    """

    first: int
    last: int

    def since(self, row: int, *, downwards: bool) -> PlanRest:
        """Return the rows still to be taken from a row of this part on, with REST_OVERLAP; at least FEWEST_ROWS.

        Args:
            row: index in this part.
            downwards: whether the rows are scanned from the last to the first.
        """
        at = self.first + min(max(row, 0), self.last - self.first)
        if downwards:
            return PlanRest(self.first, min(self.last, max(at + REST_OVERLAP, self.first + FEWEST_ROWS - 1)))
        return PlanRest(max(self.first, min(at - REST_OVERLAP, self.last - FEWEST_ROWS + 1)), self.last)

    def of(self, step: PlanStep) -> PlanStep:
        """Return the step that measures only these rows, under its own key; the step itself if all rows are left."""
        rows, columns = step.shape or (0, 0)
        if (self.first, self.last) == (0, rows - 1):
            return step
        width_m, height_m = step.region.size_m
        away_m = ((self.first + self.last) / 2 / (rows - 1) - 0.5) * height_m
        angle = step.region.angle_rad
        x_m, y_m = step.region.center_m
        center_m = (x_m - away_m * math.sin(angle), y_m + away_m * math.cos(angle))
        size_m = (width_m, (self.last - self.first) / (rows - 1) * height_m)
        region = replace(step.region, center_m=center_m, size_m=size_m)
        shape = (self.last - self.first + 1, columns)
        return replace(step, key=f"{step.key}-rows-{self.first}-{self.last}", region=region, shape=shape)


class RefusedPlaces:
    """The places of a plan that a limit or the microscope refuses: they are left out, and the others are measured.

    Args:
        places: number of places. If all are refused, or `MOST_REFUSED` in a row, the refusal is an error.
        memory: memory of the component, for the state.
    """

    def __init__(self, places: int, memory: MutableMapping[str, Any]) -> None:
        self._most_in_a_row, self._memory = min(places, MOST_REFUSED), memory

    @property
    def number(self) -> int:
        """Return the number of refused measurements."""
        number, _ = self._memory.get("refused", (0, 0))
        return int(number)

    def add(self, refused: Refused, measurements: int = 1) -> None:
        """Count the measurements of a refused place.

        Raises:
            Refused: too many places in a row are refused.
        """
        number, in_a_row = self._memory.get("refused", (0, 0))
        if in_a_row + 1 >= self._most_in_a_row:
            raise refused
        self._memory["refused"] = [number + measurements, in_a_row + 1]

    def accepted(self) -> None:
        """Begin the count of places in a row again."""
        number, in_a_row = self._memory.get("refused", (0, 0))
        if in_a_row:
            self._memory["refused"] = [number, 0]


class Retakes:
    """The scans to take again since they were judged to show a bad tip.

    Args:
        most: how often each scan is taken again; 0: never.
        memory: memory of the component, for the state.
    """

    def __init__(self, most: int, memory: MutableMapping[str, Any]) -> None:
        self._most, self._memory = most, memory
        self.has_verdicts = False

    @property
    def due(self) -> tuple[int, int] | None:
        """Return (index of the step, number of the repetition, from 1) of the next scan to take again, if any."""
        for index, again in self._memory.get("retake", ()):
            return index, again
        return None

    @property
    def awaits_newest(self) -> bool:
        """Return whether the newest scan has no verdict yet."""
        return bool(self._unjudged) and self._unjudged[-1][0] == self._memory["newest"]

    def add(self, index: int, again: int, times_ns: Iterable[int | None]) -> None:
        """Add a scan that was taken, and awaits its verdict.

        Args:
            index: index of the step in the plan.
            again: number of the repetition; 0: the first scan of the step.
            times_ns: ends of its channels.
        """
        if not self._most:
            return
        step = [index, again]
        self._memory["retake"] = [due for due in self._memory.get("retake", ()) if due != step]
        self._memory["unjudged"] = [*self._unjudged, (step, list(times_ns))][-MOST_UNJUDGED:]
        self._memory["newest"] = step

    def judge(self, verdicts: Iterable[tuple[int, float]]) -> list[int]:
        """Make bad scans due again, up to `most` times; return the steps that are bad after all repetitions.

        Args:
            verdicts: time of the scan and score.
        """
        given_up = []
        for time_ns, score in verdicts:
            self.has_verdicts = True
            judged = [step for step, times_ns in self._unjudged if time_ns in times_ns]
            self._memory["unjudged"] = [one for one in self._unjudged if one[0] not in judged]
            for index, again in judged if score == BAD else ():
                if again < self._most:
                    self._memory["retake"] = [*self._memory.get("retake", ()), [index, again + 1]]
                else:
                    given_up.append(index)
        return given_up

    @property
    def _unjudged(self) -> list[tuple[list[int], list[int | None]]]:
        return list(self._memory.get("unjudged", ()))


def grid_centers(center_m: XY, counts: tuple[int, int], spacing_m: XY, angle_rad: float = 0.0) -> tuple[XY, ...]:
    """Return the points of a grid about a centre, back and forth, from the row of smallest y on.

    Args:
        counts: (columns, rows).
        spacing_m: (x, y) between neighbours, along the axes of the rotated grid.

    Raises:
        InvalidValue: the grid is empty, or a needed spacing is not above zero.
    """
    columns, rows = counts
    if columns < 1 or rows < 1:
        raise InvalidValue(f"a grid of {columns} x {rows} points is empty")
    for count, step_m in zip(counts, spacing_m, strict=True):
        if count > 1 and not step_m > 0.0:
            raise InvalidValue(
                f"{count} points of a grid lie {lengths_text([step_m])} apart", hint="spacing is above zero"
            )
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    points = []
    for row in range(rows):
        # back and forth: the piezo makes no long jumps, and creeps less
        order = range(columns) if row % 2 == 0 else reversed(range(columns))
        for column in order:
            u = (column - (columns - 1) / 2) * spacing_m[0]
            v = (row - (rows - 1) / 2) * spacing_m[1]
            points.append((center_m[0] + u * cos - v * sin, center_m[1] + u * sin + v * cos))
    return tuple(points)


def rounds_within(duration_s: float, period_s: float) -> int:
    """Return the number of rounds that start within a duration; the first starts at once.

    Raises:
        InvalidValue: there is no period.
    """
    if period_s <= 0.0:
        raise InvalidValue("a series with a duration needs a period", hint='e.g. every = "15 min"')
    return math.floor(duration_s / period_s * (1 + 1e-12)) + 1
