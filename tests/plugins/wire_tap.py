"""A wire tap between a translator and an emulated controller: it records every byte that the translator sends."""

from __future__ import annotations

import json
import re
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Thread


class WireTap:
    """A proxy at a port of its own, which passes all bytes on in both directions.

    Attributes:
        sent: the bytes of each connection, in the order of connecting, from the client to the controller.
    """

    def __init__(self, host: str, port: int) -> None:
        self._target = host, port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.sent: list[bytearray] = []
        self._open: list[socket.socket] = []
        Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                try:
                    controller = socket.create_connection(self._target)
                except OSError:  # it is away: the client is told so by the end of its connection
                    client.close()
                    continue
                self._open += [client, controller]
                self.sent.append(bytearray())
                Thread(target=_pass_on, args=(client, controller, self.sent[-1]), daemon=True).start()
                Thread(target=_pass_on, args=(controller, client, bytearray()), daemon=True).start()

    def close(self) -> None:
        for one in (self._listener, *self._open):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()


def _pass_on(source: socket.socket, sink: socket.socket, record: bytearray) -> None:
    with suppress(OSError):
        while part := source.recv(65536):
            record += part  # before it leaves
            sink.sendall(part)
    for one in (source, sink):
        with suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)


@contextmanager
def tapped(address: str) -> Iterator[tuple[WireTap, str]]:
    """Yield a tap before the controller at an address, and the address to use instead."""
    found = re.fullmatch(r"(.*?)([\d.]+):(\d+)(?:,\d+)*", address)
    assert found, address
    tap = WireTap(found[2], int(found[3]))
    try:
        yield tap, f"{found[1]}127.0.0.1:{tap.port}"
    finally:
        tap.close()


# --- the questions in these bytes, decoded without any code of the drivers ---


def nanonis_names(sent: bytes) -> Iterator[str]:
    """Yield the function of each request: 32 bytes of its name, the size of its arguments, and 4 bytes of flags."""
    at = 0
    while at + 40 <= len(sent):
        (size,) = struct.unpack_from(">i", sent, at + 32)
        yield bytes(sent[at : at + 32]).rstrip(b"\0").decode("ascii")
        at += 40 + size


def lua_scripts(sent: bytes) -> Iterator[str]:
    """Yield each script, after its length in 4 bytes."""
    at = 0
    while at + 4 <= len(sent):
        (size,) = struct.unpack_from("<I", sent, at)
        yield bytes(sent[at + 4 : at + 4 + size]).decode()
        at += 4 + size


def zmtp_objects(sent: bytes) -> Iterator[dict[str, object]]:
    """Yield the JSON of each message of a ZeroMQ connection; its greeting has 64 bytes."""
    at = 64
    while at + 2 <= len(sent):
        flags = sent[at]
        is_long, is_command = flags & 2, flags & 4
        size = struct.unpack_from(">Q", sent, at + 1)[0] if is_long else sent[at + 1]
        at += 9 if is_long else 2
        content = bytes(sent[at : at + size])
        at += size
        if content and not is_command:
            yield json.loads(content)
