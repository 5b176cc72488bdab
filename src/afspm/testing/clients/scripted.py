"""A scripted scheduler: every byte from the client is recorded, and every byte to the client is scripted."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import zmq

from afspm.basics.clock import Clock
from afspm.model import CLOCK_REQUEST, ControlResponse
from afspm.transport import milliseconds
from afspm.transport.frames import receive_frames
from afspm.transport.keys import Keys
from afspm.transport.late_joiners import BEACON, LONGEST, Marker
from afspm.transport.network import ACCEPTED, Monitor, Network
from afspm.transport.polling import Poller, WakeUp


@dataclass(frozen=True)
class ScriptedRequest:
    """A received request; greetings are answered automatically and not recorded as requests."""

    peer: bytes
    frames: tuple[bytes, ...]

    @property
    def id(self) -> bytes:
        return self.frames[2] if len(self.frames) > 2 else b""

    def answered(
        self, code: int = ControlResponse.SUCCESS, payload: bytes = b"", reason: str = "", detail: int = 0
    ) -> list[bytes]:
        """Return the frames of a response to the request."""
        frames = [bytes([code]), payload, reason.encode(), self.id]
        return [*frames, bytes([detail])] if detail else frames


Reply = Callable[[ScriptedRequest], Sequence[Sequence[bytes]]]


def success(request: ScriptedRequest) -> Sequence[Sequence[bytes]]:
    """Return a response that reports success."""
    return [request.answered()]


class ScriptedScheduler:
    """A scheduler for tests with real sockets and scripted answers.

    Args:
        control, publish: addresses to bind.
        keys: the scheduler's keys; None: without encryption.

    Attributes:
        requests: received requests, in order.
        greetings: received greetings (request number 101).
        connections: the number of connections to `control`, including connections with refused keys.
        prefixes, markers: received subscriptions.
        cached: packets, as frames, for clients that request them by a marker.
        reply: returns the answer to a request.
        greeting: returns the answer to a greeting.
    """

    def __init__(self, clock: Clock, control: str, publish: str, keys: Keys | None) -> None:
        self._clock, self._bound = clock, (control, publish, keys)
        self._woken: WakeUp[None] = WakeUp()
        self.requests: list[ScriptedRequest] = []
        self.greetings: list[ScriptedRequest] = []
        self.connections = 0
        self.prefixes: list[bytes] = []
        self.markers: list[Marker] = []
        self.cached: list[list[bytes]] = []
        self.reply: Reply = success
        self.greeting: Reply = self._answer_clock_request
        self.open()

    def open(self) -> None:
        """Bind the sockets, also again after `shut`."""
        control, publish, keys = self._bound
        self._network = Network(keys)
        self._router = self._network.socket(zmq.ROUTER)
        # a client that reconnects replaces its old connection at once
        self._router.setsockopt(zmq.ROUTER_HANDOVER, 1)
        monitor = Monitor(self._network, self._router, ACCEPTED)
        self._network.bind(self._router, control, requests=True)
        self._publisher = self._network.socket(zmq.XPUB, max_bytes=LONGEST + 1)
        # manual: a marker subscribes to its topic, not to its own bytes; verboser: repeated subscriptions are recorded
        self._publisher.setsockopt(zmq.XPUB_MANUAL, 1)
        self._publisher.setsockopt(zmq.XPUB_VERBOSER, 1)
        self._network.bind(self._publisher, publish)
        self._poller: Poller[Callable[[], None]] = Poller(self._woken)
        self._poller.register(self._router, self._take_request)
        self._poller.register(monitor.socket, partial(self._count_connections, monitor))
        self._poller.register(self._publisher, self._take_subscription)

    def shut(self) -> None:
        """Close the sockets, which breaks all connections; `open` binds them again."""
        self._network.close()

    def close(self) -> None:
        """Close the sockets permanently."""
        self.shut()
        self._woken.close()

    def wake(self) -> None:
        """Make `pump` evaluate its condition again. Thread-safe."""
        self._woken.post()

    def pump(self, done: Callable[[], bool], within_s: float) -> bool:
        """Serve until `done()`; return False on a timeout."""
        until_s = self._clock.monotonic_s() + within_s
        while not done():
            left_s = until_s - self._clock.monotonic_s()
            if left_s <= 0.0:
                return False
            sources, woken = self._poller.wait(milliseconds(left_s))
            if woken:
                self._woken.take()
            for take in sources:
                take()
        return True

    def serve(self, for_s: float) -> None:
        self.pump(lambda: False, for_s)

    def publish(self, *frames: bytes) -> None:
        """Publish any frames, even if they form no valid packet."""
        self._publisher.send_multipart(list(frames))

    def send(self, peer: bytes, frames: Sequence[bytes]) -> None:
        self._router.send_multipart([peer, b"", *frames])

    def _count_connections(self, monitor: Monitor) -> None:
        self.connections += len(monitor.drain())

    def _take_request(self) -> None:
        peer, *frames = [frame.bytes for frame in receive_frames(self._router)]
        if frames[:1] == [b""]:
            del frames[0]
        request = ScriptedRequest(peer, tuple(frames))
        if not frames or frames == [b""]:
            return
        if frames[0] == bytes([CLOCK_REQUEST]):
            self.greetings.append(request)
            self._answer(request, self.greeting)
        else:
            self.requests.append(request)
            self._answer(request, self.reply)

    def _answer(self, request: ScriptedRequest, reply: Reply) -> None:
        for frames in reply(request):
            self.send(request.peer, frames)

    def _answer_clock_request(self, request: ScriptedRequest) -> Sequence[Sequence[bytes]]:
        now_s = self._clock.now_s()
        clock = {"now_ns": round(now_s * 1e9), "origin_s": now_s, "start_s": now_s, "speed": 1.0, "simulated": True}
        return [request.answered(payload=json.dumps(clock).encode())]

    def _take_subscription(self) -> None:
        (frame,) = receive_frames(self._publisher)[:1]
        kind, subscription = frame.bytes[:1], frame.bytes[1:]
        marker = Marker.decode(subscription)
        if kind == b"\0":
            self._publisher.setsockopt(zmq.UNSUBSCRIBE, subscription if marker is None else marker.topic)
        elif marker is None:
            self._publisher.setsockopt(zmq.SUBSCRIBE, subscription)
            self.prefixes.append(subscription)
        else:
            self._publisher.setsockopt(zmq.SUBSCRIBE, marker.topic)
            self.markers.append(marker)
            for packet in self.cached:
                self._publisher.send_multipart([marker.topic, *packet])
            self._publisher.send(marker.topic)
            # a client may ignore it, but must not take it for a packet
            self._publisher.setsockopt(zmq.SUBSCRIBE, BEACON)
            self._publisher.send_multipart([BEACON, b""])
