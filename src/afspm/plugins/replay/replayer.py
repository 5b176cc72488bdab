"""`Replayer`: the publisher of recorded packets in place of a scheduler; every command is refused."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from itertools import islice

from afspm import wire
from afspm.basics import NS_PER_S, ExperimentClock, TransportError, WireError
from afspm.model import CLOCK_REQUEST, RELAY_REQUEST, ControlResponse, Packet, Response
from afspm.night import RecordPlayback
from afspm.transport import (
    Network,
    PeerAsked,
    Poller,
    PublishedHistory,
    Publisher,
    RateLimitedLog,
    Router,
    WakeUp,
    milliseconds,
)

REASON = "this is a replay of a recorded run: it takes no requests"
FAREWELL_S = 0.5  # real: for the end to reach all subscribers
MOST_AT_ONCE = 200


class Replayer:
    """A publisher of recorded packets, each at its recorded time.

    Args:
        recorded: the recorded packets.
        clock: clock that shows the time of the recorded run.

    Raises:
        TransportError: an address can't be used.
    """

    def __init__(
        self,
        recorded: RecordPlayback[Packet],
        clock: ExperimentClock,
        log: RateLimitedLog,
        *,
        publish: str,
        serve: str,
    ) -> None:
        self._recorded = recorded
        self._clock = clock
        self._network = Network.from_launch("replay", None)
        self._published = PublishedHistory(clock)
        self._wake_up: WakeUp[None] = WakeUp()
        try:
            self._publisher = Publisher(self._network, publish, self._published, self._published.newest, log)
            self._router = Router(self._network, serve, log, clock)
        except TransportError:
            self.close()
            raise
        self._poller: Poller[Callable[[], object]] = Poller(self._wake_up)
        self._poller.register(self._publisher.socket, self._publisher.serve)
        for socket in (self._router.socket, self._router.monitor.socket):
            self._poller.register(socket, self._answer)
        self._stopping = False
        self.count = 0
        """The number of packets published."""

    def run(self, *, stay: bool = False) -> None:
        """Publish packets until the last packet or `stop`, then publish the end of the experiment.

        Args:
            stay: after the last packet, wait for `stop`.
        """
        while not self._stopping and (self._recorded.next_ns is not None or stay):
            self._serve(self._due_in_s())
            self._publish_due()
        self._publish_end()

    def stop(self) -> None:
        """Make `run` return. Can be called from any thread, or from a signal handler."""
        self._stopping = True
        self._wake_up.post()

    def wakeup_fileno(self) -> int:
        """Return a file descriptor; a write to it makes `run` check whether to stop."""
        return self._wake_up.writer_fileno()

    def _publish_end(self) -> None:
        self._publisher.kill()
        until_s = self._clock.monotonic_s() + FAREWELL_S
        while (left_s := until_s - self._clock.monotonic_s()) > 0.0:
            self._serve(left_s)

    def close(self) -> None:
        """Close all sockets once all messages are sent. Safe to repeat."""
        self._network.close()
        self._wake_up.close()

    def _due_in_s(self) -> float:
        next_ns = self._recorded.next_ns
        if next_ns is None:
            return math.inf
        return max(0.0, self._clock.real_s((next_ns - self._clock.now_ns()) / NS_PER_S))

    def _publish_due(self) -> None:
        uncached = tuple(one.name for one in wire.declared() if not one.history)  # by a scheduler either
        for packet in islice(self._recorded.due(self._clock.now_ns()), MOST_AT_ONCE):
            keep = not packet.envelope.startswith(uncached)
            stamped = self._published.stamp(packet.envelope, bytes(packet.payload), packet.time_ns, keep=keep)
            self._publisher.publish(stamped)
            self.count += 1

    def _serve(self, within_s: float) -> None:
        within_s = min(within_s, max(0.0, self._publisher.due_s - self._clock.monotonic_s()))
        timeout = None if within_s == math.inf else milliseconds(within_s)
        drains, woken = self._poller.wait(timeout)
        if woken:
            self._wake_up.take()
        for drain in drains:
            drain()
        self._publisher.serve()

    def _answer(self) -> None:
        for event in self._router.receive():
            if isinstance(event, PeerAsked) and event.frames:
                self._router.reply(event.connection, wire.encode_response(self._response(event)))

    def _response(self, asked: PeerAsked) -> Response:
        try:
            request = wire.decode_request(asked.frames)
        except WireError as error:
            return Response(error.response, reason=str(error))
        if request.kind == CLOCK_REQUEST:
            clock = {**self._clock.as_dict(), "now_ns": self._clock.now_ns()}
            return Response(int(ControlResponse.SUCCESS), json.dumps(clock).encode(), "", request.id)
        if request.kind == RELAY_REQUEST:  # a supervisor of the replay's components: nothing is published for it
            return Response(int(ControlResponse.SUCCESS), wire.encode_orders(()), "", request.id)
        return Response(int(ControlResponse.FAILURE), reason=REASON, id=request.id)
