"""Heartbeats: a thread in every process says that it is alive and for how long it has been busy."""

from __future__ import annotations

import hmac
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import zmq

from afspm.transport import keys as curve
from afspm.transport.frames import receive_frames
from afspm.transport.network import Network
from afspm.transport.polling import WakeUp, milliseconds
from afspm.wire import BEAT, CLOSING


class Heartbeat(NamedTuple):
    """One beat.

    Attributes:
        name: of the process.
        closing: it ends on purpose; no more beats will come.
        step_age_s: for how long the current step has been running; 0 when idle. None if the process did not say.
        longest_step_s: how long a step may take; None if the process did not say.
    """

    name: str
    closing: bool
    step_age_s: float | None = None
    longest_step_s: float | None = None


class HeartbeatSender:
    """Beats from a thread of its own, so that a process that is busy is not taken for dead.

    The first beat goes out as soon as there is a listener.

    Args:
        address: the listener's.
        period_s: real seconds between beats.
        step_age_s: for how long the current step has been running; called in the thread.
        longest_step_s: how long a step may take; called in the thread.
        token: of the launch line, by which the listener knows that the beat is ours.
        network: for this socket alone, and closed with it.

    Attributes:
        heard: set as soon as there is a listener: beats from then on arrive.
    """

    def __init__(
        self,
        address: str,
        period_s: float,
        step_age_s: Callable[[], float],
        longest_step_s: Callable[[], float],
        token: str = "",
        network: Network | None = None,
    ) -> None:
        self._network = network or Network()
        self._period_ms = max(1, round(period_s * 1000.0))
        self._step_age_s = step_age_s
        self._longest_step_s = longest_step_s
        self._token = token.encode()
        self._stop: WakeUp[None] = WakeUp()
        self.heard = threading.Event()
        # XPUB, since it sees the listener subscribe: a beat sent before that would be lost
        self._socket = self._network.socket(zmq.XPUB)
        self._network.connect(self._socket, address)
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._stop.fileno(), zmq.POLLIN)
        while True:
            ready = dict(poller.poll(self._period_ms))
            while receive_frames(self._socket):
                self.heard.set()
            if self._stop.fileno() in ready:
                break
            self._send(BEAT)
        self._send(CLOSING)
        self._socket.close()

    def _send(self, beat: bytes) -> None:
        ages = (self._step_age_s(), self._longest_step_s())
        self._socket.send_multipart([beat, *(f"{age_s:.3f}".encode() for age_s in ages), self._token])

    def close(self) -> None:
        """Say that we are closing on purpose, and stop. Safe to repeat."""
        if self._thread.is_alive():
            self._stop.post()
            self._thread.join()
            self._network.close()
            self._stop.close()


@dataclass
class _Expected:
    """The process that beats at one address, and the token that proves it."""

    name: str
    token: bytes
    needs_token: bool


class HeartbeatListener:
    """Listens to the heartbeats of several processes, each at an address of its own, by a token of its own.

    Other users of this computer get to no such address: it is a unix socket, or encrypted, by a key that the process
    alone gets. Other processes of this user may: a beat of a process that knows its token counts with it alone. A
    program that sends none is believed as it is.

    Args:
        take_address: returns a new address.
        encrypts: whether sockets are encrypted that other users can reach.
    """

    def __init__(
        self, *, take_address: Callable[[], str] = lambda: "tcp://127.0.0.1:0", encrypts: bool = False
    ) -> None:
        self._take_address, self._encrypts = take_address, encrypts
        self._network = Network()
        self._expected: dict[zmq.Socket[bytes], _Expected] = {}
        self._poller = zmq.Poller()

    def end_polls_by(self, descriptor: int) -> None:
        """Have a readable descriptor end a `poll` under way; to read from it is left to its owner."""
        self._poller.register(descriptor, zmq.POLLIN)

    def listen(self, name: str, *, token: str = "", needs_token: bool = False) -> tuple[str, bytes | None]:
        """Begin to listen to the process `name`; return the address and the key to give to it, None if it is plain.

        Args:
            token: to be given to it, too.
            needs_token: it is known to send its token; else it is from its first beat that has it.
        """
        socket = self._network.socket(zmq.SUB)
        socket.setsockopt(zmq.SUBSCRIBE, b"")
        address, key = self._take_address(), None
        if self._encrypts and not curve.is_private(address):
            # its clients need no keys that are known: nobody else has the server's
            key, secret = curve.pair()
            socket.setsockopt(zmq.CURVE_SERVER, 1)
            socket.setsockopt(zmq.CURVE_SECRETKEY, secret)
        bound = self._network.bind(socket, address)
        self._expected[socket] = _Expected(name, token.encode(), needs_token)
        self._poller.register(socket, zmq.POLLIN)
        return bound, key

    def poll(self, timeout_s: float | None) -> list[Heartbeat]:
        """Return the beats that have come; waits up to `timeout_s` real seconds (None: as long as it takes)."""
        found = []
        for ready, _ in self._poller.poll(milliseconds(timeout_s)):
            expected = None if isinstance(ready, int) else self._expected.get(ready)
            while expected is not None and (frames := [frame.bytes for frame in receive_frames(ready)]):
                beat = read_beat(expected.name, frames)
                if beat is not None and _is_by(expected, frames):
                    found.append(beat)
        return found

    def close(self) -> None:
        self._network.close()


def _is_by(expected: _Expected, frames: list[bytes]) -> bool:
    """True for a beat of the process that is expected."""
    token = frames[3] if len(frames) > 3 else b""
    if expected.token and hmac.compare_digest(token, expected.token):
        expected.needs_token = True
        return True
    return not expected.needs_token


def read_beat(name: str, frames: list[bytes]) -> Heartbeat | None:
    """Return a beat, of one frame or of four; None if it is neither."""
    if not frames or frames[0] not in (BEAT, CLOSING):
        return None
    ages = [_seconds(frame) for frame in frames[1:3]]
    age_s, longest_s = [*ages, None, None][:2]
    return Heartbeat(name, frames[0] == CLOSING, age_s, longest_s)


def _seconds(text: bytes) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and value >= 0.0 else None
