"""Heartbeats: a thread in every process that reports that it is alive, and the age of its current step."""

from __future__ import annotations

import hmac
import math
import threading
import time
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
    """One heartbeat.

    Attributes:
        name: name of the process.
        closing: whether the process ends on purpose, so that no more heartbeats follow.
        step_age_s: age of the current step in real time; 0 when idle, None if missing.
        longest_step_s: longest allowed duration of a step; None if missing.
    """

    name: str
    closing: bool
    step_age_s: float | None = None
    longest_step_s: float | None = None


class HeartbeatSender:
    """A thread that sends heartbeats, so that a busy process is not presumed dead.

    A heartbeat is sent as soon as the listener has connected; earlier heartbeats are lost.

    Args:
        address: address of the listener.
        period_s: real seconds between heartbeats.
        step_age_s: returns the age of the current step; called in the thread.
        longest_step_s: returns the longest allowed step; called in the thread.
        token: token of the launch line, which proves the sender's identity.
        network: network of this socket only, closed with it.

    Attributes:
        heard: set once there is a listener; later heartbeats arrive.  # word: heard
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
        self._period_s = period_s
        self._step_age_s = step_age_s
        self._longest_step_s = longest_step_s
        self._token = token.encode()
        self._stop: WakeUp[None] = WakeUp()
        self.heard = threading.Event()
        # XPUB, not PUB: it receives the listener's subscription, and a beat before that would be lost
        self._socket = self._network.socket(zmq.XPUB)
        self._network.connect(self._socket, address)
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._stop.fileno(), zmq.POLLIN)
        while True:
            # at multiples of the period: the processes of a computer beat together, and wake up their supervisor once
            ready = dict(poller.poll(milliseconds(self._period_s - time.monotonic() % self._period_s)))
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
        """Announce the end on purpose, and stop. Safe to repeat."""
        if self._thread.is_alive():
            self._stop.post()
            self._thread.join()
            self._network.close()
            self._stop.close()


@dataclass
class _Expected:
    """The process that sends heartbeats to one address, and its token."""

    name: str
    token: bytes
    needs_token: bool


class HeartbeatListener:
    """A receiver of the heartbeats of several processes, each with its own address and token.

    With `encrypts`, other users of this computer can't send heartbeats: an address is a unix socket, or encrypted with
    a key that only the process gets. Other processes of this user can. So once a process has sent its token, heartbeats
    without the token are ignored. Until then they count, unless the process needs a token.

    Args:
        take_address: returns a new address to listen at.
        encrypts: whether to encrypt sockets that other users can reach.
    """

    def __init__(
        self, *, take_address: Callable[[], str] = lambda: "tcp://127.0.0.1:0", encrypts: bool = False
    ) -> None:
        self._take_address, self._encrypts = take_address, encrypts
        self._network = Network()
        self._expected: dict[zmq.Socket[bytes], _Expected] = {}
        self._poller = zmq.Poller()

    def end_polls_by(self, descriptor: int) -> None:
        """Let `poll` also return when a descriptor is readable; the caller reads it."""
        self._poller.register(descriptor, zmq.POLLIN)

    def listen(self, name: str, *, token: str = "", needs_token: bool = False) -> tuple[str, bytes | None]:
        """Listen for heartbeats of the process `name`; return the address and its public key.

        The key is None for a socket without encryption.

        Args:
            token: the token that the process also receives.
            needs_token: whether the token is required from the first heartbeat on; otherwise after its first use.
        """
        socket = self._network.socket(zmq.SUB)
        socket.setsockopt(zmq.SUBSCRIBE, b"")
        address, key = self._take_address(), None
        if self._encrypts and not curve.is_private(address):
            # any client key is accepted: only the process gets the server's public key
            key, secret = curve.pair()
            socket.setsockopt(zmq.CURVE_SERVER, 1)
            socket.setsockopt(zmq.CURVE_SECRETKEY, secret)
        bound = self._network.bind(socket, address)
        self._expected[socket] = _Expected(name, token.encode(), needs_token)
        self._poller.register(socket, zmq.POLLIN)
        return bound, key

    def poll(self, timeout_s: float | None) -> list[Heartbeat]:
        """Return the received heartbeats, after a wait of up to `timeout_s` real seconds (None: without limit)."""
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
    # the first heartbeat with the token makes the token necessary
    token = frames[3] if len(frames) > 3 else b""
    if expected.token and hmac.compare_digest(token, expected.token):
        expected.needs_token = True
        return True
    return not expected.needs_token


def read_beat(name: str, frames: list[bytes]) -> Heartbeat | None:
    """Return the heartbeat in some frames; None if the first frame is neither BEAT nor CLOSING.

    A missing or malformed age is None; see `basics.launch` for the frames.
    """
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
