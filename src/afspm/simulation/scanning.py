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

from afspm.basics.errors import ConfigError, InvalidValue
from afspm.model import Frame, Region
from afspm.model.arrays import Array
from afspm.simulation import chance
from afspm.simulation.settings import check, one_of

MOST_PIXELS = 1 << 24
_EXACT = ((0.0, 0.0),) * 3
_SAME_M = 1e-13
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
        creep_share, creep_time_s: creep beyond the target of each move by creep_share * ln(1 + t / creep_time_s) of the
            move; it never ends, and the creep of all moves adds up.
        settling_share, settling_s: z after a move, as a share of the move's length; decays exponentially.
        backlash_m: lag of the retrace in x.
        retrace_offset: lag of the retrace in x in the left, middle and right third of a line, relative to the line.
        miscalibration: smallest and largest error of x, y and z; size and sign follow from the seed. A scanner with
            the error 0.08 moves 1.08 times as far as it should; heights with the error 0.12 read 1.12 times as high.
        coarse_spike_a: smallest and largest spike in the current while a coarse motor moves.
    """

    flatten: str = "none"
    band_limit_px: float = 0.5
    oversampling: int = 0
    tilt_x: float = 0.0
    tilt_y: float = 0.0
    creep: float = 0.0
    creep_share: float = 0.0
    creep_time_s: float = 500.0
    settling_share: float = 0.0
    settling_s: float = 10.0
    backlash_m: float = 0.0
    retrace_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    miscalibration: tuple[tuple[float, float], ...] = ()
    coarse_spike_a: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        one_of(self.flatten, FLATTENINGS, "flatten")
        check(self, from_zero="band_limit_px oversampling backlash_m", fraction="creep creep_share settling_share")
        check(self, above_zero="creep_time_s settling_s")
        for name in ("miscalibration", "retrace_offset"):
            if not all(-0.5 <= one <= 0.5 for one in np.ravel(getattr(self, name))):
                raise ConfigError(f"{getattr(self, name)} is beyond a half", where=name, hint="0.08 is 8 %")
        if len(self.miscalibration) not in (0, 3):
            raise ConfigError(f"{len(self.miscalibration)} ranges", where="miscalibration", hint="three: x, y and z")

    def scales(self, seed: int) -> tuple[float, float, float]:
        """Return the errors of calibration as factors: true x by set x, true y by set y, read z by true z."""
        random = chance.generator(chance.subseed(seed, "calibration"))
        ranges = self.miscalibration or _EXACT
        x, y, z = (1.0 + float(random.choice((-1.0, 1.0)) * random.uniform(*one)) for one in ranges)
        return x, y, z

    def retrace_lag_m(self, shape_x: int, width_m: float) -> Array:
        """Return the lag of the retrace at each pixel of a line, (shape_x,)."""
        along = (np.arange(shape_x) + 0.5) / shape_x
        return np.asarray(self.backlash_m + width_m * np.interp(along, (1 / 6, 1 / 2, 5 / 6), self.retrace_offset))


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
        moves: time and way (t_s, x, y) of all moves, for a creep that never ends; empty for other scanners.
    """

    def __init__(self, settings: ScannerSettings, start_s: float) -> None:
        self._settings = settings
        self.at_m, self.came_from_m, self.came_s = (0.0, 0.0), (0.0, 0.0), start_s
        self.moves: list[tuple[float, float, float]] = []

    def move_to(self, position_m: tuple[float, float], t_s: float) -> None:
        """Set the target; a repeated target has no effect on the creep."""
        if math.dist(position_m, self.at_m) > _SAME_M:
            self.came_from_m, self.came_s, self.at_m = self.at_m, t_s, position_m
            if self._settings.creep_share:
                self.moves.append((t_s, *np.subtract(self.at_m, self.came_from_m).tolist()))

    def creep_m(self, t_s: Array) -> Array:
        """Return the remaining part (x, y) of the last move minus the way crept beyond all targets, shape (n, 2)."""
        s, times = self._settings, np.asarray(t_s)
        move = np.subtract(self.at_m, self.came_from_m)
        since = np.maximum(times - self.came_s, 0.0) + 1.0
        left = (s.creep * np.maximum(1.0 - np.log10(since) / 4.0, 0.0))[:, None] * move
        if self.moves:
            began_s, ways = np.split(np.array(self.moves), [1], axis=1)
            grown = np.log1p(np.maximum(times[:, None] - began_s.T, 0.0) / s.creep_time_s)
            left = left - s.creep_share * grown @ ways
        return np.asarray(left)

    def settling_m(self, t_s: Array) -> Array:
        """Return z that the last move has left at times, shape (n,)."""
        s, since = self._settings, np.maximum(np.asarray(t_s) - self.came_s, 0.0)
        return np.asarray(s.settling_share * math.dist(self.at_m, self.came_from_m) * np.exp(-since / s.settling_s))


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
