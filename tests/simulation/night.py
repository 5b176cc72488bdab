"""A simulated night: its cast, its settings and its faults. All of it follows from the seed."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from typing import Any

from afspm.model import PacketHeader, Region, ScopeState, names
from afspm.model.microscope_status import FEEDBACK_OFF
from afspm.scheduler.control.arbitration import Cause, RoleTable, Rules
from afspm.scheduler.publishing.envelopes import Envelopes
from afspm.scheduler.safety.limits import ExperimentLimits, Limit
from afspm.scheduler.safety.watchdog import WatchdogSettings
from afspm.scheduler.settings import ControlSettings, SchedulerSettings
from afspm.supervisor.supervision.child import ChildPolicy, RestartPolicy
from afspm.supervisor.supervision.liveness import LivenessPolicy
from afspm.testing.components.memory_network import Weather
from afspm.testing.components.scheduler_host import SchedulerHost
from afspm.testing.components.simulated_process import Process
from afspm.testing.components.simulated_time import GoesInCircles, SimulatedTime
from tests.simulation import behaviours
from tests.simulation.client import Client
from tests.simulation.codec import TableCodec
from tests.simulation.invariants import Invariants, InvariantViolated
from tests.simulation.keeper import Keeper
from tests.simulation.microscope import FakeMicroscope, FakeScan, Habits
from tests.simulation.panel import ACTS, PANELS

_CALM = 0.15
"""The last part of a night, in which nothing bad happens any more and all must come right again."""

_SETTLED_S = 5.0
_ENDED_S = 60.0


@dataclass(frozen=True)
class Fault:
    """A fault: kind, process, time (as a part of the time before the calm) and duration (real)."""

    what: str
    whom: str
    when: float
    for_s: float = 0.0


FAULTS = ("kill", "outage", "freeze", "cut", "silence", "storm", "hang", "clock", "busy", "full disk", "slow disk")
CAST = {
    "experiment": behaviours.Experiment,
    "classifier": behaviours.Classifier,
    "corrector": behaviours.Corrector,
    "feedback": behaviours.FeedbackCorrector,
    "greedy": behaviours.Greedy,
    "crasher": behaviours.Crasher,
    "operator": behaviours.Operator,
    "stranger": behaviours.Stranger,
    "listener": behaviours.FeedListener,
    "old": behaviours.ExperimentWithoutIds,
    "careless": behaviours.Careless,
    "person": behaviours.Person,
    "burster": behaviours.Burster,
    "adjuster": behaviours.Adjuster,
    "forgetful": behaviours.Forgetful,
    "babbler": behaviours.Babbler,
    "freezer": behaviours.Freezer,
}
_TROUBLE = (
    "greedy",
    "crasher",
    "impostor",
    "operator",
    "stranger",
    "careless",
    "burster",
    "adjuster",
    "forgetful",
    "babbler",
    "freezer",
)
_ALWAYS = ("experiment", "classifier", "corrector", "feedback", "person")
_PEOPLE = ("operator", "person", "dawn")
_UNSYNCED_S = 0.1
_SLOWEST_S = 8.0
"""Packets that are published before they are on the disk must be few enough for a restart to remember."""
_LONGEST_SILENCE_S = 8.0
"""Heartbeats of the network find a half-open connection by then."""


@dataclass(frozen=True)
class Plan:
    """The plan of a night.

    Attributes:
        seed: of all random choices.
        hours: experiment time, without the calm at the end.
        speed: experiment seconds in a real one.
        cast: the components.
        impostor: another client uses the name "experiment", too.
        lease_s: None for none; then no greedy component takes part.
        faults: in their order.
        doubles: the chance that a request arrives twice.
        hangs, loses_answer: see `Habits`.
        dies_in_step: see `SchedulerHost`.
        retracts, garbles: see `Habits`.
        keys: each peer has a key, so that no other one can use its name.
        ends: the experiment is ended in the morning, at any state; if not, all components must recover.
        panel: the maker of a microscope at whose panel a person acts; empty: nobody does.
        acts: how often that person acts, an hour.
        repeats: whether a measurement that was stopped by hand is taken again.
    """

    seed: int
    hours: float = 8.0
    speed: float = 60.0
    cast: tuple[str, ...] = _ALWAYS
    impostor: bool = False
    lease_s: float | None = 1800.0
    faults: tuple[Fault, ...] = ()
    doubles: float = 0.0
    hangs: float = 0.0
    loses_answer: float = 0.0
    dies_in_step: float = 0.0
    stop_when: tuple[Cause, ...] = (Cause.PROBLEM, Cause.MANUAL, Cause.DEAD, Cause.IDLE)
    retracts: bool = True
    garbles: float = 0.0
    keys: bool = False
    ends: bool = False
    panel: str = ""
    acts: float = 2.0
    repeats: bool = False

    @property
    def length_s(self) -> float:
        """Real time with faults."""
        return self.hours * 3600.0 / self.speed

    @property
    def calm_s(self) -> float:
        """Real time after the faults, in which all components recover."""
        return max(self.length_s * _CALM, 4 * 3600.0 / self.speed, 200.0)

    @property
    def hours_to_the_end(self) -> float:
        """Experiment time including the calm."""
        return (self.length_s + (_ENDED_S if self.ends else self.calm_s)) * self.speed / 3600.0


def plan(seed: int, hours: float = 8.0) -> Plan:
    """Return the night of a seed: from a quiet one to one with nearly all faults."""
    chance = SimulatedTime(seed * 7919 + 1).random
    # the freezer is in no drawn night, where it would keep the others out for most of the time
    others = [name for name in CAST if name not in (*_ALWAYS, "freezer")]
    lease_s = chance.choice((None, 900.0, 1800.0))
    cast = [*_ALWAYS, *(name for name in others if chance.random() < 0.5)]
    if lease_s is None and "greedy" in cast:
        cast.remove("greedy")
    harm = chance.choice((0.0, 0.5, 1.0, 3.0))  # faults an hour
    targets = ["scheduler", "translator", *cast]
    faults = [
        Fault(
            chance.choice(FAULTS), chance.choice(targets), chance.random(), chance.choice((0.5, 3.0, 8.0, 20.0, 60.0))
        )
        for _ in range(round(harm * hours))
    ]
    bad = harm > 0.0
    impostor = chance.random() < 0.25
    chance.random()  # drawn for what is no more: the nights of all seeds stay as they were
    return Plan(
        seed,
        hours,
        chance.choice((60.0, 120.0, 240.0)),
        tuple(cast),
        impostor=impostor,
        lease_s=lease_s,
        faults=tuple(sorted(faults, key=lambda fault: fault.when)),
        doubles=chance.choice((0.0, 0.1)) if bad else 0.0,
        hangs=chance.choice((0.0, 0.005)) if bad else 0.0,
        loses_answer=chance.choice((0.0, 0.005)) if bad else 0.0,
        dies_in_step=chance.choice((0.0, 0.0005)) if bad else 0.0,
        stop_when=chance.choice(((), (Cause.PROBLEM,), tuple(Cause))),
        retracts=chance.random() < 0.8,
        garbles=chance.choice((0.0, 0.02)) if bad else 0.0,
        keys=chance.random() < 0.5,
        ends=chance.random() < 0.25,
    )


_FEW = ("experiment", "classifier", "corrector", "feedback", "person")


def bad_night(seed: int) -> Plan:
    """Return a night with many faults; in some nights also a greedy client."""
    away = [Fault("outage", "experiment", (seed % 10) / 10.0, 60.0)]
    drawn = plan(seed, hours=4.0)
    if seed % 4 == 3:  # few others and slow, so that control stays where it is
        drawn = replace(drawn, hours=8.0, speed=60.0, cast=(*_FEW, "greedy"), lease_s=900.0)
        away += [Fault("outage", holder, ((seed + place) % 10) / 10.0, 60.0) for place, holder in enumerate(_FEW)]
    if seed % 4 == 1:  # one whose tip is often in danger, at a microscope that can't always withdraw it
        cast = (*_FEW, "careless", "stranger")
        drawn = replace(drawn, cast=cast, ends=True, retracts=seed != 13, speed=60.0)
    if seed % 4 == 2:  # clients that do not wait for answers, and one that repeats ids
        drawn = replace(drawn, cast=(*_FEW, "burster", "adjuster", "forgetful"))
        away += [Fault("storm", "experiment", 0.2, 100.0)]  # packets arrive after answers to later requests
    there = ("scheduler", "translator", *drawn.cast)
    faults = (*(fault for fault in drawn.faults if fault.whom in there), *away)
    slow = replace(drawn, speed=drawn.speed / 2.0)  # in more real time more connections come and go
    return replace(slow, faults=faults, dies_in_step=0.003, doubles=0.1, hangs=0.005)


def ends_in_danger(seed: int, *, is_frozen: bool) -> Plan:
    """Return a night that ends while the tip is in danger, also while the translator does not answer."""
    faults = (Fault("freeze", "translator", 0.98, 14.0),) if is_frozen else ()
    return Plan(seed, 2.0, cast=("experiment", "person", "careless"), lease_s=None, ends=True, faults=faults)


FINDERS = [
    *map(bad_night, (9, 14, 11, 5, 13, 6, 0, 3, 18, 35)),
    ends_in_danger(3, is_frozen=True),
    ends_in_danger(5, is_frozen=False),
    Plan(6, 5.0, cast=("experiment", "freezer"), lease_s=None),
]
"""The nights in which all mutants of the scheduler are found, those that find most first.

A change of the code changes the nights. If `test_mutants` misses a mutant afterwards, add a night that finds it.
"""


_PANEL_NIGHTS = [
    Plan(seed, 4.0, cast=(*_FEW, "operator", "stranger", *more), panel=maker, acts=6.0, repeats=seed == 3)
    for seed, (maker, more) in enumerate(
        (("nanonis", ()), ("asylum", ("careless",)), ("gxsm", ()), ("nanosurf", ("careless",)), ("park", ()))
    )
]


def panel_night(seed: int) -> Plan:
    """Return a night with a person at the panel of a maker, and with all kinds of faults."""
    maker = tuple(PANELS)[seed % len(PANELS)]
    # where the controller does not show the tip, to repeat is to measure in the air
    repeats = PANELS[maker].shows_tip and seed % 4 == 3
    return replace(plan(seed, hours=4.0), panel=maker, acts=(2.0, 10.0)[seed % 2], repeats=repeats)


PANEL_NIGHTS = [*_PANEL_NIGHTS, panel_night(200)]
"""One night for each maker, with a person at its panel; in one more the scheduler's own actions wait meanwhile."""


@dataclass
class Outcome:
    """The outcome of a night: experiment hours, scans, steps of the scheduler."""

    hours: float
    scans: int
    scans_in_calm: int
    steps: int
    given_up: list[str] = field(default_factory=list)


class NightCodec(TableCodec):
    """A table that knows the headers of scans."""

    def header(self, envelope: str, payload: bytes | memoryview) -> PacketHeader:
        thing = self.decode(payload)
        if isinstance(thing, FakeScan):
            size_m = 2e-6 if thing.number % 2 else 5e-8
            kind = "IV" if envelope == "Spec1d" else None
            return PacketHeader(envelope, thing.channel, (size_m, size_m), kind)
        return PacketHeader(envelope)


class Night:
    """One night, ready to be run."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.timeline = timeline = SimulatedTime(plan.seed, plan.speed)
        self.weather = Weather(doubles=plan.doubles)
        self.codec = self.make_codec()
        habits = Habits(hangs=plan.hangs, loses_answer=plan.loses_answer, retracts=plan.retracts, garbles=plan.garbles)
        self.microscope = self.make_microscope(habits)
        self.settings = _settings(plan)
        self.invariants = Invariants(timeline, self.settings, self.microscope, self.codec)
        self.invariants.has_keys = plan.keys
        self.scheduler = SchedulerHost(
            timeline,
            self.weather,
            self.settings,
            self.codec,
            self.codec,
            self.invariants,
            dies_in_step=plan.dies_in_step,
            unsynced_s=_UNSYNCED_S,
            has_keys=plan.keys,
            make_core=self.make_core(),
        )
        self.scheduler.translator = (self.microscope, self.microscope)
        self.components = self._components()
        self.dawn = behaviours.Dawn(timeline, self.weather, self.codec, self.scheduler, "dawn")
        for person in (self.dawn, *self.components.values()):
            if isinstance(person, behaviours.Person):
                person.approach = self.microscope.approach
        self.keeper = Keeper(timeline, [self.microscope, self.scheduler, *self.components.values()], _policy())
        self.teller = self._teller()
        if plan.panel:
            self._seat_a_person()

    def _seat_a_person(self) -> None:
        # at the panel of the microscope; those who let the run continue put it right first
        self.microscope.panel = PANELS[self.plan.panel]
        self.invariants.panel_is_manned = True
        for person in (self.dawn, *self.components.values()):
            if isinstance(person, behaviours.Operator):
                person.put_right = self.microscope.put_right
                person.sees_to_it = 0.7 if self.microscope.panel.shows_tip else 1.0
        self._next_act()

    def _next_act(self) -> None:
        chance, length_s = self.timeline.random, self.plan.length_s
        mean_s = self.timeline.real_s(3600.0 / self.plan.acts)
        at_s = self.timeline.monotonic_s() + chance.expovariate(1.0 / mean_s)
        if at_s < length_s:
            self.timeline.at(at_s, self._act, ())

    def _act(self) -> None:
        what = self.timeline.random.choice(ACTS)
        self.microscope.act_by_hand(what)
        if what == "pause":
            self.timeline.after(self.timeline.real_s(60.0), self.microscope.go_on_by_hand)
        self._next_act()

    def make_codec(self) -> TableCodec:
        return NightCodec()

    def make_microscope(self, habits: Habits) -> FakeMicroscope:
        return FakeMicroscope(self.timeline, self.codec, habits)

    def make_core(self) -> Callable[[], Any] | None:
        """Return a factory for the core of the scheduler's next life; None: a plain core."""
        return None

    def _components(self) -> dict[str, Client]:
        made: dict[str, Client] = {
            name: CAST[name](self.timeline, self.weather, self.codec, self.scheduler, name) for name in self.plan.cast
        }
        if self.plan.impostor:
            made["impostor"] = behaviours.Impostor(
                self.timeline, self.weather, self.codec, self.scheduler, "impostor", "experiment"
            )
        for client in made.values():
            client.on_received = self.invariants.received
            client.on_answer = self.invariants.answered
        self.invariants.components = list(made.values())
        return made

    def _teller(self) -> behaviours.Teller:
        # reports the processes to the scheduler; no fault befalls it
        teller = behaviours.Teller(
            self.timeline, self.weather, self.codec, self.scheduler, "teller", "supervisor:night"
        )
        teller.processes, teller.restart = self.keeper.states, self.keeper.restart
        teller.start()
        return teller

    def run(self) -> Outcome:
        """Run the night.

        Raises:
            InvariantViolated: with the seed that replays it.
        """
        try:
            return self._run()
        except GoesInCircles as error:
            raise InvariantViolated(f"seed {self.plan.seed}, {self.plan}: {error}") from error
        except InvariantViolated as error:
            error.what = f"seed {self.plan.seed}, {self.plan}: {error.what}"
            raise

    def _run(self) -> Outcome:
        timeline, plan = self.timeline, self.plan
        length_s, calm_s = plan.length_s, plan.calm_s
        for fault in plan.faults:
            timeline.after(fault.when * length_s, self._befall, fault)
        timeline.run_until(length_s)
        if plan.ends:
            return self._end()
        self._calm(_TROUBLE)
        timeline.run_until(length_s + 100.0)
        before = self.microscope.scans_done
        timeline.run_until(length_s + calm_s)
        done = self.microscope.scans_done
        self._come_right(done - before)
        return self._outcome(done - before)

    def _outcome(self, scans_in_calm: int) -> Outcome:
        hours = self.timeline.monotonic_s() * self.plan.speed / 3600.0
        scans = self.microscope.scans_done
        return Outcome(hours, scans, scans_in_calm, self.invariants.checks, self.keeper.given_up)

    # --- what befalls them ---

    def _befall(self, fault: Fault) -> None:
        process = {"scheduler": self.scheduler, "translator": self.microscope, **self.components}[fault.whom]
        if fault.what == "kill":
            process.kill()
        elif fault.what == "outage":
            process.banned = True
            process.kill()
            self.timeline.after(fault.for_s, setattr, process, "banned", False)
        elif fault.what == "freeze":
            process.freeze(fault.for_s)
        elif fault.what == "busy":
            process.step_age_s = fault.for_s
            process.later(fault.for_s, setattr, process, "step_age_s", 0.0)
        elif fault.what == "cut" and isinstance(process, Client):
            process.cut()
        elif fault.what == "silence":
            self._silence(process, min(fault.for_s, _LONGEST_SILENCE_S))
        elif fault.what in ("cut", "storm"):
            self._storm(fault.for_s)
        elif fault.what == "hang":
            self._hang(fault.for_s)
        elif fault.what == "full disk":
            self._full_disk(fault.for_s)
        elif fault.what == "slow disk":
            self.scheduler.disk.delay_s = min(fault.for_s, _SLOWEST_S)
            self.timeline.after(fault.for_s, setattr, self.scheduler.disk, "delay_s", 0.0)
        elif fault.what == "clock":
            self.invariants.times_are_certain = False
            self.microscope.habits.clock_error_s = self.timeline.random.choice((-100.0, 0.0, 100.0, 10_000.0))

    def _silence(self, process: Process, for_s: float) -> None:
        # half-open connections: those of a component, or those between scheduler and translator
        if isinstance(process, Client):
            process.fall_silent(for_s)
            return
        self.invariants.tip.disturbed(for_s + _SETTLED_S)
        self.scheduler.fall_silent(for_s)

    def _full_disk(self, for_s: float) -> None:
        self.scheduler.disk.full = True
        self.invariants.forgets()
        self.timeline.after(for_s, setattr, self.scheduler.disk, "full", False)

    def _storm(self, for_s: float) -> None:
        # long delays, and all connections break at its beginning
        self.invariants.tip.disturbed(for_s + _SETTLED_S)
        self.weather.delay_s = 3.0
        self.invariants.times_are_certain = False  # a restarted scheduler can't wait for what comes that late
        for client in self.components.values():
            client.cut()
            client.cut_s += for_s + 5.0
        self.timeline.after(for_s, setattr, self.weather, "delay_s", 0.01)

    def _hang(self, for_s: float) -> None:
        # the translator is slow
        habits = self.microscope.habits
        self.invariants.tip.disturbed(for_s + _SETTLED_S)
        habits.service_s = for_s
        self.timeline.after(for_s, setattr, habits, "service_s", 0.02)

    def _calm(self, leaving: Collection[str] = ()) -> None:
        habits = self.microscope.habits
        self.weather.doubles = habits.hangs = habits.loses_answer = 0.0
        self.scheduler.dies_in_step = 0.0
        self.dawn.start()
        for name, component in self.components.items():
            component.banned = name in leaving
            if component.banned:
                component.kill()
        self.scheduler.banned = self.microscope.banned = False
        if self.plan.panel:
            self.timeline.after(_SETTLED_S, self.microscope.put_right)

    def _come_right(self, scans: int) -> None:
        # in calm weather the experiment goes on, and each component has all cached packets
        if not self.keeper.given_up and scans == 0:
            self.invariants.fail(f"nothing was scanned in the calm; control: {self.scheduler.core.control}")
        cached = [packet for packet, *_ in self.scheduler.core.cached()]
        self.timeline.run_until(self.timeline.monotonic_s() + 1.0)
        self.invariants.written.has_all_starts()
        for client in self.components.values():
            settled = self.timeline.monotonic_s() - max(client.since_s, self.scheduler.since_s) > _SETTLED_S
            if client.alive and self.scheduler.alive and settled:
                self.invariants.has_all(client, cached)

    def _end(self) -> Outcome:
        # at any state: all processes must leave
        self.dawn.ends = True
        self._calm()
        self.timeline.run_until(self.plan.length_s + _ENDED_S)
        if self.scheduler.alive or not self.scheduler.core.control.ended:
            self.invariants.fail("the experiment does not end")
        if self.invariants.tip.must_close and not self.microscope.closed:
            self.invariants.fail("the translator was not closed at the end")
        return self._outcome(0)


def _settings(plan: Plan) -> SchedulerSettings:
    limits = ExperimentLimits(
        {
            names.TIP_BIAS_VOLTAGE: Limit(low=-10.0, high=10.0, source="night"),
            names.ZCTRL_SETPOINT: Limit(step=0.3, source="night"),
            names.MOVE_SPEED: Limit(rate_per_s=2e-9, source="night"),
        },
        {names.PULSE: Limit(only=("corrector", "feedback"), interval_s=60.0, source="night")},
        region=Region((0.0, 0.0), (8e-6, 8e-6)),
    )
    watchdog = WatchdogSettings(
        stop_when=frozenset(plan.stop_when),
        dangerous=frozenset({ScopeState.SPEC.name, FEEDBACK_OFF}),
        retract=names.RETRACT,
        again_s=5.0,
        longest_s=20.0,
    )
    return SchedulerSettings(
        rules=Rules(
            RoleTable(end_experiment=("dawn",), set_mode=_PEOPLE, clear_problems=_PEOPLE, operate=("adjuster",)),
            adjustable=frozenset({names.ZCTRL_SETPOINT}),
        ),
        control=ControlSettings(
            lease_s=plan.lease_s, grace_s=10.0, stopped_by_hand="repeat" if plan.repeats else "pause"
        ),
        watchdog=watchdog,
        limits=limits,
        envelopes=Envelopes(),
        cache_bytes=20_000,
    )


def _policy() -> ChildPolicy:
    liveness = LivenessPolicy(beat_period_s=5.0, missed_beats=3, longest_step_s=30.0)
    return ChildPolicy(liveness, RestartPolicy(budget=10**6, longest_delay_s=5.0))
