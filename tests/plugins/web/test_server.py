"""The server: addresses, names, stalled clients; encrypted with the certificate that the docs make."""

from __future__ import annotations

import asyncio
import re
import shlex
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.request import Request, urlopen

import pytest
from deadlines import DEADLINE_S

from afspm.basics import ConfigError
from afspm.plugins.web import server as web_server
from afspm.plugins.web.server import MOST_HEAD_BYTES, WebServer, listening, url_of

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "watch-and-steer.md"


@pytest.fixture
def certificate(tmp_path: Path) -> Path:
    """Made as in the how-to, for this computer."""
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


def test_a_client_that_trusts_the_certificate_connects_encrypted(certificate: Path) -> None:
    bound = listening("127.0.0.1", 0)
    server = WebServer(hello, bound, certificate, certificate.with_suffix(".key"))
    url = url_of("127.0.0.1", bound.getsockname()[1], encrypted=True)
    server.start()
    try:
        trusting = ssl.create_default_context(cafile=certificate)
        with urlopen(url, context=trusting, timeout=DEADLINE_S) as answer:
            assert answer.read() == b"https"
        with pytest.raises(OSError, match="certificate verify failed"):
            urlopen(url, context=ssl.create_default_context(), timeout=DEADLINE_S)
        with pytest.raises(OSError, match=r"closed connection|reset"):
            urlopen(url.replace("https", "http"), timeout=DEADLINE_S)
    finally:
        server.stop()


def test_a_forged_header_is_not_taken_as_the_client_s_address() -> None:
    """Wrong passwords are counted by address."""

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
        with urlopen(forged, timeout=DEADLINE_S) as answer:
            assert answer.read() == b"127.0.0.1"
    finally:
        server.stop()


def test_a_malformed_certificate_is_refused(certificate: Path) -> None:
    with listening("127.0.0.1", 0) as bound:
        for wrong in (certificate.with_name("none.crt"), PAGE):
            with pytest.raises(ConfigError, match="certificate or certificate_key can't be loaded"):
                WebServer(hello, bound, wrong, certificate.with_suffix(".key"))


def test_a_taken_port_is_an_error_unless_any_port_will_do() -> None:
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
def test_the_url_works_in_a_browser(host: str, url: str) -> None:
    assert url_of(host, 8080, encrypted=False) == url


# --- clients that keep connections without asking for anything: before any password, so anybody may be one -----------

GET = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
HALF = GET[:-2]
LONG_S = 30.0

Serve = Callable[..., Callable[[], socket.socket]]


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Serve an application; returns a function that opens a connection to it."""
    with ExitStack() as stack:

        def begin(app: Any = hello, **settings: Any) -> Callable[[], socket.socket]:
            bound = listening("127.0.0.1", 0)
            server = WebServer(app, bound, None, None, **settings)
            server.start()
            stack.callback(server.stop)
            address = bound.getsockname()
            return lambda: stack.enter_context(socket.create_connection(address, LONG_S))

        yield begin


def status(connection: socket.socket) -> int:
    """Return the status of the next answer."""
    return int(connection.makefile("rb").readline().split()[1])


def closes(connection: socket.socket) -> bool:
    """Return whether the server ends a connection; an earlier answer is skipped."""
    connection.settimeout(LONG_S)
    with suppress(ConnectionError):
        while connection.recv(1 << 16):
            pass
    return True


def test_endless_head_is_cut_off_and_takes_little_memory(serve: Serve) -> None:
    connection, sent = serve()(), 0
    connection.sendall(HALF + b"X-Long: ")
    with suppress(ConnectionError):
        while sent < 60 << 20:
            sent += connection.send(b"a" * 65536)
    # what the two sockets' buffers take in besides is not read any more
    assert sent < MOST_HEAD_BYTES + (8 << 20)


def test_head_of_the_greatest_length_is_answered(serve: Serve) -> None:
    connection = serve()()
    connection.sendall(HALF + b"X-Long: " + b"a" * (MOST_HEAD_BYTES - len(HALF) - 12) + b"\r\n\r\n")
    assert status(connection) == 200


def test_half_requests_do_not_block_other_clients(serve: Serve) -> None:
    connect = serve(most_requests=2)
    halves = [connect() for _ in range(2 * web_server.MOST_UNFINISHED)]
    for half in halves:
        with suppress(ConnectionError):  # the oldest are closed already
            half.sendall(HALF)
    whole = connect()
    whole.sendall(GET)
    assert status(whole) == 200
    assert closes(halves[0])


def _answer_in_time(url: str, trusting: ssl.SSLContext) -> bytes:
    # a client on a busy computer may need longer than the server waits, and asks again
    end_s = time.monotonic() + DEADLINE_S
    while True:
        try:
            with urlopen(url, context=trusting, timeout=DEADLINE_S) as answer:
                return bytes(answer.read())
        except URLError:
            if time.monotonic() > end_s:
                raise


def test_endless_tls_handshakes_do_not_block_other_clients_and_end_in_time(certificate: Path) -> None:
    bound = listening("127.0.0.1", 0)
    address = bound.getsockname()
    server = WebServer(hello, bound, certificate, certificate.with_suffix(".key"), head_s=2.0)
    server.start()
    silent: list[socket.socket] = []
    url, trusting = url_of(*address, encrypted=True), ssl.create_default_context(cafile=certificate)
    try:
        # before its first answer only 128 connections can wait; the system drops others without a word to the client
        urlopen(url, context=trusting, timeout=DEADLINE_S).close()
        silent += (socket.create_connection(address) for _ in range(2 * web_server.MOST_UNFINISHED))
        assert _answer_in_time(url, trusting) == b"https"
        assert all(closes(one) for one in silent[: web_server.MOST_UNFINISHED])  # of too many the oldest
        assert closes(silent[-1])
    finally:
        for one in silent:
            one.close()
        server.stop()


@pytest.mark.parametrize("sent", [b"", HALF], ids=["nothing", "half"])
def test_head_that_does_not_come_ends_the_connection(serve: Serve, sent: bytes) -> None:
    connection = serve(head_s=0.3)()
    connection.sendall(sent)
    assert closes(connection)


def test_head_that_does_not_come_after_a_whole_request_ends_the_connection(serve: Serve) -> None:
    connection = serve(head_s=0.3)()
    connection.sendall(GET)
    assert status(connection) == 200
    connection.sendall(HALF)
    assert closes(connection)


def test_head_that_drips_ends_the_connection(serve: Serve) -> None:
    connection = serve(head_s=0.3)()
    connection.settimeout(0.02)
    assert any(_is_closed_after_a_byte(connection) for _ in range(int(LONG_S / 0.02)))


def _is_closed_after_a_byte(connection: socket.socket) -> bool:
    try:
        connection.sendall(b"G")
        return not connection.recv(1)
    except TimeoutError:
        return False
    except ConnectionError:
        return True


def test_body_that_does_not_come_ends_the_connection(serve: Serve) -> None:
    connection = serve(stalled_s=0.3)()
    connection.sendall(b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n1234")
    assert closes(connection)


# faults 9
def test_requests_with_slow_bodies_do_not_count(serve: Serve) -> None:
    async def read(scope: Any, receive: Any, send: Any) -> None:
        while scope["type"] == "http" and (await receive()).get("more_body"):
            pass
        await hello(scope, receive, send)

    connect = serve(read, most_requests=2)
    slow = [connect() for _ in range(20)]
    for one in slow:
        one.sendall(b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n1234")
        whole = connect()
        whole.sendall(b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 4\r\n\r\n1234")
        assert status(whole) == 200
    slow[0].sendall(b"56789")
    assert status(slow[0]) == 200


def test_long_body_reaches_the_application_whole(serve: Serve) -> None:
    sizes: list[int] = []

    async def read(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "http":
            more = True
            while more:
                message = await receive()
                sizes.append(len(message["body"]))
                more = message.get("more_body", False)
        await hello(scope, receive, send)

    connection = serve(read, most_requests=2)()
    long = 4 * web_server.MOST_AHEAD_BYTES
    connection.sendall(b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: %d\r\n\r\n" % long + b"a" * long)
    assert status(connection) == 200
    assert sum(sizes) == long


def test_only_requests_in_progress_count(serve: Serve) -> None:
    go_on, loops = asyncio.Event(), list[asyncio.AbstractEventLoop]()

    async def slow(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "http":
            loops.append(asyncio.get_running_loop())
            await go_on.wait()
        await hello(scope, receive, send)

    connect = serve(slow, most_requests=1)
    first, second = connect(), connect()
    first.sendall(GET)
    # that of the second is answered once the first has come to the application
    while (answered := _asked(second)) != 503:
        assert answered is None
        second = connect()
    loops[0].call_soon_threadsafe(go_on.set)
    assert status(first) == 200
    third = connect()
    third.sendall(GET)
    assert status(third) == 200


def _asked(connection: socket.socket) -> int | None:
    connection.settimeout(0.2)
    connection.sendall(GET)
    try:
        return status(connection)
    except TimeoutError:
        return None


def test_open_websocket_is_not_taken_for_a_head_that_does_not_come(serve: Serve) -> None:
    async def talk(scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] != "websocket":
            await hello(scope, receive, send)
            return
        await receive()
        await send({"type": "websocket.accept"})
        await asyncio.sleep(0.5)
        await send({"type": "websocket.send", "text": "still here"})
        await receive()

    connection = serve(talk, head_s=0.2)()
    upgrade = b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    connection.sendall(HALF + upgrade + b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n")
    answer = b""
    while b"still here" not in answer:
        more = connection.recv(4096)
        assert more, answer
        answer += more
