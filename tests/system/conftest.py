"""A controller that is not of the run, which records every byte that anybody sends it, and patience for busy runs."""

from __future__ import annotations

import contextlib
import select
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from threading import Thread

import pytest
from deadlines import DEADLINE_S

from afspm.client import connect


@pytest.fixture(autouse=True)
def patient_joining(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let tests join a run whose scheduler is still starting, or busy; some of the terminal's join one that is gone."""
    if request.path.parent.name != "cli":
        monkeypatch.setattr(connect, "JOINED_WITHIN_S", DEADLINE_S)


class Stranger:
    """Listens where a real controller would, and never answers.

    Args:
        port: 0: any free one.
    """

    def __init__(self, port: int = 0) -> None:
        self.received = b""
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = int(self._listener.getsockname()[1])
        self._end, self._ended = socket.socketpair()
        self._thread = Thread(target=self._serve, name="stranger")
        self._thread.start()

    def close(self) -> None:
        self._end.close()
        self._thread.join()

    def _serve(self) -> None:
        with self._listener, self._ended, ExitStack() as clients:
            open_: list[socket.socket] = [self._listener, self._ended]
            while True:
                ready = select.select(open_, [], [])[0]
                if self._ended in ready:
                    return
                for one in ready:
                    if one is self._listener:
                        open_.append(clients.enter_context(one.accept()[0]))
                    else:
                        self._receive(one, open_)

    def _receive(self, client: socket.socket, open_: list[socket.socket]) -> None:
        part = b""
        with contextlib.suppress(OSError):
            part = client.recv(65536)
        self.received += part
        if not part:
            open_.remove(client)


@contextmanager
def listening(*ports: int) -> Iterator[Stranger]:
    """Strangers at these ports; the first is given, and all must have heard nothing by the end of the block."""
    strangers: list[Stranger] = []
    try:
        for port in ports:
            try:
                strangers.append(Stranger(port))
            except OSError as error:
                pytest.skip(f"a controller, or another test, has port {port}: {error}")
        yield strangers[0]
    finally:
        for stranger in strangers:
            stranger.close()
    assert {stranger.port: stranger.received for stranger in strangers if stranger.received} == {}


@pytest.fixture
def stranger() -> Iterator[Stranger]:
    """One at a free port."""
    with listening(0) as found:
        yield found


@pytest.fixture
def strangers() -> Callable[..., contextlib.AbstractContextManager[Stranger]]:
    """`with strangers(6501, 6502):` at fixed ports; the test is skipped where one is taken."""
    return listening
