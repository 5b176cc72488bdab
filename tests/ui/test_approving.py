"""A person gives an agent a grant on the page, and revokes it; the scheduler is the real one."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import httpx2
import pytest
from mcp import Client
from mcp.client.streamable_http import streamable_http_client
from tests.system.agent.agent_lab import SCAN, AgentClient
from tests.ui.ui_lab import DEADLINE_S, Night, Opened

PLAN = {"title": "look", "steps": [{"do": "set", "parameter": "tip-bias-voltage", "value": "0.5 V"}, SCAN]}


@pytest.fixture
def page(night: Night, opened: Opened) -> Any:
    page = opened(night.url, person="Ada")
    page.wait_for_selector("button:has-text('Give an agent a grant')")
    return page


@pytest.fixture
def no_approval_afterwards(night: Night, opened: Opened) -> Iterator[None]:
    """Revoke what the agent may do: it is given for hours."""
    yield
    page = opened(night.url, person="Ada")
    page.click(".approval button:has-text('Revoke')")
    night.until(lambda: not approvals(night))


def act(night: Night, doing: Callable[[AgentClient], Awaitable[Any]]) -> Any:
    """Let an agent do something; in a thread, because the browser's driver has the loop of this one."""
    found: list[Any] = []
    url = f"{night.wait_for_url('agent server')}/mcp"

    async def whole() -> None:
        async with (
            httpx2.AsyncClient(headers={"Authorization": "Bearer claude:"}, timeout=DEADLINE_S) as http,
            Client(streamable_http_client(url, http_client=http)) as client,
        ):
            found.append(await doing(AgentClient(client)))

    thread = threading.Thread(target=lambda: asyncio.run(whole()))
    thread.start()
    thread.join(DEADLINE_S)
    return found[0]


def fill(page: Any, **fields: str) -> None:
    for label, text in fields.items():
        page.fill(f".question input[aria-label='{label.replace('_', ' ')}']", text)


def give(page: Any) -> None:
    page.get_by_role("button", name="Give the grant", exact=True).click()


def approvals(night: Night) -> Any:
    return night.follower.overview.approvals.approvals


def test_grant_is_given_in_the_dialog_and_ends_with_manual(night: Night, page: Any, keep: Any) -> None:
    page.click("button:has-text('Give an agent a grant')")
    page.wait_for_selector(".question.grant")
    assert page.input_value(".question input[aria-label='x-pulse']") == "0"
    assert page.input_value(".question input[aria-label='x-crash']") == "0"
    fill(page, agent="agent:claude", x_from="-1 um", x_to="1 um", y_from="-1 um", y_to="1 um")
    page.fill(".question input[aria-label='for']", "2")
    give(page)
    page.wait_for_selector(".question .wrong:has-text('unit')")  # the same refusal as of `afspm approve --grant`
    page.fill(".question input[aria-label='for']", "2 h")
    page.fill(".question input[aria-label='start-scan']", "2")
    fill(page, parameter_1="tip-bias-voltage", lowest_1="-0.5 V", highest_1="0.5 V")
    keep(page, "grant-dialog")
    give(page)
    (given,) = night.until(lambda: approvals(night))
    assert (given.agent, given.by, given.region_m) == ("agent:claude", "dashboard:Ada", (0.0, 0.0, 2e-6, 2e-6))
    assert [(one.action, one.count) for one in given.counts] == [("start-scan", 2)]
    page.wait_for_selector(".approval:has-text('start-scan: 0 of 2 used')")
    page.click("button:has-text('Take over')")  # MANUAL ends all approvals
    night.until(lambda: not approvals(night))
    page.locator(".approval").wait_for(state="detached")
    page.click("button:has-text('Hand back')")


def test_scheduler_refuses_a_grant_in_the_dialog(night: Night, page: Any) -> None:
    page.click("button:has-text('Give an agent a grant')")
    page.fill(".question input[aria-label='agent']", "series:claude")
    give(page)
    page.wait_for_selector(".question .wrong:has-text('is not an agent of this experiment')")
    page.fill(".question input[aria-label='agent']", "agent:claude")
    give(page)
    page.locator(".question").wait_for(state="detached")
    night.until(lambda: approvals(night))
    page.click(".approval button:has-text('Revoke')")
    night.until(lambda: not approvals(night))


def test_place_of_a_grant_is_drawn_in_the_picture(night: Night, page: Any, keep: Any) -> None:
    page.wait_for_function("document.querySelector('.picture').dataset.number > 0")
    page.click("[data-tool=grant]")
    box = page.locator(".picture").bounding_box()
    x, y = box["x"] + box["width"] * 0.4, box["y"] + box["height"] * 0.4
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 60, y + 40, steps=4)
    page.mouse.up()
    page.wait_for_selector(".question.grant")
    edges = [page.input_value(f".question input[aria-label='{one}']") for one in ("x from", "x to", "y from", "y to")]
    assert all(edge.endswith("m") for edge in edges)
    page.fill(".question input[aria-label='agent']", "agent:claude")
    give(page)
    (given,) = night.until(lambda: approvals(night))
    _, _, width, height = given.region_m
    assert 1.3 < width / height < 1.7
    page.click(".approval button:has-text('Revoke')")
    night.until(lambda: not approvals(night))


@pytest.mark.usefixtures("no_approval_afterwards")
def test_waiting_proposal_is_readable_on_a_phone_and_approved_there(night: Night, opened: Opened, keep: Any) -> None:
    async def propose(agent: AgentClient) -> str:
        proposed = await agent.call("propose", plan=PLAN)
        await agent.call("preflight", proposal=proposed["proposal"])
        return str(proposed["proposal"])

    proposal = act(night, propose)
    page = opened(night.url, person="Ada", width=390, height=844)
    bar = page.locator(".approvals .waits")
    bar.wait_for(timeout=DEADLINE_S * 1000)
    text = bar.inner_text()
    assert "agent:claude" in text
    assert "“look”: set tip-bias-voltage to 0.5 V" in text
    assert "Simulated:" in text
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    keep(page, "approval-phone")
    page.click(f"button[aria-label='Review {proposal}']")
    page.wait_for_selector(".question li:has-text('tip-bias-voltage')")
    page.get_by_role("button", name="Approve", exact=True).click()
    (given,) = night.until(lambda: approvals(night))
    assert given.plan == proposal
    page.wait_for_selector(".approval:has-text('may carry out plan')")
