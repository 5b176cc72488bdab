"""Nanosurf Studio's socket: a script and its reply, each behind its length as four bytes, least significant first."""

from __future__ import annotations

import struct
from typing import Final, cast

from afspm.simulation.emulation.emulator import LOOPBACK
from afspm.simulation.emulation.scripted import Client, OnRequest
from afspm.simulation.emulation.tcp_server import ClientConnection, TcpServer

_LENGTH: Final = struct.Struct("<I")
LONGEST_SCRIPT: Final = 1 << 20
_MOST_UNREAD: Final = 64 << 20
"""Bytes of replies that a client may leave unread: after that its connection ends."""


class StudioWire:
    """The socket. See `ScriptWire`."""

    def __init__(self, port: int, on_request: OnRequest, wakes: object, *, one_client: bool) -> None:
        self._on_request = on_request
        self._server = TcpServer(LOOPBACK, [port], one_each=one_client, wakes=wakes, on_bytes=self._split)

    @property
    def port(self) -> int:
        return self._server.ports[0]

    @property
    def address(self) -> str:
        return f"{LOOPBACK}:{self.port}"

    def poll(self, timeout_s: float) -> None:
        self._server.poll(timeout_s)

    def send(self, client: Client, reply: bytes) -> None:
        connection = cast(ClientConnection, client)
        if connection in self._server.connections:
            self._server.send(connection, _LENGTH.pack(len(reply)) + reply)
            if len(connection.sending) > _MOST_UNREAD:
                self._server.cut(connection)

    def send_half(self, client: Client, reply: bytes) -> None:
        """Half a reply, after which the connection ends."""
        connection = cast(ClientConnection, client)
        if connection in self._server.connections:
            connection.closing = True
            self._server.send(connection, (_LENGTH.pack(len(reply)) + reply)[: 4 + len(reply) // 2])

    def close(self) -> None:
        self._server.close()

    def _split(self, connection: ClientConnection) -> None:
        """Hand on each whole script; a connection that announces too much ends."""
        received = connection.received
        while len(received) >= _LENGTH.size:
            (size,) = _LENGTH.unpack_from(received)
            if size > LONGEST_SCRIPT:
                self._server.cut(connection)
                return
            if len(received) < _LENGTH.size + size:
                return
            script = bytes(received[_LENGTH.size : _LENGTH.size + size])
            del received[: _LENGTH.size + size]
            self._on_request(connection, script)
