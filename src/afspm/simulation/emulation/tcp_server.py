"""TCP connections of clients, with replies in the order of requests and emulated communication faults."""

from __future__ import annotations

import contextlib
import selectors
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from afspm.basics.plain_data import Plain

if TYPE_CHECKING:
    from _typeshed import HasFileno

READ_AT_ONCE = 1 << 16
_LAST_ANSWER_S = 1.0


@dataclass(eq=False)
class ClientConnection:
    """A connection of a client.

    Attributes:
        received: bytes not yet answered.
        sending: bytes not yet sent.
        waits_for: the condition of the reply to the current request; no other request is answered meanwhile.
        closing: True if there are no more answers: the connection ends once all bytes are sent.
        half_closed: True if the client sends nothing more, and may still read the answer that it waits for.
        memory: the controller's state for this client.
    """

    socket: socket.socket
    received: bytearray = field(default_factory=bytearray)
    sending: bytearray = field(default_factory=bytearray)
    waits_for: object = None
    closing: bool = False
    half_closed: bool = False
    memory: Plain = field(default_factory=dict)


class TcpServer:
    """Listening ports and their connections, without a thread: `poll` does all the work.

    Args:
        ports: listening ports; 0 selects a free port.
        stream_port: port for clients that only read; 0: any free port; None: no such port.
        one_each: True if each of `ports` serves one client at a time; other clients wait until the connection ends.
        wedges: True if a port stays silent for ever once its client has reset the connection in mid-answer.
        wakes: an object with a `fileno`; `poll` returns once it is readable.
        on_bytes: called with a connection after new bytes in `received`.
    """

    def __init__(
        self,
        host: str,
        ports: list[int],
        *,
        stream_port: int | None = None,
        one_each: bool,
        wedges: bool = False,
        wakes: HasFileno,
        on_bytes: Callable[[ClientConnection], None],
    ) -> None:
        self._one_each, self._wedges = one_each, wedges
        self._silent: set[socket.socket] = set()
        self._stream: socket.socket | None = None
        self._on_bytes = on_bytes
        self._selector = selectors.DefaultSelector()
        self._listeners: list[socket.socket] = []
        self._of: dict[ClientConnection, socket.socket] = {}
        self._selector.register(wakes, selectors.EVENT_READ, None)
        try:
            self._listeners = [self._listener(host, port) for port in ports]
            if stream_port is not None:
                self._stream = self._listener(host, stream_port)
        except OSError:
            self.close()
            raise

    @property
    def ports(self) -> list[int]:
        """The ports that listen for requests."""
        return [int(listener.getsockname()[1]) for listener in self._listeners]

    @property
    def stream_port(self) -> int:
        """The port of the stream; 0 without one."""
        return 0 if self._stream is None else int(self._stream.getsockname()[1])

    @property
    def connections(self) -> list[ClientConnection]:
        """The connections of clients that send requests."""
        return [connection for connection, listener in self._of.items() if listener is not self._stream]

    @property
    def readers(self) -> list[ClientConnection]:
        """The connections of clients that read the stream."""
        return [connection for connection, listener in self._of.items() if listener is self._stream]

    def poll(self, timeout_s: float) -> None:
        """Wait up to `timeout_s` real seconds for clients, and process their bytes."""
        for key, events in self._selector.select(timeout_s):
            if isinstance(key.data, ClientConnection):
                if events & selectors.EVENT_READ:
                    self._read(key.data)
                if events & selectors.EVENT_WRITE and key.data in self._of:
                    self.send(key.data)
            elif key.data is not None:
                self._accept(key.data)

    def send(self, connection: ClientConnection, content: bytes = b"") -> None:
        """Send the bytes that the client accepts now, and the rest in later polls."""
        connection.sending += content
        if connection.half_closed:
            self._send_last(connection)
            return
        try:
            while connection.sending:
                sent = connection.socket.send(connection.sending)
                del connection.sending[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self._reset(connection)
            return
        if connection.closing and not connection.sending:
            self.cut(connection)
            return
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if connection.sending else 0)
        self._selector.modify(connection.socket, events, connection)

    def _send_last(self, connection: ClientConnection) -> None:
        try:
            connection.socket.sendall(connection.sending)
            # of a client that is gone, the answer to the answer is a reset
            is_gone = bool(connection.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR))
        except OSError:
            is_gone = True
        (self._reset if is_gone else self.cut)(connection)

    @property
    def wedged(self) -> int:
        """Return the number of ports that answer nothing any more."""
        return len(self._silent)

    def wedge(self, connection: ClientConnection) -> None:
        """Let the connection's port accept connections, and answer nothing any more."""
        self._silent.add(self._of[connection])

    def cut(self, connection: ClientConnection) -> None:
        listener = self._of.pop(connection, None)
        if listener is None:
            return
        connection.closing = True
        if not connection.half_closed:
            self._selector.unregister(connection.socket)
        connection.socket.close()
        if self._one_each and listener is not self._stream:
            self._selector.register(listener, selectors.EVENT_READ, listener)

    def close(self) -> None:
        for connection in self._of:
            connection.socket.close()
        for listener in (*self._listeners, *filter(None, [self._stream])):
            listener.close()
        self._of.clear()
        self._listeners.clear()
        self._selector.close()

    def _listener(self, host: str, port: int) -> socket.socket:
        listener = socket.create_server((host, port))
        listener.settimeout(0)  # a client may have gone before `accept`, which must not block then
        self._selector.register(listener, selectors.EVENT_READ, listener)
        return listener

    def _accept(self, listener: socket.socket) -> None:
        with contextlib.suppress(BlockingIOError):
            client, _ = listener.accept()
            client.settimeout(0)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection = ClientConnection(client)
            self._of[connection] = listener
            self._selector.register(client, selectors.EVENT_READ, connection)
            if self._one_each and listener is not self._stream:
                self._selector.unregister(listener)

    def _reset(self, connection: ClientConnection) -> None:
        if self._wedges:
            self.wedge(connection)
        self.cut(connection)

    def _read(self, connection: ClientConnection) -> None:
        try:
            received = connection.socket.recv(READ_AT_ONCE)
        except BlockingIOError:
            return
        except OSError:
            self._reset(connection)
            return
        if not received:
            if self._wedges and (connection.waits_for is not None or connection.sending):
                # whether the client is gone, or waits for the answer, shows when it is sent
                connection.half_closed = True
                self._selector.unregister(connection.socket)
                connection.socket.settimeout(_LAST_ANSWER_S)
                return
            self.cut(connection)
            return
        if self._of[connection] not in (self._stream, *self._silent):
            connection.received += received
            self._on_bytes(connection)
