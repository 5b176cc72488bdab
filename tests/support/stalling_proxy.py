"""A TCP proxy whose present connections can be stalled for ever, while it serves later ones."""

from __future__ import annotations

import socket
import threading
from types import TracebackType
from typing import Self


class StallingProxy:
    """A proxy in threads, between a client and `target`.

    Attributes:
        port: its port, at 127.0.0.1.
    """

    def __init__(self, target: tuple[str, int]) -> None:
        self._target = target
        self._stalled: set[socket.socket] = set()
        self._ends: list[socket.socket] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def stall(self) -> None:
        """Pass nothing more over the present connections, which stay open."""
        self._stalled.update(self._ends)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        for one in (self._listener, *self._ends):
            one.close()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            server = socket.create_connection(self._target)
            self._ends += [client, server]
            for source, sink in ((client, server), (server, client)):
                threading.Thread(target=self._pass, args=(source, sink), daemon=True).start()

    def _pass(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while some := source.recv(1 << 16):
                if source not in self._stalled:
                    sink.sendall(some)
            if source not in self._stalled:
                sink.shutdown(socket.SHUT_WR)
        except OSError:
            return
