"""A TCP proxy that cuts connections after a request has passed, before its reply is delivered.

The proxy parses only the frame boundaries of ZMTP, which encryption (CURVE) does not hide: after the greeting and the
handshake's commands, each frame from the scheduler belongs to a reply.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import socket
import threading
from dataclasses import dataclass, field

_CHUNK = 1 << 16
_GREETING = 64
_LONG, _COMMAND = 0x02, 0x04


@dataclass
class FrameCounter:
    """The count of frames in a ZMTP stream, without commands."""

    messages: int = 0
    _skip: int = _GREETING
    _head: bytearray = field(default_factory=bytearray)

    def feed(self, chunk: bytes) -> None:
        """Count the frames that begin in received bytes."""
        at = 0
        while at < len(chunk):
            if self._skip:
                step = min(self._skip, len(chunk) - at)
                self._skip, at = self._skip - step, at + step
                continue
            self._head.append(chunk[at])
            at += 1
            flags, size = self._head[0], self._head[1:]
            if len(size) == (8 if flags & _LONG else 1):
                self._skip = int.from_bytes(size, "big")
                self.messages += not flags & _COMMAND
                self._head.clear()


class CuttingProxy:
    """A proxy between client and scheduler that cuts connections.

    Args:
        target: the scheduler's address, "tcp://host:port".
        longest: the first connection is cut at its first chunk with replies, the second at its second chunk, and
            so on up to this number. A cut at the first chunk loses the answer to the greeting; later cuts lose
            replies to requests.

    Attributes:
        cuts: the number of cut connections.
    """

    def __init__(self, target: str, longest: int) -> None:
        host, _, port = target.removeprefix("tcp://").rpartition(":")
        self._target = (host, int(port))
        self._lengths = itertools.cycle(range(1, 1 + longest))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self.cuts = 0
        threading.Thread(target=self._accept, name="proxy", daemon=True).start()

    def close(self) -> None:
        """Cut all connections and close the listening socket."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            self._end(*self._open)

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                try:
                    server = socket.create_connection(self._target, 5.0)
                except OSError:
                    client.close()
                    continue
                # the timeout is for connecting only
                server.settimeout(None)
                with self._lock:
                    self._open |= {client, server}
                for pair in ((client, server, math.inf), (server, client, next(self._lengths))):
                    threading.Thread(target=self._pass_on, args=pair, daemon=True).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket, chunks: float) -> None:
        # the chunk with number `chunks` is lost together with the connection
        counter = FrameCounter()
        with contextlib.suppress(OSError):
            for chunk in iter(lambda: source.recv(_CHUNK), b""):
                before = counter.messages
                counter.feed(chunk)
                chunks -= counter.messages > before
                if chunks <= 0:
                    self.cuts += 1
                    break
                sink.sendall(chunk)
        with self._lock:
            self._end(source, sink)

    def _end(self, *sockets: socket.socket) -> None:
        for one in sockets:
            with contextlib.suppress(OSError):
                # wakes the thread that reads from this socket; close alone does not
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        self._open -= set(sockets)
