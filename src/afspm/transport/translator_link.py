"""The scheduler's connection to the translator's control socket."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import zmq

from afspm.transport.frames import receive_frames, send_frames
from afspm.transport.network import CONNECTED, DISCONNECTED, Monitor, Network
from afspm.transport.rate_limited_log import RateLimitedLog

_LONGEST_NUMBER = 18


class LinkUp(NamedTuple):
    """The event that the translator is connected."""


class LinkDown(NamedTuple):
    """The event that the translator is disconnected."""


class LinkReply(NamedTuple):
    """The translator's answer to the request `number`, as frames for `wire.decode_response`."""

    number: int
    frames: Sequence[bytes]


class TranslatorLink:
    """A client that sends requests to the translator.

    A REP socket returns the frames before the empty frame: a number, so that a late answer is never taken for the
    answer to another request, and the scheduler's epoch, which the translator checks.

    Args:
        epoch: epoch of the scheduler; empty: none.
    """

    def __init__(self, network: Network, address: str, log: RateLimitedLog, epoch: bytes = b"") -> None:
        self._log = log
        self._before = [epoch, b""] if epoch else [b""]
        self._address = address
        self.socket = network.socket(zmq.DEALER)
        # without it, requests would queue for a translator that is gone, and move the tip when it returns. The price:
        # an answer may be lost with the connection; the request is then repeated with its id.
        self.socket.setsockopt(zmq.IMMEDIATE, 1)
        self.monitor = Monitor(network, self.socket, CONNECTED | DISCONNECTED)
        network.connect(self.socket, address)

    def send(self, number: int, frames: Sequence[bytes]) -> bool:
        """Send a request; return False without a connected translator."""
        return send_frames(self.socket, [b"%d" % number, *self._before, *frames])

    def receive(self) -> LinkReply | None:
        """Return the next answer; None if there is none, or it is malformed."""
        frames = [frame.bytes for frame in receive_frames(self.socket)]
        if not frames or frames == [b""]:  # an empty message is the translator's probe
            return None
        before, content = _parted(frames)
        number = before[0] if before else b""
        is_ours = before[1:] in ([], self._before[:-1]) and number.isdigit() and len(number) <= _LONGEST_NUMBER
        if not content or not is_ours:
            self._log.warning(f"dropped a malformed answer from {self._address}")
            return None
        return LinkReply(int(number), content)

    def follow(self) -> list[LinkUp | LinkDown]:
        """Return connections and disconnections of the translator."""
        return [LinkUp() if event.kind == CONNECTED else LinkDown() for event in self.monitor.drain()]


def _parted(frames: list[bytes]) -> tuple[list[bytes], list[bytes]]:
    # the frames before the first empty one, and those after it
    if b"" not in frames[1:]:
        return [], []
    at = frames.index(b"", 1)
    return frames[:at], frames[at + 1 :]
