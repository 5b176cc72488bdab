"""Sample agent that joins over MCP and takes the scans of its task, without a model and without afspm.

Copy this file, and replace `order_of` by a model: `prompt.txt` holds the task, and `client.list_tools()` the tools.

    afspm bench run operate/places --command "python3 -m afspm_bench.agents.mcp_sample"
"""

from __future__ import annotations

import asyncio
import json
import os
from pathlib import Path
from typing import Any

import httpx2
from mcp import Client
from mcp.client.streamable_http import streamable_http_client

URL, TOKEN = os.environ["AFSPM_BENCH_MCP_URL"], os.environ["AFSPM_BENCH_MCP_TOKEN"]


def length(value_m: float) -> str:
    return f"{value_m * 1e9:.6g} nm"


def order_of(given: dict[str, Any]) -> list[dict[str, object]]:
    """Return the scans of a task as steps for the tool `measure`."""
    size, pixels = [length(given["size_m"])] * 2, [given["pixels"]] * 2
    return [{"do": "scan", "center": list(map(length, at)), "size": size, "pixels": pixels} for at in given["scans"]]


async def call(client: Client, tool: str, **arguments: object) -> Any:
    answer = await client.call_tool(tool, arguments)
    text = next(one.text for one in answer.content if one.type == "text")
    if answer.is_error:
        raise RuntimeError(f"{tool}: {text}")
    return json.loads(text)


async def measured(client: Client, step: dict[str, object]) -> list[str]:
    """Carry out one step, and return the ids of its scans and spectra."""
    begun = await call(client, "measure", step=step)
    while True:
        run = next(one for one in (await call(client, "status"))["runs"] if one["id"] == begun["run"])
        if run["state"] != "running":
            break
        await asyncio.sleep(0.2)
    if run["state"] != "done":
        raise RuntimeError(f"the step {step} {run['state']}: {run['untrusted']['reason']}")
    results: list[str] = run["results"]
    return results


async def main() -> None:
    task = json.loads(Path("task.json").read_text(encoding="utf-8"))
    http = httpx2.AsyncClient(headers={"Authorization": f"Bearer {TOKEN}"}, timeout=60.0)
    async with http, Client(streamable_http_client(URL, http_client=http)) as client:
        cites = [cite for step in order_of(task["given"]) for cite in await measured(client, step)]
    Path("report.json").write_text(json.dumps({"status": "done", "cites": cites}), encoding="utf-8")


if __name__ == "__main__":
    asyncio.run(main())
