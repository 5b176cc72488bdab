"""An experiment with an agent server, and an agent that calls its tools."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx2
import pytest
from afspm_process import AfspmProcess
from deadlines import DEADLINE_S
from mcp import Client
from mcp.client.streamable_http import streamable_http_client

EXPERIMENT = """
[clock]
speed = 60.0

[microscope]
component = true
class = "Simulator"
seed = 1
initial = { scan-speed = "2 um/s" }

[scheduler]
component = true
class = "Scheduler"

[agent]
component = true
class = "Agent"
port = 0

[limits]
region = { x = ["-5 um", "5 um"], y = ["-5 um", "5 um"] }

[limits.roles.agent]
actions = ["start-scan", "start-spec"]
parameters = { tip-bias-voltage = ["-1 V", "1 V"], scan-speed = ["0.1 um/s", "50 um/s"] }
region = { x = ["-2 um", "2 um"], y = ["-2 um", "2 um"] }
per_hour = { start-scan = 30 }
"""
SCAN = {"do": "scan", "center": ["0 nm", "0 nm"], "size": ["500 nm", "500 nm"], "pixels": [16, 16]}
PLAN = {"title": "look", "steps": [{"do": "set", "parameter": "tip-bias-voltage", "value": "0.5 V"}, SCAN]}
GRANT = """
agent = "agent:claude"
for = "2 h"
region = { x = ["-1 um", "1 um"], y = ["-1 um", "1 um"] }
parameters = { tip-bias-voltage = ["-0.5 V", "0.5 V"] }
counts = { start-scan = 2 }
"""


class AgentClient:
    """Calls tools, and reads their answers."""

    def __init__(self, client: Client) -> None:
        self.client = client

    async def call(self, tool: str, **given: Any) -> Any:
        """Return the content of a successful answer."""
        answer = await self.client.call_tool(tool, given)
        assert not answer.is_error, answer
        return json.loads(answer.content[0].text)  # type: ignore[union-attr]

    async def refused(self, tool: str, **given: Any) -> Any:
        """Return the content of a refusal."""
        answer = await self.client.call_tool(tool, given)
        assert answer.is_error, answer
        return json.loads(answer.content[0].text)  # type: ignore[union-attr]

    async def ended(self, run: str) -> Any:
        """Return a run at its end."""
        end_s = time.monotonic() + DEADLINE_S
        while True:
            (found,) = [one for one in (await self.call("status"))["runs"] if one["id"] == run]
            if found["state"] != "running":
                return found
            assert time.monotonic() < end_s, found
            await asyncio.sleep(0.1)

    async def has_problems(self, wanted: list[str]) -> None:
        """Wait until the server has received these flags: the answer to a stop may come first."""
        end_s = time.monotonic() + DEADLINE_S
        while (found := (await self.call("status"))["problems"]) != wanted:
            assert time.monotonic() < end_s, found
            await asyncio.sleep(0.1)


class AgentRun(AfspmProcess):
    """`afspm run` of an experiment with an agent server."""

    def __init__(self, folder: Path, more: str = "", experiment: str = EXPERIMENT) -> None:
        file = folder / "experiment.toml"
        file.write_text(experiment + more, encoding="utf-8")
        super().__init__("run", "--verbose", "--no-report", str(file), "--runs", str(folder / "runs"), folder=folder)
        self.url = f"{self.wait_for_url('agent server')}/mcp"
        self.home = folder

    @asynccontextmanager
    async def client(self, name: str = "claude", mode: Any = "auto") -> AsyncIterator[AgentClient]:
        headers = {"Authorization": f"Bearer {name}:"} if name else {}
        async with (
            httpx2.AsyncClient(headers=headers, timeout=DEADLINE_S) as http,
            Client(streamable_http_client(self.url, http_client=http), mode=mode) as client,
        ):
            yield AgentClient(client)

    def act(self, doing: Callable[[AgentClient], Awaitable[Any]], name: str = "claude", mode: Any = "auto") -> Any:
        """Let an agent do something."""

        async def whole() -> Any:
            async with self.client(name, mode) as client:
                return await doing(client)

        return asyncio.run(whole())

    def person(self, *arguments: str) -> str:
        """Let a person use a command of `afspm`."""
        return AfspmProcess(*arguments, folder=self.home).read_to_the_end()

    def grant(self, text: str = GRANT) -> None:
        """Let a person give a grant."""
        file = self.home / "grant.toml"
        file.write_text(text, encoding="utf-8")
        self.person("approve", "--grant", str(file), "--yes", "", str(self.folder))


Started = Callable[..., AgentRun]


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Started]:
    """Starts an experiment with an agent server; killed after the test."""
    runs: list[AgentRun] = []

    def start(more: str = "", **options: Any) -> AgentRun:
        runs.append(AgentRun(tmp_path, more, **options))
        return runs[-1]

    yield start
    for one in runs:
        one.close()
