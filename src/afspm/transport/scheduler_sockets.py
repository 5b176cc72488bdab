"""The sockets of a scheduler in one poller, including its connection to the translator's control socket."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from typing import NamedTuple

import zmq

from afspm.basics.clock import Clock
from afspm.basics.errors import ConfigError
from afspm.basics.launch import Launch
from afspm.model import Packet
from afspm.transport.frames import receive_frames, send_frames
from afspm.transport.late_joiners import History, Newest
from afspm.transport.network import CONNECTED, DISCONNECTED, Monitor, Network
from afspm.transport.polling import Poller, WakeUp
from afspm.transport.port import Incoming
from afspm.transport.publisher import Publisher
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.router import Router, RouterEvent
from afspm.transport.subscriber import Subscriber

_LONGEST_NUMBER = 18
_MOST_ANSWERS = 12
"""Limit of answers in one turn, below the 100 frames that libzmq receives between two looks at its connections."""


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

    Before the empty frame of a request go its number and the scheduler's epoch; a REP socket returns both with the
    answer. By the number a late answer is never taken for the answer to another request; the translator checks the
    epoch.

    Args:
        epoch: epoch of the scheduler; empty: none.
    """

    def __init__(self, network: Network, address: str, log: RateLimitedLog, epoch: bytes = b"") -> None:
        self._log = log
        self._before = [epoch, b""] if epoch else [b""]
        self._address = address
        self.socket = network.socket(zmq.DEALER)
        # without it, requests would queue for a translator that is gone, and move the tip when it returns. The price:
        # an answer may be lost with the connection; the request is then repeated with its id. And `receive` must always
        # read until nothing is left: with this option libzmq 4.3.5 drops the rest of an answer, and aborts the process
        # (`Assertion failed: !_more`), if it finds the connection lost between two frames. It looks when nothing is
        # left, and at each 100th frame after that.
        self.socket.setsockopt(zmq.IMMEDIATE, 1)
        self.monitor = Monitor(network, self.socket, CONNECTED | DISCONNECTED)
        network.connect(self.socket, address)

    def send(self, number: int, frames: Sequence[bytes]) -> bool:
        """Send a request; return False without a connected translator."""
        return send_frames(self.socket, [b"%d" % number, *self._before, *frames])

    def receive(self) -> list[LinkReply]:
        """Return all answers that have arrived; a malformed one is dropped."""
        found: list[LinkReply] = []
        for _ in range(_MOST_ANSWERS):
            if not (frames := receive_frames(self.socket)):
                break
            reply = self._interpret([frame.bytes for frame in frames])
            if reply is not None:
                found.append(reply)
        return found

    def _interpret(self, frames: list[bytes]) -> LinkReply | None:
        if frames == [b""]:  # the translator's probe
            return None
        before, content = _parted(frames)
        number = before[0] if before else b""
        is_ours = before[1:] in ([], self._before[:-1]) and number.isdigit() and len(number) <= _LONGEST_NUMBER
        if not content or not is_ours:
            self._log.warning(f"dropped a malformed answer from {self._address}")
            return None
        return LinkReply(int(number), content)

    def follow(self) -> list[LinkUp | LinkDown]:
        """Return the translator's connection and disconnection events."""
        return [LinkUp() if event.kind == CONNECTED else LinkDown() for event in self.monitor.drain()]


def _parted(frames: list[bytes]) -> tuple[list[bytes], list[bytes]]:
    # the frames before the first empty one, and those after it
    if b"" not in frames[1:]:
        return [], []
    at = frames.index(b"", 1)
    return frames[:at], frames[at + 1 :]


Source = Router | TranslatorLink | Subscriber | Publisher | Monitor
SocketEvent = RouterEvent | LinkReply | LinkUp | LinkDown | Incoming
"""An event of a component, of the connection to the translator, or of the translator's packets."""


class SchedulerSockets:
    """Publisher and router for the components, subscriber and link for the translator.

    Args:
        since_ns: time up to which the scheduler has all packets of the translator.
        epoch: epoch before each request to the translator; empty: none.

    Raises:
        TransportError: an address can't be used.
        ConfigError: an address is missing.
    """

    def __init__(self, launch: Launch, log: RateLimitedLog, clock: Clock, *, since_ns: int, epoch: bytes = b"") -> None:
        sockets = launch.sockets
        if sockets.publish is None or sockets.serve is None or sockets.control is None or not sockets.subscribe:
            raise ConfigError(
                "a scheduler needs four addresses: publish, serve, control and subscribe",
                where=launch.name,
            )
        self._network = Network.from_launch(launch.name, launch.keys)
        self._wake_up: WakeUp[None] = WakeUp()
        self._clock = clock
        self.publisher = Publisher(self._network, sockets.publish, _nothing, dict, log)
        self.router = Router(self._network, sockets.serve, log, clock)
        self.link = TranslatorLink(self._network, sockets.control, log, epoch)
        self.subscriber = Subscriber(
            self._network, launch.name, sockets.subscribe[0], None, log, since_ns=since_ns, filtered=False
        )
        self._poller: Poller[Source] = Poller(self._wake_up)
        for source in (self.router, self.link, self.publisher, self.subscriber):
            self._poller.register(source.socket, source)
        for monitor in (self.router.monitor, self.link.monitor, self.subscriber.monitor):
            self._poller.register(monitor.socket, monitor)

    @property
    def history(self) -> History:
        """Return the packets that a subscriber lacks when it joins."""
        return self.publisher.history

    @history.setter
    def history(self, history: History) -> None:
        self.publisher.history = history

    @property
    def newest(self) -> Newest:
        """Return the time of the newest kept packet of each envelope."""
        return self.publisher.newest

    @newest.setter
    def newest(self, newest: Newest) -> None:
        self.publisher.newest = newest

    @property
    def due_s(self) -> float:
        """Real monotonic time at which `receive` must be called even if no source is ready."""
        return min(self.router.due_s, self.publisher.due_s)

    def receive(self, ready: Sequence[Source]) -> Iterator[Sequence[SocketEvent]]:
        """Yield the events of each ready source, and let new subscribers join."""
        for source in ready:
            if source in (self.router, self.router.monitor):
                yield self.router.receive()
            elif source is self.link:
                yield self.link.receive()
            elif source is self.link.monitor:
                yield self.link.follow()
            elif source is self.subscriber:
                yield self.subscriber.receive()
            elif source is self.subscriber.monitor:
                self.subscriber.follow()
            else:
                self.publisher.serve()
        if self._clock.monotonic_s() >= self.publisher.due_s:
            self.publisher.serve()
        if self._clock.monotonic_s() >= self.router.due_s:
            yield self.router.receive()

    def reply(self, connection: int, frames: Sequence[bytes]) -> None:
        """Answer a component, if it is still connected."""
        self.router.reply(connection, frames)

    def send(self, number: int, frames: Sequence[bytes]) -> bool:
        """Send a request to the translator; return False if it is not connected."""
        return self.link.send(number, frames)

    def publish(self, packet: Packet) -> None:
        self.publisher.publish(packet)

    def end(self) -> None:
        """Send the end of the experiment to all subscribers, and to each that joins later."""
        self.publisher.kill()

    def wait(self, timeout_ms: int | None) -> list[Source]:
        """Return the readable sources, after a wait of up to `timeout_ms` (None: without limit).

        Returns early, perhaps without sources, after `wake_up`.
        """
        sources, woken = self._poller.wait(timeout_ms)
        if woken:
            self._wake_up.take()
        return sources

    def wake_up(self) -> None:
        """End the present or next `wait`. Thread-safe."""
        self._wake_up.post()

    def close(self) -> None:
        """Close all sockets after all sent messages have left, within a fraction of a second."""
        self._network.close()
        self._wake_up.close()


def _nothing(_who: Hashable, _prefixes: tuple[str, ...], _since_ns: int) -> tuple[Packet, ...]:
    return ()
