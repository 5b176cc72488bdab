"""One scan: position and time of each pixel, and the computed channels.

Time: a line lasts `line_s`, its first half the trace (x upwards), its second the retrace. Lines follow each other from
small y to large y, or the other way round when scanning down.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from afspm.basics.errors import InvalidValue
from afspm.model import Frame, Region
from afspm.model.arrays import Array
from afspm.simulation.settings import check, one_of

MOST_PIXELS = 1 << 24
DIRECTIONS = ("up", "down")
FLATTENINGS = ("none", "offset", "line")


@dataclass(frozen=True)
class ScannerSettings:
    """Mechanics of the scanner.

    Attributes:
        flatten: levelling of height lines before they are delivered: "none", "offset" or "line" (Flatten1).
        band_limit_px: standard deviation of the blur of the tip's path over the surface, in pixels.
        oversampling: grid points per pixel and axis for the contact of tip and sample; 0: 1 to 4, by the scan's size.
        tilt_x, tilt_y: slope of the sample in its holder, m/m.
        creep: remaining fraction of a move right after the move; falls by a quarter per decade of 1 + t in s, to zero
            after almost three hours; 0: none.
        backlash_m: lag of the retrace in x.
    """

    flatten: str = "none"
    band_limit_px: float = 0.5
    oversampling: int = 0
    tilt_x: float = 0.0
    tilt_y: float = 0.0
    creep: float = 0.0
    backlash_m: float = 0.0

    def __post_init__(self) -> None:
        one_of(self.flatten, FLATTENINGS, "flatten")
        check(self, from_zero="band_limit_px oversampling backlash_m", fraction="creep")


def clipped(along_m: Array, reach_m: Array | float) -> Array:
    """Return positions within the scanner's reach."""
    return np.asarray(np.clip(along_m, -reach_m, reach_m))


@dataclass(frozen=True)
class Course:
    """Positions and times of a scan's pixels.

    Attributes:
        region: in tip coordinates.
        shape: (ny, nx).
        line_s: duration of trace and retrace together.
        direction: direction of the slow axis, "up" (small y first) or "down".
        reach_m: largest distance of the tip from the scanner's centre, in x and y: beyond it the output is clipped, so
            that pixels show the surface at the edge; None: unlimited.
    """

    region: Region
    shape: tuple[int, int]
    line_s: float
    start_s: float
    direction: str = "up"
    reach_m: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        ny, nx = self.shape
        if ny < 1 or nx < 1 or ny * nx > MOST_PIXELS:
            raise InvalidValue(f"a scan of {nx} x {ny} pixels cannot be taken", hint=f"1 to {MOST_PIXELS} pixels")
        if not (math.isfinite(self.line_s) and self.line_s > 0 and math.isfinite(self.start_s)):
            raise InvalidValue(f"a line of {self.line_s} s, started at {self.start_s} s, cannot be scanned")
        if self.direction not in DIRECTIONS:
            raise InvalidValue(f"scan direction {self.direction!r}", hint='"up" or "down"')
        if self.region.frame is not Frame.TIP:
            raise InvalidValue("the microscope scans in tip coordinates, not those of the sample")

    @property
    def end_s(self) -> float:
        """The end of the last retrace."""
        return self.start_s + self.shape[0] * self.line_s

    @property
    def order(self) -> NDArray[np.int64]:
        """The row indices in the order of time."""
        rows = np.arange(self.shape[0])
        return rows if self.direction == "up" else rows[::-1]

    def row_times_s(self, part: float) -> Array:
        """Return the time of each row at a fraction of its line: 0.25 mid-trace, 0.75 mid-retrace, 1 end."""
        times = np.empty(self.shape[0])
        times[self.order] = self.start_s + (np.arange(self.shape[0]) + part) * self.line_s
        return times

    def rows_taken(self, until_s: float | None) -> NDArray[np.bool_]:
        """Return a mask of the rows that are complete at `until_s`; None selects all rows."""
        if until_s is None:
            return np.ones(self.shape[0], dtype=bool)
        return np.asarray(self.row_times_s(1.0) <= until_s + 1e-9 * self.line_s)

    def pixels_m(self) -> tuple[Array, Array]:
        """Return x and y of the tip at each pixel, in m, both of the scan's shape."""
        x, y = self.region.pixels_m(self.shape)
        return (x, y) if self.reach_m is None else (clipped(x, self.reach_m[0]), clipped(y, self.reach_m[1]))

    @property
    def pixel_m(self) -> tuple[float, float]:
        """The distance (x, y) between pixels, in m."""
        ny, nx = self.shape
        width, height = self.region.size_m
        return (width / (nx - 1) if nx > 1 else width, height / (ny - 1) if ny > 1 else height)

    @property
    def length_m(self) -> float:
        """The length of all lines, trace and retrace."""
        return 2.0 * self.shape[0] * self.region.size_m[0]


class ScannerPlace:
    """The target of the piezo, and its remaining creep.

    Attributes:
        at_m: (x, y) of the last target.
        came_from_m, came_s: the previous target, and the time of the last move.
    """

    def __init__(self, creep: float, start_s: float) -> None:
        self._creep = creep
        self.at_m, self.came_from_m, self.came_s = (0.0, 0.0), (0.0, 0.0), start_s

    def move_to(self, position_m: tuple[float, float], t_s: float) -> None:
        """Set the target; a repeated target has no effect on the creep."""
        if position_m != self.at_m:
            self.came_from_m, self.came_s, self.at_m = self.at_m, t_s, position_m

    def creep_m(self, t_s: Array) -> Array:
        """Return the remaining part (x, y) of the last move at times, shape (n, 2)."""
        move = np.subtract(self.at_m, self.came_from_m)
        since = np.maximum(np.asarray(t_s) - self.came_s, 0.0) + 1.0
        left = self._creep * np.maximum(1.0 - np.log10(since) / 4.0, 0.0)
        return np.asarray(left[:, None] * move)


@dataclass(frozen=True)
class SimulatedScan:
    """A scan that is computed at its start; the caller limits the visible rows.

    Attributes:
        course: positions and times.
        drift_m: (x, y, z) at the middle of each row's trace, by row index.
        truth: the parameters of the simulation, JSON-able.
    """

    course: Course
    drift_m: Array
    truth: Mapping[str, object]
    _channels: Mapping[str, tuple[str, Array]] = field(repr=False)

    @property
    def start_s(self) -> float:
        return self.course.start_s

    @property
    def end_s(self) -> float:
        return self.course.end_s

    def channels(self, until_s: float | None = None) -> dict[str, tuple[str, Array]]:
        """Return channel -> (unit, values [y, x]); rows that are not complete at `until_s` are NaN."""
        taken = self.course.rows_taken(until_s)
        if taken.all():
            return {name: (unit, values.copy()) for name, (unit, values) in self._channels.items()}
        return {
            name: (unit, np.where(taken[:, None], values, np.nan)) for name, (unit, values) in self._channels.items()
        }
