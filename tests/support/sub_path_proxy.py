"""A reverse proxy that serves another server below a path, as a laboratory's web server does: /lab/… becomes /…."""

from __future__ import annotations

import asyncio
import threading
from types import TracebackType
from typing import Self
from urllib.parse import urlsplit

END_OF_HEAD = b"\r\n\r\n"


class SubPathProxy:
    """The proxy, in a thread. It strips the path and names it in X-Forwarded-Prefix; websockets pass.

    Attributes:
        url: address of the page, with the path and a slash.
        outside: paths asked for beside the path, which a laboratory's web server would not find.
    """

    def __init__(self, target: str, path: str = "/lab") -> None:
        parts = urlsplit(target)
        self._host, self._port, self._path = str(parts.hostname), int(parts.port or 80), path.encode()
        self.outside: list[str] = []
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)
        self._thread.start()
        starting = asyncio.start_server(self._serve, "127.0.0.1", 0)
        self._server = asyncio.run_coroutine_threadsafe(starting, self._loop).result()
        self.url = f"http://127.0.0.1:{self._server.sockets[0].getsockname()[1]}{path}/"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        asyncio.run_coroutine_threadsafe(self._close(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)  # after the callbacks of the connections closed just now
        self._thread.join()

    async def _close(self) -> None:
        self._server.close()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for one in others:
            one.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _serve(self, browser: asyncio.StreamReader, to_browser: asyncio.StreamWriter) -> None:
        try:
            head = await browser.readuntil(END_OF_HEAD)
            line, _, rest = head.partition(b"\r\n")
            method, path, version = line.split(b" ")
            if not path.startswith(self._path + b"/"):
                self.outside.append(path.decode())
                to_browser.write(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
                return
            more = b"X-Forwarded-Prefix: " + self._path + b"\r\n"
            if b"upgrade: websocket" not in rest.lower():  # one request a connection: each has its own line
                more += b"Connection: close\r\n"
                rest = b"\r\n".join(one for one in rest.split(b"\r\n") if not one.lower().startswith(b"connection:"))
            server, to_server = await asyncio.open_connection(self._host, self._port)
            to_server.write(b" ".join((method, path.removeprefix(self._path), version)) + b"\r\n" + more + rest)
            await asyncio.gather(_copy(browser, to_server), _copy(server, to_browser))
        except (OSError, asyncio.IncompleteReadError):
            return  # the browser has gone
        finally:
            to_browser.close()


async def _copy(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
    try:
        while data := await source.read(1 << 16):
            target.write(data)
            await target.drain()
    finally:
        target.close()
