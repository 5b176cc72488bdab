"""Adversaries: a model that calls the tools with anything, and a stolen connection that avoids the tools."""

from __future__ import annotations

import asyncio
import json
import math
import random
from typing import Any

from mcp import Client

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
from afspm.plugins.agent.approval import fresh, of_plan
from afspm.plugins.agent.plan import plan_of
from tests.simulation.agent_rig import ADA, AGENT, STOP, STOPS, UM, AgentRig, AgentViolation, facts

_TEXTS = (
    "0 nm",
    "100 nm",
    "-300 nm",
    "0.9 um",
    "1.9 um",
    "3 um",
    "-5 um",
    "nan nm",
    "inf m",
    "1e400 nm",
    "5",
    "",
    "x",
    "0.1 V",
)
_NUMBERS = (0.0, 1e-7, -3e-7, 9e-7, 1.9e-6, 3e-6, -5e-6, math.nan, math.inf, 1e300)
_VOLTS = ("0.1 V", "0.45 V", "-0.5 V", "0.9 V", "1.5 V", "12 V", "400 mV", "nan", "inf V", "true", "0.2", "1e3 mV")
_ACTIONS = (names.START_SCAN, names.START_SPEC, names.STOP_SCAN, names.PULSE, names.RETRACT, "x-crash", "approach")
_TOOLS = (
    "status", "limits", "journal", "scans", "scan_numbers", "scan_image", "proposals", "propose", "propose",
    "preflight", "run", "run", "run", "measure", "measure", "measure", "measure", "stop",
)  # fmt: skip


class Attack:
    """A sequence of calls and events that follows from the seed."""

    def __init__(self, seed: int, *, loses: float = 0.02, kills: float = 0.004, texts: Any = str) -> None:
        self.rig = AgentRig(seed, loses=loses, kills=kills, texts=texts)
        self.rig.not_free = 0.05
        self.random = random.Random(seed * 7919 + 1)
        self.proposals: list[str] = []
        self.calls = 0
        self._raw = 0
        self._spent: list[str] = []

    async def steps(self, count: int) -> None:
        """Make calls of tools and raw requests, among events of other peers."""
        async with Client(self.rig.tools.server()) as client:
            for _ in range(count):
                self._world()
                self.calls += 1
                if self.random.random() < 0.5:
                    await self._tool(client)
                else:
                    self._raw_request()
                for _ in range(4):
                    await asyncio.sleep(0)  # runs go on
        self._spend_again()

    def _spend_again(self) -> None:
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
        elif chance < 0.20 and rig.place.proposals:
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

    def _approve(self) -> None:
        proposal = self.random.choice(list(self.rig.place.proposals.values())[-3:])
        if proposal.preflight:
            self._person(GRANT_REQUEST, of_plan(proposal, self.rig.place.frame, facts(self.rig))[0])

    # --- the model ---

    async def _tool(self, client: Client) -> None:
        name = self.random.choice(_TOOLS)
        if name == "stop" and self.random.random() < 0.8:
            name = "status"
        given = self._arguments(name)
        answer = await client.call_tool(name, given)
        if name == "stop" and given.keys() == {"reason"}:
            is_flagged = STOP in self.rig.core.control.problems
            if answer.is_error or not is_flagged:
                raise AgentViolation(f"stop had no effect: {answer}")

    def _arguments(self, name: str) -> dict[str, Any]:
        given: dict[str, Any] = {}
        if name in ("scan_numbers", "scan_image"):
            given = {"scan": self.random.choice(("newest", "1", "../x"))}
        elif name == "propose":
            given = {"plan": {"title": "t", "steps": [self._step() for _ in range(self.random.randint(1, 4))]}}
        elif name in ("preflight", "run"):
            known = list(self.rig.place.proposals)[-3:]
            given = {"proposal": self.random.choice(known) if known and self.random.random() < 0.9 else "0" * 16}
        elif name == "measure":
            given = {"step": self._step()}
        elif name == "stop":
            given = {"reason": "x"}
        if self.random.random() < 0.03:
            given[self.random.choice(("force", "approved", "limits"))] = self.random.choice((True, None, 1, "yes"))
        return given

    def _step(self) -> dict[str, Any]:
        good = self.random.random() < 0.6
        pair = (lambda: [self.random.choice(_TEXTS[:4]) for _ in "xy"]) if good else self._pair
        match self.random.randint(0, 3):
            case 0:
                size = ["200 nm", "200 nm"] if good else self._pair()
                pixels = [16, 16] if good else self.random.choice(([0, 1], [10**9, 2], [1.5, 2], ["1", "2"], [True, 2]))
                return {"do": "scan", "center": pair(), "size": size, "pixels": pixels}
            case 1:
                return {"do": "spectrum", "at": pair()}
            case 2:
                return {"do": "move", "to": pair()}
        name = names.TIP_BIAS_VOLTAGE if good else self.random.choice((names.SCAN_SPEED, names.FEEDBACK_ON, "x-y", ""))
        return {"do": "set", "parameter": name, "value": self.random.choice(_VOLTS)}

    def _pair(self) -> Any:
        return self.random.choice(([self.random.choice(_TEXTS) for _ in "xy"], "0 nm", [1e-9, 0.0], ["0 nm"], None))

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
            known = self.rig.place.proposals.get(held.grant.plan)  # its steps: in turn, again, or one left out
            steps = plan_of(known.plan).requests(self.rig.place.frame) if known else []
            if steps:
                planned = steps[(held.step + chance.choice((-1, 0, 0, 1))) % len(steps)]
                return planned.kind, planned.subject
        if self.rig.place.proposals and chance.random() < 0.3:  # a step of a plan: again, early, or of another plan
            newest = list(self.rig.place.proposals.values())[-3:]
            planned = chance.choice(plan_of(chance.choice(newest).plan).requests(self.rig.place.frame))
            return planned.kind, planned.subject
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
    asyncio.run(attack.steps(calls))
    return attack


def as_text(rig: AgentRig) -> str:
    """Return everything that was sent to the microscope."""
    return json.dumps(rig.effects)
