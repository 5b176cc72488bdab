"""Serves an ASGI application, in a thread of its own."""

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

from afspm.errors import ConfigError

if TYPE_CHECKING:
    from afspm.web.asgi import AsgiApp

USUAL_PORT = 8080
_STOPPED_S = 3.0
STALLED_S = 60.0
"""A client that takes nothing of what is sent to it for so long is disconnected."""


def listening(
    host: str, port: int | None, wanted: Iterable[int] = (USUAL_PORT,), *, what: str = "dashboard"
) -> socket.socket:
    """Return a socket that listens at `host`.

    Args:
        port: None: the first of `wanted` that is free, or any.
        what: listens, for the error.

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
        if hasattr(socket, "SO_EXCLUSIVEADDRUSE"):  # Windows, where the other option would let two have it
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
    """Return where the page is found, from other computers too if it listens at all addresses of this one."""
    with contextlib.suppress(ValueError):  # a name
        if ipaddress.ip_address(host).is_unspecified:
            host = socket.gethostname()
    return f"{'https' if encrypted else 'http'}://{f'[{host}]' if ':' in host else host}:{port}"


def _impatient(stalled_s: float) -> type[asyncio.Protocol]:
    """Return uvicorn's protocol, which disconnects clients that stall: they would keep their connections for ever."""
    from uvicorn.protocols.http.auto import AutoHTTPProtocol

    class ImpatientProtocol(AutoHTTPProtocol):  # type: ignore[valid-type, misc]
        _stalled: asyncio.TimerHandle | None = None

        def pause_writing(self) -> None:
            super().pause_writing()
            self._stalled = asyncio.get_running_loop().call_later(stalled_s, self.transport.abort)

        def resume_writing(self) -> None:
            if self._stalled is not None:
                self._stalled.cancel()
            super().resume_writing()

    return ImpatientProtocol


class WebServer:
    """Serves an ASGI application until it is stopped.

    Args:
        certificate, key: PEM files, for https; None: http.
        most_connections: at a time; those beyond hear 503. None: any number.
        stalled_s: real; see `STALLED_S`.

    Raises:
        ConfigError: the files are no certificate and its key.
    """

    def __init__(
        self,
        app: AsgiApp,
        bound: socket.socket,
        certificate: Path | None,
        key: Path | None,
        *,
        most_connections: int | None = None,
        stalled_s: float = STALLED_S,
    ) -> None:
        import uvicorn

        logging.getLogger("uvicorn").setLevel(logging.ERROR)  # what clients do wrong is theirs
        config = uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            lifespan="on",
            proxy_headers=False,  # what a request says of its origin is anybody's word, and passwords are tried by it
            timeout_graceful_shutdown=1,
            limit_concurrency=most_connections,
            http=_impatient(stalled_s),
            ssl_certfile=certificate,
            ssl_keyfile=key,
        )
        try:
            config.load()
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"certificate or certificate_key can't be loaded: {error}", hint="both must be PEM files"
            ) from error
        self._socket = bound
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="web", daemon=True)

    def start(self) -> None:
        """Begin to serve; requests that came before are answered then."""
        self._thread.start()

    def stop(self) -> None:
        """Stop, within seconds; whoever is connected is cut off."""
        self._server.should_exit = True
        self._thread.join(_STOPPED_S)
        with contextlib.suppress(OSError):
            self._socket.close()

    def _run(self) -> None:
        try:
            self._server.run(sockets=[self._socket])
        except SystemExit:  # that is how it tells that it couldn't start
            logging.getLogger("afspm.web").error("nothing can be served")
