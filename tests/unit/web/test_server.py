"""Where the page is served, and under which name it is found; encrypted with the certificate that the docs make."""

from __future__ import annotations

import re
import shlex
import shutil
import socket
import ssl
import subprocess
from pathlib import Path
from typing import Any
from urllib.request import Request, urlopen

import pytest

from afspm.errors import ConfigError
from afspm.web.server import WebServer, listening, url_of

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "watch-and-steer.md"


@pytest.fixture
def certificate(tmp_path: Path) -> Path:
    """Made as the how-to says, for this computer."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl is found: `apt install openssl`")
    command = re.search(r"^\$ (openssl req .*\\\n.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert command
    said = command[1].replace("\\\n", " ").replace("192.168.1.20", "127.0.0.1")
    subprocess.run(shlex.split(said), cwd=tmp_path, check=True, capture_output=True)
    return tmp_path / "lab.crt"


async def hello(scope: Any, receive: Any, send: Any) -> None:
    if scope["type"] == "lifespan":
        for step in ("startup", "shutdown"):
            await receive()
            await send({"type": f"lifespan.{step}.complete"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": scope["scheme"].encode()})


def test_whoever_trusts_the_certificate_comes_in_encrypted(certificate: Path) -> None:
    bound = listening("127.0.0.1", 0)
    server = WebServer(hello, bound, certificate, certificate.with_suffix(".key"))
    url = url_of("127.0.0.1", bound.getsockname()[1], encrypted=True)
    server.start()
    try:
        trusting = ssl.create_default_context(cafile=certificate)
        with urlopen(url, context=trusting, timeout=10.0) as answer:
            assert answer.read() == b"https"
        with pytest.raises(OSError, match="certificate verify failed"):
            urlopen(url, context=ssl.create_default_context(), timeout=10.0)
        with pytest.raises(OSError, match=r"closed connection|reset"):
            urlopen(url.replace("https", "http"), timeout=10.0)
    finally:
        server.stop()


def test_a_forged_header_is_not_the_address_of_whoever_asks() -> None:
    """By the address it is counted how often somebody was wrong."""

    async def origin(scope: Any, receive: Any, send: Any) -> None:
        await hello({**scope, "scheme": scope.get("client", ("",))[0]}, receive, send)

    bound = listening("127.0.0.1", 0)
    server = WebServer(origin, bound, None, None)
    server.start()
    try:
        forged = Request(
            url_of("127.0.0.1", bound.getsockname()[1], encrypted=False),
            headers={"X-Forwarded-For": "10.9.8.7", "X-Forwarded-Proto": "https"},
        )
        with urlopen(forged, timeout=10.0) as answer:
            assert answer.read() == b"127.0.0.1"
    finally:
        server.stop()


def test_what_is_no_certificate_is_refused(certificate: Path) -> None:
    with listening("127.0.0.1", 0) as bound:
        for wrong in (certificate.with_name("none.crt"), PAGE):
            with pytest.raises(ConfigError, match="certificate or certificate_key can't be loaded"):
                WebServer(hello, bound, wrong, certificate.with_suffix(".key"))


def test_a_port_that_is_taken_is_told_unless_any_will_do() -> None:
    with listening("127.0.0.1", 0) as first:
        taken = first.getsockname()[1]
        with pytest.raises(ConfigError, match=f"can't listen at 127.0.0.1, port {taken}"):
            listening("127.0.0.1", taken)
        with listening("127.0.0.1", None, wanted=[taken]) as other:
            assert other.getsockname()[1] != taken


@pytest.mark.parametrize(
    ("host", "url"),
    [
        ("127.0.0.1", "http://127.0.0.1:8080"),
        ("::1", "http://[::1]:8080"),
        ("lab-pc", "http://lab-pc:8080"),
        ("0.0.0.0", f"http://{socket.gethostname()}:8080"),
        ("::", f"http://{socket.gethostname()}:8080"),
    ],
)
def test_where_it_is_can_be_typed_into_a_browser(host: str, url: str) -> None:
    assert url_of(host, 8080, encrypted=False) == url
