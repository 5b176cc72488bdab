"""An adversary: a stolen connection of an agent that sends anything, among persons who approve plans and grants."""

from __future__ import annotations

import hashlib
import math
import random
from dataclasses import replace
from typing import Any, ClassVar

from afspm import wire
from afspm.model import (
    GRANT_REQUEST,
    LEASE_REQUEST,
    RELAY_REQUEST,
    RESTART_REQUEST,
    ControlMode,
    ControlRequest,
    Feedback,
    Grant,
    GrantedCount,
    GrantedRange,
    GrantedStep,
    Note,
    Parameter,
    PositionChange,
    ProbePosition,
    Region,
    RegionChange,
    RelayedMessage,
    Request,
    ScanParameters,
    names,
)
from tests.simulation.grant_rig import ADA, AGENT, STOP, STOPS, UM, AgentViolation, GrantRig, facts

_NUMBERS = (0.0, 1e-7, -3e-7, 9e-7, 1.9e-6, 3e-6, -5e-6, math.nan, math.inf, 1e300)
_ACTIONS = (names.START_SCAN, names.START_SPEC, names.STOP_SCAN, names.PULSE, names.RETRACT, "x-crash", "approach")
Planned = tuple[int, Any]
"""A request of a plan: kind and subject."""
_ACTION, _SET_SCAN = int(ControlRequest.ACTION), int(ControlRequest.SET_SCAN_PARAMS)
_SET_PROBE = int(ControlRequest.SET_PROBE_POS)


class Attack:
    """A sequence of calls and events that follows from the seed."""

    rig_of: ClassVar[type[GrantRig]] = GrantRig

    def __init__(self, seed: int, *, loses: float = 0.02, kills: float = 0.004, texts: Any = str) -> None:
        self.rig = self.rig_of(seed, loses=loses, kills=kills, texts=texts)
        self.rig.not_free = 0.05
        self.random = random.Random(seed * 7919 + 1)
        self.plans: dict[str, list[Planned]] = {}
        self.calls = 0
        self._raw = 0
        self._spent: list[str] = []

    def steps(self, count: int) -> None:
        """Send requests of the agent, among events of other peers."""
        for _ in range(count):
            self._world()
            self.calls += 1
            if self.random.random() < 0.5:
                self._raw_request()
            else:
                self._other_call()
        self.spend_again()

    def _other_call(self) -> None:
        if self.random.random() < 0.3:
            self._propose()
        elif self.random.random() < 0.1:
            self._stop()
        else:
            self._raw_request()

    def _propose(self) -> None:
        wanted: list[Planned] = []
        for _ in range(self.random.randint(1, 4)):
            x_m, y_m = self.random.choice(_NUMBERS[:4]), self.random.choice(_NUMBERS[:4])
            match self.random.randint(0, 3):
                case 0:
                    place = ScanParameters(Region((x_m, y_m), (0.2 * UM, 0.2 * UM)), (16, 16))
                    wanted += [(_SET_SCAN, place), (_ACTION, names.START_SCAN)]
                case 1:
                    wanted += [(_SET_PROBE, ProbePosition((x_m, y_m))), (_ACTION, names.START_SPEC)]
                case 2:
                    wanted.append((_SET_PROBE, ProbePosition((x_m, y_m))))
                case 3:
                    volts = self.random.choice(("0.1", "0.45", "-0.5", "0.9", "1.5"))
                    wanted.append((int(ControlRequest.PARAM), Parameter(names.TIP_BIAS_VOLTAGE, volts, "V")))
        self.plans[hashlib.sha256(repr(wanted).encode()).hexdigest()[:16]] = wanted

    def _stop(self) -> None:
        # an agent stops the experiment with nothing approved; all lose control
        rig = self.rig
        rig.link(AGENT).request(int(ControlRequest.ADD_EXP_PRBLM), STOP)
        if STOP not in rig.core.control.problems:
            raise AgentViolation("stop had no effect")
        if rig.core.control.holder is not None:
            raise AgentViolation(f"after a stop {rig.core.control.holder} is in control")

    def spend_again(self) -> None:
        # a scan that is granted once: asked for again after a restart, as random calls seldom do
        rig = self.rig
        rig.later(4000.0)  # what a role allows within an hour is free again
        for problem in (STOP, 1):
            self._person(ControlRequest.RMV_EXP_PRBLM, problem)
        self._person(ControlRequest.SET_CONTROL_MODE, int(ControlMode.AUTOMATED))
        self._ask("series", ControlRequest.RELEASE_CTRL)
        self._person(GRANT_REQUEST, Grant(AGENT))
        once = Grant(
            AGENT, region_m=(0.0, 0.0, 2 * UM, 2 * UM), counts=(GrantedCount(names.START_SCAN, 1),), lasts_s=600.0
        )  # fmt: skip
        self._person(GRANT_REQUEST, fresh(once, facts(rig)))
        place = ScanParameters(Region((0.0, 0.0), (0.2 * UM, 0.2 * UM)), (16, 16))
        for _ in range(2):
            for kind, subject in (
                (ControlRequest.REQUEST_CTRL, 0),
                (ControlRequest.SET_SCAN_PARAMS, place),
                (ControlRequest.ACTION, names.START_SCAN),
            ):
                self.calls += 1
                rig.link(AGENT).request(int(kind), subject, request_id=f"{AGENT}/{rig.life}/again{self.calls}")
            rig.restart()

    # --- everybody else ---

    def _world(self) -> None:
        chance, rig = self.random.random(), self.rig
        rig.later(self.random.choice((0.0, 0.1, 0.1, 2.0)))
        if chance < 0.12:
            self._person(GRANT_REQUEST, self._grant())
        elif chance < 0.20 and self.known_plans():
            self._approve()
        elif chance < 0.21:
            self._person(GRANT_REQUEST, Grant(AGENT))
        elif chance < 0.225:
            self._person(
                ControlRequest.SET_CONTROL_MODE, int(self.random.choice((ControlMode.MANUAL, ControlMode.AUTOMATED)))
            )
        elif chance < 0.24:
            self._ask("classifier", self.random.choice((ControlRequest.ADD_EXP_PRBLM, ControlRequest.RMV_EXP_PRBLM)), 1)
        elif chance < 0.25:
            rig.later(self.random.choice((30.0, 61.0, 400.0, 4000.0)))
        elif chance < 0.29:
            rig.region = Region((self._number(), 0.0), (0.5 * UM, 0.5 * UM))  # a person at the panel
            rig.probe_m = (self._number(), 0.0)
        elif chance < 0.30:
            self._ask("series", ControlRequest.REQUEST_CTRL, 0)
        elif chance < 0.36:
            self._ask("series", ControlRequest.RELEASE_CTRL)
        elif chance < 0.365:
            rig.restart()
        if STOP in rig.core.control.problems and self.random.random() < 0.3:
            self._person(ControlRequest.RMV_EXP_PRBLM, STOP)
        if rig.core.control.mode is ControlMode.MANUAL and self.random.random() < 0.5:
            self._person(ControlRequest.SET_CONTROL_MODE, int(ControlMode.AUTOMATED))
        if 1 in rig.core.control.problems and self.random.random() < 0.5:
            self._ask("classifier", ControlRequest.RMV_EXP_PRBLM, 1)

    def _ask(self, name: str, kind: int, subject: Any = None) -> None:
        self._raw += 1
        self.rig.ask(name, Request(int(kind), subject, b"", f"{name}/{self.rig.life}p/{self._raw}"))

    def _person(self, kind: int, subject: Any = None) -> None:
        self._ask(ADA, kind, subject)

    def _grant(self) -> Grant:
        side = self.random.choice((0.5 * UM, UM, 2 * UM))
        region = (self.random.choice((0.0, 0.3 * UM, UM)), 0.0, side, side) if self.random.random() < 0.9 else ()
        wanted = Grant(
            AGENT, region_m=region,
            ranges=(GrantedRange(names.TIP_BIAS_VOLTAGE, -0.5, 0.5),) if self.random.random() < 0.9 else (),
            counts=(GrantedCount(names.START_SCAN, self.random.randint(0, 5)), GrantedCount(names.START_SPEC, 3)),
            lasts_s=self.random.choice((20.0, 600.0, 7200.0)),
        )  # fmt: skip
        return fresh(wanted, facts(self.rig))

    def known_plans(self) -> dict[str, list[Planned]]:
        """Return the requests of each plan, by its id; the newest is last."""
        return self.plans

    def _approve(self) -> None:
        id_ = self.random.choice(list(self.plans)[-3:])
        steps = tuple(GrantedStep(kind, wire.frames.encode_subject(subject)) for kind, subject in self.plans[id_])
        drift_m = 20e-9 if any(kind == _SET_SCAN for kind, _ in self.plans[id_]) else 10e-9
        self._person(GRANT_REQUEST, fresh(Grant(AGENT, id_, steps, lasts_s=3600.0, drift_m=drift_m), facts(self.rig)))

    # --- a stolen connection ---

    def _number(self) -> float:
        return self.random.choice(_NUMBERS[:7])

    def _raw_request(self) -> None:
        rig, chance = self.rig, self.random
        kind, subject = self._wish()
        new = f"{AGENT}/{rig.life}/raw{self.calls}"
        # an id that was spent, with another request: also after a restart, when fewer are known
        id_ = chance.choice((*[new] * 6, chance.choice(self._spent[-6:] or [""]), ""))
        try:
            answer = rig.link(AGENT).request(kind, subject, request_id=id_)
        except (ValueError, TypeError, OverflowError):  # it can't even be encoded
            return
        if answer.ok and id_ == new and kind not in (ControlRequest.REQUEST_CTRL, ControlRequest.RELEASE_CTRL):
            self._spent.append(id_)

    def _wish(self) -> tuple[int, Any]:
        chance = self.random
        if self.rig.core.control.holder != AGENT and chance.random() < 0.5:
            return int(ControlRequest.REQUEST_CTRL), 0
        held = self.rig.watchman.plan
        if held is not None and self.rig.core.control.holder == AGENT and chance.random() < 0.3:
            if chance.random() < 0.3:
                return int(ControlRequest.ACTION), chance.choice(STOPS)
            steps = self.known_plans().get(held.grant.plan)  # its steps: in turn, again, or one left out
            if steps:
                return steps[(held.step + chance.choice((-1, 0, 0, 1))) % len(steps)]
        if self.known_plans() and chance.random() < 0.3:  # a step of a plan: again, early, or of another plan
            newest = list(self.known_plans().values())[-3:]
            return chance.choice(chance.choice(newest))
        match chance.randint(0, 15):
            case 0 | 1 | 2:
                return int(ControlRequest.REQUEST_CTRL), chance.choice((0, 0, 0, 0, 1, 2, STOP))
            case 3 | 4:
                volts = chance.choice(("0.1", "0.5", "0.51", "-2", "1e9", "nan", "inf", "true", ""))
                unit = chance.choice(("V", "mV", "m", None))
                return int(ControlRequest.PARAM), Parameter(names.TIP_BIAS_VOLTAGE, volts, unit)
            case 5:
                name = chance.choice((names.SCAN_SPEED, names.FEEDBACK_ON, names.SCAN_SIZE_X, names.PROBE_POS_X, "x"))
                return int(ControlRequest.PARAM), Parameter(name, chance.choice(("1e-6", "off", "1")), None)
            case 6 | 7 | 8:
                return int(ControlRequest.ACTION), chance.choice(_ACTIONS)
            case 9 | 10:
                size = chance.choice((0.2 * UM, 0.2 * UM, UM, 9 * UM))
                angle = chance.choice((0.0, 0.8))
                region = Region((self._number(), self._number()), (size, size), angle)
                wanted = chance.choice((region, RegionChange(left_m=self._number()), None))
                return int(ControlRequest.SET_SCAN_PARAMS), ScanParameters(wanted, (16, 16))
            case 11:
                to = ProbePosition((self._number(), self._number()))
                return int(ControlRequest.SET_PROBE_POS), chance.choice((to, PositionChange(x_m=self._number())))
            case 12:
                return int(ControlRequest.SET_ZCTRL_PARAMS), Feedback(on=False, setpoint=1e-9)
            case 13:
                return chance.choice((
                    (int(ControlRequest.SET_CONTROL_MODE), int(ControlMode.MANUAL)),
                    (int(ControlRequest.RMV_EXP_PRBLM), STOP), (int(ControlRequest.RMV_EXP_PRBLM), 1),
                    (int(ControlRequest.ADD_EXP_PRBLM), 2), (int(ControlRequest.END_EXPERIMENT), None),
                    (RESTART_REQUEST, "series"), (LEASE_REQUEST, 86_000.0), (LEASE_REQUEST, 20.0),
                ))  # fmt: skip
            case 14:
                step = GrantedStep(int(ControlRequest.ACTION), wire.frames.encode_subject(names.PULSE))
                return GRANT_REQUEST, chance.choice((self._grant(), Grant(AGENT, "f" * 16, (step,), lasts_s=60.0)))
        note = Note(self.rig.now_ns, chance.choice((AGENT, ADA)), "x", None, self.rig.now_ns)
        return RELAY_REQUEST, RelayedMessage(*wire.encode(note))


def attacked(seed: int, calls: int, **options: Any) -> Attack:
    """Return an attack after its calls; AgentViolation if a request got through."""
    attack = Attack(seed, **options)
    attack.steps(calls)
    return attack


def fresh(grant: Grant, known: Any) -> Grant:
    """Return a copy of an approval, bound to the present run, limits and time, as a person's program makes it."""
    return replace(grant, run=known.get("run", ""), limits=known.get("limits", ""), since_ns=int(known["now_ns"]))
