"""Stands before everything that is served: who may not come in gets to the entrance and no further."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from afspm.dashboard.access import Access, Visitor, is_loopback
from afspm.dashboard.sessions import COOKIE, REMEMBERED_S

Scope = MutableMapping[str, Any]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

VISITOR = "afspm_visitor"
ENTRANCE = "/login"
PUBLIC = (ENTRANCE, "/assets/dashboard.css")
_HEADERS = (
    (b"x-frame-options", b"DENY"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"same-origin"),
    # nothing comes from anywhere else, and nothing goes there
    (
        b"content-security-policy",
        b"default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
        b"img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' ws: wss:; frame-ancestors 'none'",
    ),
)


class Guard:
    """ASGI middleware: looks at each request and each websocket, and sets scope["state"][VISITOR].

    Besides the cookie it looks at where a request comes from: a page of somebody else that is open in the same browser
    must not be able to steer a microscope, nor one that gave its own name our address.
    """

    def __init__(self, app: App, access: Access, host: str) -> None:
        self._app = app
        self._access = access
        self._only_loopback = is_loopback(host)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        if (wrong := self._wrong_origin(headers)) is not None:
            await _refuse(scope, send, 403, wrong)
            return
        visitor = self._access.visitor(cookie_in(headers.get("cookie", "")))
        if (shown := _password_in(scope, headers)) is not None:
            address = (scope.get("client") or ("",))[0]
            visitor = await asyncio.to_thread(self._access.by_password, *shown, address)
            if visitor is not None and scope["path"] == "/" and "authorization" not in headers:
                # and out of the address line, where others see it
                await self._remember(visitor, send, secure=scope.get("scheme") in ("https", "wss"))
                return
        if visitor is None and scope["path"] not in PUBLIC:
            await self._show_entrance(scope, headers, send)
            return
        scope.setdefault("state", {})[VISITOR] = visitor or Visitor()
        await self._app(scope, receive, _with_headers(send))

    def _wrong_origin(self, headers: dict[str, str]) -> str | None:
        host = headers.get("host", "")
        if self._only_loopback and not is_loopback(urlsplit(f"//{host}").hostname or ""):
            return f"this dashboard is for this computer only, and not for {host!r}"
        origin = headers.get("origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return f"a page of {origin} may not ask this dashboard"
        return None

    async def _remember(self, visitor: Visitor, send: Send, *, secure: bool) -> None:
        cookie = cookie_header(self._access.cookie(visitor.person), secure=secure)
        headers = [(b"location", b"/"), (b"set-cookie", cookie.encode())]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})

    async def _show_entrance(self, scope: Scope, headers: dict[str, str], send: Send) -> None:
        wants_page = scope["type"] == "http" and scope["method"] == "GET" and "text/html" in headers.get("accept", "")
        if not wants_page:
            await _refuse(scope, send, 401, "sign in first")
            return
        await send({"type": "http.response.start", "status": 303, "headers": [(b"location", ENTRANCE.encode())]})
        await send({"type": "http.response.body", "body": b""})


def cookie_in(header: str) -> str | None:
    """Our cookie among those that a browser sends."""
    try:
        found = SimpleCookie(header).get(COOKIE)
    except CookieError:
        return None
    return found.value if found else None


def cookie_header(cookie: str, *, secure: bool) -> str:
    """What sets our cookie in a browser; an empty one takes it away."""
    life_s = REMEMBERED_S if cookie else 0
    return f"{COOKIE}={cookie}; Path=/; Max-Age={life_s}; HttpOnly; SameSite=Strict{'; Secure' if secure else ''}"


def _password_in(scope: Scope, headers: dict[str, str]) -> tuple[str, str] | None:
    """(name of the person, password) as a program shows it, or a link."""
    asked = parse_qs(scope.get("query_string", b"").decode("latin-1"))
    person = asked.get("name", [""])[0]
    shown = headers.get("authorization", "")
    if shown.startswith("Bearer "):
        return person, shown.removeprefix("Bearer ")
    return (person, asked["token"][0]) if "token" in asked else None


async def _refuse(scope: Scope, send: Send, status: int, why: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 4000 + status, "reason": why[:100]})
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8")]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": why.encode()})


def _with_headers(send: Send) -> Send:
    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *_HEADERS]
        await send(message)

    return sending
