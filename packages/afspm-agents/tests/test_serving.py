"""The HTTP server of the tools: no caller takes room from another."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import httpx2
from agent_rig import AgentRig
from mcp import Client
from mcp.client.streamable_http import streamable_http_client
from test_tools import facts

from afspm.basics import ExperimentClock
from afspm.plugins.web.asgi import AsgiApp
from afspm.plugins.web.passwords import Passwords
from afspm_agents.serving import PATH, application

URL = f"http://127.0.0.1{PATH}"
INITIALIZE = {
    "jsonrpc": "2.0", "id": 1, "method": "initialize",
    "params": {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "x", "version": "1"}},
}  # fmt: skip


@asynccontextmanager
async def served(app: AsgiApp) -> AsyncIterator[httpx2.ASGITransport]:
    """Serve an application in this loop, between its startup and its shutdown."""
    orders: asyncio.Queue[Any] = asyncio.Queue()
    answers: asyncio.Queue[Any] = asyncio.Queue()
    task = asyncio.ensure_future(app({"type": "lifespan", "asgi": {"version": "3.0"}}, orders.get, answers.put))
    for order in ("startup", "shutdown"):
        await orders.put({"type": f"lifespan.{order}"})
        assert (await answers.get())["type"] == f"lifespan.{order}.complete"
        if order == "startup":
            yield httpx2.ASGITransport(app)
    await task


def test_callers_without_a_name_open_no_sessions_and_stop_is_answered_in_the_older_protocol() -> None:
    passwords = Passwords("127.0.0.1", "", {}, ExperimentClock.real().now_s)

    async def whole() -> None:
        app = application(AgentRig().tools, passwords, host="127.0.0.1")
        headers = {"Accept": "application/json, text/event-stream"}
        async with served(app) as transport, httpx2.AsyncClient(transport=transport, headers=headers) as nobody:
            for _ in range(20):
                opened = await nobody.post(URL, json=INITIALIZE)
                assert opened.status_code == 200
                assert "mcp-session-id" not in opened.headers
            async with (
                httpx2.AsyncClient(transport=transport, headers={"Authorization": "Bearer claude:"}) as http,
                Client(streamable_http_client(URL, http_client=http), mode="legacy") as agent,
            ):
                assert facts(await agent.call_tool("stop", {"reason": "too many callers"}))["stopped"] is True

    asyncio.run(whole())
