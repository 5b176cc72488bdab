"""A component's connection to the scheduler's control socket."""

from __future__ import annotations

from collections.abc import Sequence

import zmq

from afspm import wire
from afspm.basics.errors import WireError
from afspm.model import CLOCK_REQUEST, Request
from afspm.model.sessions import token_of
from afspm.transport.frames import receive_frames, send_frames
from afspm.transport.keys import routing_id
from afspm.transport.network import CONNECTED, DISCONNECTED, Monitor, Network
from afspm.transport.port import ControlConnected, ControlDisconnected, Incoming, ReplyReceived
from afspm.transport.rate_limited_log import RateLimitedLog


class ControlClient:
    """A client that sends requests to the scheduler in a REQ socket's format, but need not wait for each answer.

    Args:
        name: name of the component, under which the scheduler recognises the same client after a restart.
    """

    def __init__(self, network: Network, name: str, address: str, log: RateLimitedLog) -> None:
        self._log = log
        self._address = address
        self._connected = self._has_asked = False
        self._unanswered = b""
        self._name, self._token = name, ""
        self.socket = network.socket(zmq.DEALER)
        self.socket.setsockopt(zmq.ROUTING_ID, routing_id(name))
        self.monitor = Monitor(network, self.socket, CONNECTED | DISCONNECTED)
        network.connect(self.socket, address)

    def send(self, frames: Sequence[bytes]) -> None:
        """Send a request; without a connection to the scheduler the request is dropped.

        A repetition of the last request (the same id) before its answer is not sent, but opens a new connection: the
        old connection may look intact while it is cut off, or while another process has taken its identity.
        """
        if not self._connected:
            return
        asked = frames[2] if len(frames) > 2 else b""
        if asked and not self._token:  # equal in all ids of a process with a token
            self._token = token_of(self._name, asked.decode()) or ""
        if asked and asked == self._unanswered:
            self._reconnect()
            return
        self._unanswered, self._has_asked = asked, True
        self._send(frames)

    def _send(self, frames: Sequence[bytes]) -> None:
        # a full queue drops it: the scheduler has ignored thousands of requests
        send_frames(self.socket, [b"", *frames])

    def _reconnect(self) -> None:
        self._connected, self._unanswered = False, b""
        self.socket.disconnect(self._address)
        self.socket.connect(self._address)

    def receive(self) -> list[Incoming]:
        """Return the next answer; empty for the scheduler's probe or a malformed reply."""
        frames = [frame.bytes for frame in receive_frames(self.socket)]
        if not frames or frames == [b""]:  # an empty message is the scheduler's probe
            return []
        try:
            return self._interpret(frames)
        except WireError as error:
            self._log.warning(f"dropped a malformed reply from {self._address}: {error}")
            return []

    def follow(self) -> list[Incoming]:
        """Return the scheduler's connection and disconnection events."""
        found: list[Incoming] = []
        for event in self.monitor.drain():
            self._connected, self._unanswered = event.kind == CONNECTED, b""
            if self._connected:
                self._greet()
            found.append(ControlConnected() if self._connected else ControlDisconnected())
        return found

    def _interpret(self, frames: list[bytes]) -> list[Incoming]:
        if len(frames) < 2 or frames[0]:
            raise WireError("the empty frame before the answer is missing")
        response = wire.decode_response(frames[1:])
        self._unanswered = b""
        return [ReplyReceived(response)]

    def _greet(self) -> None:
        # a restarted scheduler may wait for this client, which is in control. The next request need not have the token
        # in its id, without which the scheduler can't match the new connection with the old session.
        if self._has_asked and self._token:
            self._send(wire.encode_request(Request(CLOCK_REQUEST, id=f"{self._name}/{self._token}/0")))
        elif self._has_asked:
            self._send([])
