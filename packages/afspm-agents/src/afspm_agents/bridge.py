"""Bridge from stdin and stdout to an agent server, for tool calls over HTTP."""

from __future__ import annotations

import json
from typing import Any

import httpx2
from mcp import Client, types
from mcp.client.streamable_http import streamable_http_client
from mcp.server.lowlevel import Server
from mcp.server.stdio import stdio_server

from afspm.basics import escaped
from afspm.plugins.web.gateway.problems import RefusalCode
from afspm_agents.serving import PATH

ANSWER_S = 300.0


async def serve(url: str, name_and_token: str) -> None:
    """Serve the tools over stdin and stdout until stdin ends.

    Args:
        name_and_token: the agent's NAME:TOKEN; if empty, the agent can only read.
    """
    headers = {"Authorization": f"Bearer {name_and_token}"} if name_and_token else {}
    address = url if url.endswith(PATH) else f"{url.rstrip('/')}{PATH}"
    async with httpx2.AsyncClient(headers=headers, timeout=ANSWER_S) as http:

        def joined(mode: str = "auto") -> Client:
            return Client(streamable_http_client(address, http_client=http), mode=mode)

        async with joined() as client:
            tools, instructions, version = await client.list_tools(), client.instructions, client.protocol_version

        async def list_tools(context: object, asked: object) -> types.ListToolsResult:
            return tools

        async def call_tool(context: object, asked: types.CallToolRequestParams) -> types.CallToolResult:
            # a client for each call: the library's connection ends for good with the first failed request, and an agent
            # server that was killed is started again
            try:
                async with joined(version) as client:
                    return await client.call_tool(asked.name, asked.arguments)
            except Exception as error:  # of the connection, in any of three libraries: the model must learn of it
                return _not_answered(asked.name, error)

        bridge: Server[Any] = Server(
            "afspm", instructions=instructions, on_list_tools=list_tools, on_call_tool=call_tool
        )
        async with stdio_server() as (read, write):
            await bridge.run(read, write, bridge.create_initialization_options())


def _not_answered(tool: str, error: Exception) -> types.CallToolResult:
    # as a refusal of the server, which is an answer that the model reads
    reason = f"the agent server does not answer ({escaped(str(error) or type(error).__name__)}); call {tool} again"
    facts = {"code": RefusalCode.NO_RESPONSE.value, "may_have_been_done": True, "untrusted": {"reason": reason}}
    return types.CallToolResult(content=[types.TextContent(type="text", text=json.dumps(facts))], is_error=True)
