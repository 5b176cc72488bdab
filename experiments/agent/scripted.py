"""A client without a model, which calls the tools in a fixed order, and a person who approves what it proposes."""

import asyncio
import json
import time

import httpx2
from mcp import Client
from mcp.client.streamable_http import streamable_http_client

from afspm import Component
from afspm.model import Frame
from afspm_agents.approval import of_plan, of_table

NAME = "script"
WITHIN_S = 120.0  # real
OVERVIEW = {"do": "scan", "center": ["0 nm", "0 nm"], "size": ["2 um", "2 um"], "pixels": [64, 64]}
GRANT = {
    "agent": f"agent:{NAME}",
    "for": "1 h",
    "region": {"x": ["-1 um", "1 um"], "y": ["-1 um", "1 um"]},
    "counts": {"start-spec": 1},
}


class ScriptedModel(Component):
    """Looks at the whole region, goes to its highest block, and takes a curve there."""

    listens = ("ControlState",)
    longest_step_s = 2 * WITHIN_S

    def run(self):
        asyncio.run(self.measure())
        self.scope.end_experiment()

    async def measure(self):
        async with (
            httpx2.AsyncClient(headers={"Authorization": f"Bearer {NAME}:"}, timeout=WITHIN_S) as http,
            Client(streamable_http_client(f"{self.url()}/mcp", http_client=http)) as self.client,
        ):
            plan = {"title": "an overview, to find the highest particle", "steps": [OVERVIEW]}
            proposal = (await self.call("propose", plan=plan))["proposal"]
            simulated = await self.call("preflight", proposal=proposal)
            self.log.info(
                "simulated: %s s, refused by limits: %s", simulated["seconds"], simulated["refused_by_limits"]
            )
            await self.until(lambda state: any(one["plan"] == proposal for one in state["approvals"]))
            overview = await self.ended(await self.call("run", proposal=proposal))
            numbers = await self.call("scan_numbers", scan=overview["results"][0])
            x_m, y_m = highest(numbers)
            self.log.info("the highest block is at %.0f, %.0f nm", x_m * 1e9, y_m * 1e9)
            await self.until(lambda state: any(one["plan"] is None for one in state["approvals"]))
            curve = {"do": "spectrum", "at": [f"{x_m * 1e9:.3f} nm", f"{y_m * 1e9:.3f} nm"]}
            await self.ended(await self.call("measure", step=curve))
            refused = await self.ended(await self.call("measure", step=curve), state="failed")
            self.log.info("a second curve is refused: %s", refused["untrusted"]["reason"])

    def url(self):
        # the agent server notes it when it has started
        file = self.run_dir / "state" / "agent.json"
        until_s = time.monotonic() + WITHIN_S
        while time.monotonic() < until_s:
            url = json.loads(file.read_text(encoding="utf-8")).get("url") if file.exists() else None
            if url is not None:
                return url
            self.scope.sleep(1.0)
        raise RuntimeError("the agent server did not start")

    async def call(self, tool, **given):
        answer = await self.client.call_tool(tool, given)
        facts = json.loads(answer.content[0].text)
        if answer.is_error:
            raise RuntimeError(f"{tool}: {facts}")
        return facts

    async def until(self, holds):
        until_s = time.monotonic() + WITHIN_S
        while not holds(state := await self.call("status")):
            if time.monotonic() > until_s:
                raise RuntimeError(f"waited in vain: {state}")
            await asyncio.sleep(0.2)
        return state

    async def ended(self, begun, state="done"):
        def run(status):
            return next(one for one in status["runs"] if one["id"] == begun["run"])

        found = run(await self.until(lambda status: run(status)["state"] != "running"))
        if found["state"] != state:
            raise RuntimeError(f"the run is {found}")
        return found


class ScriptedPerson(Component):
    """Approves every plan that has a preflight, and gives a grant for one curve. A real person would look first."""

    listens = ("Proposal",)

    def on_proposal(self, proposal):
        if not proposal.preflight or proposal.time_ns <= self.memory.get("newest_ns", -1):
            return  # not simulated yet, or approved before a restart
        self.memory["newest_ns"] = proposal.time_ns
        facts = self.scope.approval_facts()  # as of what this person sees
        grant, plan = of_plan(proposal, Frame.TIP, facts)
        self.log.info("approves %s of %s: %d requests", plan.id, proposal.who, len(grant.steps))
        self.scope.approve(grant)
        self.scope.approve(of_table(GRANT, facts))


def highest(numbers):
    """Return x and y, in m, of the middle of the highest block of the first channel with heights."""
    # another microscope may publish an amplitude before the height
    heights = next(n for n, channel in enumerate(numbers["untrusted"]["channels"]) if channel.endswith(" (m)"))
    blocks = numbers["numbers"][heights]["blocks"]
    rows, columns = len(blocks), len(blocks[0])
    row, column = max(((r, c) for r in range(rows) for c in range(columns)), key=lambda at: blocks[at[0]][at[1]])
    (x_m, y_m), (width_m, height_m) = numbers["center_m"], numbers["size_m"]
    return x_m + ((column + 0.5) / columns - 0.5) * width_m, y_m + ((row + 0.5) / rows - 0.5) * height_m
