"""The scheduler's connection to the translator's control socket."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import zmq

from afspm.transport.complaints import Complaints
from afspm.transport.frames import receive_small, send
from afspm.transport.monitor import CONNECTED, DISCONNECTED, Monitor
from afspm.transport.network import Network

_LONGEST_NUMBER = 18


class LinkUp(NamedTuple):
    """The translator can be asked."""


class LinkDown(NamedTuple):
    """The translator's connection is gone."""


class LinkReply(NamedTuple):
    """The translator's answer to the request that was sent as `number`, as frames for `wire.decode_response`."""

    number: int
    frames: Sequence[bytes]


class TranslatorLink:
    """Asks the translator, ours or of version 1: a REP socket gives back the number that stands before the empty frame,
    so that a late answer is never taken for another's.
    """

    def __init__(self, network: Network, address: str, complaints: Complaints) -> None:
        self._complaints = complaints
        self._address = address
        self.touched = True
        self.socket = network.socket(zmq.DEALER)
        # nothing waits for a translator that is gone, to be carried out when it is back. (With this an answer may be
        # lost together with the connection: it is asked for again by its id.)
        self.socket.setsockopt(zmq.IMMEDIATE, 1)
        self.monitor = Monitor(network, self.socket, CONNECTED | DISCONNECTED)
        network.connect(self.socket, address)

    def send(self, number: int, frames: Sequence[bytes]) -> bool:
        """Ask; False if there is no translator to ask."""
        self.touched = True
        return send(self.socket, [b"%d" % number, b"", *frames])

    def receive(self) -> LinkReply | None:
        """The next answer; None: there is none, or it is malformed."""
        self.touched = True
        _, frames = receive_small(self.socket)
        if not frames:
            return None
        if len(frames) < 3 or frames[1] or not frames[0].isdigit() or len(frames[0]) > _LONGEST_NUMBER:
            self._complaints.say(f"dropped a malformed answer from {self._address}")
            return None
        return LinkReply(int(frames[0]), frames[2:])

    def follow(self) -> list[LinkUp | LinkDown]:
        """The translator's coming and going."""
        return [LinkUp() if event.kind == CONNECTED else LinkDown() for event in self.monitor.drain()]

    def close(self) -> None:
        self.monitor.close()
        self.socket.close()
