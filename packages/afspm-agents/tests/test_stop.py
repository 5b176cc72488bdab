"""`stop` of an agent takes effect while calls are blocked, a disk is full or hangs, and the scheduler restarts."""

from __future__ import annotations

import asyncio
import logging
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from deadlines import DEADLINE_S
from small_disk import fill, small_disk
from tests.system.agent.agent_lab import GRANT, PLAN, SCAN, AgentClient, Started, started  # noqa: F401

pytestmark = pytest.mark.slow

HOOK = Path(__file__).parents[2] / "support" / "hanging_disk"
BLOCKED = 45
"""More calls than a pool of 40 threads serves."""
LONG = {**SCAN, "pixels": [512, 512]}
_log = logging.getLogger(__name__)


async def stopped(agent: AgentClient) -> None:
    began_s = time.monotonic()
    assert (await agent.call("stop", reason="it looks wrong"))["stopped"] is True
    _log.warning("stop was accepted after %.3f s", time.monotonic() - began_s)


async def until(agent: AgentClient, holds: Callable[[Any], bool]) -> None:
    end_s = time.monotonic() + DEADLINE_S
    while not holds(state := await agent.call("status")):
        assert time.monotonic() < end_s, state
        await asyncio.sleep(0.05)


def is_flagged(state: Any) -> bool:
    return bool(state["problems"] == ["stopped-by-agent"])


def is_scanning(state: Any) -> bool:
    return bool(state["microscope"]["state"] == "SCANNING")


@pytest.fixture
def full_disk(tmp_path: Path) -> Iterator[Path]:
    """A small disk for all runs."""
    with small_disk(tmp_path / "runs") as runs:
        yield runs


def test_stop_does_not_wait_for_a_preflight(started: Started) -> None:
    run = started()

    async def stop(agent: AgentClient) -> None:
        steps = [{**SCAN, "pixels": [512, 512]} for _ in range(30)]
        proposed = await agent.call("propose", plan={"title": "long", "steps": steps})
        preflight = asyncio.ensure_future(agent.client.call_tool("preflight", {"proposal": proposed["proposal"]}))
        server, end_s = psutil.Process(run.pid("agent")), time.monotonic() + DEADLINE_S
        while not any("afspm_agents.twin" in child.cmdline() for child in server.children()):
            assert time.monotonic() < end_s
            assert not preflight.done()
            await asyncio.sleep(0.02)
        await stopped(agent)
        assert not preflight.done()
        await until(agent, is_flagged)
        await preflight

    run.act(stop)


def test_stop_does_not_wait_for_blocked_calls(started: Started) -> None:
    run = started()

    async def stop(agent: AgentClient) -> None:
        run.freeze("microscope")
        calls = [asyncio.ensure_future(agent.client.call_tool("capabilities", {})) for _ in range(BLOCKED)]
        await asyncio.wait(calls, timeout=1.0)
        assert not any(one.done() for one in calls)
        await stopped(agent)
        await until(agent, is_flagged)
        for one in calls:
            one.cancel()

    run.act(stop)


@pytest.mark.parametrize("again", [False, True], ids=["while it starts", "after its start"])
def test_stop_takes_effect_after_a_restart_of_the_scheduler(started: Started, *, again: bool) -> None:
    run = started()
    run.grant(GRANT)

    async def stop(agent: AgentClient) -> None:
        await agent.call("measure", step=LONG)
        await until(agent, is_scanning)
        run.kill("scheduler")
        if again:
            run.wait_up("scheduler", 2)
            await stopped(agent)
        else:
            await agent.call("stop", reason="it looks wrong")  # accepted now, or tried again until it is
        await until(agent, is_flagged)
        await until(agent, lambda state: not is_scanning(state))

    run.act(stop)


def test_stop_takes_effect_with_a_full_disk(started: Started, full_disk: Path) -> None:
    run = started()
    run.grant(GRANT)

    async def stop(agent: AgentClient) -> None:
        await agent.call("measure", step=LONG)
        await until(agent, is_scanning)
        fill(full_disk / "filler")
        await stopped(agent)
        await until(agent, is_flagged)
        await until(agent, lambda state: not is_scanning(state))

    run.act(stop)
    (full_disk / "filler").unlink()


@pytest.mark.skipif(sys.platform != "linux", reason="what a descriptor is open on is found in /proc")
def test_stop_takes_effect_with_a_hanging_disk(
    started: Started, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(HOOK))
    monkeypatch.setenv("HANGING_FOLDER", str(tmp_path / "runs"))
    run = started()
    monkeypatch.delenv("PYTHONPATH")
    run.grant(GRANT)
    switch = tmp_path / "runs.hangs"

    async def stop(agent: AgentClient) -> None:
        await agent.call("measure", step=LONG)
        await until(agent, is_scanning)
        switch.touch()
        # a call that saves: another run is refused, and the one that goes on ends by the stop
        await agent.refused("measure", step=LONG)
        await stopped(agent)
        await until(agent, is_flagged)
        await until(agent, lambda state: not is_scanning(state))
        switch.unlink()
        assert (await agent.call("propose", plan=PLAN))["proposal"]

    run.act(stop)
