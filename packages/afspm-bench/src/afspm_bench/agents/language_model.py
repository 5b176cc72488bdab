"""Agent that gives the tools of the agent server to a language model, behind any server of chat completions.

    export AFSPM_MODEL_URL=https://… AFSPM_MODEL=… AFSPM_MODEL_KEY=…
    afspm bench run --speed 10 --patience 1800 --command "python3 -m afspm_bench.agents.language_model"

The requests are those of OpenAI's chat completions with function calls, which most servers of models understand.
"""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from afspm.basics import InvalidValue
from afspm_bench.evidence import Report

MOST_TURNS: Final = 60
"""Answers of the model in one trial; a model that has not reported by then fails the trial."""
REPORT: Final = "report"
_TO_REPORT: Final = {
    "type": "function",
    "function": {
        "name": REPORT,
        "description": "End the task with its report, as the task describes it.",
        "parameters": {
            "type": "object",
            "properties": {
                "status": {"type": "string", "enum": ["done", "cannot", "ask"]},
                "answer": {"type": "object", "description": "as the task describes it"},
                "cites": {
                    "type": "array",
                    "items": {"type": "string"},
                    "description": "ids of the measurements that the answer rests on",
                },
                "asks": {"type": "array", "items": {"type": "string"}, "description": "names of the missing facts"},
            },
            "required": ["status"],
            "additionalProperties": False,
        },
    },
}
Message = dict[str, Any]
Ask = Callable[[Sequence[Message], Sequence[Message]], Awaitable[Message]]
"""Sends messages and tools to the model, and returns its completion."""
Call = Callable[[str, Mapping[str, Any]], Awaitable[str]]
"""Calls a tool of the agent server, and returns its answer or its error as text."""


async def converse(prompt: str, tools: Sequence[Message], ask: Ask, call: Call) -> Message | None:
    """Let a model call tools until it reports; return its report with `usage`, or None after `MOST_TURNS`."""
    messages: list[Message] = [{"role": "user", "content": prompt}]
    usage = {"turns": 0, "prompt_tokens": 0, "completion_tokens": 0}
    for _ in range(MOST_TURNS):
        completion = await ask(messages, [*tools, _TO_REPORT])
        usage["turns"] += 1
        for name in ("prompt_tokens", "completion_tokens"):
            usage[name] += int((completion.get("usage") or {}).get(name) or 0)
        message = completion["choices"][0]["message"]
        messages.append(message)
        calls = message.get("tool_calls") or []
        if not calls:
            messages.append({"role": "user", "content": f"Go on with a tool, or end the task with {REPORT!r}."})
        for one in calls:
            name = one["function"]["name"]
            try:
                given = json.loads(one["function"]["arguments"] or "{}")
            except ValueError as error:
                answer = f"the arguments are no JSON: {error}"
            else:
                if name != REPORT:
                    answer = await call(name, given)
                elif not (answer := _fault_of(given)):
                    return {**given, "usage": usage}
            messages.append({"role": "tool", "tool_call_id": one["id"], "content": answer})
    return None


def _fault_of(report: object) -> str:
    # the model may report again: the bench judges the work, not the format of one call
    try:
        Report.from_plain(report)
    except InvalidValue as error:
        return str(error)
    return ""


async def main() -> None:
    import httpx2
    from mcp import Client
    from mcp.client.streamable_http import streamable_http_client

    # read here: without one of these variables the error names it
    url, token = os.environ["AFSPM_BENCH_MCP_URL"], os.environ["AFSPM_BENCH_MCP_TOKEN"]
    model_url, model, key = (os.environ[f"AFSPM_MODEL{end}"] for end in ("_URL", "", "_KEY"))
    http = httpx2.AsyncClient(headers={"Authorization": f"Bearer {token}"}, timeout=60.0)
    to_model = httpx2.AsyncClient(headers={"Authorization": f"Bearer {key}"}, timeout=600.0)

    async with http, to_model, Client(streamable_http_client(url, http_client=http)) as client:

        async def ask(messages: Sequence[Message], tools: Sequence[Message]) -> Message:
            asked = {"model": model, "messages": messages, "tools": tools}
            response = await to_model.post(f"{model_url.rstrip('/')}/chat/completions", json=asked)
            response.raise_for_status()
            found: Message = response.json()
            return found

        async def call(name: str, given: Mapping[str, Any]) -> str:
            answer = await client.call_tool(name, dict(given))
            return "\n".join(one.text for one in answer.content if one.type == "text")

        tools = [
            {
                "type": "function",
                "function": {"name": one.name, "description": one.description or "", "parameters": one.input_schema},
            }
            for one in (await client.list_tools()).tools
        ]
        report = await converse(Path("prompt.txt").read_text(encoding="utf-8"), tools, ask, call)
    if report is not None:
        Path("report.json").write_text(json.dumps(report), encoding="utf-8")


if __name__ == "__main__":
    asyncio.run(main())
