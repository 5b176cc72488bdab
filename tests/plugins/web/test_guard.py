from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest
from fastapi import FastAPI, Request, WebSocket

from afspm.plugins.web.dashboard.access import Access
from afspm.plugins.web.dashboard.sessions import Sessions
from afspm.plugins.web.dashboard.sign_in import VISITOR, Guard, add_sign_in
from afspm.plugins.web.passwords import hashed

KEPT = hashed("open sesame")
PEOPLE = {"Ada": hashed("analytical")}


def completed(doing: Coroutine[Any, Any, Any]) -> Any:
    """Run a coroutine in a thread of its own: the browser under test has its loop running in this one."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(asyncio.run, doing).result()


class Browser:
    """Sends requests to an application without a network, and keeps its cookies."""

    def __init__(self, app: Guard, at: str) -> None:
        self._app = app
        self._at = httpx.URL(at)
        self.cookies = httpx.Cookies()

    def get(self, path: str, **more: Any) -> httpx.Response:
        answer: httpx.Response = completed(self._ask("GET", path, **more))
        return answer

    def post(self, path: str, **more: Any) -> httpx.Response:
        answer: httpx.Response = completed(self._ask("POST", path, **more))
        return answer

    async def _ask(self, method: str, path: str, **more: Any) -> httpx.Response:
        transport = httpx.ASGITransport(self._app)
        async with httpx.AsyncClient(transport=transport, base_url=self._at, cookies=self.cookies) as client:
            answer = await client.request(method, path, **more)
            self.cookies = client.cookies
        return answer

    def talk(self, origin: str) -> list[str]:
        """Connect a websocket; return the messages it receives, one word each."""
        cookies = "; ".join(f"{cookie.name}={cookie.value}" for cookie in self.cookies.jar)
        headers = {"host": self._at.netloc.decode(), "origin": origin, "cookie": cookies}
        scope = {
            "type": "websocket", "path": "/talk", "raw_path": b"/talk", "query_string": b"", "root_path": "",
            "headers": [(name.encode(), value.encode()) for name, value in headers.items()], "subprotocols": [],
        }  # fmt: skip
        told: list[str] = []

        async def receive() -> dict[str, str]:
            return {"type": "websocket.connect"}

        async def send(message: Any) -> None:
            told.append(message.get("text") or message["type"].removeprefix("websocket."))

        completed(self._app(scope, receive, send))
        return told


Served = Callable[..., Browser]


@pytest.fixture
def served() -> Served:
    def serve(host: str = "127.0.0.1", kept: str = "", at: str = "http://127.0.0.1:8080") -> Browser:
        access = Access(host, kept, PEOPLE if kept else {}, lambda: 1000.0, Sessions(None, lambda: 1000.0), {})
        app = FastAPI()
        add_sign_in(app, access, "night <1>", encrypted=at.startswith("https"), only_here=host == "127.0.0.1")

        def who(request: Request) -> dict[str, str]:
            return {"person": getattr(request.state, VISITOR).person}

        async def talk(socket: WebSocket) -> None:
            await socket.accept()
            await socket.send_text("hello")
            await socket.close()

        # annotations as text would be looked for in this module, where they are not
        who.__annotations__ = {"request": Request}
        talk.__annotations__ = {"socket": WebSocket}
        app.get("/")(who)
        app.post("/act")(who)
        app.websocket("/talk")(talk)
        return Browser(Guard(app, access, host), at)

    return serve


def test_on_loopback_a_viewer_looks_at_once_and_gives_a_name_to_steer(served: Served) -> None:
    browser = served()
    assert browser.get("/").json() == {"person": ""}
    answer = browser.post("/login", data={"person": "Ada"})
    assert (answer.status_code, answer.headers["location"]) == (303, "./")
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    assert browser.get("/").json() == {"person": "Ada"}
    browser.post("/logout")
    assert browser.get("/").json() == {"person": ""}


def test_beyond_loopback_everything_but_the_sign_in_page_is_closed(served: Served) -> None:
    browser = served("0.0.0.0", KEPT, "http://lab:8080")
    assert browser.get("/", headers={"accept": "text/html"}).headers["location"] == "login"
    assert browser.get("/night/report", headers={"accept": "text/html"}).headers["location"] == "../login"
    assert browser.get("/", headers={"accept": "image/png"}).status_code == 401
    assert browser.post("/act").status_code == 401
    assert browser.talk("http://lab:8080") == ["close"]
    assert browser.get("/login").status_code == 200


def test_the_password_opens_the_page(served: Served) -> None:
    browser = served("0.0.0.0", KEPT, "https://lab:8080")
    assert browser.post("/login", data={"person": "Eve", "password": "guess"}).status_code == 403
    answer = browser.post("/login", data={"person": "Ada", "password": "analytical"})
    assert answer.status_code == 303
    assert "secure" in answer.headers["set-cookie"].lower()
    assert browser.get("/").json() == {"person": "Ada"}
    assert browser.talk("https://lab:8080") == ["accept", "hello", "close"]


@pytest.mark.parametrize("everywhere", ["", "yes"])
def test_a_cookie_is_worth_nothing_after_signing_out(served: Served, everywhere: str) -> None:
    browser = served("0.0.0.0", KEPT, "https://lab:8080")
    browser.post("/login", data={"person": "Ada", "password": "analytical"})
    (kept,) = [f"{cookie.name}={cookie.value}" for cookie in browser.cookies.jar]
    assert browser.get("/", headers={"cookie": kept}).status_code == 200
    browser.post("/logout", data={"everywhere": everywhere})
    assert not list(browser.cookies.jar)
    assert browser.get("/", headers={"cookie": kept}).status_code == 401


def test_guessing_is_slowed_down_with_a_message(served: Served) -> None:
    browser = served("0.0.0.0", KEPT, "http://lab:8080")
    answers = [browser.post("/login", data={"person": "Eve", "password": f"guess {i}"}) for i in range(6)]
    assert [answer.status_code for answer in answers] == [403, 403, 403, 403, 403, 429]
    assert "try again in 3 s" in answers[-1].text


def test_a_link_with_a_token_signs_no_person_in(served: Served) -> None:
    """Another site's page may contain such a link: its reader would steer under the name of its author."""
    browser = served("0.0.0.0", KEPT, "http://lab:8080")
    answer = browser.get("/?token=analytical&name=Ada", headers={"accept": "text/html"})
    assert (answer.status_code, answer.headers["location"]) == (303, "login")
    assert "set-cookie" not in answer.headers
    assert browser.get("/?token=analytical&name=Ada").status_code == 401


def test_a_program_sends_its_token_with_each_request(served: Served) -> None:
    browser = served("0.0.0.0", KEPT, "http://lab:8080")
    shown = {"authorization": "Bearer analytical"}
    assert browser.post("/act?name=Ada", headers=shown).json() == {"person": "Ada"}
    assert browser.post("/act", headers=shown).status_code == 401
    assert browser.post("/act", headers={"authorization": "Bearer open sesame"}).json() == {"person": ""}
    assert browser.post("/act").status_code == 401


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:9999", "null", "http://["])
def test_pages_of_other_sites_may_not_steer(served: Served, origin: str) -> None:
    browser = served()
    assert browser.post("/act", headers={"origin": origin}).status_code == 403
    assert browser.talk(origin) == ["close"]
    assert browser.post("/act", headers={"origin": "http://127.0.0.1:8080"}).status_code == 200
    assert browser.talk("http://127.0.0.1:8080") == ["accept", "hello", "close"]


def test_on_loopback_requests_for_other_host_names_are_refused(served: Served) -> None:
    assert served(at="http://rebound.example:8080").get("/").status_code == 403
    assert served(at="http://localhost:8080").get("/").status_code == 200


@pytest.mark.parametrize("host", ["[", "lab:port", "[::1"])
def test_a_malformed_host_is_refused(served: Served, host: str) -> None:
    browser = served("0.0.0.0", KEPT, "http://lab:8080")
    assert browser.get("/", headers={"host": host}).status_code == 403


def test_nothing_external_is_loaded_and_framing_is_forbidden(served: Served) -> None:
    headers = served().get("/").headers
    assert "default-src 'self'" in headers["content-security-policy"]
    assert headers["x-frame-options"] == "DENY"


def test_the_sign_in_page_warns_of_missing_encryption_and_escapes_names(served: Served) -> None:
    page = served("0.0.0.0", KEPT, "http://lab:8080").get("/login").text
    assert "not encrypted" in page
    assert "certificate_key" in page
    assert "night &lt;1&gt;" in page
    assert "not encrypted" not in served("0.0.0.0", KEPT, "https://lab:8080").get("/login").text
    assert "not encrypted" not in served().get("/login").text


def test_a_name_that_may_not_stand_in_the_record_is_refused_as_text(served: Served) -> None:
    answer = served().post("/login", data={"person": "<script>"})
    assert answer.status_code == 422
    assert "<script>" not in answer.text
