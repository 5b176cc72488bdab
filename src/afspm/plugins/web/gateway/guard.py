"""The guard of the gateway, which checks origin, name and size of each request."""

from __future__ import annotations

import asyncio
import base64
import binascii
from collections.abc import Collection

from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse

from afspm.plugins.web.asgi import AsgiApp, Message, Receive, Send, wrong_origin
from afspm.plugins.web.gateway.problems import RefusalCode, RefusedRequest
from afspm.plugins.web.passwords import Passwords, check_name, is_loopback

PERSON = "afspm_person"
MOST_BODY_BYTES = 64 << 10


class GatewayGuard:
    """ASGI middleware that checks each request, and stores the name in scope["state"][PERSON]; empty: may only look.

    Args:
        origins: origins of other pages that may send requests.
    """

    def __init__(self, app: AsgiApp, passwords: Passwords, host: str, origins: Collection[str]) -> None:
        self._app = app
        self._passwords = passwords
        self._only_here = is_loopback(host)
        self._origins = origins

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        try:
            if scope["type"] != "http":
                raise RefusedRequest(RefusalCode.NOT_FOUND, "there are no websockets here")
            asked = HTTPConnection(scope)
            self._check_origin(asked)
            scope.setdefault("state", {})[PERSON] = await self._person(asked)
            bounded = await _Body.bounded(asked, receive)
        except RefusedRequest as refused:
            await answer(refused)(scope, receive, send)
            return
        await self._app(scope, bounded, send)

    def _check_origin(self, asked: HTTPConnection) -> None:
        why = wrong_origin(asked.headers, only_here=self._only_here, what="gateway", allowed=self._origins)
        is_foreign = asked.headers.get("sec-fetch-site") == "cross-site"
        if why is None and is_foreign and asked.headers.get("origin") not in self._origins:
            why = "a page of another site may not send requests to this gateway"
        if why is not None:
            raise RefusedRequest(RefusalCode.WRONG_ORIGIN, why)

    async def _person(self, asked: HTTPConnection) -> str:
        shown = asked.headers.get("authorization")
        if shown is None:
            if self._passwords.lets_look:
                return ""
            raise RefusedRequest(RefusalCode.NAME_NEEDED, "name and token are missing")
        name, token = _name_and_token(shown)
        address = asked.client.host if asked.client else ""
        if not name or name != check_name(name):
            raise RefusedRequest(RefusalCode.UNAUTHORIZED, "that can't be a name")
        if not await asyncio.to_thread(self._passwords.proves, name, token, address):
            wait_s = self._passwords.wait_s(name, address)
            later = f"; too many wrong ones: wait {wait_s:.0f} s" if wait_s else ""
            raise RefusedRequest(RefusalCode.UNAUTHORIZED, f"name or token is wrong{later}")
        return name


def answer(refused: RefusedRequest) -> JSONResponse:
    headers = {"Cache-Control": "no-store"}
    if refused.status == 401:
        headers["WWW-Authenticate"] = 'Basic realm="afspm", charset="UTF-8"'
    return JSONResponse(refused.model.model_dump(mode="json"), refused.status, headers)


class _Body:
    """The body of a request, limited in size even without a declared length."""

    def __init__(self, receive: Receive) -> None:
        self._receive = receive
        self._bytes = 0

    @classmethod
    async def bounded(cls, asked: HTTPConnection, receive: Receive) -> Receive:
        length = asked.headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > MOST_BODY_BYTES:
            raise RefusedRequest(RefusalCode.TOO_LARGE, f"a body of {length[:20]} bytes")
        return cls(receive).next

    async def next(self) -> Message:
        message = await self._receive()
        self._bytes += len(message.get("body", b""))
        if self._bytes > MOST_BODY_BYTES:
            raise RefusedRequest(RefusalCode.TOO_LARGE, f"a body of more than {MOST_BODY_BYTES} bytes")
        return message


def _name_and_token(shown: str) -> tuple[str, str]:
    # Basic, or Bearer with name and token joined by a colon
    scheme, _, said = shown.partition(" ")
    if scheme.lower() == "basic":
        try:
            said = base64.b64decode(said.strip(), validate=True).decode()
        except (binascii.Error, ValueError):
            return "", ""
    elif scheme.lower() != "bearer":
        return "", ""
    name, _, token = said.partition(":")
    return name, token
