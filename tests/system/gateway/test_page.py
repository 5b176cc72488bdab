"""The page of the sample, in chromium: it shows each scan where its origin is named, and nothing where it is not."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S
from tests.system.gateway.gateway_lab import SERIES, GatewayRun

Started = Callable[..., GatewayRun]
SAMPLE = Path(__file__).parents[3] / "experiments" / "gateway"

DEADLINE_MS = 1000 * DEADLINE_S


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def served() -> Iterator[str]:
    """The origin of the page, different from the gateway's."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(SAMPLE))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_the_page_shows_each_new_scan(started: Started, browser: Any, served: str) -> None:
    run = started(SERIES.format(every="2 min", scans=1000), speed=60.0, settings=f'origins = ["{served}"]')
    page = browser.new_page()
    page.goto(f"{served}/page.html?gateway={run.url}")
    page.wait_for_function("document.querySelector('#scan').naturalWidth == 32", timeout=DEADLINE_MS)
    first = page.get_attribute("#scan", "src")
    page.wait_for_function(f"document.querySelector('#scan').src != '{first}'", timeout=DEADLINE_MS)
    page.wait_for_function("/is in control/.test(document.querySelector('#state').textContent)", timeout=DEADLINE_MS)
    page.close()


def test_a_page_of_another_origin_receives_nothing_and_does_nothing(
    started: Started, browser: Any, served: str
) -> None:
    run = started()
    page = browser.new_page()
    page.goto(f"{served}/page.html")
    asked = """async ([address, method, path, body]) => {
        try {
            const headers = body ? {"Content-Type": "text/plain"} : {};
            return (await fetch(`${address}/v1${path}`, {method, headers, body})).status;
        } catch (error) {
            return error.name;
        }
    }"""
    for method, path, body in (("GET", "/state", None), ("POST", "/control", None), ("POST", "/end", "{}")):
        assert page.evaluate(asked, [run.url, method, path, body]) == "TypeError", "the browser keeps it from the page"
    page.close()
    state = run.client("ada").get("/state")
    assert (state["holder"], state["ended"]) == (None, False)
