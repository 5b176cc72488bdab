"""Messages of browsers that the page's libraries can't process."""

from __future__ import annotations

import asyncio
import logging

import pytest
import socketio
from fake_clock import FakeClock

from afspm.plugins.web.dashboard.application import MessageComplaints


# faults 10
def test_unprocessable_messages_are_one_line_each_and_a_flood_is_counted(caplog: pytest.LogCaptureFixture) -> None:
    clock = FakeClock(1_750_000_000.0)
    complaints = MessageComplaints(clock)
    loggers = [logging.getLogger(name) for name in ("engineio.server", "asyncio")]
    server = socketio.AsyncServer(async_mode="asgi", async_handlers=False)
    caplog.set_level(logging.INFO)

    async def receive(messages: int) -> None:
        for _ in range(messages):
            await server.eio._trigger_event("message", "sid", '2["event",' + "[" * 100_000, run_async=False)

    for one in loggers:
        one.addFilter(complaints)
    try:
        asyncio.run(receive(50))
        assert "Traceback" not in caplog.text
        assert len(caplog.records) == 5
        assert {one.levelname for one in caplog.records} == {"WARNING"}
        assert "a message from a browser can't be processed: " in caplog.records[0].getMessage()
        clock.t_s += 60.0
        asyncio.run(receive(1))
        assert "dropped 45 more warnings" in caplog.text
        logging.getLogger("asyncio").error("another error", exc_info=ValueError())
        assert "another error" in caplog.text
    finally:
        for one in loggers:
            one.removeFilter(complaints)
