"""The sign-in page, and the guard that shows only this page to viewers without access."""

from __future__ import annotations

import asyncio
import html
from pathlib import Path

from fastapi import FastAPI, Form, Request, Response
from fastapi.responses import HTMLResponse, PlainTextResponse, RedirectResponse
from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection

from afspm.plugins.web.asgi import AsgiApp, Message, Receive, Send, wrong_origin
from afspm.plugins.web.dashboard.access import Access, Visitor
from afspm.plugins.web.dashboard.sessions import COOKIE, REMEMBERED_S
from afspm.plugins.web.passwords import check_name, is_loopback

VISITOR = "afspm_visitor"
SIGN_IN = "/login"
PUBLIC = (SIGN_IN, "/assets/dashboard.css")
TLS_HINT = (
    "This connection is not encrypted: others on the network can read the password and then steer. "
    "Set certificate and certificate_key of the dashboard in the experiment file."
)
WRONG = "Wrong name or password. Each person has a password; the common one, without a name, lets you look."
_HEADERS = {
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    # the page loads nothing from other sites, and sends nothing there
    "content-security-policy": "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self' ws: wss:; frame-ancestors 'none'",
}
_PAGE = Path(__file__).with_name("assets") / "sign_in.html"
_PASSWORD = """<label for="password">Password</label>
<input id="password" name="password" type="password" autocomplete="current-password">"""


class Guard:
    """ASGI middleware: checks each request and each websocket, and sets scope["state"][VISITOR].

    The guard refuses a wrong origin. A viewer needs the cookie, or a password as Bearer token (not in the URL:
    a link on any page would sign its reader in under the name of its author).
    """

    def __init__(self, app: AsgiApp, access: Access, host: str) -> None:
        self._app = app
        self._access = access
        self._only_loopback = is_loopback(host)

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        asked = HTTPConnection(scope)
        if (wrong := wrong_origin(asked.headers, only_here=self._only_loopback)) is not None:
            await _refuse(403, wrong, scope, receive, send)
            return
        visitor = self._access.visitor(asked.cookies.get(COOKIE))
        if (shown := _password_in(asked)) is not None:
            address = asked.client.host if asked.client else ""
            visitor = await asyncio.to_thread(self._access.by_password, *shown, address)
        if visitor is None and scope["path"] not in PUBLIC:
            wants_page = scope.get("method") == "GET" and "text/html" in asked.headers.get("accept", "")
            if wants_page:
                up = "../" * (scope["path"].count("/") - 1)
                await RedirectResponse(f"{up}{SIGN_IN[1:]}", 303)(scope, receive, send)
            else:
                await _refuse(401, "sign in first", scope, receive, send)
            return
        scope.setdefault("state", {})[VISITOR] = visitor or Visitor()
        await self._app(scope, receive, _with_headers(send))


def add_sign_in(app: FastAPI, access: Access, title: str, *, encrypted: bool, only_here: bool) -> None:
    """Serve /login, which sets the cookie, and /logout, which removes the cookie."""

    def page(person: str = "", wrong: str = "", status: int = 200) -> HTMLResponse:
        text = _page(access, title, person, wrong, hint="" if encrypted or only_here else TLS_HINT)
        return HTMLResponse(text, status, {"Cache-Control": "no-store"})

    async def show() -> HTMLResponse:
        return page()

    async def enter(request: Request, person: str = Form(""), password: str = Form("")) -> Response:
        name = check_name(person)
        if person.strip() and not name:
            return page(person, "A name of letters, digits, spaces, - . and ', at most 40 of them.", 422)
        address = request.client.host if request.client else ""
        cookie = await asyncio.to_thread(access.enter, name, password, address)
        if cookie is None:
            wait_s = access.wait_s(name, address)
            later = f"Too many failed attempts: try again in {wait_s:.0f} s." if wait_s else WRONG
            return page(person, later, 429 if wait_s else 403)
        return _set_cookie(RedirectResponse("./", 303), cookie, secure=encrypted)

    async def leave(request: Request, everywhere: str = Form("")) -> Response:
        await asyncio.to_thread(access.leave, request.cookies.get(COOKIE), everywhere=bool(everywhere))
        return _set_cookie(RedirectResponse(SIGN_IN[1:], 303), "", secure=encrypted)

    app.get(SIGN_IN, response_model=None)(show)
    app.post(SIGN_IN, response_model=None)(enter)
    app.post("/logout", response_model=None)(leave)


def _page(access: Access, title: str, person: str, wrong: str, hint: str) -> str:
    return _PAGE.read_text(encoding="utf-8").format(
        title=html.escape(title),
        person=html.escape(person),
        password="" if access.is_open else _PASSWORD,
        wrong=f'<p class="wrong" role="alert">{html.escape(wrong)}</p>' if wrong else "",
        look='<a href="./">Watch without signing in</a>'
        if access.lets_look
        else "<small>Without a name you can watch but not steer.</small>",
        hint=f'<p class="hint">{html.escape(hint)}</p>' if hint else "",
    )


def _set_cookie(answer: Response, cookie: str, *, secure: bool) -> Response:
    # an empty cookie removes it
    answer.set_cookie(
        COOKIE, cookie, max_age=REMEMBERED_S if cookie else 0, httponly=True, samesite="strict", secure=secure
    )
    return answer


def _password_in(asked: HTTPConnection) -> tuple[str, str] | None:
    # for programs; not accepted in a link: any page could contain one, and its reader would steer under another name
    shown = asked.headers.get("authorization", "")
    if not shown.startswith("Bearer "):
        return None
    return asked.query_params.get("name", ""), shown.removeprefix("Bearer ")


async def _refuse(status: int, why: str, scope: Message, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 4000 + status, "reason": why[:100]})
    else:
        await PlainTextResponse(why, status)(scope, receive, send)


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).update(_HEADERS)
        await send(message)

    return sending
