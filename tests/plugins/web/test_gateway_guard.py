"""The guard of the gateway: names, origins, and sizes of requests."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from afspm.basics import ConfigError
from afspm.plugins.web.gateway import Gateway
from afspm.plugins.web.gateway.guard import MOST_BODY_BYTES, PERSON, GatewayGuard
from afspm.plugins.web.passwords import Passwords, hashed

TOKEN = hashed("secret")
PEOPLE = {"ada": TOKEN, "max": hashed("other")}


class Clock:
    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


async def echo(scope: Any, receive: Any, send: Any) -> None:
    """Answers with the name and the length of the body."""
    size, more = 0, True
    while more:
        message = await receive()
        size, more = size + len(message.get("body", b"")), message.get("more_body", False)
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": f"{scope['state'][PERSON]} {size}".encode()})


Ask = Callable[..., httpx.Response]


def gateway(
    people: dict[str, str] | None = None, host: str = "127.0.0.1", clock: Clock | None = None, **more: Any
) -> Ask:
    guard: Any = GatewayGuard(echo, Passwords(host, "", people or {}, clock or Clock()), host, more.get("origins", ()))

    async def asked(method: str, at: str, **options: Any) -> httpx.Response:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(guard), base_url=at) as client:
            return await client.request(method, "/v1/state", **options)

    def ask(method: str = "GET", at: str = "http://127.0.0.1:8090", **options: Any) -> httpx.Response:
        with ThreadPoolExecutor(1) as thread:  # a browser that is tested has its loop running in this one
            return thread.submit(asyncio.run, asked(method, at, **options)).result()

    return ask


def basic(name: str, token: str) -> dict[str, str]:
    return {"Authorization": f"Basic {base64.b64encode(f'{name}:{token}'.encode()).decode()}"}


def test_on_loopback_every_client_looks_and_any_name_acts() -> None:
    ask = gateway()
    assert ask().text == " 0"
    assert ask(headers=basic("ada", "")).text == "ada 0"


def test_with_tokens_a_name_needs_its_own() -> None:
    ask = gateway(PEOPLE)
    assert ask().text == " 0"
    assert ask(headers=basic("ada", "secret")).text == "ada 0"
    assert ask(headers={"Authorization": "Bearer ada:secret"}).text == "ada 0"
    for wrong in (basic("ada", "other"), basic("eve", "secret"), basic("", "secret"), {"Authorization": "Basic ?"}):
        refused = ask(headers=wrong)
        assert (refused.status_code, refused.json()["code"]) == (401, "unauthorized")
        assert "Basic" in refused.headers["www-authenticate"]


def test_beyond_loopback_a_client_needs_a_token_to_look() -> None:
    refused = gateway(PEOPLE, host="0.0.0.0")(at="https://lab-pc:8090")
    assert (refused.status_code, refused.json()["code"]) == (401, "name-needed")


def test_wrong_tokens_are_slowed_down_and_lock_out_neither_the_owner_nor_others() -> None:
    clock = Clock()
    ask = gateway(PEOPLE, clock=clock)
    for _ in range(6):
        assert ask(headers=basic("ada", "guess")).status_code == 401
    assert "wait 3 s" in ask(headers=basic("ada", "guess")).json()["reason"]
    assert ask(headers=basic("max", "other")).text == "max 0"
    clock.now_s += 3.0
    assert ask(headers=basic("ada", "secret")).text == "ada 0"
    for _ in range(20):
        assert ask(headers=basic("ada", "guess")).status_code == 401
    assert ask(headers=basic("ada", "secret")).text == "ada 0"


def test_the_owner_of_a_token_comes_in_after_five_wrong_ones() -> None:
    ask = gateway(PEOPLE)
    for _ in range(5):
        assert ask(headers=basic("ada", "guess")).status_code == 401
    assert ask(headers=basic("ada", "secret")).text == "ada 0"


@pytest.mark.parametrize(
    ("at", "headers"),
    [
        ("http://evil.example:8090", {}),  # that gave its name our address
        ("http://127.0.0.1.evil.example", {}),
        ("http://127.0.0.1:8090", {"Origin": "http://evil.example"}),
        ("http://127.0.0.1:8090", {"Origin": "null"}),
        ("http://127.0.0.1:8090", {"Origin": "http://["}),
        ("http://127.0.0.1:8090", {"Origin": "http://127.0.0.1:port"}),
        ("http://127.0.0.1:8090", {"Host": "["}),
        ("http://127.0.0.1:8090", {"Origin": "http://127.0.0.1:3000"}),
        ("http://127.0.0.1:8090", {"Sec-Fetch-Site": "cross-site"}),
    ],
)
def test_pages_of_other_sites_are_refused(at: str, headers: dict[str, str]) -> None:
    for method in ("GET", "POST"):
        refused = gateway()(method, at, headers={**basic("ada", ""), **headers})
        assert (refused.status_code, refused.json()["code"]) == (403, "wrong-origin")


def test_pages_of_allowed_origins_are_answered() -> None:
    ask = gateway(origins=("http://127.0.0.1:3000",))
    assert ask(headers={"Origin": "http://127.0.0.1:3000", "Sec-Fetch-Site": "cross-site"}).status_code == 200
    assert ask(headers={"Origin": "http://127.0.0.1:3001"}).status_code == 403


def test_requests_beyond_the_size_limit_are_refused() -> None:
    ask = gateway()
    assert ask("POST", content=b"x" * MOST_BODY_BYTES).status_code == 200
    refused = ask("POST", content=b"x" * (MOST_BODY_BYTES + 1))
    assert (refused.status_code, refused.json()["code"]) == (413, "too-large")


@pytest.mark.parametrize(
    "settings",
    [
        {"host": "0.0.0.0"},
        {"host": "0.0.0.0", "people": PEOPLE},
        {"host": "0.0.0.0", "certificate": "lab.crt", "certificate_key": "lab.key"},
        {"certificate": "lab.crt"},
        {"origins": ["*"]},
        {"people": {"ada": "secret"}},
    ],
)
def test_settings_open_to_intruders_or_eavesdroppers_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        Gateway(**settings)
    Gateway(host="0.0.0.0", people=PEOPLE, certificate="lab.crt", certificate_key="lab.key")  # type: ignore[arg-type]
