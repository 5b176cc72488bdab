"""A person acts at the panel at moments between and in the requests of a run: which complete results are wrong then?

python -m tests.plugins.acts_at_wire_moments --cases 84     # of each maker, with a person and without

A case follows from maker and number: what the run measures, what the person does once, and when. The run is a peer of
the translator that repeats what was interrupted and stops after an act by hand, as components of a run do. The verdict
is the emulator's: `Truth` records every measurement and every change of the panel in the emulator's own thread.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from threading import Timer
from typing import Any, Final

import numpy as np

ROOT: Final = Path(__file__).parents[2]
for _folder in (ROOT, ROOT / "tests" / "support", ROOT / "tests" / "plugins"):
    if str(_folder) not in sys.path:
        sys.path.insert(0, str(_folder))

from tests.plugins.vendor_bench import Peer, VendorBench  # noqa: E402 (found by the path above)

from afspm.model import (  # noqa: E402
    ActByHand,
    ControlRequest,
    ControlResponse,
    PanelAct,
    Parameter,
    ProbePosition,
    Region,
    Scan,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    Spectrum,
    names,
)

FRAME: Final = Region((40e-9, -25e-9), (320e-9, 200e-9), 0.0)
SHAPE: Final = (8, 16)
ASIDE_M: Final = 90e-9
"""How far the person moves the frame."""
SCAN_S: Final = 0.4
WAITS_S: Final = 30.0
"""How long the run waits for a microscope that is not free, or for a measurement that does not end: real seconds."""
DELAYS_MS: Final = (0, 5, 20, 50, 100)
_OFF_AGAIN_S: Final = 0.03
_PAUSED_S: Final = 0.3
_BRIEF_S: Final = 0.3
"""No reading of the run sees what a person has put right so soon after an end."""
_MATCHES: Final = 0.02
"""Largest difference of a published value from the true one, as a share of the standard deviation of its channel."""
_FACTORS: Final = (1.0, 1e9, 60e-9)
"""From true values to published ones: GXSM's current in nA, Asylum's amplitude in m."""
ENDING: Final = frozenset(
    {PanelAct.STOP, PanelAct.PAUSE, PanelAct.WITHDRAW, PanelAct.FEEDBACK_OFF, PanelAct.CONTRADICTION}
)
"""Acts after which the mode of a run is MANUAL."""
Hand = Callable[[Any], object]


# --- the panels ---


@dataclass(frozen=True)
class Panel:
    """What a person can do at an emulated panel; each in the emulator's thread.

    Attributes:
        value: parameter that a sweep sets, its unit's first values, and what a person sets it to.
        turn, shown: set that value, and return it as the panel shows it.
        feedback: switches the z feedback; None: the maker does not show it.
        withdraw: None: the maker does not show the tip.
        pause: pauses the scan, or lets it go on; None: not tried.
    """

    turn: Callable[[Any, float], object]
    shown: Callable[[Any], float]
    stop: Hand
    start: Hand
    move_frame: Hand
    feedback: Callable[[Any, bool], object] | None = None
    withdraw: Hand | None = None
    pause: Callable[[Any, bool], object] | None = None
    value: str = names.TIP_BIAS_VOLTAGE
    values: tuple[float, ...] = (0.12, 0.16, 0.2, 0.24, 0.28, 0.32)
    by_hand: float = 0.45
    settings: Mapping[str, Any] = field(default_factory=dict)


def _now_s(emulator: Any) -> float:
    now_s: float = emulator.clock.now_s()
    return now_s


def _call(emulator: Any, name: str, *arguments: object) -> None:
    emulator.software.functions.call(name, list(arguments))


def _stop_nanonis(emulator: Any) -> None:
    curve = emulator.software.spectra.running
    if curve is not None:
        _call(emulator, "BiasSpectr.Stop" if curve.kind == "IV" else "ZSpectr.Stop")
    _call(emulator, "Scan.Action", 1, 0)


def _move_nanonis(emulator: Any) -> None:
    x, y, *rest = emulator.software.scans.frame
    _call(emulator, "Scan.FrameSet", x + ASIDE_M, y, *rest)


def _stop_gxsm(emulator: Any) -> None:
    emulator.program.stop_scan()
    if emulator.program.curve is not None:
        emulator.program.curve = None
        emulator.rig.stop_spectrum(_now_s(emulator))


def _move_gxsm(emulator: Any) -> None:
    emulator.program.entries.set("OffsetX", repr(emulator.program.entries["OffsetX"] + ASIDE_M / 1e-10))


def _start_asylum(emulator: Any) -> None:
    emulator.controller.values.put("LastScan", 1)  # else one scan follows the other
    emulator.controller.scan(_now_s(emulator), None)


def _feedback_asylum(emulator: Any, on: bool) -> None:
    emulator.rig.switch_feedback(_now_s(emulator), on=on)


def _stop_asylum(emulator: Any) -> None:
    emulator.controller.stop(_now_s(emulator))


def _move_asylum(emulator: Any) -> None:
    controller = emulator.controller
    controller.put("XOffset", controller.values.get("XOffset") + ASIDE_M, _now_s(emulator))


def _stop_program(emulator: Any) -> None:
    emulator.program.stop_scan(_now_s(emulator))
    emulator.program.stop_curve()


def _start_program(emulator: Any) -> None:
    emulator.program.start_scan(_now_s(emulator))


def _move_park(emulator: Any) -> None:
    x_um = emulator.program.geometry["offsetX"]
    emulator.program.ask("call", "scan.setScanGeometry", [{"offsetX": x_um + ASIDE_M * 1e6}])


def _pause_nanosurf(emulator: Any, on: bool) -> None:
    (emulator.program.pause if on else emulator.program.resume)(_now_s(emulator))


def _move_nanosurf(emulator: Any) -> None:
    path = "imaging.frame_center_offset_x"
    emulator.program.put(path, emulator.program.values[path] + ASIDE_M)


PANELS: Final = {
    "nanonis": Panel(
        turn=lambda emulator, value: _call(emulator, "Bias.Set", value),
        shown=lambda emulator: emulator.rig.setup.bias_v,
        stop=_stop_nanonis,
        start=lambda emulator: emulator.software.scans.start(upwards=True),
        move_frame=_move_nanonis,
        feedback=lambda emulator, on: _call(emulator, "ZCtrl.OnOffSet", int(on)),
        withdraw=lambda emulator: _call(emulator, "ZCtrl.Withdraw", 0, -1),
    ),
    "gxsm": Panel(
        turn=lambda emulator, value: emulator.program.entries.set("dsp-fbs-bias", repr(value)),
        shown=lambda emulator: emulator.rig.setup.bias_v,
        stop=_stop_gxsm,
        start=lambda emulator: emulator.program.start_scan(),
        move_frame=_move_gxsm,
        feedback=lambda emulator, on: emulator.program.switch_feedback(on=on),
    ),
    "asylum": Panel(
        turn=lambda emulator, value: emulator.controller.put("TipVoltage", value, _now_s(emulator)),
        shown=lambda emulator: emulator.controller.values.get("TipVoltage"),
        stop=_stop_asylum,
        start=_start_asylum,
        move_frame=_move_asylum,
        feedback=_feedback_asylum,
        withdraw=_stop_asylum,
    ),
    "park": Panel(
        turn=lambda emulator, value: emulator.program.ask("set", "bias.tip", [value]),
        shown=lambda emulator: emulator.program.ask("get", "bias.tip", []),
        stop=_stop_program,
        start=_start_program,
        move_frame=_move_park,
        feedback=lambda emulator, on: emulator.program.ask("set", "zservo.enable", [on]),
    ),
    "nanosurf": Panel(
        turn=lambda emulator, value: emulator.program.put("z_control.setpoint", value),
        shown=lambda emulator: emulator.program.values["z_control.setpoint"],
        stop=_stop_program,
        start=_start_program,
        move_frame=_move_nanosurf,
        pause=_pause_nanosurf,
        value=names.ZCTRL_SETPOINT,
        values=(0.5, 0.55, 0.6, 0.65, 0.7, 0.75),
        by_hand=0.4,
    ),
}
MAKERS: Final = tuple(PANELS)


# --- a case ---


@dataclass(frozen=True)
class Moment:
    """When the person acts.

    Attributes:
        kind: "request": `delay_ms` after the request `number` of the run, counted from 0; "wire": after `calls` rounds
            of the emulator after that request, each of which answers what has arrived; "running": in the measurement
            `number`, after `share` of its time; "kill": `delay_ms` after the translator was killed.
    """

    kind: str
    number: int = 0
    delay_ms: float = 0.0
    calls: int = 0
    share: float = 0.0

    def __str__(self) -> str:
        return {
            "request": f"{self.delay_ms:g} ms after request {self.number}",
            "wire": f"{self.calls} rounds of the emulator after request {self.number}",
            "running": f"after {self.share:.0%} of measurement {self.number}",
            "kill": f"{self.delay_ms:g} ms after the kill",
            "never": "never",
        }[self.kind]


@dataclass(frozen=True)
class Case:
    """A run and the act of a person in it.

    Attributes:
        plan: "curves", "scans" or "sweep"; all other values follow from maker and number.
        act: what the person does; empty: nothing.
        killed_share: share of the time of the second measurement after which the translator is killed; 0: it is not.
    """

    maker: str
    number: int
    plan: str
    act: str
    moment: Moment
    curve_s: float
    hold_s: float
    hold_reads: str
    unscanned: str
    measurements: int
    killed_share: float = 0.0

    @classmethod
    def of(cls, maker: str, number: int) -> Case:
        """Return the case of this number: each kind of run meets each act in turn, at a random moment."""
        chance = random.Random(f"{maker}/{number}")
        kinds = acts_of(maker)
        act = kinds[number % len(kinds)]
        plan = ("curves", "scans", "sweep", "long curves", "killed curves", "killed scans")[
            (number // len(kinds) + number) % 6
        ]
        if act == "value" and chance.random() < 0.5:
            plan = "sweep"
        killed = plan.startswith("killed")
        measurements = {"curves": 5, "scans": 5, "sweep": 4, "long curves": 3}.get(plan, 3)
        requests = 2 if plan in ("scans", "killed scans") else 3
        moments = ["request", "wire", "running"] + (["kill"] * 3 if killed else [])
        kind = chance.choice(moments)
        number_of_request = chance.randrange(requests + (requests - 1) * (measurements - 1))
        moment = Moment(
            kind,
            number_of_request if kind in ("request", "wire") else chance.randrange(measurements),
            chance.choice((-100, -20, 0, 20, 50, 100, 300, 800) if kind == "kill" else DELAYS_MS),
            chance.randrange(12),
            chance.uniform(0.0, 1.15),
        )
        return cls(
            maker,
            number,
            plan.split()[-1],
            act,
            moment,
            curve_s=2.0 if plan == "long curves" else 0.4,
            hold_s=chance.choice((0.0, 0.05, 0.3)),
            hold_reads=chance.choice(("off", "on")),
            unscanned=chance.choice(("nan", "zeros")),
            measurements=measurements,
            killed_share=chance.uniform(0.05, 0.95) if killed else 0.0,
        )

    def without_a_person(self) -> Case:
        """Return the same run, longer, in which no one acts."""
        return replace(self, act="", moment=Moment("never"), measurements=4 * self.measurements)

    @property
    def emulator(self) -> dict[str, Any]:
        curve = {"duration_s": self.curve_s}
        settings: dict[str, Any] = {
            "seed": self.number + 1,
            "iv": curve,
            "force": curve,
            "feedback": {"hold_s": self.hold_s, "hold_reads": self.hold_reads},
        }
        return {**settings, "unscanned": self.unscanned} if self.maker == "nanonis" else settings

    def __str__(self) -> str:
        killed = f", translator killed after {self.killed_share:.0%} of the second" if self.killed_share else ""
        hold = f"hold {self.hold_s:g} s, reads {self.hold_reads}"
        return (
            f"{self.maker} {self.number}: {self.act or 'no one acts'} {self.moment}; {self.measurements} {self.plan}"
            f" (curves {self.curve_s:g} s, {hold}, unscanned {self.unscanned}){killed}"
        )


def acts_of(maker: str) -> tuple[str, ...]:
    """Return what a person can do at a maker's panel, of feedback and tip as far as the maker shows them."""
    panel = PANELS[maker]
    feedback = ("off", "off and on") if panel.feedback else ()
    more = (("withdraw", panel.withdraw), ("pause", panel.pause))
    return (*feedback, *(act for act, hand in more if hand), "value", "stop", "own", "frame", "replace")


# --- the truth ---


@dataclass(frozen=True)
class Look:
    """The panel at a time: feedback switched on, tip at the sample, the swept value."""

    time_s: float
    on: bool
    engaged: bool
    value: float


@dataclass
class Taken:
    """A measurement that the instrument began.

    Attributes:
        by_hand: True if the person began it.
        in_hold: True if the controller still held the feedback after an earlier spectrum.
        stopped_s: when a spectrum was stopped; None: it was not.
    """

    activity: Any
    by_hand: bool
    in_hold: bool
    begin: Look
    stopped_s: float | None = None

    @property
    def is_scan(self) -> bool:
        return bool(self.activity.what == "scan")

    @property
    def is_complete(self) -> bool:
        was_stopped = self.is_scan and self.activity.stopped_s is not None
        return self.stopped_s is None and not was_stopped

    @property
    def end_s(self) -> float:
        return float(self.activity.end_s if self.stopped_s is None else self.stopped_s)


class Truth:
    """What happens at the instrument, recorded in the emulator's thread."""

    def __init__(self, emulator: Any, panel: Panel, log: Callable[[str], None]) -> None:
        self._emulator, self._panel, self._log = emulator, panel, log
        self.looks: list[Look] = []
        self.taken: list[Taken] = []
        self.person_acts = self.person_starts = False
        self.on_begin: Callable[[Taken, int], None] = lambda taken, number: None
        self.on_round: Callable[[], None] = lambda: None
        self._plain_tick = emulator.tick
        rig = emulator.rig
        self._plain: dict[str, Callable[..., Any]] = {
            name: getattr(rig, name) for name in ("start_scan", "start_spectrum", "stop_spectrum")
        }
        emulator.tick = self._tick
        rig.start_scan = lambda now_s: self._started("start_scan", now_s, now_s)
        rig.start_spectrum = lambda kind, now_s, *rest, **curve: self._started(
            "start_spectrum", now_s, kind, now_s, *rest, **curve
        )
        rig.stop_spectrum = self._stopped
        self.look()

    def look(self) -> Look:
        rig = self._emulator.rig
        now = Look(
            _now_s(self._emulator), bool(rig.setup.feedback.on), rig.engaged, float(self._panel.shown(self._emulator))
        )
        if not self.looks or replace(now, time_s=self.looks[-1].time_s) != self.looks[-1]:
            self.looks.append(now)
        return now

    def at(self, time_s: float) -> Look:
        """Return the panel as it was at a time."""
        return next((look for look in reversed(self.looks) if look.time_s <= time_s), self.looks[0])

    def _tick(self, now_s: float) -> float | None:
        self.look()
        self.on_round()
        next_s: float | None = self._plain_tick(now_s)
        self.look()
        return next_s

    def _started(self, name: str, now_s: float, *given: Any, **curve: Any) -> Any:
        in_hold = self._emulator.rig.is_held(now_s)
        activity = self._plain[name](*given, **curve)
        is_by_hand = self.person_acts or (self.person_starts and name == "start_scan")
        self.person_starts = self.person_starts and not is_by_hand
        taken = Taken(activity, is_by_hand, in_hold, self.look())
        self.taken.append(taken)
        whose = "the person's" if taken.by_hand else "the run's"
        held = ", while the feedback was still held" if in_hold else ""
        self._log(f"instrument: {activity.what} {len(self.taken) - 1} begins, {whose}, {_place(activity)}{held}")
        self.on_begin(taken, len(self.taken) - 1)
        return activity

    def _stopped(self, now_s: float) -> None:
        running = next((one for one in reversed(self.taken) if not one.is_scan), None)
        if running is not None and running.activity is self._emulator.rig.spectrum and now_s < running.activity.end_s:
            running.stopped_s = now_s
            self._log("instrument: spectrum stopped")
        self._plain["stop_spectrum"](now_s)


def _place(activity: Any) -> str:
    x, y = activity.region.center_m if activity.what == "scan" else activity.position_m
    return f"at ({x * 1e9:.1f}, {y * 1e9:.1f}) nm"


class Person:
    """Acts once, at the moment of the case."""

    def __init__(self, made: VendorBench[Any], panel: Panel, case: Case, truth: Truth, log: Callable[[str], None]):
        self._made, self._panel, self._case, self._truth, self._log = made, panel, case, truth, log
        self.is_there = False
        self._asked_so_far = 0
        self.acted_s: float | None = None
        self.refused = ""
        self._rounds: int | None = None
        self._timers: list[Timer] = []
        self._is_armed = bool(case.act)
        truth.on_begin, truth.on_round = self._begun, self._round

    def asking(self) -> None:
        """Take note that the run sends a request now."""
        moment, number = self._case.moment, self._asked_so_far
        if self.is_there:
            self._asked_so_far += 1
        if not self.is_there or number != moment.number:
            return
        if moment.kind == "request":
            self.later(moment.delay_ms / 1e3)
        elif moment.kind == "wire":
            self._rounds = moment.calls

    def later(self, delay_s: float) -> None:
        """Act after some real time."""
        if self._is_armed:
            self._is_armed = False
            self._after(max(delay_s, 0.0), partial(self._do, self._made.emulator))

    def rest(self) -> None:
        """Do nothing any more."""
        self._is_armed = False
        for timer in self._timers:
            timer.cancel()
            timer.join()

    def _begun(self, taken: Taken, number: int) -> None:
        moment = self._case.moment
        if moment.kind == "running" and number == moment.number:
            self.later(moment.share * (taken.activity.end_s - taken.activity.start_s))

    def _round(self) -> None:
        if self._rounds is not None:
            self._rounds -= 1
            if self._rounds < 0:
                self._rounds = None
                if self._is_armed:
                    self._is_armed = False
                    self._do(self._made.emulator)

    def _after(self, delay_s: float, hand: Callable[[], object]) -> None:
        self._timers.append(Timer(delay_s, self._queue, [hand]))
        self._timers[-1].start()

    def _queue(self, hand: Callable[[], object]) -> None:
        self._made.emulator.to_do.put(hand)
        self._made.emulator.woken.post()

    def _do(self, emulator: Any) -> None:
        act = self._case.act
        self._truth.look()
        self.acted_s = _now_s(emulator)
        self._log(f"PERSON: {act} (the instrument does: {emulator.rig.doing(self.acted_s) or 'nothing'})")
        self._truth.person_acts = True
        try:
            self._hand(act, emulator)
        except Exception as error:  # the panel refuses: that is no act
            self.refused = f"{type(error).__name__}: {error}"
            self._log(f"PERSON: refused by the panel: {self.refused}")
        self._truth.person_acts = False
        self._truth.look()

    def _hand(self, act: str, emulator: Any) -> None:
        panel = self._panel
        if act in ("off", "off and on"):
            assert panel.feedback is not None
            panel.feedback(emulator, False)
            if act == "off and on":
                self._after(_OFF_AGAIN_S, partial(panel.feedback, emulator, True))
        elif act == "pause":
            assert panel.pause is not None
            panel.pause(emulator, True)
            self._after(_PAUSED_S, partial(panel.pause, emulator, False))
        elif act == "withdraw":
            assert panel.withdraw is not None
            panel.withdraw(emulator)
        elif act == "value":
            panel.turn(emulator, panel.by_hand)
        elif act == "frame":
            panel.move_frame(emulator)
        else:
            panel.stop(emulator)
            if act == "replace":
                panel.move_frame(emulator)
            if act in ("own", "replace"):
                before = len(self._truth.taken)
                panel.start(emulator)
                self._truth.person_starts = len(self._truth.taken) == before  # it begins after a ramp


# --- the run ---


@dataclass
class Wanted:
    """What the run asked for: of a measurement, with the time of its request."""

    number: int
    kind: str
    position_m: tuple[float, float] | None
    value: float | None
    sent_s: float = 0.0
    is_open: bool = False


@dataclass(frozen=True)
class Published:
    """A result of the run: what was wanted, and all its channels."""

    wanted: Wanted
    packet: Scan | Spectrum
    told_before: tuple[ActByHand, ...]

    @property
    def is_of_its_kind(self) -> bool:
        return isinstance(self.packet, Spectrum if self.wanted.kind == "curve" else Scan)


class Run:
    """A peer that measures as a component does, and what it received."""

    def __init__(self, made: VendorBench[Any], case: Case, panel: Panel) -> None:
        self._made, self._case, self._panel = made, case, panel
        self._begun_s = time.monotonic()
        self.events: list[str] = []
        made.at_panel(lambda emulator: setattr(self, "truth", Truth(emulator, panel, self.log)))
        self.truth: Truth
        self.person = Person(made, panel, case, self.truth, self.log)
        self.acts: list[ActByHand] = []
        self.results: list[Published] = []
        self.interrupted = self.repeats = self.measured = 0
        self.refused = ""
        self.unfinished = ""
        self._newest: Wanted | None = None
        self._states: list[ScopeState] = []
        self._newest_ns: dict[bytes, int] = {}
        """Over restarts: a translator that was killed publishes its last results again, which no component sees."""
        self._peer: Peer

    def log(self, text: str) -> None:
        self.events.append(f"{1e3 * (time.monotonic() - self._begun_s):8.1f} ms  {text}")

    @property
    def is_over(self) -> bool:
        return bool(self.refused or self.unfinished) or any(one.act in ENDING for one in self.acts)

    def measure(self) -> None:
        """Carry out the plan of the case."""
        case, panel = self._case, self._panel
        self._start_translator()
        speed_m_s = 2.0 * FRAME.size_m[0] / (SCAN_S / SHAPE[0])
        self._done(ControlRequest.SET_SCAN_PARAMS, ScanParameters(FRAME, SHAPE, ""), "set frame")
        for name, number in ((names.SCAN_SPEED, speed_m_s), (panel.value, panel.values[0])):
            self._done(ControlRequest.PARAM, Parameter(name, str(number)), f"set {name} {number:g}")
        assert not self.refused, self.refused
        self._settle(0.3)
        self.person.is_there = True
        is_curve, is_first = case.plan == "curves", True
        for number in range(case.measurements):
            place = (FRAME.center_m[0] + 8e-9 * (number % 5 - 2), FRAME.center_m[1] + 6e-9 * (number % 3 - 1))
            value = panel.values[number % len(panel.values)] if case.plan == "sweep" else None
            wanted = Wanted(number, "curve" if is_curve else "scan", place if is_curve else None, value)
            self._measure_one(wanted, sets_frame=is_first)
            is_first = False
            if self.is_over:
                break
        self.person.rest()
        until_s = time.monotonic() + (2.0 if self.person.acted_s is not None else 0.3)
        while time.monotonic() < until_s and not self.acts:  # a setting is read less often than a state
            self._take(0.1)
        self._settle(0.3)

    def _measure_one(self, wanted: Wanted, *, sets_frame: bool) -> None:
        for attempt in range(5):
            before = len(self.results)
            if attempt:
                self.repeats += 1
                self.log("run: once more")
            if not self._prepared(wanted, sets_frame=sets_frame or attempt > 0):
                return
            again = replace(wanted)
            if not self._started(again):
                return
            if self._case.killed_share and wanted.number == 1 and not attempt:
                self._kill_and_start_again(again)
            else:
                self._until_end(again)
            if any(one.is_of_its_kind for one in self.results[before:]):
                self.measured += 1
                return
            if self.is_over:
                return

    def _prepared(self, wanted: Wanted, *, sets_frame: bool) -> bool:
        if sets_frame and not self._done(ControlRequest.SET_SCAN_PARAMS, ScanParameters(FRAME, SHAPE, ""), "set frame"):
            return False
        if wanted.position_m is not None and not self._done(
            ControlRequest.SET_PROBE_POS, ProbePosition(wanted.position_m), "set position"
        ):
            return False
        if wanted.value is None:
            return True
        return self._done(
            ControlRequest.PARAM, Parameter(self._panel.value, str(wanted.value)), f"set value {wanted.value}"
        )

    def _started(self, wanted: Wanted) -> bool:
        self._newest = wanted
        action = names.START_SPEC if wanted.kind == "curve" else names.START_SCAN
        return self._done(ControlRequest.ACTION, action, f"start {wanted.kind}", wanted)

    def _done(self, kind: int, subject: Any, words: str, wanted: Wanted | None = None) -> bool:
        """Ask until the microscope is free; return False if the run ends instead."""
        until_s = time.monotonic() + WAITS_S
        self.log(f"run: {words}")
        self.person.asking()
        while True:
            if wanted is not None:
                while self._take(0.0):  # what was published before is of no measurement of the run
                    pass
                self._states.clear()
                wanted.sent_s = self._made.clock.now_s()
            response = self._peer.ask(kind, subject)
            if response.ok:
                if wanted is not None:
                    wanted.is_open = True
                return True
            if not self.events[-1].endswith(response.reason):
                self.log(f"  answer: {response.code} {response.reason}")
            if response.code != ControlResponse.NOT_FREE or time.monotonic() > until_s:
                self.refused = f"{words}: {response.code} {response.reason}"
                return False
            self._settle(0.05)
            if self.is_over:
                return False

    def _until_end(self, wanted: Wanted) -> None:
        until_s = time.monotonic() + 2 * WAITS_S
        while not self._has_ended():
            if time.monotonic() > until_s:
                self.unfinished = f"{wanted.kind} {wanted.number} did not end"
                self.log(f"run: {self.unfinished}")
                return
            self._take(0.1)
        wanted.is_open = False

    def _has_ended(self) -> bool:
        busy = [n for n, one in enumerate(self._states) if one in (ScopeState.SCANNING, ScopeState.SPEC)]
        return bool(busy) and ScopeState.FREE in self._states[busy[0] :]

    def _kill_and_start_again(self, wanted: Wanted) -> None:
        until_s = time.monotonic() + WAITS_S
        while not self._states and time.monotonic() < until_s:
            self._take(0.02)
        lasts_s = self._case.curve_s if wanted.kind == "curve" else SCAN_S
        moment = self._case.moment
        early_s = max(0.0, -moment.delay_ms / 1e3) if moment.kind == "kill" else 0.0
        if early_s:
            self.person.later(0.0)
        self._settle(max(self._case.killed_share * lasts_s, early_s))
        self.log("translator killed")
        self._made.kill()
        if moment.kind == "kill":
            self.person.later(moment.delay_ms / 1e3)
        self._states.clear()
        self._start_translator()
        wanted.is_open = False

    def _start_translator(self) -> None:
        self._peer = self._made.start()
        self._peer.newest_ns = self._newest_ns
        self.log("translator started")
        until_s = time.monotonic() + 60.0
        while ScopeState.FREE not in self._states and time.monotonic() < until_s:
            self._take(0.1)
        self._settle(0.2)

    def _settle(self, lasts_s: float) -> None:
        until_s = time.monotonic() + lasts_s
        while (left_s := until_s - time.monotonic()) > 0.0:
            self._take(left_s)

    def _take(self, within_s: float) -> bool:
        if not self._peer.has_news(within_s):
            return False
        packet = self._peer.next()
        if isinstance(packet, ScopeStatus):
            self._states.append(packet.state)
            self.log(f"  state {packet.state.name}")
            self.interrupted += packet.state is ScopeState.INTERRUPTED
        elif isinstance(packet, ActByHand):
            self.acts.append(packet)
            self.log(f"  told: {packet}")
        elif isinstance(packet, Scan | Spectrum):
            self.log(f"  result: {type(packet).__name__} {getattr(packet, 'channel', '')} {Path(packet.filename).name}")
            is_measuring = any(one in (ScopeState.SCANNING, ScopeState.SPEC) for one in self._states)
            if self._newest is not None and self._newest.is_open and is_measuring:
                self.results.append(Published(self._newest, packet, tuple(self.acts)))
        return True


# --- the verdict ---


@dataclass(frozen=True)
class Verdict:
    """What became of a case.

    Attributes:
        wrong: each wrong complete result, in words.
        apart: complete results that began, or lost the feedback, while the controller held it; that lost it for less
            than `_BRIEF_S` at their end; or that say that they are of the frame that the person has set.
        events: the sequence, for who wants to see it again.
    """

    case: Case
    has_acted: bool = False
    has_trace: bool = False
    is_told: bool = False
    wrong: tuple[str, ...] = ()
    apart: tuple[str, ...] = ()
    unmatched: tuple[str, ...] = ()
    results: int = 0
    repeats: int = 0
    interrupted: int = 0
    false_acts: tuple[str, ...] = ()
    ended: str = ""
    error: str = ""
    events: tuple[str, ...] = ()


def judged(run: Run, case: Case) -> Verdict:
    """Compare all results with the truth."""
    wrong: dict[str, None] = {}
    apart: dict[str, None] = {}
    unmatched: dict[str, None] = {}
    for one in run.results:
        for kind, words in _faults(one, run, case):
            {"wrong": wrong, "apart": apart, "unmatched": unmatched}[kind][words] = None
    truth, person = run.truth, run.person
    acted_s = None if person.refused and case.act not in ("own", "replace") else person.acted_s
    after = [] if acted_s is None else [one for one in truth.taken if one.end_s >= acted_s]
    ends = [truth.at(one.end_s) for one in after]
    spoiled = any(not (look.on and look.engaged) for look in ends)
    stopped = any(not one.is_complete for one in after) or any(one.by_hand for one in after)
    trace = {"off and on": spoiled, "pause": False, "stop": stopped, "own": stopped, "replace": stopped}.get(
        case.act, acted_s is not None
    )
    return Verdict(
        case,
        has_acted=acted_s is not None,
        has_trace=acted_s is not None and trace,
        is_told=bool(run.acts) or "panel" in run.refused,
        wrong=tuple(wrong),
        apart=tuple(apart),
        unmatched=tuple(unmatched),
        results=run.measured,
        repeats=run.repeats,
        interrupted=run.interrupted,
        false_acts=() if acted_s is not None else tuple(map(str, run.acts)),
        ended=run.refused or run.unfinished,
        events=tuple(run.events),
    )


def _faults(one: Published, run: Run, case: Case) -> Iterator[tuple[str, str]]:
    truth, wanted, packet = run.truth, one.wanted, one.packet
    name = f"{wanted.kind} {wanted.number}"
    if not one.is_of_its_kind:
        yield "apart", f"{name}: a {type(packet).__name__.lower()} came instead of it"
        return
    found = _measurement_of(packet, truth.taken)
    if found is None:
        yield "unmatched", f"{name}: {Path(packet.filename).name} is like no measurement"
        return
    taken, missing = found
    number = truth.taken.index(taken)
    if missing:
        yield "wrong", f"{name}: {missing}"
    begin, end = taken.begin, truth.at(taken.end_s)
    if taken.activity.start_s < wanted.sent_s - 0.01 and not case.killed_share:
        yield "wrong", f"{name}: it is measurement {number}, which began before the run asked for one"
    if not taken.is_complete:
        yield "wrong", f"{name}: measurement {number} was stopped"
    if not begin.on and end.on and truth.at(taken.begin.time_s + _BRIEF_S).on:
        yield "apart", f"{name}: the feedback was off at its begin, and on again soon after"
    elif not begin.on:
        yield "wrong", f"{name}: the feedback was off at its begin"
    elif not end.on and truth.at(taken.end_s + _BRIEF_S).on:
        yield "apart", f"{name}: the feedback was off at its end, and on again soon after"
    elif not end.on and taken.is_scan:
        yield "wrong", f"{name}: the feedback was off at its end"
    elif not end.on:
        yield "apart", f"{name}: the feedback was switched off while the controller held it"
    if not (begin.engaged and end.engaged):
        yield "wrong", f"{name}: the tip was withdrawn at its {'begin' if not begin.engaged else 'end'}"
    if taken.in_hold:
        yield "apart", f"{name}: it began while the feedback was still held"
    if wanted.value is not None and not taken.by_hand:
        for when, look in (("begin", begin), ("end", end)):
            if abs(look.value - wanted.value) > 1e-6:
                yield "wrong", f"{name}: {look.value:g} instead of {wanted.value:g} was in force at its {when}"
    told = {act.act for act in one.told_before}
    if taken.is_scan and isinstance(packet, Scan):
        if not _near(packet.region.center_m, taken.activity.region.center_m):
            yield "wrong", f"{name}: it is said to be at {packet.region.center_m}, and was at {_place(taken.activity)}"
        if not _near(taken.activity.region.center_m, FRAME.center_m):
            if taken.by_hand and not told & {PanelAct.SCAN, PanelAct.STOP}:
                yield "wrong", f"{name}: it is a scan of the person of another frame, without a word"
            else:
                yield "apart", f"{name}: it is of the frame that the person has set"
    elif isinstance(packet, Spectrum):
        at_m = taken.activity.position_m
        if packet.position_m is not None and not _near(packet.position_m, at_m, 1e-9):
            yield "wrong", f"{name}: it is said to be at {packet.position_m}, and was {_place(taken.activity)}"
        if wanted.position_m is not None and not _near(at_m, wanted.position_m, 1e-9):
            yield "wrong", f"{name}: it was taken {_place(taken.activity)}, wanted was {wanted.position_m}"


def _near(one: Sequence[float], other: Sequence[float], within_m: float = 0.2 * ASIDE_M) -> bool:
    return max(abs(a - b) for a, b in zip(one, other, strict=True)) < within_m


def _measurement_of(packet: Scan | Spectrum, taken: Sequence[Taken]) -> tuple[Taken, str] | None:
    """Return the measurement whose values a result has, and what is wrong with its rows."""
    if isinstance(packet, Spectrum):
        return _curve_of(packet, taken)
    near: list[tuple[int, float, Taken, np.ndarray]] = []
    for one in taken:
        if not one.is_scan or one.activity.shape != packet.values.shape:
            continue
        for _, values in one.activity.channels().values():
            for true in (values * factor for factor in _FACTORS):
                scale = float(np.nanstd(true)) or 1.0
                with np.errstate(invalid="ignore"):
                    apart = np.max(np.abs(packet.values - true), axis=1) / scale
                is_row = apart < _MATCHES
                near.append((int(is_row.sum()), -float(np.nanmin(apart, initial=9.0)), one, is_row))
    if not near:
        return None
    best = max(near, key=lambda each: each[:2])
    if not best[0]:
        return None
    count, _, one, is_row = best
    rows = len(is_row)
    if count == rows:
        return one, ""
    rest = packet.values[~is_row]
    if np.isnan(rest).all() or (rest == 0.0).all():
        return one, f"{rows - count} of {rows} rows are missing, and filled with {rest.flat[0]:g}"
    return one, f"{rows - count} of {rows} rows are not of this scan"


def _curve_of(packet: Spectrum, taken: Sequence[Taken]) -> tuple[Taken, str] | None:
    near: list[tuple[float, Taken]] = []
    for one in taken:
        if one.is_scan:
            continue
        tables: list[Any] = []
        for activity in (one.activity, _over_the_way_of(packet, one.activity)):
            tables += [activity.values.T, activity.values.T[:, ::-1]]
            there, back = activity.both_ways()
            tables += [[values for _, values in way.values()] for way in (there, back)]
            tables.append([np.concatenate([values, back[name][1]]) for name, (_, values) in there.items()])
        for table in tables:
            for true in list(table)[1:]:
                for column in packet.values.T[1:]:
                    if len(column) == len(true):
                        scale = float(np.std(true)) or 1.0
                        near.append((float(np.max(np.abs(column - true))) / scale, one))
    near = [each for each in near if np.isfinite(each[0]) and each[0] < _MATCHES]
    return (min(near, key=lambda each: each[0])[1], "") if near else None


def _over_the_way_of(packet: Spectrum, activity: Any) -> Any:
    # Asylum's curves are over the way of the piezo that is set, whatever the tip indents
    if "Raw" not in packet.names:
        return activity
    z = activity.values[:, 0]
    way_m = float(np.ptp(packet.values[:, packet.names.index("Raw")]))
    swept = np.linspace(z[0], z[0] + way_m, len(z))
    return replace(activity, values=np.stack([np.interp(swept, z, column) for column in activity.values.T], axis=1))


# --- cases by number ---


@contextmanager
def own_home(folder: Path) -> Iterator[None]:
    """Give GXSM's bridge a folder for its secret."""
    before = {name: os.environ.get(name) for name in ("HOME", "USERPROFILE")}
    os.environ.update(dict.fromkeys(before, str(folder)))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def carried_out(case: Case, folder: Path) -> Verdict:
    """Let the run and the person of a case act, and judge its results."""
    panel = PANELS[case.maker]
    module = import_module(f"tests.plugins.{case.maker}.{case.maker}_bench")
    with own_home(folder), ExitStack() as stack:
        made = module.Bench(folder, stack, 1.0, case.emulator)
        run = Run(made, case, panel)
        try:
            run.measure()
            made.kill()
        finally:
            run.person.rest()
        return judged(run, case)


def _in_process(case: Case) -> Verdict:
    with tempfile.TemporaryDirectory(prefix="afspm-acts-", ignore_cleanup_errors=True) as folder:
        out, sys.stdout = sys.stdout, open(os.devnull, "w")  # noqa: PTH123, SIM115 (the log of translators)
        try:
            return carried_out(case, Path(folder))
        except Exception:  # the other cases go on
            return Verdict(case, error=traceback.format_exc())
        finally:
            sys.stdout.close()
            sys.stdout = out


def cases(makers: Sequence[str], count: int, *, first: int = 0, persons: Sequence[bool] = (True, False)) -> list[Case]:
    """Return the cases of each maker; without a person a third of them, which are four times as long."""
    found = []
    for number in range(first, first + count):
        for maker in makers:
            one = Case.of(maker, number)
            if True in persons:
                found.append(one)
            if False in persons and number % 3 == 0:
                found.append(one.without_a_person())
    return found


def table(verdicts: Sequence[Verdict]) -> str:
    """Return the counts by maker and kind of act."""
    lines = [
        "| maker | act | cases | acts | with a trace | wrong results | told | apart | errors |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    groups: dict[tuple[str, str], list[Verdict]] = {}
    for one in verdicts:
        if one.case.act:
            groups.setdefault((one.case.maker, one.case.act), []).append(one)
            groups.setdefault(("all", "all"), []).append(one)
    for (maker, act), ones in sorted(groups.items()):
        counts = (
            len(ones),
            sum(one.has_acted for one in ones),
            sum(one.has_trace for one in ones),
            sum(bool(one.wrong) for one in ones),
            sum(one.has_trace and one.is_told for one in ones),
            sum(bool(one.apart) for one in ones),
            sum(bool(one.error) for one in ones),
        )
        lines.append(f"| {maker} | {act} | {' | '.join(map(str, counts))} |")
    lines += [
        "",
        "| without a person | runs | measurements | false acts | interrupted | repeats | wrong | apart | errors |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    alone = [one for one in verdicts if not one.case.act]
    for maker in (*MAKERS, "all"):
        ones = [one for one in alone if maker in (one.case.maker, "all")]
        whole = [one for one in ones if not one.case.killed_share]
        numbers = (
            len(ones),
            sum(one.results for one in ones),
            sum(len(one.false_acts) for one in ones),
            sum(one.interrupted for one in whole),
            sum(one.repeats for one in whole),
            sum(len(one.wrong) for one in ones),
            sum(len(one.apart) for one in ones),
            sum(bool(one.error) for one in ones),
        )
        lines.append(f"| {maker} | {' | '.join(map(str, numbers))} |")
    return "\n".join(lines)


def is_bad(one: Verdict) -> bool:
    """Return whether a verdict is one that must not be."""
    alone = not one.case.act and not one.case.killed_share
    return bool(one.wrong or one.false_acts or one.unmatched or one.error or (alone and (one.interrupted or one.ended)))


def shown(one: Verdict, *, events: bool = True) -> str:
    """Return a verdict with its sequence."""
    found = [str(one.case)]
    for kind in ("wrong", "apart", "unmatched", "false_acts"):
        found += [f"  {kind.upper()}: {words}" for words in getattr(one, kind)]
    found += [f"  ended: {one.ended}"] if one.ended else []
    found += [one.error] if one.error else []
    return "\n".join([*found, *(f"    {event}" for event in one.events if events)])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=84, help="of each maker")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--makers", nargs="*", default=list(MAKERS))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", choices=("person", "alone"), default=None)
    parser.add_argument("--all-events", action="store_true")
    given = parser.parse_args()
    persons = {"person": (True,), "alone": (False,), None: (True, False)}[given.only]
    todo = cases(given.makers, given.cases, first=given.first, persons=persons)
    verdicts: list[Verdict] = []
    with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
        for done in as_completed([pool.submit(_in_process, case) for case in todo]):
            one = done.result()
            verdicts.append(one)
            if is_bad(one) or given.all_events:
                sys.stdout.write(f"{shown(one)}\n\n")
                sys.stdout.flush()
    reasons = Counter(words.partition(": ")[2] for one in verdicts for words in one.wrong)
    sys.stdout.write(
        f"{table(verdicts)}\n\n" + "".join(f"{count} x {words}\n" for words, count in reasons.most_common())
    )
    return int(any(map(is_bad, verdicts)))


if __name__ == "__main__":
    sys.exit(main())
