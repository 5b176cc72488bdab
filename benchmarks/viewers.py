"""`python -m benchmarks.viewers URL COUNT`: this number of viewers of a dashboard, without browsers.

Each does what a browser does on the wire: it gets the page, its websocket with its replies, and picture after picture.
Prints "ready" when all have a picture, and ends with its standard input. The viewers stand for other computers, so on
this one the measured processes have priority.
"""

from __future__ import annotations

import asyncio
import json
import re
import sys
from typing import Any

import aiohttp
import socketio

from afspm.transport.process.context import step_back


async def view(url: str, seen: asyncio.Semaphore) -> None:
    """View the page until cancelled."""
    async with aiohttp.ClientSession() as session:
        async with session.get(url) as answer:
            page = await answer.text()
        found = re.search(r"""[\"']client_id[\"']: *[\"']([^\"']+)""", page)
        assert found, "NiceGUI's page has no client_id any more"
        socket = await _connect(url, found[1])
        try:
            await _pictures(url, session, seen)
        finally:
            await socket.disconnect()


async def _connect(url: str, client_id: str) -> Any:
    socket = socketio.AsyncClient(reconnection=False)

    @socket.on("run_javascript")  # type: ignore[untyped-decorator]
    async def answer(message: dict[str, Any]) -> None:
        if request := message.get("request_id"):
            told = {"request_id": request, "client_id": client_id, "result": ""}
            await socket.emit("javascript_response", told)

    await socket.connect(
        f"{url}?client_id={client_id}", socketio_path="_nicegui_ws/socket.io", transports=["websocket"]
    )
    told = {"client_id": client_id, "tab_id": client_id, "document_id": client_id, "next_message_id": 0}
    assert await socket.call("handshake", told)
    return socket


async def _pictures(url: str, session: aiohttp.ClientSession, seen: asyncio.Semaphore) -> None:
    after = 0
    while True:
        async with session.get(f"{url}/live/image", params={"after": str(after)}) as answer:
            await answer.read()
            if answer.status == 200:
                if not after:
                    seen.release()
                after = json.loads(answer.headers["X-Frame"])["number"]


async def main(url: str, count: int) -> None:
    seen = asyncio.Semaphore(0)
    viewers = [asyncio.create_task(view(url, seen)) for _ in range(count)]
    for _ in range(count):
        await asyncio.wait_for(seen.acquire(), 60.0)
    print("ready", flush=True)
    await asyncio.to_thread(sys.stdin.read)
    for viewer in viewers:
        viewer.cancel()
    await asyncio.gather(*viewers, return_exceptions=True)


if __name__ == "__main__":
    step_back()
    asyncio.run(main(sys.argv[1], int(sys.argv[2])))
