"""The shape of the tip, its changes, and the effects of repairs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from afspm.basics.errors import ConfigError
from afspm.simulation import chance
from afspm.simulation.settings import check, one_of
from afspm.simulation.tip_answers import ANSWER_KINDS, TipAnswers, answers_of

if TYPE_CHECKING:
    from afspm.simulation.feedback import Loop
    from afspm.simulation.scanning import Course

FLAWS = ("blunt", "double", "contaminated")
CONDITIONS = ("sharp", *FLAWS)


@dataclass(frozen=True)
class TipShape:
    """A shape of the tip.

    Attributes:
        radius_m: radius of the apex, without debris.
        half_angle_deg: half angle of the cone behind the apex.
        second_apex_m: (x, y, height) of a second apex beside the first, height (negative) below it; None without.
        debris_m: size of debris that sticks to the tip and jumps; 0 for a clean tip.
        length_m: length relative to the first tip; a change makes the height jump.
        flaws: a subset of FLAWS.
    """

    radius_m: float
    half_angle_deg: float
    second_apex_m: tuple[float, float, float] | None = None
    debris_m: float = 0.0
    length_m: float = 0.0
    flaws: tuple[str, ...] = ()

    @property
    def is_sharp(self) -> bool:
        return not self.flaws

    @property
    def imaging_radius_m(self) -> float:
        """The radius of the part that touches the sample: the apex with its debris."""
        return self.radius_m + self.debris_m


@dataclass(frozen=True)
class TipSettings:
    """The sharp tip and its possible flaws, whose sizes are relative to its radius.

    Attributes:
        condition: at the start: "sharp", "blunt", "double" or "contaminated".
        spread: relative scatter of every random size.
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
        if not self.half_angle_deg < 90.0:
            raise ConfigError(f"{self.half_angle_deg!r} is not below 90", where="half_angle_deg")
        one_of(self.condition, CONDITIONS, "condition")


@dataclass(frozen=True)
class TipRepairSettings:
    """The settings of repairs: the effects of pulses and crashes on the tip.

    Attributes:
        pulse_threshold_v: a pulse below this voltage has no effect.
        pulse_cures, pulse_worsens: probability for a pulse far above the threshold that lasts `pulse_duration_s`.
        pulse_duration_s: a longer pulse has more effect, up to twice; a shorter pulse has less.
        crash_cures, crash_worsens: probability for a crash `crash_depth_m` deep.
        crash_depth_m: an n times deeper crash has n chances of an effect.
        crash_speed_m_per_s: slower crashes are less likely to have an effect, in proportion.
        answers: "even": every flaw answers alike, by the probabilities above; "public", "sealed": the answer depends on
            flaw, polarity, voltage and depth, drawn for each seed from the prior of that name (`tip_answers`).
        answers_seed: seed of that draw, for several nights with the same answers; by default the seed of the world.
        answers_turn_s: the time after the start at which the answers change to `TipAnswers.turned`; 0: never.
        keep_away_m: a treatment nearer than this to a place scanned before counts in the damage ledger.
    """

    pulse_threshold_v: float = 2.0
    pulse_cures: float = 0.5
    pulse_worsens: float = 0.08
    pulse_duration_s: float = 50e-3
    crash_cures: float = 0.85
    crash_worsens: float = 0.1
    crash_depth_m: float = 5e-9
    crash_speed_m_per_s: float = 50e-9
    answers: str = "even"
    answers_seed: int | None = None
    answers_turn_s: float = 0.0
    keep_away_m: float = 500e-9

    def __post_init__(self) -> None:
        one_of(self.answers, ANSWER_KINDS, "answers")
        check(self, from_zero="answers_turn_s keep_away_m")
        check(self, from_zero="pulse_threshold_v", above_zero="pulse_duration_s crash_depth_m crash_speed_m_per_s")
        check(self, fraction="pulse_cures pulse_worsens crash_cures crash_worsens")


@dataclass(frozen=True)
class TipChangeSettings(TipRepairSettings):
    """Spontaneous tip changes, and the effect of repairs.

    The probabilities of a repair are made up, so that a repair typically takes several attempts. Their growth is a
    simple picture and no theory: a crash removes material from the apex, or leaves some there, all along its way in;
    the field of a pulse moves atoms, most of them soon.

    Attributes:
        per_hour: mean number of changes per hour of scanning at a gentle setpoint.
        per_metre: mean number of changes per metre of scanned line.
        hardness_exponent: both rates grow as (force / force at a gentle setpoint) to this power.
        blunt_weight, double_weight, contaminated_weight: relative probabilities of the flaws.
        schedule: pairs of seconds after the start and a condition: changes at fixed times.
        in_scans: pairs of a scan's number and a condition: 4 at the start of the fourth scan, 4.5 in its middle.
        wear_m_per_m: growth of the radius per metre scanned at a gentle setpoint.
    """

    per_hour: float = 0.0
    per_metre: float = 0.0
    hardness_exponent: float = 2.0
    blunt_weight: float = 1.0
    double_weight: float = 1.0
    contaminated_weight: float = 1.0
    schedule: tuple[tuple[float, str], ...] = field(default_factory=tuple)
    in_scans: tuple[tuple[float, str], ...] = field(default_factory=tuple)
    wear_m_per_m: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, from_zero="per_hour per_metre hardness_exponent blunt_weight double_weight contaminated_weight")
        check(self, from_zero="wear_m_per_m")
        for _, condition in self.schedule:
            one_of(condition, CONDITIONS, "schedule")
        for _, condition in self.in_scans:
            one_of(condition, CONDITIONS, "in_scans")
        object.__setattr__(self, "schedule", tuple(sorted(self.schedule)))


@dataclass(frozen=True)
class TipChange:
    """A change of the tip to `tip` at `t_s`; cause is "start", "chance", "schedule", "pulse", "crash" or "wear"."""

    t_s: float
    cause: str
    tip: TipShape


class TipMaker:
    """A generator of random tips: sharp tips, and tips after a change."""

    def __init__(self, settings: TipSettings) -> None:
        self._s = settings

    def first(self, random: np.random.Generator) -> TipShape:
        """Return the tip at the start, with the flaw in the settings if any."""
        sharp = TipShape(self._s.radius_m, self._s.half_angle_deg)
        return sharp if self._s.condition == "sharp" else self.changed(sharp, self._s.condition, random)

    def changed(self, tip: TipShape, condition: str, random: np.random.Generator) -> TipShape:
        """Return the tip after a change of condition; a change to "sharp" removes all flaws, other changes add one."""
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
    """The probabilities that a treatment cures a tip and that it worsens the tip."""

    cures: float
    worsens: float

    def of_times(self, times: float) -> Chances:
        """Return the probabilities of `times` treatments (any number), which end with the first effect.

        Both probabilities grow with the number; their ratio stays, and their sum is at most 1.
        """
        once = min(1.0, self.cures + self.worsens)
        if once <= 0.0:
            return self
        ever = 1.0 - (1.0 - once) ** times
        cures = min(self.cures, once)
        return Chances(ever * cures / once, ever * (once - cures) / once)

    def weakened(self, share: float) -> Chances:
        """Return both probabilities multiplied by `share`."""
        return Chances(share * self.cures, share * self.worsens)


def pulse_times(settings: TipChangeSettings, duration_s: float) -> float:
    """Return the equivalent number of pulses of the usual duration: from 0 to 2, and 1 for the usual duration.

    Simulated, without a source: the field moves atoms of the apex, so the voltage matters most; movable atoms go soon,
    and the longer the pulse lasts, the fewer remain. Half of them are gone after the usual duration.
    """
    return 2.0 * duration_s / (duration_s + settings.pulse_duration_s)


def crash_times(settings: TipChangeSettings, depth_m: float) -> float:
    """Return the equivalent number of crashes of the usual depth for a crash `depth_m` deep.

    Simulated, without a source: material is removed from the apex, or left there, all along the way in, so each further
    interval of depth has the same chance as the one before.
    """
    return depth_m / settings.crash_depth_m


def indented_m(tip: TipShape, depth_m: float) -> float:
    """Return the indentation of the sample by a tip that moves `depth_m` beyond the surface.

    Simulated, without a source: at first the sample yields by the whole depth. At larger depth the apex yields more and
    becomes blunt; the indentation is limited to three apex radii. A blunt apex is stiffer.
    """
    most_m = 3.0 * tip.imaging_radius_m
    return -most_m * math.expm1(-depth_m / most_m)


def drawn_flaw(settings: TipChangeSettings, random: np.random.Generator) -> str | None:
    """Draw the next random flaw; None if all weights are zero."""
    weights = np.array([settings.blunt_weight, settings.double_weight, settings.contaminated_weight])
    return str(random.choice(FLAWS, p=weights / weights.sum())) if weights.sum() else None


def chance_changes(
    settings: TipChangeSettings, start_s: float, end_s: float, rate_per_s: float, seed: int, call: int
) -> list[tuple[float, str]]:
    """Return times and flaws of random changes during a scan: a Poisson process."""
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
    """The shapes of the tip over time, and the causes of its changes.

    Predicted changes (tip changes and wear in the rest of a stopped scan) can be revoked.

    Attributes:
        history: in the order of time; the first entry is the start.
        scheduled_until_s: the time up to which scheduled changes have happened.
    """

    def __init__(self, settings: TipSettings, changes: TipChangeSettings, seed: int, start_s: float) -> None:
        self._settings, self._seed, self._start_s = changes, seed, start_s
        self._maker = TipMaker(settings)
        own_seed = changes.answers_seed
        self._answers = answers_of(changes.answers, seed if own_seed is None else own_seed)
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
        """Revoke all changes later than `t_s`, and apply scheduled changes up to `t_s`."""
        self.history = [c for c in self.history if c.t_s <= t_s or c.cause == "start"]
        self.scheduled_until_s = min(self.scheduled_until_s, t_s)
        self.advance(t_s)

    def schedule(self, condition: str, t_s: float) -> None:
        """Add a change to the schedule, so that scans computed again include it."""
        change = (t_s - self._start_s, condition)
        self._settings = replace(self._settings, schedule=(*self._settings.schedule, change))

    def advance(self, until_s: float) -> None:
        """Apply the scheduled changes up to a time."""
        for number, (after_s, condition) in enumerate(self._settings.schedule):
            t_s = self._start_s + after_s
            if self.scheduled_until_s < t_s <= until_s or (t_s == until_s == self._start_s):
                self._change(t_s, "schedule", condition, chance.generator(self._seed, 6, number))
        self.scheduled_until_s = max(self.scheduled_until_s, until_s)

    def foresee(self, course: Course, loop: Loop, call: int) -> None:
        """Predict and add the scheduled and random changes during a scan."""
        s, start_s, end_s = self._settings, course.start_s, course.end_s
        hardness = loop.force**s.hardness_exponent if loop.on and loop.engages else float(not loop.on)
        rate = (s.per_hour / 3600.0 + s.per_metre * course.length_m / (end_s - start_s)) * hardness
        seed = chance.subseed(self._seed, "tip changes")
        for number, (t_s, flaw) in enumerate(chance_changes(s, start_s, end_s, rate, seed, call)):
            self.advance(t_s)
            self._change(t_s, "chance", flaw, chance.generator(seed, call, number))
        self.advance(end_s)

    def wear(self, course: Course, loop: Loop) -> None:
        """Increase the radius by the wear of a scan."""
        s, tip = self._settings, self.history[-1].tip
        if s.wear_m_per_m and loop.engages:
            worn_m = s.wear_m_per_m * course.length_m * loop.force**s.hardness_exponent
            self._add(TipChange(course.end_s, "wear", replace(tip, radius_m=tip.radius_m + worn_m)))

    def answers(self, t_s: float) -> TipAnswers | None:
        """Return the present response of each flaw to treatments; None if all flaws respond alike."""
        turn_s = self._settings.answers_turn_s
        turned = self._answers is not None and 0.0 < turn_s <= t_s - self._start_s
        return self._answers.turned() if self._answers is not None and turned else self._answers

    def pulse(self, voltage_v: float, duration_s: float, t_s: float, random: np.random.Generator) -> str:
        """Apply a bias pulse and return its effect: "cured", "worsened" or "unchanged", depending mostly on voltage."""
        s, answers = self._settings, self.answers(t_s)
        if answers is not None:
            once = Chances(*answers.of(self.at(t_s).flaws).pulse(voltage_v))
            return self._treat("pulse", t_s, once.of_times(pulse_times(s, duration_s)), random)
        strength = max(0.0, abs(voltage_v) / s.pulse_threshold_v - 1.0) if s.pulse_threshold_v else 1.0
        if strength == 0.0:
            return "unchanged"
        effect = 1.0 - math.exp(-3.0 * strength)
        chances = Chances(s.pulse_cures, s.pulse_worsens).weakened(effect).of_times(pulse_times(s, duration_s))
        return self._treat("pulse", t_s, chances, random)

    def crash(self, depth_m: float, speed_m_s: float, t_s: float, random: np.random.Generator) -> str:
        """Apply a crash and return its effect: "cured", "worsened" or "unchanged"."""
        s, answers = self._settings, self.answers(t_s)
        effect = min(1.0, speed_m_s / s.crash_speed_m_per_s)
        if answers is not None:
            once = Chances(*answers.of(self.at(t_s).flaws).crash(depth_m))
            return self._treat("crash", t_s, once.weakened(effect), random)
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
