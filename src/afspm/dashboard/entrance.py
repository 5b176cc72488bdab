"""The page on which a person gives a name and, where that is needed, the password."""

from __future__ import annotations

import asyncio
import html
from typing import TYPE_CHECKING

from afspm.dashboard.access import Access, check_name
from afspm.dashboard.guard import ENTRANCE, cookie_header, cookie_in

if TYPE_CHECKING:
    from fastapi import FastAPI, Request, Response

TLS_HINT = (
    "This connection is not encrypted: whoever is in between can read the password and steer. "
    "Set certificate and certificate_key of the dashboard in the experiment file."
)
WRONG = "That is not right. Each person has a password; the one for all lets you look, without a name."
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Sign in: {title}</title><link rel="stylesheet" href="/assets/dashboard.css"></head>
<body class="entrance"><main><h1>{title}</h1>
<form method="post" action="/login">
<p>{why}</p>
<label for="person">Your name</label>
<input id="person" name="person" value="{person}" autocomplete="name" maxlength="40" autofocus>
{password}
{wrong}
<button type="submit">{button}</button>
{look}
</form>{hint}</main></body></html>"""
_PASSWORD = """<label for="password">Password</label>
<input id="password" name="password" type="password" autocomplete="current-password">"""


def add_entrance(app: FastAPI, access: Access, title: str, *, encrypted: bool, only_here: bool) -> None:
    """/login, which sets the cookie, and /logout, which takes it away."""
    from fastapi import Form, Request
    from fastapi.responses import HTMLResponse, RedirectResponse

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
            wait_s = access.wait_s(address)
            later = f"Too many wrong ones: try again in {wait_s:.0f} s." if wait_s else WRONG
            return page(person, later, 429 if wait_s else 403)
        return RedirectResponse("/", 303, {"set-cookie": cookie_header(cookie, secure=encrypted)})

    async def leave(request: Request, everywhere: str = Form("")) -> Response:
        cookie = cookie_in(request.headers.get("cookie", ""))
        await asyncio.to_thread(access.leave, cookie, everywhere=bool(everywhere))
        return RedirectResponse(ENTRANCE, 303, {"set-cookie": cookie_header("", secure=encrypted)})

    # annotations as text would be looked for where these names are not
    enter.__annotations__ = {"request": Request, "person": str, "password": str}
    leave.__annotations__ = {"request": Request, "everywhere": str}
    app.get(ENTRANCE, response_model=None)(show)
    app.post(ENTRANCE, response_model=None)(enter)
    app.post("/logout", response_model=None)(leave)


def _page(access: Access, title: str, person: str, wrong: str, hint: str) -> str:
    return _PAGE.format(
        title=html.escape(title),
        person=html.escape(person, quote=True),
        why="What you do is in the record of the experiment with your name.",
        password="" if access.is_open else _PASSWORD,
        wrong=f'<p class="wrong" role="alert">{html.escape(wrong)}</p>' if wrong else "",
        button="Sign in",
        look='<a href="/">Only look</a>' if access.lets_look else "<small>Without a name you may only look.</small>",
        hint=f'<p class="hint">{html.escape(hint)}</p>' if hint else "",
    )
