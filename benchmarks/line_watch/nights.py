"""Simulated nights for the watch on running scans: surfaces, drift, tips and noise are drawn, in two halves.

A night has three scans to learn from, then good scans with a planted hard negative each, then a scan during which the
tip changes. All tuning uses the half "fitted"; figures are from the half "unseen".

A change is visible if, without noise, it changes at least a quarter of the 20 rows after it by more than the white
noise (rms of a levelled row). A blunt tip on flat terraces is no visible change.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from afspm.components import Array
from afspm.model import Feedback, Region
from afspm.plugins.line_watch.line_judge import AlarmLevel, Kind, LineJudge, ScanJudge
from afspm.plugins.line_watch.registration import levelled
from afspm.simulation.measuring import Adjustment
from afspm.simulation.world import World

Half = Literal["fitted", "unseen"]
HALVES: tuple[Half, ...] = ("fitted", "unseen")
SURFACES = ("particles", "stamper", "rough", "steps", "lattice")
FLAWS = ("blunt", "double", "contaminated")
NEGATIVES = ("none", "spikes", "creep", "missing rows", "jump", "setpoint")
LEARNT, GOOD, ROWS = 3, 3, 128
SPIKES = 10  # in a scan, of six times the heights' standard deviation
WITHIN = 20  # rows after a change
_QUIET = {"noise": {"white_m": 0.0, "one_over_f_m": 0.0, "line_offset_m": 0.0, "scar_probability": 0.0}}
_LINES_UNTIL_TOLD = 2  # a changed setting is published a moment after the controller has it


@dataclass
class NightOutcome:
    """Alarms of one night, in rows.

    Attributes:
        false_alarms: by planted negative: row of the alarm, or None.
        changed_row, alarm_row: of the last scan; alarm_row None without an alarm.
        is_visible: see the head of this module.
        line_s: duration of a row.
        strongest: evidence that each good scan reached.
    """

    surface: str
    flaw: str
    seed: int
    line_s: float
    changed_row: int
    alarm_row: int | None = None
    is_visible: bool = False
    false_alarms: list[tuple[str, int | None]] = field(default_factory=list)
    strongest: list[float] = field(default_factory=list)


class NightScan(NamedTuple):
    """A scan of a night.

    Attributes:
        at_s: time of its start.
        negative: planted in it; "changed": the tip changes.
        picture: heights in m of trace and retrace, [y, x].
    """

    at_s: float
    negative: str
    picture: list[Array]


class Night:
    """A night of a half, by its seed."""

    def __init__(self, half: Half, seed: int) -> None:
        self.random = np.random.default_rng([1 + HALVES.index(half), 44, seed])
        self.seed, self.number = 10_000 * HALVES.index(half) + seed, seed
        self.surface = SURFACES[seed % len(SURFACES)]
        self.size_m = (8e-9 if self.surface == "lattice" else 2e-6) * self._about(1.6)
        self.line_s = self._about(2.0)
        self.period_s = ROWS * self.line_s + 30.0
        self.region = Region((0.0, 0.0), (self.size_m, self.size_m))
        self._at = self.region  # moves where the sample slips below it
        self.flaw = FLAWS[int(self.random.integers(len(FLAWS)))]
        self.row = int(self.random.integers(10, 100))
        self.settings = {
            "surface": self._surface(),
            "drift": self._drift(),
            "scanner": {"creep": self._one_of(0.0, 0.02)},
        }

    def outcome(self) -> NightOutcome:
        """Judge the night's scans, line by line."""
        return self.judged(*self.scans())

    def scans(self) -> tuple[list[NightScan], bool]:
        """Take the scans of the night; return them, and whether the change in the last one is visible."""
        world = World.from_settings(self.settings, self.seed, 0.0)
        negatives = [str(one) for one in self.random.choice(NEGATIVES, GOOD, replace=False)]
        taken = []
        for number in range(LEARNT + GOOD):
            at_s = 1.0 + number * self.period_s
            negative = "none" if number < LEARNT else negatives[number - LEARNT]
            taken.append(NightScan(at_s, negative, self._scan(world, at_s, negative)))
        at_s = 1.0 + (LEARNT + GOOD) * self.period_s
        changed = self._changed(world, at_s, {})
        is_visible = self._is_visible(world, at_s)
        return [*taken, NightScan(at_s, "changed", self._scan(changed, at_s, "none"))], is_visible

    def judged(self, scans: Sequence[NightScan], is_visible: bool) -> NightOutcome:
        """Judge scans of this night, line by line."""
        found = NightOutcome(self.surface, self.flaw, self.number, self.line_s, self.row, is_visible=is_visible)
        judge, kind = LineJudge(), Kind.of(self.region, (ROWS, ROWS), "")
        for number, (at_s, negative, picture) in enumerate(scans[:-1]):
            judged = None if number < LEARNT else self._begin(judge, kind, at_s)
            if judged is not None:
                until = ROWS if negative != "setpoint" else self.row + _LINES_UNTIL_TOLD
                row, strongest = _watch(judged, picture, until)
                found.false_alarms.append((negative, row))
                found.strongest.append(strongest)
            if negative != "setpoint" and (judged is None or judged.alarm is None):
                judge.learn(picture, self.region, kind, at_s + ROWS * self.line_s)
        last = scans[-1]
        judged = self._begin(judge, kind, last.at_s)
        found.alarm_row = None if judged is None else _watch(judged, last.picture, ROWS)[0]
        return found

    def _begin(self, judge: LineJudge, kind: Kind, at_s: float) -> ScanJudge | None:
        return judge.begin(self.region, kind, at_s, channels=2)

    def _changed(self, world: World, at_s: float, more: Mapping[str, object]) -> World:
        schedule = [[at_s + self.row * self.line_s, self.flaw]]
        other = World.from_settings({**self.settings, **more, "tip_changes": {"schedule": schedule}}, self.seed, 0.0)
        other.restore(world.state())
        return other

    def _is_visible(self, world: World, at_s: float) -> bool:
        same = World.from_settings({**self.settings, **_QUIET}, self.seed, 0.0)
        same.restore(world.state())
        changed = self._changed(world, at_s, _QUIET)
        with_change, without = (levelled(self._scan(one, at_s, "none")[0]) for one in (changed, same))
        rows = slice(self.row + 1, self.row + 1 + WITHIN)
        off_m = np.sqrt(np.mean((with_change - without)[rows] ** 2, axis=1))
        return bool(np.mean(off_m >= world.settings.noise.white_m) >= 0.25)

    def _scan(self, world: World, at_s: float, negative: str) -> list[Array]:
        adjusted: list[Adjustment] = []
        world_before = world.state()
        if negative == "creep":
            # a spectrum two scan widths away, just before
            world.spectrum("IV", (2.0 * self.size_m, self.size_m), at_s - 2.0)
        if negative == "setpoint":
            other = Feedback(setpoint=0.8 * world.settings.feedback.first_setpoint)
            adjusted = [Adjustment(at_s + self.row * self.line_s, other, 0.1)]
        channels = self._taken(world, at_s, adjusted)
        if negative == "jump":
            # the sample slips by some pixels, and stays there: a rolled picture would wrap its rows around
            slipped = World.from_settings(self.settings, self.seed, 0.0)
            slipped.restore(world_before)
            pixels = self.random.integers(-4, 5, 2)
            x, y = (at + self.size_m / ROWS * float(by) for at, by in zip(self._at.center_m, pixels, strict=True))
            self._at = Region((x, y), self._at.size_m)
            for picture, after in zip(channels, self._taken(slipped, at_s, adjusted), strict=True):
                picture[self.row :] = after[self.row :]
        self._plant(channels, negative)
        return channels

    def _taken(self, world: World, at_s: float, adjusted: Sequence[Adjustment]) -> list[Array]:
        channels = world.scan(self._at, (ROWS, ROWS), self.line_s, at_s, adjusted=adjusted).channels()
        return [channels[name][1].copy() for name in ("Height", "Height Retrace")]

    def _plant(self, picture: list[Array], negative: str) -> None:
        rows = self.random.permutation(ROWS)
        if negative == "missing rows":
            for values in picture:
                values[rows[:6]] = np.nan
        for values in picture:
            spread = float(np.std(levelled(values)))
            if negative == "spikes":
                where = self.random.integers(0, ROWS, (SPIKES, 2))
                values[where[:, 0], where[:, 1]] += 6.0 * spread * self.random.standard_normal(SPIKES)

    def _surface(self) -> dict[str, object]:
        about = self._about
        drawn: dict[str, dict[str, object]] = {
            "particles": {"radius_m": 22e-9 * about(1.4), "spacing_m": 160e-9 * about(1.5)},
            "stamper": {"angle_deg": self.random.uniform(0.0, 90.0), "height_m": 120e-9 * about(1.5)},
            "rough": {"rms_m": 6e-9 * about(2.0), "hurst": self.random.uniform(0.6, 0.95)},
            "steps": {"terrace_m": 180e-9 * about(1.6), "angle_deg": self.random.uniform(0.0, 90.0)},
            "lattice": {"angle_deg": self.random.uniform(0.0, 60.0), "defect_fraction": 0.012 * about(2.0)},
        }
        return {"kind": self.surface, **drawn[self.surface]}

    def _drift(self) -> dict[str, object]:
        # what prediction leaves of a drift: up to two pixels from scan to scan
        speed = math.exp(self.random.uniform(math.log(0.05), math.log(2.0))) * self.size_m / ROWS / self.period_s
        angle = self.random.uniform(0.0, math.tau)
        walk = 0.0 if self.surface == "lattice" else 2e-9
        velocity = [speed * math.cos(angle), speed * math.sin(angle), 0.0]
        return {"velocity_m_per_s": velocity, "walk_z_m_per_sqrt_hour": walk}

    def _about(self, factor: float) -> float:
        return math.exp(self.random.uniform(-math.log(factor), math.log(factor)))

    def _one_of(self, *values: float) -> float:
        return values[int(self.random.integers(len(values)))]


def _watch(judged: ScanJudge, picture: list[Array], until: int) -> tuple[int | None, float]:
    strongest = 0.0
    for row in range(until):
        alarm = judged.add(row, [values[row] for values in picture])
        strongest = max(strongest, judged.evidence)
        if alarm is not None and alarm.level is AlarmLevel.STOP:
            return row, strongest
    return None, strongest


def judged_night(half: Half, seed: int) -> NightOutcome:
    """Return the outcome of one night."""
    return Night(half, seed).outcome()
