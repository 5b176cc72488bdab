"""A server for an ASGI application, in a separate thread."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import socket
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from afspm.basics import ConfigError

if TYPE_CHECKING:
    from afspm.plugins.web.asgi import AsgiApp, Message, Receive, Send

USUAL_PORT = 8080
_STOPPED_S = 3.0
STALLED_S = 60.0
"""Real seconds after which a client is disconnected whose answer is stalled, or whose request body is incomplete."""
HEAD_S = 10.0
"""Real seconds for the head of a request: without the head no password can be checked."""
MOST_HEAD_BYTES = 64 << 10
MOST_UNFINISHED = 200
"""Limit of connections without a finished TLS handshake, and of connections without a complete request.

Beyond a limit the oldest of these connections is closed.
"""

MOST_AHEAD_BYTES = 64 << 10
"""Size of a request body that is awaited before the request counts; the rest of a longer body comes later."""


def listening(
    host: str, port: int | None, wanted: Iterable[int] = (USUAL_PORT,), *, what: str = "dashboard"
) -> socket.socket:
    """Return a socket that listens at `host`.

    Args:
        port: the port; None: the first free port of `wanted`, or any free port.
        what: name of the server, for the error.

    Raises:
        ConfigError: no such address, or the port is taken.
    """
    for attempt in (*wanted, 0) if port is None else (port,):
        try:
            return _bound(host, attempt)
        except OSError as error:
            failed = error
    raise ConfigError(
        f"the {what} can't listen at {host}, port {port}: {failed.strerror or failed}",
        where=what,
        hint="another program may use it; set another port, or leave port out",
    ) from failed


def _bound(host: str, port: int) -> socket.socket:
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    bound = socket.socket(family, kind, protocol)
    try:
        if hasattr(socket, "SO_EXCLUSIVEADDRUSE"):  # Windows, where SO_REUSEADDR would let two processes share the port
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
        else:
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        bound.listen(128)
    except OSError:
        bound.close()
        raise
    return bound


def url_of(host: str, port: int, *, encrypted: bool) -> str:
    """Return the page's URL; if the server listens at all addresses, a URL for other computers."""
    with contextlib.suppress(ValueError):  # a name
        if ipaddress.ip_address(host).is_unspecified:
            host = socket.gethostname()
    return f"{'https' if encrypted else 'http'}://{f'[{host}]' if ':' in host else host}:{port}"


class _TlsListener(socket.socket):
    """A listening socket that limits the duration and the number of pending TLS handshakes.

    The server learns of a connection only after its handshake, and asyncio waits a minute for that: a client that never
    begins would use up the process's file descriptors. (On Windows, whose event loop accepts connections by itself,
    asyncio's minute remains.)
    """

    def __init__(self, bound: socket.socket, within_s: float) -> None:
        super().__init__(bound.family, bound.type, bound.proto, fileno=bound.dup().detach())
        self._within_s = within_s
        self._unfinished: dict[int, socket.socket] = {}

    def accept(self) -> tuple[socket.socket, object]:
        """Accept the next connection. Called by the event loop."""
        connection, address = super().accept()
        descriptor = connection.fileno()
        self._unfinished.pop(descriptor, None)  # of a connection that is closed
        self._unfinished[descriptor] = connection
        asyncio.get_running_loop().call_later(self._within_s, self._end, descriptor, connection)
        if len(self._unfinished) > MOST_UNFINISHED:
            self._end(*next(iter(self._unfinished.items())))  # a handshake usually takes milliseconds
        return connection, address

    def finished(self, descriptor: int) -> None:
        """Register that a connection has finished its handshake."""
        self._unfinished.pop(descriptor, None)

    def _end(self, descriptor: int, connection: socket.socket) -> None:
        if self._unfinished.get(descriptor) is connection:
            del self._unfinished[descriptor]
            with contextlib.suppress(OSError):  # closed already
                connection.shutdown(socket.SHUT_RDWR)


def _impatient(stalled_s: float, head_s: float, listener: _TlsListener | None) -> type[asyncio.Protocol]:
    # uvicorn keeps a stalled client's connection for ever, and has no setting for it; this protocol disconnects it. It
    # reads `conn` and `transport` of uvicorn's, so pyproject.toml takes only versions that this was tried with
    import h11

    # h11, not httptools: only h11 bounds the head of a request
    from uvicorn.protocols.http.h11_impl import H11Protocol

    waiting: dict[ImpatientProtocol, None] = {}

    class ImpatientProtocol(H11Protocol):
        _stalled: asyncio.TimerHandle | None = None
        _unfinished: asyncio.TimerHandle | None = None
        _awaited: object = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if listener is not None:
                listener.finished(transport.get_extra_info("socket").fileno())
            self._await(h11.IDLE)

        def data_received(self, data: bytes) -> None:
            if self._awaited is None and self.conn.their_state is h11.IDLE:
                self._await(h11.IDLE)  # the first bytes of the next request
            super().data_received(data)
            is_upgraded = self.transport.get_protocol() is not self
            state = None if is_upgraded else self.conn.their_state
            if state is not self._awaited:
                self._await(state if state is h11.SEND_BODY else None)

        def connection_lost(self, exc: Exception | None) -> None:
            self._await(None)
            super().connection_lost(exc)

        def pause_writing(self) -> None:
            super().pause_writing()
            self._stalled = asyncio.get_running_loop().call_later(stalled_s, self.transport.abort)

        def resume_writing(self) -> None:
            if self._stalled is not None:
                self._stalled.cancel()
            super().resume_writing()

        def _await(self, state: object) -> None:
            # waits for: IDLE, the rest of a head; SEND_BODY, the rest of a body; None, nothing
            self._awaited = state
            if self._unfinished is not None:
                self._unfinished.cancel()
                self._unfinished = None
            waiting.pop(self, None)
            if state is not None:
                within_s = head_s if state is h11.IDLE else stalled_s
                self._unfinished = asyncio.get_running_loop().call_later(within_s, self.transport.abort)
                waiting[self] = None
            if len(waiting) > MOST_UNFINISHED:
                oldest = next(iter(waiting))  # an honest client's request takes milliseconds
                oldest._await(None)
                oldest.transport.abort()

    return ImpatientProtocol


def _limited(app: AsgiApp, most: int) -> AsgiApp:
    # connections without a complete request do not count: a client could open many of them and block all others
    running = 0

    async def limited(scope: Message, receive: Receive, send: Send) -> None:
        nonlocal running
        if scope["type"] != "http":
            await app(scope, receive, send)
            return
        came = [await receive()]
        while came[-1].get("more_body") and sum(len(one["body"]) for one in came) <= MOST_AHEAD_BYTES:
            came.append(await receive())

        async def receive_again() -> Message:
            return came.pop(0) if came else await receive()

        if running >= most:
            headers = [(b"content-type", b"text/plain"), (b"retry-after", b"1"), (b"connection", b"close")]
            await send({"type": "http.response.start", "status": 503, "headers": headers})
            await send({"type": "http.response.body", "body": f"{most} requests are being answered".encode()})
            return
        running += 1
        try:
            await app(scope, receive_again, send)
        finally:
            running -= 1

    return limited


class WebServer:
    """A server for an ASGI application.

    Args:
        bound: the bound socket, which `stop` closes.
        certificate, key: PEM files, for https; None: http.
        most_requests: limit of simultaneous complete requests; further requests get the status 503. None: no limit.
        stalled_s, head_s: real seconds; see `STALLED_S` and `HEAD_S`.

    Raises:
        ConfigError: the files are not a certificate and its key.
    """

    def __init__(
        self,
        app: AsgiApp,
        bound: socket.socket,
        certificate: Path | None,
        key: Path | None,
        *,
        most_requests: int | None = None,
        stalled_s: float = STALLED_S,
        head_s: float = HEAD_S,
    ) -> None:
        import uvicorn

        logging.getLogger("uvicorn").setLevel(logging.ERROR)  # clients' errors are not this process's
        self._bound = bound
        listener = None if certificate is None else _TlsListener(bound, head_s)
        self._listener = listener or bound
        config = uvicorn.Config(
            app if most_requests is None else _limited(app, most_requests),
            loop="auto" if listener is None else "asyncio",  # uvloop accepts connections past the listener
            log_config=None,
            access_log=False,
            lifespan="on",
            proxy_headers=False,  # forwarding headers can be forged, and wrong passwords are counted by address
            timeout_graceful_shutdown=1,
            http=_impatient(stalled_s, head_s, listener),
            h11_max_incomplete_event_size=MOST_HEAD_BYTES,
            ssl_certfile=certificate,
            ssl_keyfile=key,
        )
        try:
            config.load()
        except (OSError, ValueError) as error:
            self._listener.close()
            raise ConfigError(
                f"certificate or certificate_key can't be loaded: {error}", hint="both must be PEM files"
            ) from error
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="web", daemon=True)

    def start(self) -> None:
        """Start serving, including connections that are already waiting."""
        self._thread.start()

    def stop(self) -> None:
        """Stop within seconds, and cut off open connections."""
        self._server.should_exit = True
        self._thread.join(_STOPPED_S)
        for one in (self._listener, self._bound):
            with contextlib.suppress(OSError):
                one.close()

    def _run(self) -> None:
        try:
            self._server.run(sockets=[self._listener])
        except SystemExit:  # uvicorn exits if it can't start
            logging.getLogger("afspm.plugins.web").error("nothing can be served")
