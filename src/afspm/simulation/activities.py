"""Activities of a simulated instrument: scans, spectra, moves, and other activities that take time."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from afspm.model import Feedback, Region
from afspm.model.arrays import Array
from afspm.simulation.measuring import Adjustment
from afspm.simulation.scanning import Course, SimulatedScan, clipped

Channels = dict[str, tuple[str, Array]]
"""Channel -> (unit, values [y, x], both ascending)."""
RETRACE = " Retrace"
"""Suffix of the names of retrace channels."""


class ScanValues(Protocol):
    """The values of a scan, computed at its start; the caller limits the visible rows."""

    def channels(self, until_s: float | None = None) -> Channels: ...


@dataclass(frozen=True)
class Occupied:
    """An activity `what` (a move, an approach …) that keeps the instrument busy until `end_s`."""

    what: str
    start_s: float
    end_s: float

    def running(self, now_s: float) -> bool:
        return now_s < self.end_s


@dataclass(frozen=True)
class Move(Occupied):
    """A move of the probe."""

    from_m: tuple[float, float]
    to_m: tuple[float, float]

    def probe_at(self, now_s: float) -> tuple[float, float]:
        """Return the position during the move."""
        part = (now_s - self.start_s) / (self.end_s - self.start_s)
        (x0, y0), (x1, y1) = self.from_m, self.to_m
        return x0 + part * (x1 - x0), y0 + part * (y1 - y0)


@dataclass
class ScanActivity:
    """A started scan, with the settings at its start and later changes.

    Attributes:
        number: number of the scan, from 1 on.
        region, shape: frame, and (rows, columns).
        line_s: duration of trace and retrace together.
        upwards: True if the first line has the smallest y.
        feedback, bias_v, slope: settings at the start of the scan.
        adjusted: changes during the scan, each in force from the next line on.
        reach_m: largest distance of the tip from the scanner's centre, in x and y; None: unlimited.
        stopped_s: the time of the scan's interruption; None without.
    """

    number: int
    region: Region
    shape: tuple[int, int]
    start_s: float
    line_s: float
    upwards: bool
    feedback: Feedback
    bias_v: float
    slope: tuple[float, float] = (0.0, 0.0)
    adjusted: tuple[Adjustment, ...] = ()
    reach_m: tuple[float, float] | None = None
    stopped_s: float | None = None
    paused_since_s: float | None = None
    paused_s: float = 0.0
    _drawn: Future[ScanValues] = field(default_factory=Future, init=False, repr=False, compare=False)
    _whole: Channels | None = field(default=None, init=False, repr=False, compare=False)

    what = "scan"

    @property
    def course(self) -> Course:
        """Positions and times of the scan.

        Raises:
            InvalidValue: the settings allow no scan.
        """
        direction = "up" if self.upwards else "down"
        return Course(self.region, self.shape, self.line_s, self.start_s, direction, self.reach_m)

    def draw(self, values: ScanValues) -> None:
        """Set the values; `channels` waits for this call."""
        self._drawn.set_result(values)

    def wait(self) -> None:
        wait([self._drawn])

    def redrawn(self, adjusted: tuple[Adjustment, ...]) -> None:
        """Discard the values, so that they are computed again with these adjustments."""
        self.adjusted, self._whole, self._drawn = adjusted, None, Future()

    @property
    def end_s(self) -> float:
        """The expected end of the last line: later after a pause, earlier if stopped."""
        if self.stopped_s is not None:
            return self.stopped_s
        return self.start_s + self.shape[0] * self.line_s + self.paused_s

    @property
    def paused(self) -> bool:
        return self.paused_since_s is not None

    @property
    def drawing(self) -> bool:
        """True while the values are being computed; the scan cannot end earlier."""
        return not self._drawn.done()

    def running(self, now_s: float) -> bool:
        """True until the scan has ended, also while paused."""
        if self.stopped_s is not None:
            return False
        return self.paused or now_s < self.end_s or self.drawing

    def lines_done(self, now_s: float) -> int:
        """Return the number of complete lines."""
        done = int((self._scanned_until_s(now_s) - self.start_s) / self.line_s + 1e-9)
        rows = self.shape[0]
        return max(0, min(done, rows - 1 if self.drawing and done >= rows else rows))

    def passes(self, now_s: float) -> int:
        """Return the number of complete passes, forward and backward separately."""
        return int((self._scanned_until_s(now_s) - self.start_s) / (self.line_s / 2) + 1e-9)

    def tip_m(self, now_s: float) -> tuple[float, float]:
        """Return the position (x, y) of the tip during trace or retrace, in m."""
        lines = (self._scanned_until_s(now_s) - self.start_s) / self.line_s
        row = min(int(lines), self.shape[0] - 1)
        there = 1.0 - abs(1.0 - 2.0 * min(lines - row, 1.0))
        up = row / max(self.shape[0] - 1, 1)
        along = np.array([there - 0.5, (up if self.upwards else 1.0 - up) - 0.5]) * self.region.size_m
        cos, sin = np.cos(self.region.angle_rad), np.sin(self.region.angle_rad)
        (x, y), (cx, cy) = along, self.region.center_m
        at_m = np.array([cx + cos * x - sin * y, cy + sin * x + cos * y])
        tip_x, tip_y = at_m if self.reach_m is None else clipped(at_m, np.array(self.reach_m))
        return float(tip_x), float(tip_y)

    def channels(self, until_s: float | None = None) -> Channels:
        """Return channel -> (unit, values [y, x]), both ascending; lines not complete at `until_s` are NaN.

        None returns all lines, also of a stopped scan. Waits for values that are being computed.
        """
        drawn = self._drawn.result()
        return drawn.channels(None if until_s is None else self._scanned_until_s(until_s))

    @property
    def truth(self) -> Mapping[str, object]:
        """The parameters of the simulation, JSON-able; empty without a sample. Waits until the values are computed."""
        drawn = self._drawn.result()
        return drawn.truth if isinstance(drawn, SimulatedScan) else {}

    def signals(self, now_s: float) -> dict[str, float]:
        """Return the present value of each channel; during the retrace, of a recorded backward channel."""
        if self._whole is None:
            self._whole = self._drawn.result().channels()
        rows, columns = self.shape
        lines = (self._scanned_until_s(now_s) - self.start_s) / self.line_s
        line = min(max(int(lines), 0), rows - 1)
        along = 2.0 * min(max(lines - line, 0.0), 1.0)
        column = min(int(columns * min(along, 2.0 - along)), columns - 1)
        row = line if self.upwards else rows - 1 - line
        forward = {name: data for name, data in self._whole.items() if not name.endswith(RETRACE)}
        shown = {
            name: self._whole.get(f"{name}{RETRACE}", data) if along > 1.0 else data for name, data in forward.items()
        }
        return {name: float(values[row, column]) for name, (_, values) in shown.items()}

    def pause(self, now_s: float) -> None:
        """Hold the current line until `resume`."""
        if not self.paused and self.running(now_s):
            self.paused_since_s = now_s

    def resume(self, now_s: float) -> None:
        if self.paused_since_s is not None:
            self.paused_s += now_s - self.paused_since_s
            self.paused_since_s = None

    def stop(self, now_s: float) -> None:
        if self.running(now_s):
            self.resume(now_s)
            self.stopped_s = now_s

    def _scanned_until_s(self, now_s: float) -> float:
        until_s = now_s if self.stopped_s is None else min(now_s, self.stopped_s)
        if self.paused_since_s is not None:
            until_s = min(until_s, self.paused_since_s)
        return until_s - self.paused_s


@dataclass(frozen=True)
class SpectrumActivity:
    """A started spectrum.

    Attributes:
        values: [n_points, n_variables], complete from the start on; the caller must not publish them before `end_s`.
    """

    number: int
    kind: str
    position_m: tuple[float, float]
    start_s: float
    end_s: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array

    what = "spectrum"

    def running(self, now_s: float) -> bool:
        return now_s < self.end_s

    def both_ways(self) -> tuple[Channels, Channels]:
        """Return the variables forward and backward, in the order of time.

        A variable without a backward sweep has the same values in both.
        """
        table = dict(zip(self.names, zip(self.units, self.values.T, strict=True), strict=True))
        there = {name: data for name, data in table.items() if not name.endswith(RETRACE)}
        back = {
            name: (unit, table.get(f"{name}{RETRACE}", (unit, values))[1]) for name, (unit, values) in there.items()
        }
        turned = there if self.kind == "force" else back  # a force curve begins away from the sample
        turned.update({name: (unit, values[::-1]) for name, (unit, values) in turned.items()})
        return there, back


@dataclass(frozen=True)
class ValuesInAir:
    """A scan without a sample: noise on every channel.

    Attributes:
        units: the unit of each channel.
    """

    units: Mapping[str, str]
    course: Course
    seed: tuple[int, ...]

    def channels(self, until_s: float | None = None) -> Channels:
        """Return the noise of each channel, in the form of `SimulatedScan.channels`."""
        random = np.random.default_rng(self.seed)
        missing = ~self.course.rows_taken(until_s)
        found: Channels = {}
        for name, unit in self.units.items():
            values = noise_in_air(random, self.course.shape, unit)
            values[missing] = np.nan
            found[name] = (unit, values)
        return found


@dataclass(frozen=True)
class NoValues:
    """A scan that could not be simulated: no line is available."""

    units: Mapping[str, str]
    shape: tuple[int, int]

    def channels(self, until_s: float | None = None) -> Channels:
        return {name: (unit, np.full(self.shape, np.nan)) for name, unit in self.units.items()}


def noise_in_air(random: np.random.Generator, shape: tuple[int, ...], unit: str) -> Array:
    """Return detector noise without a sample: a few pm, fA, or thousandths of the unit."""
    return np.asarray(random.normal(0.0, {"m": 5e-12, "A": 5e-15}.get(unit, 1e-3), shape))
