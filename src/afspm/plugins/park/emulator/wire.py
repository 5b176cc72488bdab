"""SmartRemote's socket: a ZeroMQ REP for many clients, each of which waits for its reply."""

from __future__ import annotations

from typing import Final, cast

import zmq

from afspm.simulation.emulation.emulator import LOOPBACK
from afspm.simulation.emulation.scripted import Client, OnRequest

LONGEST_REQUEST: Final = 1 << 20


class SmartRemoteWire:
    """The socket. See `ScriptWire`."""

    def __init__(self, port: int, on_request: OnRequest, wakes: object) -> None:
        self._on_request = on_request
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.SNDTIMEO, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LONGEST_REQUEST)
        try:
            self._socket.bind(f"tcp://{LOOPBACK}:{port or '*'}")
        except zmq.ZMQError as error:
            self.close()
            raise OSError(error.errno, str(error)) from error
        self.port = int(self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
        self._poller = zmq.Poller()
        self._poller.register(wakes, zmq.POLLIN)
        self._poller.register(self._socket, zmq.POLLIN)

    @property
    def address(self) -> str:
        return f"tcp://{LOOPBACK}:{self.port}"

    def poll(self, timeout_s: float) -> None:
        if self._socket not in dict(self._poller.poll(max(0, round(timeout_s * 1000)))):
            return
        while True:
            try:
                client, *frames = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            if len(frames) == 2 and not frames[0]:
                self._on_request(client, frames[1])

    def send(self, client: Client, reply: bytes) -> None:
        self._socket.send_multipart([cast(bytes, client), b"", reply])

    def send_half(self, client: Client, reply: bytes) -> None:
        """Half a reply: a message of ZeroMQ's is never cut, but what is in it may be."""
        self.send(client, reply[: len(reply) // 2])

    def close(self) -> None:
        self._context.destroy(linger=0)
