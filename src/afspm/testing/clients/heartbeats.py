"""`BeatRecorder`: receives the heartbeats of a client and records their times."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import zmq

from afspm.basics.clock import Clock
from afspm.transport.frames import receive_frames
from afspm.transport.network import Network
from afspm.transport.polling import WakeUp
from afspm.wire import CLOSING


@dataclass(frozen=True)
class ReceivedBeat:
    """A received heartbeat; times in real seconds."""

    at_s: float
    frames: list[bytes]

    @property
    def closing(self) -> bool:
        return self.frames[:1] == [CLOSING]


class BeatRecorder:
    """A receiver of heartbeats at its own address, in its own thread, until it is closed.

    Args:
        on_beat: called in that thread after each beat.
    """

    def __init__(self, clock: Clock, on_beat: Callable[[], None]) -> None:
        self._clock, self._on_beat = clock, on_beat
        self._network = Network()
        self._socket = self._network.socket(zmq.SUB)
        self._socket.setsockopt(zmq.SUBSCRIBE, b"")
        self.address = self._network.bind(self._socket, "tcp://127.0.0.1:0")
        self.beats: list[ReceivedBeat] = []
        self._stop: WakeUp[None] = WakeUp()
        self._thread = threading.Thread(target=self._run, name="beats", daemon=True)
        self._thread.start()

    def longest_pause_s(self, since_s: float) -> float:
        """Return the longest time without a beat from `since_s` until now."""
        times = [since_s, *(beat.at_s for beat in self.beats if beat.at_s > since_s), self._clock.monotonic_s()]
        return max(after - before for before, after in pairwise(times))

    def _run(self) -> None:
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._stop.fileno(), zmq.POLLIN)
        while self._stop.fileno() not in dict(poller.poll()):
            while frames := receive_frames(self._socket):
                self.beats.append(ReceivedBeat(self._clock.monotonic_s(), [frame.bytes for frame in frames]))
                self._on_beat()

    def close(self) -> None:
        self._stop.post()
        self._thread.join()
        self._network.close()
        self._stop.close()
