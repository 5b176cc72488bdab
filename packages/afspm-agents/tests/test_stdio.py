"""`afspm agent`: the tools over stdin and stdout, called by the client of the protocol's own library."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from afspm_process import AFSPM
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client
from tests.system.agent.agent_lab import GRANT, PLAN, SCAN, AgentClient, AgentRun, Started, started  # noqa: F401

from afspm_agents.commands import NAME_VARIABLE

pytestmark = pytest.mark.slow


@asynccontextmanager
async def joined(run: AgentRun, name: str = "claude", mode: Any = "auto") -> AsyncIterator[AgentClient]:
    """A client that starts the bridge itself, as desktop clients do."""
    command, *arguments = AFSPM
    environment = {**os.environ, NAME_VARIABLE: f"{name}:" if name else ""}
    server = StdioServerParameters(command=command, args=[*arguments, "agent", run.url], env=environment)
    async with Client(stdio_client(server), mode=mode) as client:
        yield AgentClient(client)


@pytest.mark.parametrize("mode", ["auto", "legacy"])
def test_agent_measures_and_stops_over_stdin_and_stdout(started: Started, mode: str) -> None:
    run = started()
    run.grant(GRANT)

    async def whole() -> None:
        async with joined(run, mode=mode) as agent, run.client() as direct:
            assert await agent.client.list_tools() == await direct.client.list_tools()
            assert agent.client.instructions == direct.client.instructions
            assert (await agent.call("status"))["you"] == "agent:claude"
            done = await agent.ended((await agent.call("measure", step=SCAN))["run"])
            assert done["state"] == "done"
            picture = await agent.client.call_tool("scan_image", {"scan": "newest"})
            assert [one.type for one in picture.content] == ["text", "image"]
            assert (await agent.refused("scans", count="3"))["code"] == "invalid"
            assert (await agent.call("stop", reason="it looks wrong"))["stopped"] is True
            await direct.has_problems(["stopped-by-agent"])

    asyncio.run(whole())


def test_bridge_without_a_name_only_looks_and_outlives_a_killed_server(started: Started) -> None:
    run = started()

    async def whole() -> None:
        async with joined(run, name="") as agent:
            assert (await agent.call("status"))["you"] is None
            assert (await agent.refused("propose", plan=PLAN))["code"] == "name-needed"
            run.kill("agent")
            for _ in range(2):
                lost = await agent.refused("status")
                assert (lost["code"], lost["may_have_been_done"]) == ("no-response", True)
                assert "the agent server does not answer" in lost["untrusted"]["reason"]

    asyncio.run(whole())
