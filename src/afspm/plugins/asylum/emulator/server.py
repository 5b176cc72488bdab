"""ZeroMQ-XOP within Igor: its socket, its immediate replies, and the queue of calls for Igor.

A thread of the XOP answers malformed requests at once; valid requests wait until Igor is idle. Times are real seconds.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import zmq

from afspm.emulation import LOOPBACK
from afspm.plugins.asylum.emulator.wire import LONGEST_REQUEST, CallFailed, FunctionCall, call, failure

if TYPE_CHECKING:
    from _typeshed import HasFileno


@dataclass(frozen=True)
class QueuedCall:
    """A call that waits for Igor's next idle moment."""

    client: bytes
    call: FunctionCall


class XopServer:
    """The XOP's socket and queue.

    Args:
        port: listening port; 0: any free port.
        wakes: HasFileno with a `fileno` that ends `poll`.
    """

    def __init__(self, port: int, wakes: HasFileno, log: logging.Logger) -> None:
        self._log = log
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._wakes = wakes
        self.queue: deque[QueuedCall] = deque()
        self.port = port
        self._socket: zmq.Socket[bytes] | None = None
        self._held: QueuedCall | None = None
        self.bind()

    def bind(self) -> None:
        """Start listening (zeromq_server_bind)."""
        socket = self._context.socket(zmq.ROUTER)
        # the options of the real XOP; a longer request makes libzmq drop the connection without a reply
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SNDTIMEO, 0)
        socket.setsockopt(zmq.ROUTER_MANDATORY, 1)
        socket.setsockopt(zmq.MAXMSGSIZE, LONGEST_REQUEST)
        socket.setsockopt(zmq.IDENTITY, b"zeromq xop: router")
        socket.bind(f"tcp://{LOOPBACK}:{self.port or '*'}")
        self.port = int(socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        self._socket = socket

    def unbind(self) -> None:
        """Stop listening and discard queued calls (zeromq_stop)."""
        if self._socket is not None:
            self._socket.close(linger=0)
            self._socket = None
            self.queue.clear()
            self._held = None

    @property
    def listens(self) -> bool:
        return self._socket is not None

    def poll(self, timeout_s: float, *, locked: bool) -> None:
        """Wait for requests and receive them.

        Args:
            locked: True while a dialog waits for a person: the queue is locked, and the receiving thread blocks at the
                next valid request.
        """
        poller = zmq.Poller()
        poller.register(self._wakes, zmq.POLLIN)
        if self._held is not None and not locked:
            self.queue.append(self._held)
            self._held = None
            timeout_s = 0.0  # the held call can be executed at once
        if self._socket is not None and self._held is None:
            poller.register(self._socket, zmq.POLLIN)
        ready = dict(poller.poll(max(0, round(timeout_s * 1000))))
        if self._socket is None or self._socket not in ready:
            return
        while self._held is None:
            try:
                frames = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._take(frames, locked=locked)

    def send(self, client: bytes, *payload: bytes) -> None:
        """Send a reply if the client is still connected. A working server sends one frame of payload."""
        if self._socket is not None:
            try:
                self._socket.send_multipart([client, b"", *payload], zmq.NOBLOCK)
            except zmq.ZMQError as error:
                self._log.debug("a reply could not be sent: %s", error)

    def close(self) -> None:
        self.unbind()
        self._context.destroy(linger=0)

    def _take(self, frames: list[bytes], *, locked: bool) -> None:
        # the real XOP throws and never replies: to REQ_CORRELATE, or a DEALER without an empty frame
        if len(frames) != 3 or frames[1]:
            self._log.warning("received %d frames, which are not a request; it gets no reply", len(frames))
            return
        client, _, payload = frames
        try:
            queued = QueuedCall(client, call(payload))
        except CallFailed as failed:
            self.send(client, failure(failed, None))
            return
        if locked:
            self._held = queued
        else:
            self.queue.append(queued)
