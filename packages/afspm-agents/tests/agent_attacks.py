"""An adversary: a model that calls the tools with anything, beside the stolen connection of `grant_attacks`."""

from __future__ import annotations

import asyncio
from typing import Any, ClassVar

from agent_rig import AgentRig
from mcp import Client
from tests.simulation.grant_attacks import Attack, Planned
from tests.simulation.grant_rig import STOP, AgentViolation, facts

from afspm.model import GRANT_REQUEST, names
from afspm_agents.approval import of_plan
from afspm_agents.plan import plan_of

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
_VOLTS = ("0.1 V", "0.45 V", "-0.5 V", "0.9 V", "1.5 V", "12 V", "400 mV", "nan", "inf V", "true", "0.2", "1e3 mV")
_TOOLS = (
    "status", "limits", "journal", "scans", "scan_numbers", "scan_image", "proposals", "propose", "propose",
    "preflight", "run", "run", "run", "measure", "measure", "measure", "measure", "stop",
)  # fmt: skip


class AgentAttack(Attack):
    """Calls of tools and raw requests, among events of other peers."""

    rig: AgentRig
    rig_of: ClassVar[type[AgentRig]] = AgentRig

    async def call(self, count: int) -> None:
        """Make calls of tools and raw requests."""
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
        self.spend_again()

    def known_plans(self) -> dict[str, list[Planned]]:
        frame = self.rig.place.frame
        return {
            id_: [(one.kind, one.subject) for one in plan_of(known.plan).requests(frame)]
            for id_, known in self.rig.place.proposals.items()
        }

    def _approve(self) -> None:
        proposal = self.random.choice(list(self.rig.place.proposals.values())[-3:])
        if proposal.preflight:
            self._person(GRANT_REQUEST, of_plan(proposal, self.rig.place.frame, facts(self.rig))[0])

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


def attacked(seed: int, calls: int, **options: Any) -> AgentAttack:
    """Return an attack after its calls; AgentViolation if a request got through."""
    attack = AgentAttack(seed, **options)
    asyncio.run(attack.call(calls))
    return attack
