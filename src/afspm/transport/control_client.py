"""Asks the scheduler."""

from __future__ import annotations

from collections.abc import Sequence

import zmq

from afspm import wire
from afspm.errors import WireError
from afspm.logic.sessions import token_of
from afspm.model import CLOCK_REQUEST, Request
from afspm.transport.complaints import Complaints
from afspm.transport.frames import receive_small, send
from afspm.transport.monitor import CONNECTED, DISCONNECTED, Monitor
from afspm.transport.network import Network
from afspm.transport.port import ControlConnected, ControlDisconnected, Incoming, ReplyReceived


class ControlClient:
    """A component's connection to the scheduler: the same bytes as a REQ socket, without its lock step.

    Args:
        name: of the component. Restarted, it is the same client to the scheduler.
    """

    def __init__(self, network: Network, name: str, address: str, complaints: Complaints) -> None:
        self._complaints = complaints
        self._address = address
        self._scheduler_is_ours = False
        self._connected = False
        self._unanswered = b""
        self._name, self._token = name, ""
        self.touched = True
        self.socket = network.socket(zmq.DEALER)
        self.socket.setsockopt(zmq.ROUTING_ID, name.encode())
        self.monitor = Monitor(network, self.socket, CONNECTED | DISCONNECTED)
        network.connect(self.socket, address)

    def send(self, frames: Sequence[bytes]) -> None:
        """Ask; dropped while there is no scheduler.

        Asked again what was asked last, with no answer in between, it makes the connection anew: a connection that
        stands but leads nowhere (cut off, or its name was taken by another process) would never lead anywhere again.
        """
        if not self._connected:
            return
        asked = frames[2] if len(frames) > 2 else b""
        if asked and not self._token:  # the same in all of a process's ids that have one
            self._token = token_of(self._name, asked.decode()) or ""
        if asked and asked == self._unanswered:
            self._reconnect()
            return
        self._unanswered = asked
        self.touched = True
        send(self.socket, [b"", *frames])  # or not, if it is full: then the scheduler has stood still for thousands

    def _reconnect(self) -> None:
        self._connected, self._unanswered = False, b""
        self.socket.disconnect(self._address)
        self.socket.connect(self._address)

    def receive(self) -> list[Incoming]:
        """The next answer."""
        self.touched = True
        _, frames = receive_small(self.socket)
        if not frames or frames == [b""]:  # an empty one: the scheduler has looked whether we are there
            return []
        try:
            return [self._interpret(frames)]
        except WireError as error:
            self._complaints.say(f"dropped a reply from {self._address}: {error}")
            return []

    def follow(self) -> list[Incoming]:
        """The scheduler's coming and going."""
        found: list[Incoming] = []
        for event in self.monitor.drain():
            self._connected, self._unanswered = event.kind == CONNECTED, b""
            if self._connected:
                self._greet()
                found.append(ControlConnected())
            else:
                found.append(ControlDisconnected())
        return found

    def _interpret(self, frames: list[bytes]) -> Incoming:
        if len(frames) < 2 or frames[0]:
            raise WireError("there is no empty frame before it")
        response = wire.decode_response(frames[1:])
        self._unanswered = b""
        self._scheduler_is_ours = self._scheduler_is_ours or bool(response.id)
        return ReplyReceived(response)

    def _greet(self) -> None:
        """Say who we are to a scheduler that was restarted, or that has not yet seen our last connection close.

        It may be waiting for us, who are in control; and what we ask next may have an id that does not say who we are.
        Only to ours, known by its answers: for one of version 1 a request that it does not know might be its last.
        """
        if self._scheduler_is_ours and self._token:
            self.send(wire.encode_request(Request(CLOCK_REQUEST, id=f"{self._name}/{self._token}/0")))
        elif self._scheduler_is_ours:
            self.send([])

    def close(self) -> None:
        self.monitor.close()
        self.socket.close()
