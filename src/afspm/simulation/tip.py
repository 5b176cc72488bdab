"""The tip: its shape, what goes wrong with it, and what may cure it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from afspm.simulation import chance
from afspm.simulation.settings import check, one_of

if TYPE_CHECKING:
    from afspm.simulation.feedback import Loop
    from afspm.simulation.scanning import Course

FLAWS = ("blunt", "double", "contaminated")
CONDITIONS = ("sharp", *FLAWS)


@dataclass(frozen=True)
class TipShape:
    """One shape of the tip.

    Attributes:
        radius_m: of the apex, debris not counted.
        half_angle_deg: of the cone that the apex turns into.
        second_apex_m: (x, y, height) of a second apex beside the first, height (negative) below it; None without.
        debris_m: size of what sticks to the tip and jumps; 0 for a clean one.
        length_m: against the first tip; a change makes the height jump.
        flaws: which of FLAWS it has.
    """

    radius_m: float
    half_angle_deg: float
    second_apex_m: tuple[float, float, float] | None = None
    debris_m: float = 0.0
    length_m: float = 0.0
    flaws: tuple[str, ...] = ()

    @property
    def is_sharp(self) -> bool:
        """Without any flaw."""
        return not self.flaws

    @property
    def imaging_radius_m(self) -> float:
        """Of what touches the sample: apex or debris."""
        return self.radius_m + self.debris_m


@dataclass(frozen=True)
class TipSettings:
    """The sharp tip, and its possible flaws, whose sizes are in units of its radius.

    Attributes:
        condition: at the start: "sharp", "blunt", "double" or "contaminated".
        spread: relative scatter of every size that is drawn.
    """

    radius_m: float = 8e-9
    half_angle_deg: float = 18.0
    condition: str = "sharp"
    blunt_radii: float = 6.0
    second_distance_radii: float = 7.0
    second_below_radii: float = 0.1
    debris_radii: float = 1.5
    length_jump_radii: float = 0.5
    spread: float = 0.25

    def __post_init__(self) -> None:
        check(self, above_zero="radius_m half_angle_deg blunt_radii second_distance_radii", fraction="spread")
        check(self, from_zero="second_below_radii debris_radii length_jump_radii")
        one_of(self.condition, CONDITIONS, "condition")


@dataclass(frozen=True)
class TipRepairSettings:
    """The repairs of `TipChangeSettings`.

    Attributes:
        pulse_threshold_v: below, a pulse does nothing.
        pulse_cures, pulse_worsens: probability for a pulse far above the threshold that lasts `pulse_duration_s`.
        pulse_duration_s: a longer pulse does more, up to the effect of two; a shorter one does less.
        crash_cures, crash_worsens: probability for a crash `crash_depth_m` deep.
        crash_depth_m: an n times deeper crash has n chances of an effect.
        crash_speed_m_per_s: slower crashes are less likely to have an effect, in proportion.
    """

    pulse_threshold_v: float = 2.0
    pulse_cures: float = 0.5
    pulse_worsens: float = 0.08
    pulse_duration_s: float = 50e-3
    crash_cures: float = 0.85
    crash_worsens: float = 0.1
    crash_depth_m: float = 5e-9
    crash_speed_m_per_s: float = 50e-9

    def __post_init__(self) -> None:
        check(self, from_zero="pulse_threshold_v", above_zero="pulse_duration_s crash_depth_m crash_speed_m_per_s")
        check(self, fraction="pulse_cures pulse_worsens crash_cures crash_worsens")


@dataclass(frozen=True)
class TipChangeSettings(TipRepairSettings):
    """Spontaneous tip changes, and the effect of repairs.

    The chances of a repair are made up, so that one is seen to take some trying. How they grow is a simple picture and
    no theory: a crash takes material from the apex, or leaves some there, all along its way in; a pulse moves by its
    field what it can, most of it soon.

    Attributes:
        per_hour: mean number of changes per hour of scanning at a gentle setpoint.
        per_metre: mean number of changes per metre of scanned line.
        hardness_exponent: both rates grow as (force / force at a gentle setpoint) to this power.
        blunt_weight, double_weight, contaminated_weight: how likely each is.
        schedule: pairs of seconds after the start and a condition: changes at fixed times.
        wear_m_per_m: growth of the radius per metre scanned at a gentle setpoint.
    """

    per_hour: float = 0.0
    per_metre: float = 0.0
    hardness_exponent: float = 2.0
    blunt_weight: float = 1.0
    double_weight: float = 1.0
    contaminated_weight: float = 1.0
    schedule: tuple[tuple[float, str], ...] = field(default_factory=tuple)
    wear_m_per_m: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, from_zero="per_hour per_metre hardness_exponent blunt_weight double_weight contaminated_weight")
        check(self, from_zero="wear_m_per_m")
        for _, condition in self.schedule:
            one_of(condition, CONDITIONS, "schedule")
        object.__setattr__(self, "schedule", tuple(sorted(self.schedule)))


@dataclass(frozen=True)
class TipChange:
    """From t_s on the tip is `tip`; cause is "start", "chance", "schedule", "pulse", "crash" or "wear"."""

    t_s: float
    cause: str
    tip: TipShape


class TipMaker:
    """Draws tips: sharp ones, and what becomes of them."""

    def __init__(self, settings: TipSettings) -> None:
        self._s = settings

    def first(self, random: np.random.Generator) -> TipShape:
        """The tip that the experiment starts with: as in the settings, exactly, and perhaps with a flaw."""
        sharp = TipShape(self._s.radius_m, self._s.half_angle_deg)
        return sharp if self._s.condition == "sharp" else self.changed(sharp, self._s.condition, random)

    def changed(self, tip: TipShape, condition: str, random: np.random.Generator) -> TipShape:
        """The tip after it became sharp, blunt, double or contaminated; flaws it had stay unless it is sharp now."""
        s, radius = self._s, self._s.radius_m
        length = tip.length_m + s.length_jump_radii * radius * float(random.normal())
        if condition == "sharp":
            return TipShape(radius * self._about(0.4, random), s.half_angle_deg, length_m=length)
        flaws = tuple(sorted({*tip.flaws, condition}))
        worse = replace(tip, flaws=flaws, length_m=length)
        if condition == "blunt":
            return replace(worse, radius_m=max(1.5 * tip.radius_m, s.blunt_radii * radius * self._about(1.0, random)))
        if condition == "double":
            angle = random.uniform(0.0, 2.0 * math.pi)
            distance = s.second_distance_radii * radius * self._about(1.0, random)
            below = -s.second_below_radii * radius * self._about(1.0, random)
            return replace(worse, second_apex_m=(distance * math.cos(angle), distance * math.sin(angle), below))
        return replace(worse, debris_m=s.debris_radii * radius * self._about(1.0, random))

    def _about(self, share: float, random: np.random.Generator) -> float:
        # a random factor near 1; `share` is its part of the spread
        return math.exp(share * self._s.spread * float(random.normal()))


@dataclass(frozen=True)
class Chances:
    """Probabilities that a treatment cures a tip, and that it worsens it."""

    cures: float
    worsens: float

    def of_times(self, times: float) -> Chances:
        """Of so many treatments, not necessarily a whole number, of which the first that does anything is the last.

        Both grow with the number; their ratio stays, and their sum is 1 at most.
        """
        once = min(1.0, self.cures + self.worsens)
        if once <= 0.0:
            return self
        ever = 1.0 - (1.0 - once) ** times
        cures = min(self.cures, once)
        return Chances(ever * cures / once, ever * (once - cures) / once)

    def weakened(self, share: float) -> Chances:
        """With both smaller by a factor."""
        return Chances(share * self.cures, share * self.worsens)


def pulse_times(settings: TipChangeSettings, duration_s: float) -> float:
    """As many pulses of the usual duration as one of `duration_s` is worth: from 0 to 2, 1 for the usual.

    Simulated, without a source: it is the field that moves atoms of the apex, so the voltage matters most; those that
    it can move go soon, and the longer it lasts, the fewer are left. Half of them are gone after the usual duration.
    """
    return 2.0 * duration_s / (duration_s + settings.pulse_duration_s)


def crash_times(settings: TipChangeSettings, depth_m: float) -> float:
    """As many crashes of the usual depth as one `depth_m` deep is worth.

    Simulated, without a source: material is taken from the apex, or left there, all along the way in, so each further
    stretch of the way has the chance that the one before it had.
    """
    return depth_m / settings.crash_depth_m


def indented_m(tip: TipShape, depth_m: float) -> float:
    """Return how deep a tip gets into the sample when it is driven `depth_m` beyond the surface.

    Simulated, without a source: at first the sample gives way, by as much as was asked for. The deeper, the more it is
    the apex that gives way, and blunts; beyond some three of its radii nothing more is gained. A blunt apex is stiffer.
    """
    most_m = 3.0 * tip.imaging_radius_m
    return -most_m * math.expm1(-depth_m / most_m)


def drawn_flaw(settings: TipChangeSettings, random: np.random.Generator) -> str | None:
    """Return the next flaw; None when all weights are zero."""
    weights = np.array([settings.blunt_weight, settings.double_weight, settings.contaminated_weight])
    return str(random.choice(FLAWS, p=weights / weights.sum())) if weights.sum() else None


def chance_changes(
    settings: TipChangeSettings, start_s: float, end_s: float, rate_per_s: float, seed: int, call: int
) -> list[tuple[float, str]]:
    """Times and flaws of the changes that come by chance in a scan: a Poisson process."""
    random = chance.generator(seed, call)
    t, found = start_s, []
    while rate_per_s > 0:
        t += random.exponential(1.0 / rate_per_s)
        flaw = drawn_flaw(settings, random)
        if t >= end_s or flaw is None:
            break
        found.append((t, flaw))
    return found


class SimulatedTip:
    """The tip through the night: every shape it has had, by time, and what changes it.

    What is foreseen (the rest of a scan that was stopped: changes, wear) can be taken back.

    Attributes:
        history: in the order of time; the first is that of the start.
        scheduled_until_s: up to when the changes of the schedule have happened.
    """

    def __init__(self, settings: TipSettings, changes: TipChangeSettings, seed: int, start_s: float) -> None:
        self._settings, self._seed, self._start_s = changes, seed, start_s
        self._maker = TipMaker(settings)
        self.history = [TipChange(start_s, "start", self._maker.first(chance.generator(seed, 0)))]
        self.scheduled_until_s = start_s
        self.advance(start_s)

    def at(self, t_s: float) -> TipShape:
        """Return the tip at a time."""
        return next((c.tip for c in reversed(self.history) if c.t_s <= t_s), self.history[0].tip)

    def between(self, start_s: float, end_s: float) -> list[TipChange]:
        """Return the changes in (start, end]."""
        return [change for change in self.history if start_s < change.t_s <= end_s]

    def begin(self, t_s: float) -> None:
        """Go to a time, and take back what was to come after it."""
        self.history = [c for c in self.history if c.t_s <= t_s or c.cause == "start"]
        self.scheduled_until_s = min(self.scheduled_until_s, t_s)
        self.advance(t_s)

    def advance(self, until_s: float) -> None:
        """Let the scheduled changes up to a time happen."""
        for number, (after_s, condition) in enumerate(self._settings.schedule):
            t_s = self._start_s + after_s
            if self.scheduled_until_s < t_s <= until_s or (t_s == until_s == self._start_s):
                self._change(t_s, "schedule", condition, chance.generator(self._seed, 6, number))
        self.scheduled_until_s = max(self.scheduled_until_s, until_s)

    def foresee(self, course: Course, loop: Loop, call: int) -> None:
        """Add the changes that will come during a scan: scheduled ones, and by chance."""
        s, start_s, end_s = self._settings, course.start_s, course.end_s
        hardness = loop.force**s.hardness_exponent if loop.on and loop.engages else float(not loop.on)
        rate = (s.per_hour / 3600.0 + s.per_metre * course.length_m / (end_s - start_s)) * hardness
        seed = chance.subseed(self._seed, "tip changes")
        for number, (t_s, flaw) in enumerate(chance_changes(s, start_s, end_s, rate, seed, call)):
            self.advance(t_s)
            self._change(t_s, "chance", flaw, chance.generator(seed, call, number))
        self.advance(end_s)

    def wear(self, course: Course, loop: Loop) -> None:
        """Let the apex grow by what a scan has rubbed off."""
        s, tip = self._settings, self.history[-1].tip
        if s.wear_m_per_m and loop.engages:
            worn_m = s.wear_m_per_m * course.length_m * loop.force**s.hardness_exponent
            self._add(TipChange(course.end_s, "wear", replace(tip, radius_m=tip.radius_m + worn_m)))

    def pulse(self, voltage_v: float, duration_s: float, t_s: float, random: np.random.Generator) -> str:
        """Return what a bias pulse did; see `_treat`. It depends on the voltage above all."""
        s = self._settings
        strength = max(0.0, abs(voltage_v) / s.pulse_threshold_v - 1.0) if s.pulse_threshold_v else 1.0
        if strength == 0.0:
            return "unchanged"
        effect = 1.0 - math.exp(-3.0 * strength)
        chances = Chances(s.pulse_cures, s.pulse_worsens).weakened(effect).of_times(pulse_times(s, duration_s))
        return self._treat("pulse", t_s, chances, random)

    def crash(self, depth_m: float, speed_m_s: float, t_s: float, random: np.random.Generator) -> str:
        """Return what a crash did; see `_treat`."""
        s = self._settings
        effect = min(1.0, speed_m_s / s.crash_speed_m_per_s)
        chances = Chances(s.crash_cures, s.crash_worsens).of_times(crash_times(s, depth_m)).weakened(effect)
        return self._treat("crash", t_s, chances, random)

    def _treat(self, cause: str, t_s: float, chances: Chances, random: np.random.Generator) -> str:
        draw = random.random()
        if draw < chances.cures:
            self._change(t_s, cause, "sharp", random)
            return "cured"
        flaw = drawn_flaw(self._settings, random)
        if draw < chances.cures + chances.worsens and flaw is not None:
            self._change(t_s, cause, flaw, random)
            return "worsened"
        return "unchanged"

    def _change(self, t_s: float, cause: str, condition: str, random: np.random.Generator) -> None:
        self._add(TipChange(t_s, cause, self._maker.changed(self.at(t_s), condition, random)))

    def _add(self, change: TipChange) -> None:
        self.history.append(change)
        self.history.sort(key=lambda c: c.t_s)
