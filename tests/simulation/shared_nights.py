"""Nights of components that share a microscope, each with settings of its own.

    python -m tests.simulation.shared_nights 200

Plans state different settings, or none; sweeps, curves, a solver, decisions and a person change values in between. The
scheduler, the translator and the components are real, and die at random. In the truth of the simulation, each published
measurement must have been taken with the settings that its plan states, or with what the log has said takes their
place, and with the base for all others. The base is the value at the start, or the last decision: of a person at the
panel, or of a component by a plain `scope.set`.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import random
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal
from unittest.mock import patch

from afspm import Component, Region, wire
from afspm.basics.errors import AfspmError, ControlLost, NoResponse, Refused
from afspm.components.planned_scans import ListedRegion, ScanList, ScanSeries
from afspm.components.spectroscopy_grid import SpectroscopyGrid
from afspm.components.sweep import KEY, Sweep
from afspm.components.sweep_at import SweepAt
from afspm.model import ControlMode, ControlRequest, JournalEntry, MeasurementConditions, Problem, Request, Spectrum
from afspm.model import names as n
from afspm.model.events import ControlEvent
from afspm.scheduler.loans import Loan, LoanBook
from afspm.scheduler.overrulings import PlanBook
from afspm.scheduler.requests import lending
from afspm.testing import Bench

MUTANTS: Final[Mapping[str, tuple[Any, str, Any]]] = {
    "compares nothing": (LoanBook, "compared", lambda book, settings, kind: (book, {})),
    "sets nothing back": (LoanBook, "due", lambda book, action, kind: []),
    "states for ever": (LoanBook, "nothing_stated", lambda book: book),
    "base is the last loan": (
        LoanBook,
        "sending",
        lambda book, key, now, value, lender, kind: book._with(key, Loan(now, value, lender or "x", kind)),
    ),
    "a person's value is a base alone": (PlanBook, "instead", lambda book, lender, key, planned: planned),
    "answers before all is set": (lending, "_in_order", lambda draft, found, way: tuple(way[:1])),
}
"""Parts of the book of loans that are left out, each of which a night must see."""
LASTS_S = 60.0
RETURNED_WITHIN_S = 60.0  # an end waits for returns, and a lender that has gone is given up after a while

SHOWN: Final = (n.TIP_BIAS_VOLTAGE, n.ZCTRL_SETPOINT, n.ZCTRL_PGAIN, n.ZCTRL_IGAIN)  # the truth shows each change
OF_SCANS: Final = (*SHOWN, n.SCAN_SPEED)
OF_CURVES: Final = (n.SPEC_FROM, n.SPEC_TO, n.SPEC_POINTS)

_START_S = 1.75e9  # experiment time at the start of a bench
_SHAPE, _SIZE_M = (8, 8), (200e-9, 200e-9)
_UNSEEN_S = 0.3
_PLACE_TAKEN = re.compile(r"(\S+) measures at (\S+) ([^,]+?)(?:, set (.+); it states (.+)| (again), as it states)$")
_REFUSALS = (Refused, ControlLost, NoResponse)
_BASE = {
    **dict(zip(OF_SCANS, (0.1, math.nan, 0.1, 1500.0, 10e-6), strict=True)),
    **dict(zip(OF_CURVES, (-0.6, 0.6, 32.0), strict=True)),
}
_SETPOINTS = {"current": (100e-12, "A"), "amplitude": (0.7, "V")}
# values of plans and sweeps; setpoints here and below are in parts of the base
_OF_PLANS = ((-1.0, -0.5, 0.8, 1.2), (0.5, 1.2), (0.05, 0.6), (800.0, 2000.0, 3000.0), (5e-6, 20e-6, 40e-6))
_STATED = dict(zip(OF_SCANS, _OF_PLANS, strict=True))
_SWEPT = {n.TIP_BIAS_VOLTAGE: (-0.9, -0.7, 0.6, 0.9, 1.1), n.ZCTRL_SETPOINT: (0.4, 0.55, 1.1, 1.15)}
# first value and step of decisions, none of which has the value of another or of a plan
_STEPS = ((0.2, 1e-3), (0.6, 1e-3), (0.2, 1e-3), (1000.0, 1.0), (11e-6, 1e-8))
_DECIDED = dict(zip(OF_SCANS, _STEPS, strict=True))
_DECIDERS = ("person", "foreign", "solver")

Values = Mapping[str, float]
Place = tuple[str, int, int]  # "scan" or "spectrum", and its middle in nm


def scaled(name: str, value: float, setpoint: float) -> float:
    return value * setpoint if name == n.ZCTRL_SETPOINT else value


def decided(by: str, number: int, name: str, setpoint: float) -> float:
    """Return the value of a person's or component's decision of this number."""
    first, step = _DECIDED[name]
    return scaled(name, first + step * (100 * _DECIDERS.index(by) + 1 + number % 99), setpoint)


def decider(name: str, value: float, setpoint: float) -> str:
    """Return who alone decides this value; empty for a value of a plan or of the start."""
    if name not in _DECIDED:
        return ""
    first, step = _DECIDED[name]
    number = (value / scaled(name, 1.0, setpoint) - first) / step
    is_one = abs(number - round(number)) < 0.01 and 0 < number < 100 * len(_DECIDERS) and round(number) % 100
    return _DECIDERS[round(number) // 100] if is_one else ""


def _next_of(component: Component) -> int:
    count = component.memory["count"] = int(component.memory.get("count", 0)) + 1
    component.memory.save()
    return count


class Solver(Component):
    """A component that treats the tip or takes a test scan, both at the base, and clears the problem."""

    def __init__(self, seed: int, slot: int, setpoint: float) -> None:
        self.seed, self.slot, self.setpoint = seed, slot, setpoint

    def run(self) -> None:
        while True:
            self.scope.wait_until(lambda: int(Problem.TIP_SHAPE_CHANGED) in self.scope.control_state.problems)
            count = _next_of(self)
            draw = random.Random(f"solver {self.seed} {count}")
            with suppress(*_REFUSALS), self.scope.control(solving=Problem.TIP_SHAPE_CHANGED, timeout_s=60.0):
                if draw.random() < 0.5:
                    self.scope.action(n.PULSE, timeout_s=5.0)
                if draw.random() < 0.8:
                    self.scope.scan(region(self.slot, 0), shape=_SHAPE, timeout_s=60.0)
                if draw.random() < 0.2:  # as a tuner that has found a gain
                    found = decided("solver", count, n.ZCTRL_IGAIN, self.setpoint)
                    self.scope.set(n.ZCTRL_IGAIN, found, timeout_s=5.0)
                self.scope.clear(Problem.TIP_SHAPE_CHANGED)
            self.scope.wait_until(lambda: False, timeout_s=0.5)


class Flagger(Component):
    """A component that flags the problem now and then."""

    def __init__(self, seed: int) -> None:
        self.draw = random.Random(f"flagger {seed}")

    def run(self) -> None:
        while True:
            self.scope.wait_until(lambda: False, timeout_s=self.draw.uniform(6.0, 25.0))
            with suppress(*_REFUSALS):
                self.scope.flag(Problem.TIP_SHAPE_CHANGED)


class Foreign(Component):
    """A component that decides values by plain sets."""

    def __init__(self, seed: int, setpoint: float) -> None:
        self.seed, self.setpoint = seed, setpoint

    def run(self) -> None:
        while True:
            count = _next_of(self)
            draw = random.Random(f"foreign {self.seed} {count}")
            self.scope.wait_until(lambda: False, timeout_s=draw.uniform(4.0, 20.0))
            name = draw.choice(OF_SCANS)
            with suppress(*_REFUSALS), self.scope.control(timeout_s=60.0):
                self.scope.set(name, decided("foreign", count, name, self.setpoint), timeout_s=5.0)


class Own(Component):
    """A component of a user's own, which states its settings with a measurement or for a block."""

    def __init__(self, slot: int, first: Values, second: Values) -> None:
        self.slot, self.first, self.second, self.third = slot, first, second, {n.ZCTRL_IGAIN: 2000.0}

    def stated(self) -> dict[Place, Values]:
        """Return the settings of each measurement of a round."""
        both, of_curve = {**self.first, **self.second}, {**self.second, n.SPEC_POINTS: 24.0}
        scans: tuple[Values | None, ...] = (self.first, {}, None, self.first, both, {**both, **self.third}, self.first)
        found = {place("scan", self.slot, step): one for step, one in enumerate(scans) if one is not None}
        return {**found, place("spectrum", self.slot, 2): of_curve, place("spectrum", self.slot, 7): {}}

    def run(self) -> None:
        scope: Any = self.scope
        while True:
            with suppress(*_REFUSALS):
                self._scan(0, settings=self.first)
                self._scan(1)
                of_curve = {**self.second, n.SPEC_POINTS: 24}
                scope.spectrum(at(self.slot, 2), kind="IV", settings=of_curve, timeout_s=60.0)
                with scope.settings(self.first):
                    self._scan(3)
                    with scope.settings(self.second):
                        self._scan(4)
                        self._scan(5, settings=self.third)
                    self._scan(6)
                scope.spectrum(at(self.slot, 7), kind="IV", timeout_s=60.0)
            scope.wait_until(lambda: False, timeout_s=8.0)

    def _scan(self, step: int, **settings: Any) -> None:
        self.scope.scan(region(self.slot, step), shape=_SHAPE, timeout_s=60.0, **settings)


@dataclass(frozen=True)
class Plan:
    """A component of a night, and the settings that it states at each place; a sweep has `points` of its parameter."""

    name: str
    component: Component
    states: Mapping[Place, Values] = field(default_factory=dict)
    swept: str = ""
    points: tuple[float, ...] = ()

    @property
    def kind(self) -> str:
        return self.name.rstrip("0123456789").rstrip("_")

    def says(self, name: str, value: float) -> bool:
        """Return whether the plan states this value anywhere."""
        points = self.points if name == self.swept else ()
        stated = (states[name] for states in self.states.values() if name in states)
        return any(same(value, one) for one in (*points, *stated))


def at(slot: int, step: int) -> tuple[float, float]:
    return (slot * 1e-6, step * 300e-9)


def region(slot: int, step: int) -> Region:
    return Region(at(slot, step), _SIZE_M)


def place(what: str, slot: int, step: int) -> Place:
    return (what, slot * 1000, step * 300)


def plans(seed: int, setpoint: float) -> list[Plan]:
    """Return the components of a night: two to five, and where one solves a problem perhaps one that flags it."""
    draw = random.Random(f"plans {seed}")
    scans = ("scan_series", "scan_list")
    kinds = [*scans, "bare", "sweep", "sweep_at", "grid", "curves", "foreign", "solver", "own"]
    found = [draw.choice(scans), *draw.sample(kinds, draw.randrange(1, 5))]
    made = [_plan(kind, slot, draw, seed, setpoint) for slot, kind in enumerate(found)]
    return [*made, Plan("flagger", Flagger(seed))] if "solver" in found and draw.random() < 0.7 else made


def _plan(kind: str, slot: int, draw: random.Random, seed: int, setpoint: float) -> Plan:
    name = f"{kind}_{slot}" if slot else kind  # the bench names its first component by the class
    first, second = _some(draw, setpoint), _some(draw, setpoint)
    match kind:
        case "scan_series" | "bare":
            states = first if kind == "scan_series" else {}
            made: dict[str, Any] = {"pixels": _SHAPE, "every": draw.uniform(1.0, 6.0), "parameters": dict(states)}
            series = ScanSeries(_SIZE_M, at(slot, 0), scans=draw.randrange(4, 30), **made)
            return Plan(name, series, {place("scan", slot, 0): states})
        case "scan_list":
            listed = [ListedRegion(at(slot, step), _SIZE_M) for step in range(2)]
            made = {"pixels": _SHAPE, "every": draw.uniform(2.0, 8.0), "parameters": dict(first)}
            scans = ScanList(listed, rounds=draw.randrange(2, 12), **made)
            return Plan(name, scans, {place("scan", slot, step): first for step in range(2)})
        case "sweep" | "sweep_at":
            swept = draw.choice(tuple(_SWEPT))
            points = tuple(scaled(swept, one, setpoint) for one in _SWEPT[swept])
            if kind == "sweep_at":
                read = [one for one in SHOWN if one != swept]
                made = {"positions": [at(slot, 0)], "repeats": draw.randrange(2, 8), "settle": 0.2}
                return Plan(name, SweepAt(swept, list(points), read, **made), {}, swept, points)
            made = {"order": "listed", "repeat": draw.randrange(3, 12)}
            if is_of_scans := draw.random() < 0.5:
                made |= {"measure": "scan", "size": _SIZE_M, "center": at(slot, 0), "pixels": _SHAPE}
            else:
                made |= {"measure": "spectrum", "at": at(slot, 0), "kind": "IV"}
            where = place("scan" if is_of_scans else "spectrum", slot, 0)
            each = tuple(point for point in points for _ in range(made["repeat"]))
            return Plan(name, Sweep({swept: list(points)}, **made), {where: {}}, swept, each)
        case "grid" | "curves":
            curve: dict[str, Any] = {"sweep": ["-0.4 V", "0.4 V"], "points": 16} if kind == "curves" else {}
            positions = [at(slot, step) for step in range(3)]
            grid = SpectroscopyGrid(positions=positions, kind="IV", curve=curve, repeats=draw.randrange(2, 7))
            states = dict(zip(OF_CURVES, (-0.4, 0.4, 16.0), strict=True)) if curve else {}
            return Plan(name, grid, {place("spectrum", slot, step): states for step in range(3)})
        case "solver":
            return Plan(name, Solver(seed, slot, setpoint), {place("scan", slot, 0): {}})
        case "own":
            own = Own(slot, first, second)
            return Plan(name, own, own.stated())
    return Plan(name, Foreign(seed, setpoint))


def _some(draw: random.Random, setpoint: float) -> Values:
    some = draw.sample(OF_SCANS, draw.randrange(1, 4))
    return {name: scaled(name, draw.choice(_STATED[name]), setpoint) for name in some}


@dataclass(frozen=True)
class Event:
    """An event at a time after the start: of a process by its name, or an act at the panel with parameter and value."""

    at_s: float
    does: Literal["manual", "continue", "panel", "flag", "clear", "kill", "give up"]
    process: str = ""
    act: tuple[str, float] = ("", math.nan)


def events(seed: int, cast: Sequence[Plan], setpoint: float) -> list[Event]:
    """Return the events of a night, in any order."""
    draw = random.Random(f"events {seed}")
    found: list[Event] = []
    acts: list[float] = [draw.uniform(2.0, LASTS_S - 5.0) for _ in range(draw.randrange(3))]
    for _ in range(draw.randrange(3)):
        from_s, for_s = draw.uniform(2.0, LASTS_S - 15.0), draw.uniform(2.0, 8.0)
        found += [Event(from_s, "manual"), Event(from_s + for_s, "continue")]
        acts += [from_s + draw.uniform(0.5, for_s - 0.5)] if draw.random() < 0.6 else []
    for number, at_s in enumerate(acts):
        name = draw.choice(SHOWN)
        found.append(Event(at_s, "panel", act=(name, decided("person", number, name, setpoint))))
    others = [one.name for one in cast]
    for _ in range(draw.randrange(4)):
        found.append(Event(draw.uniform(1.0, LASTS_S), "kill", draw.choice((*others, "scheduler", "translator"))))
    if draw.random() < 0.3:
        found.append(Event(draw.uniform(3.0, LASTS_S), "give up", draw.choice(others)))
    if any(one.kind == "solver" for one in cast):
        found += [Event(draw.uniform(2.0, LASTS_S - 15.0), "flag") for _ in range(draw.randrange(4))]
        found.append(Event(LASTS_S - 8.0, "clear"))  # the solver may have been given up
    return [*found, Event(LASTS_S - 2.0, "manual")] if draw.random() < 0.1 else found


def play(seed: int, folder: Path, lasts_s: float = LASTS_S) -> Evidence:
    """Play the night of a seed, or its beginning, to the end of its run."""
    draw = random.Random(seed)
    mode = draw.choice(tuple(_SETPOINTS))
    setpoint, unit = _SETPOINTS[mode]
    first, *others = cast = plans(seed, setpoint)
    happens = [one for one in events(seed, cast, setpoint) if one.at_s < lasts_s]
    evidence = Evidence(seed, cast, {**_BASE, n.ZCTRL_SETPOINT: setpoint}, setpoint, happens, _START_S + lasts_s)
    base, units = evidence.base, {n.TIP_BIAS_VOLTAGE: "V", n.ZCTRL_SETPOINT: unit}
    loop = {"setpoint": setpoint, "proportional_gain": base[n.ZCTRL_PGAIN], "integral_gain": base[n.ZCTRL_IGAIN]}
    initial = {n.TIP_BIAS_VOLTAGE: f"{base[n.TIP_BIAS_VOLTAGE]} V", n.SCAN_SPEED: f"{base[n.SCAN_SPEED]} m/s"}
    acts = [(one.at_s, *one.act) for one in happens if one.does == "panel"]
    bench = Bench(
        first.component,
        others={one.name: one.component for one in others},
        microscope={
            "seed": seed,
            "surface": "flat",
            "feedback": {"mode": mode, **loop},
            "iv": {"range_v": base[n.SPEC_TO], "points": int(base[n.SPEC_POINTS]), "duration_s": 0.3},
            "initial": {**initial, n.MOVE_SPEED: "1 mm/s"},
            "panel": [{"at_s": at_s, "set": {name: f"{value!r} {units.get(name, '')}"}} for at_s, name, value in acts],
        },
        folder=folder,
        seed=seed,
        dies_in_call=draw.choice((0.0, 0.0, 0.002)),
    )
    does: dict[str, Callable[[str], None]] = {
        "flag": lambda _: bench.flag(Problem.TIP_SHAPE_CHANGED),
        "clear": lambda _: bench.clear(Problem.TIP_SHAPE_CHANGED),
        "manual": lambda _: bench.set_mode(ControlMode.MANUAL),
        "continue": lambda _: bench.set_mode(ControlMode.AUTOMATED),
        "kill": bench.kill,
        "give up": lambda name: bench.kill(name, restarts=False),
    }
    for one in happens:
        if one.does != "panel":  # the simulated microscope plays these
            bench.at(one.at_s, does[one.does], one.process)
    with _log_to(lambda text: evidence.said.append((_START_S + bench.now_s, text))):
        try:
            _run(bench, lasts_s, evidence.errors)
            bench._person.ask(Request(ControlRequest.END_EXPERIMENT))
            _run(bench, lasts_s + RETURNED_WITHIN_S, evidence.errors)
        finally:
            bench.close()
    controller = bench._microscope._simulator._controller
    assert controller is not None
    evidence.left = {name: float(controller._si()[name]) for name in (*OF_SCANS, *OF_CURVES)}
    evidence.take(bench)
    (file,) = folder.rglob("truth.jsonl")
    lines = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    evidence.truth = {line["n"]: line for line in lines}  # a kill may repeat a line
    return evidence


def _run(bench: Bench, until_s: float, errors: list[str]) -> None:
    while True:
        try:
            return bench.run(until=until_s)
        except AfspmError as error:  # it has ended a component, and the others go on
            errors.append(f"{type(error).__name__}: {error}")


@contextmanager
def _log_to(say: Callable[[str], None]) -> Iterator[None]:
    class Keeper(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            say(record.getMessage())

    log, scheduler, keeper = logging.getLogger("afspm"), logging.getLogger("afspm.simulated-scheduler"), Keeper()
    before = (log.level, log.propagate, scheduler.disabled)
    log.addHandler(keeper)
    log.level, log.propagate, scheduler.disabled = logging.INFO, False, False  # a bench keeps its scheduler silent
    try:
        yield
    finally:
        log.removeHandler(keeper)
        log.level, log.propagate, scheduler.disabled = before


@dataclass
class Evidence:
    """What a night has left behind."""

    seed: int
    plans: list[Plan]
    base: dict[str, float]  # at the start
    setpoint: float  # at the start
    events: list[Event]
    ended_s: float  # by a person
    truth: dict[int, dict[str, Any]] = field(default_factory=dict)  # by the number of the line
    conditions: list[MeasurementConditions] = field(default_factory=list)
    curves: dict[int | None, Spectrum] = field(default_factory=dict)
    journal: list[JournalEntry] = field(default_factory=list)
    modes: list[tuple[float, bool]] = field(default_factory=list)  # time, and whether it is AUTOMATED
    said: list[tuple[float, str]] = field(default_factory=list)  # in the log
    left: dict[str, float] = field(default_factory=dict)  # in force after the end
    errors: list[str] = field(default_factory=list)  # that have ended components

    def take(self, bench: Bench) -> None:
        """Take over what the bench has published."""
        found = {(one.filename, one.time_ns): one for one in bench.published("MeasurementConditions")}
        self.conditions = list(found.values())  # a restarted scheduler publishes the newest again
        self.curves = {one.time_ns: one for one in bench.published("Spec1d")}
        self.journal = [entry for published in bench.published("JournalEntries") for entry in published.entries]
        notes = (one for one in self.journal if one.kind != "request")
        self.said += [(one.time_ns / 1e9, f"{one.what} {one.reason}") for one in notes]
        states = (one for one in bench.packets if one.envelope == "ControlState")
        modes = (((one.time_ns or 0) / 1e9, wire.decode("ControlState", one.payload).mode) for one in states)
        self.modes = [(at_s, mode is ControlMode.AUTOMATED) for at_s, mode in modes]

    def is_automated(self, from_s: float, to_s: float) -> bool:
        """Return whether the mode was AUTOMATED at any time between these."""
        at_first = next((is_so for at_s, is_so in reversed(self.modes) if at_s <= from_s), True)
        return at_first or any(is_so for at_s, is_so in self.modes if from_s < at_s <= to_s)

    def key(self, what: str, at_s: float) -> str:
        """Return the key of the measurement that began at a time; empty if the journal lacks the request."""
        action = n.START_SCAN if what == "scan" else n.START_SPEC
        starts = ((one.sent_ns or 0, one) for one in self.journal if one.subject == action)
        found = (one.key for sent_ns, one in starts if sent_ns / 1e9 - 1e-3 <= at_s <= one.time_ns / 1e9 + 1e-3)
        return next(found, "")

    def instead(self, plan: str, name: str, at_s: float) -> tuple[float, float] | None:
        """Return the value that takes the place of a plan's, and the stated one, as the log said; None: the plan's."""
        found = ((at, _PLACE_TAKEN.match(text)) for at, text in self.said if at <= at_s)
        of_plan = [one for _, one in found if one is not None and one.group(1, 2) == (plan, name)]
        if not of_plan or of_plan[-1][6]:
            return None
        return _numbers(of_plan[-1][3])[0], _numbers(of_plan[-1][5])[0]

    def says_left(self, name: str, value: float) -> bool:
        """Return whether the log says at the end that a parameter has this value."""
        is_manual = bool(self.modes) and not self.modes[-1][1]  # then it was said as MANUAL began
        before_s = [at_s for at_s, is_automated in self.modes if is_automated] if is_manual else [self.ended_s]
        since_s = max(before_s, default=0.0)
        texts = (text.partition(name)[2] for at_s, text in self.said if at_s >= since_s and name in text)
        return any(same(one, value, 0.01) for text in texts for one in _numbers(text))


@dataclass(frozen=True)
class Decision:
    """A decided value, the value before, and whether a person or solver may have meant a plan by it."""

    at_s: float
    name: str
    value: float
    before: float
    by: str
    is_for_plans: bool


@dataclass
class Taken:
    """A measurement in the truth, with the values at its begin, and the changes until its end."""

    at_s: float
    where: Place
    values: dict[str, float]
    end_s: float = math.inf
    changes: list[tuple[float, str, float]] = field(default_factory=list)


@dataclass(frozen=True)
class Fault:
    """A wrong value."""

    kind: str
    seed: int
    where: str
    name: str
    found: float
    right: tuple[float, ...]

    def __str__(self) -> str:
        right = " or ".join(f"{value:g}" for value in self.right)
        return f"seed {self.seed}, {self.where}: {self.name} {self.found:g}, right is {right} ({self.kind})"


class Night:
    """The verdict on a night, with the number of measurements and events that it met by kind."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        self.decisions: list[Decision] = []
        self.faults: list[Fault] = []
        self.met: Counter[str] = Counter()
        self._history: list[tuple[float, dict[str, float]]] = []  # values shown by the truth
        self._taken: dict[str, Taken] = {}  # by file
        self._treated: list[tuple[float, dict[str, float]]] = []
        self._read_truth()
        self._judge_measurements()
        for at_s, values in self._treated:
            self._count("treatment", at_s)
            for name in SHOWN:
                self._compare(f"treatment after {at_s - _START_S:.1f} s", name, values[name], (self.base(name, at_s),))
        for name, value in evidence.left.items():
            if not evidence.says_left(name, value):
                self._compare("end", name, value, (self.base(name, math.inf),), kind="left at the end, not said")
        self._count_events()

    @property
    def measured(self) -> int:
        return sum(count for what, count in self.met.items() if what.startswith("measurement"))

    def base(self, name: str, at_s: float) -> float:
        """Return the base of a parameter at a time."""
        of_name = (one.value for one in reversed(self.decisions) if one.name == name and one.at_s <= at_s)
        return next(of_name, self.evidence.base[name])

    def _read_truth(self) -> None:
        now, reached_s = {name: self.evidence.base[name] for name in OF_SCANS}, 0.0
        running: dict[tuple[str, int], Taken] = {}
        for entry in self.evidence.journal:
            # a component may decide the same value again, and the truth shows a speed only at the next scan
            if entry.subject in OF_SCANS and entry.response == 0 and entry.sent_ns:
                self._decided(entry.sent_ns / 1e9, entry.subject, float(entry.value), math.nan, entry.who)
        for _, line in sorted(self.evidence.truth.items()):
            # an act at the panel has its own time, and takes effect at the next look at the controller
            reached_s, event = max(reached_s, line["time_s"]), line["event"]
            what, _, did = event.partition(" ")
            if event in ("conditions", "scan starts"):
                for name, value in _shown(line.get("setup", line)).items():
                    if not same(value, now[name]):
                        self._decided(reached_s, name, value, now[name])
                        for one in running.values():
                            one.changes.append((line["time_s"], name, value))
                    now[name] = value
                self._history.append((reached_s, dict(now)))
            if did == "starts":
                x, y = line["setup"]["center_m"] if what == "scan" else line["position_m"]
                values = {name: now[name] for name in (OF_SCANS if what == "scan" else SHOWN)}
                taken = Taken(line["time_s"], (what, round(x * 1e9), round(y * 1e9)), values)
                running[what, line["number"]] = taken
            elif did == "ends":
                running[what, line["number"]].end_s = line["time_s"]
            elif event == "crash":
                self._count("crash of the tip")
            elif event == "pulse":
                self._treated.append((line["time_s"], dict(now)))
            elif "file" in line:
                self._taken[line["file"]] = running.pop((what, int(re.split("[-.]", line["file"])[1])))

    def _decided(self, at_s: float, name: str, value: float, before: float, who: str | None = None) -> None:
        by = decider(name, value, self.evidence.setpoint)
        is_known = any(one.name == name and same(one.value, value) for one in self.decisions)
        if not by or (is_known if who is None else not who.startswith(by)):
            return
        acts = (one.at_s for one in self.evidence.events if one.act[0] == name and same(one.act[1], value))
        by_person = by == "person" and self.evidence.is_automated(_START_S + next(acts, math.inf), at_s)
        self.decisions.append(Decision(at_s, name, value, before, by, by_person or by == "solver"))
        self.decisions.sort(key=lambda one: one.at_s)

    def _judge_measurements(self) -> None:
        of_place = {where: (one, states) for one in self.evidence.plans for where, states in one.states.items()}
        for one in self.evidence.conditions:
            curve, file = self.evidence.curves.get(one.time_ns), Path(one.filename).name
            if one.filename and file in self._taken:
                taken = self._taken[file]
                plan, states = of_place.get(taken.where, (None, {}))
                if plan is None or plan.name != one.holder:
                    # a region of another was lost on its way: the result does not fit, and is measured again
                    self._count("measurement at the place of another")
                    continue
                self._judge(file, taken, curve, plan, states)
            elif curve is not None:
                plan = next(each for each in self.evidence.plans if each.name == one.holder)
                self._judge_sweep_at(plan, (one.began_ns or 0) / 1e9, one.time_ns / 1e9, curve)

    def _judge(self, file: str, taken: Taken, curve: Spectrum | None, plan: Plan, states: Values) -> None:
        self._count(f"measurement of {plan.kind}")
        key = self.evidence.key(taken.where[0], taken.at_s)
        number = re.fullmatch(f"{KEY}-(\\d+)", key) if plan.swept else None
        points = (plan.points[int(number[1]) - 1],) if number else plan.points
        for name, value in {**taken.values, **({} if curve is None else _of_curve(curve))}.items():
            right = accepted(plan, states, name, self, taken.at_s)
            if name == plan.swept:  # an act that no poll can have seen before the begin is not repaired
                just_before = (one for one in self.decisions if 0.0 <= taken.at_s - one.at_s < _UNSEEN_S)
                right = (*points, *(one.value for one in just_before if one.name == name and one.by == "person"))
            self._compare(f"{plan.name} {key} {file}", name, value, right, plan)
        for at_s, name, value in taken.changes:
            if at_s < taken.end_s and any(same(one.value, value) for one in self.decisions if one.name == name):
                self._count("act in a measurement")
            elif at_s < taken.end_s:
                self._compare(f"within {plan.name} {key} {file}", name, value, (taken.values[name],), plan)

    def _judge_sweep_at(self, plan: Plan, began_s: float, ended_s: float, curve: Spectrum) -> None:
        self._count(f"measurement of {plan.kind}")
        for column, name in enumerate(curve.names):
            meanwhile = [one.value for one in self.decisions if one.name == name and began_s <= one.at_s <= ended_s]
            for point, value in zip(plan.points, curve.values[:, column], strict=True):
                right = (point,) if name == plan.swept else (self.base(name, began_s), *meanwhile)
                self._compare(f"{plan.name} after {ended_s - _START_S:.1f} s", name, float(value), right, plan)

    def _compare(
        self, where: str, name: str, value: float, right: tuple[float, ...], plan: Plan | None = None, kind: str = ""
    ) -> None:
        if not any(same(value, one) for one in right):
            kind = kind or self._kind(plan, name, value)
            self.faults.append(Fault(kind, self.evidence.seed, where, name, value, right))

    def _kind(self, plan: Plan | None, name: str, value: float) -> str:
        what = "treatment" if plan is None else plan.kind if plan.swept else "measurement"
        others = [one for one in self.evidence.plans if one is not plan and one.says(name, value)]
        if by := decider(name, value, self.evidence.setpoint):
            return f"{what} with a decision of {by} that is not its"
        if others:
            return f"{what} with a value of another {'sweep' if others[0].swept == name else 'plan'}"
        if plan is not None and plan.says(name, value):
            return f"{what} with a value of its own plan, which is not stated for it"
        is_first = same(value, self.evidence.base[name])
        return f"{what} with {'the value at the start' if is_first else 'an unknown value'}"

    def _count_events(self) -> None:
        kinds = {one.name: one.kind for one in self.evidence.plans}
        for one in self.evidence.events:
            at_s, does = _START_S + one.at_s, f"{one.does} {kinds.get(one.process, one.process)}".strip()
            in_mode = "AUTOMATED" if self.evidence.is_automated(at_s, at_s) else "MANUAL"
            self._count(f"panel in {in_mode}" if one.does == "panel" else does, at_s)
        for decision in self.decisions:
            if decision.by != "person":
                self._count(f"set by {decision.by}", decision.at_s)
        for entry in self.evidence.journal:
            if entry.event in (ControlEvent.PROBLEM_FLAGGED, ControlEvent.CONTROL_LOST) and "gave" not in entry.reason:
                self._count(entry.event.name.lower().replace("_", " "), entry.time_ns / 1e9)
        for error in self.evidence.errors:
            self._count(f"component ended by {error}")

    def _count(self, what: str, at_s: float = 0.0) -> None:
        values: Values = next((values for since_s, values in reversed(self._history) if since_s < at_s), {})
        is_lent = any(not same(value, self.base(name, at_s)) for name, value in values.items())
        self.met[f"{what}, off the base" if is_lent else what] += 1


def accepted(plan: Plan, states: Values, parameter: str, night: Night, at_s: float) -> tuple[float, ...]:
    """Return the values that a plan with these settings may measure with at a time.

    What takes the place of a plan's value must have been said before; an act right before the begin is seen after it.
    """
    if parameter not in states:
        return (night.base(parameter, at_s),)
    acts = [one for one in night.decisions if one.name == parameter and one.by == "person" and one.at_s <= at_s]
    unseen = [one.value for one in acts if at_s - one.at_s < _UNSEEN_S]
    place = night.evidence.instead(plan.name, parameter, at_s)
    if place is None or not same(place[1], states[parameter], 0.01):
        return (states[parameter], *unseen)
    night.met["measured with a decision in the place of the plan's value"] += 1
    # the log rounds
    return (*(one.value for one in night.decisions if same(one.value, place[0], 1e-3)), *unseen)


def same(one: float, other: float, within: float = 1e-5) -> bool:
    return math.isclose(one, other, rel_tol=within)


def _shown(line: Mapping[str, Any]) -> dict[str, float]:
    loop = line["feedback"]
    values = (line["bias_v"], loop["setpoint"], loop["proportional_gain"], loop["integral_gain"])
    speed = {n.SCAN_SPEED: 2.0 * line["size_m"][0] / line["line_s"]} if "line_s" in line else {}
    return {**dict(zip(SHOWN, values, strict=True)), **speed}


def _of_curve(curve: Spectrum) -> dict[str, float]:
    swept = [float(value) for value in curve.values[:, 0]]
    return dict(zip(OF_CURVES, (min(swept), max(swept), float(len(set(swept)))), strict=True))


def _numbers(text: str) -> list[float]:
    prefixes = {"f": 1e-15, "p": 1e-12, "n": 1e-9, "\u00b5": 1e-6, "u": 1e-6, "m": 1e-3, "k": 1e3, "": 1.0}
    found = re.findall(r"([-\u2212]?\d*\.?\d+(?:e[-+]?\d+)?) ?([fpn\u00b5umk]?)", text)
    return [float(number.replace("\u2212", "-")) * prefixes[prefix] for number, prefix in found]


def night(seed: int, folder: Path, mutant: str = "", lasts_s: float = LASTS_S) -> Night:
    """Return the verdict on the night of a seed, or on its beginning."""
    owner, name, other = MUTANTS.get(mutant, (LoanBook, "due", LoanBook.due))
    with patch.object(owner, name, other):
        return Night(play(seed, folder, lasts_s))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("nights", type=int)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first night")
    parser.add_argument("--mutant", default="", choices=MUTANTS, help="leave a part out")
    given = parser.parse_args()
    found = []
    for seed in range(given.seed, given.seed + given.nights):
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            found.append(night(seed, Path(folder), given.mutant))
    sys.stdout.write(report(found))
    return 1 if any(one.faults for one in found) else 0


def report(found: Sequence[Night]) -> str:
    """Return the number of wrong nights, their faults by kind, and how often each kind of event was met."""
    wrong = [one for one in found if one.faults]
    shown = wrong[0].faults if len(found) == len(wrong) == 1 else [one.faults[0] for one in wrong[:3]]
    kinds = Counter(fault.kind for one in wrong for fault in one.faults)
    seeds = {
        kind: sorted({fault.seed for one in wrong for fault in one.faults if fault.kind == kind}) for kind in kinds
    }
    met = sum((one.met for one in found), Counter[str]())
    measured = sum(one.measured for one in found)
    lines = [f"{len(wrong)} of {len(found)} nights wrong, {measured} measurements", *(f"  {one}" for one in shown)]
    lines += ["faults, nights, first seeds:"]
    lines += [f"{count:6} {len(seeds[kind]):5}  {kind} {seeds[kind][:3]}" for kind, count in kinds.most_common()]
    return "\n".join((*lines, "met:", *(f"{count:6} {kind}" for kind, count in sorted(met.items())), ""))


if __name__ == "__main__":
    raise SystemExit(main())
