"""The tools of an agent server over stdin and stdout: each call is passed on over HTTP."""

from __future__ import annotations

from typing import Any

import httpx2
from mcp import Client, types
from mcp.client.streamable_http import streamable_http_client
from mcp.server.lowlevel import Server
from mcp.server.stdio import stdio_server

from afspm.plugins.agent.serving import PATH

ANSWER_S = 300.0


async def serve(url: str, name_and_token: str) -> None:
    """Serve until stdin ends.

    Args:
        name_and_token: NAME:TOKEN; empty: the agent only looks.
    """
    headers = {"Authorization": f"Bearer {name_and_token}"} if name_and_token else {}
    address = url if url.endswith(PATH) else f"{url.rstrip('/')}{PATH}"
    async with (
        httpx2.AsyncClient(headers=headers, timeout=ANSWER_S) as http,
        Client(streamable_http_client(address, http_client=http)) as client,
    ):

        async def list_tools(context: Any, asked: Any) -> types.ListToolsResult:
            return await client.list_tools()

        async def call_tool(context: Any, asked: types.CallToolRequestParams) -> types.CallToolResult:
            return await client.call_tool(asked.name, asked.arguments)

        bridge: Server[Any] = Server(
            "afspm", instructions=client.instructions, on_list_tools=list_tools, on_call_tool=call_tool
        )
        async with stdio_server() as (read, write):
            await bridge.run(read, write, bridge.create_initialization_options())
