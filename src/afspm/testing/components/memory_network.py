"""An in-memory network whose lines keep the message order, delay messages, break and reconnect."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from afspm.model import Packet, Request, Response
from afspm.testing.components.simulated_process import Cuttable
from afspm.testing.components.simulated_time import SimulatedTime

Deliver = Callable[..., None]


@dataclass
class Weather:
    """The quality of the network, which may be changed at any time.

    Attributes:
        delay_s: the longest delay of a message; most delays are much shorter.
        doubles: the chance that a request arrives twice.
        reconnect_s: mean time between attempts to reconnect a broken line.
    """

    delay_s: float = 0.01
    doubles: float = 0.0
    reconnect_s: float = 0.1


class Host(Protocol):
    """The interface of a process for its lines: its connections, and its input."""

    @property
    def alive(self) -> bool: ...
    @property
    def sockets(self) -> dict[Cuttable, None]:
        """The lines that end at this process, and break when the process dies."""

    def take(self, do: Callable[..., None], *args: object) -> None:
        """Call `do(*args)` now, after a freeze, or never if this life ends first."""


class Pipe:
    """One direction of a line: first in, first out."""

    def __init__(self, timeline: SimulatedTime, weather: Weather, receiver: Host) -> None:
        self._timeline = timeline
        self._weather = weather
        self._receiver = receiver
        self._last_s = 0.0
        self.open = True
        self.silent = False

    def send(self, do: Deliver, *args: object) -> None:
        if self.silent:
            return
        timeline = self._timeline
        # mostly quick, now and then slow
        time_s = timeline.monotonic_s() + self._weather.delay_s * timeline.random.random() ** 4
        # a message must not overtake the message before it
        if time_s > self._last_s:
            self._last_s = time_s
        timeline.at(self._last_s, self._arrive, (do, args))

    def _arrive(self, do: Deliver, args: tuple[object, ...]) -> None:
        if self.open:
            self._receiver.take(do, *args)


class LineServer(Host, Protocol):
    """The server end of a line: scheduler or translator."""

    def peer_connected(self, line: ControlLine) -> None: ...
    def peer_disconnected(self, line: ControlLine) -> None: ...
    def peer_asked(self, line: ControlLine, request: Request, number: int) -> None: ...


class LineClient(Host, Protocol):
    """The client end of a line."""

    def line_up(self, line: ControlLine) -> None: ...
    def line_down(self, line: ControlLine) -> None: ...
    def answered(self, line: ControlLine, number: int, response: Response) -> None: ...


class ControlLine:
    """A connection for requests from one client to one server, reopened whenever it breaks.

    Attributes:
        name: the name that the client uses.
        owner: the owner of the client's key; "": the client itself.

    Args:
        doubling: whether requests may arrive twice, as from a client that retries early.
    """

    def __init__(
        self,
        timeline: SimulatedTime,
        weather: Weather,
        client: LineClient,
        server: LineServer,
        name: str,
        *,
        doubling: bool = True,
    ) -> None:
        self._doubling = doubling
        self._timeline = timeline
        self._weather = weather
        self._client = client
        self._server = server
        self.name = name
        self.owner = ""
        self._there: Pipe | None = None
        self._back: Pipe | None = None
        self._closed = False
        self._try()

    @property
    def up(self) -> bool:
        return self._there is not None

    def ask(self, request: Request, number: int = 0) -> None:
        """Send a request; drop the request while the line is down."""
        if self._there is None:
            return
        self._there.send(self._server.peer_asked, self, _copy(request), number)
        if self._doubling and self._timeline.chance(self._weather.doubles):
            self._there.send(self._server.peer_asked, self, _copy(request), number)

    def answer(self, response: Response, number: int = 0) -> None:
        if self._back is not None:
            self._back.send(self._client.answered, self, number, response)

    def cut(self) -> None:
        """Break the line: messages in transit are lost, both ends notice, and the line reconnects."""
        if self._there is None or self._back is None:
            return
        there, back = self._there, self._back
        self._there = self._back = None
        there.open = back.open = False
        self._server.sockets.pop(self, None)
        self._server.take(self._server.peer_disconnected, self)
        self._client.take(self._client.line_down, self)
        self._retry()

    def fall_silent(self, for_s: float) -> None:
        """Lose all messages in one or both directions; both ends notice only after `for_s`."""
        _fall_silent(self._timeline, (self._there, self._back))
        self._timeline.after(for_s, self.cut)

    def close(self) -> None:
        """Close the line permanently, after its client has ended or died."""
        self._closed = True
        self.cut()

    def _retry(self) -> None:
        if not self._closed:
            self._timeline.after(self._weather.reconnect_s * (0.5 + self._timeline.random.random()), self._try)

    def _try(self) -> None:
        if self._closed or self.up:
            return
        if not (self._server.alive and self._client.alive):
            self._retry()
            return
        self._there = Pipe(self._timeline, self._weather, self._server)
        self._back = Pipe(self._timeline, self._weather, self._client)
        self._server.sockets[self] = None
        self._there.send(self._server.peer_connected, self)
        self._back.send(self._client.line_up, self)


class PacketSource(Host, Protocol):
    """A publisher of packets, with a cache for late joiners."""

    def joined(self, feed: Feed, prefixes: Sequence[str], since_ns: int) -> Sequence[Packet]: ...
    def left(self, feed: Feed) -> None: ...


class FeedListener(Host, Protocol):
    """A subscriber to packets."""

    def since_ns(self, feed: Feed) -> int: ...
    def received(self, feed: Feed, packet: Packet) -> None: ...
    def caught_up(self, feed: Feed) -> None: ...
    def killed(self, feed: Feed) -> None: ...


class Feed:
    """A subscription of one listener to one publisher, with a replay for this listener at each connection."""

    def __init__(
        self,
        timeline: SimulatedTime,
        weather: Weather,
        listener: FeedListener,
        publisher: PacketSource,
        prefixes: Sequence[str] = ("",),
    ) -> None:
        self._timeline = timeline
        self._weather = weather
        self._listener = listener
        self._publisher = publisher
        self._prefixes = tuple(prefixes)
        self._there: Pipe | None = None
        self._back: Pipe | None = None
        self._joined = False
        self._closed = False
        self._try()

    def publish(self, packet: Packet) -> None:
        if self._joined and self._back is not None and packet.envelope.startswith(self._prefixes):
            self._back.send(self._listener.received, self, packet)

    def request_since(self, since_ns: int) -> None:
        """Ask for the kept packets after `since_ns` again."""
        if self._there is not None and self._back is not None:
            self._there.send(self._join, since_ns, self._back)

    def kill_signal(self) -> None:
        if self._back is not None:
            self._back.send(self._listener.killed, self)

    def cut(self) -> None:
        if self._there is None or self._back is None:
            return
        self._there.open = self._back.open = False
        self._there = self._back = None
        self._joined = False
        self._publisher.sockets.pop(self, None)
        self._publisher.take(self._publisher.left, self)
        if not self._closed:
            self._timeline.after(self._weather.reconnect_s * (0.5 + self._timeline.random.random()), self._try)

    def fall_silent(self, for_s: float) -> None:
        """Lose all messages in one or both directions; both ends notice only after `for_s`."""
        _fall_silent(self._timeline, (self._there, self._back))
        self._timeline.after(for_s, self.cut)

    def close(self) -> None:
        self._closed = True
        self.cut()

    def _try(self) -> None:
        if self._closed or self._there is not None:
            return
        if not (self._publisher.alive and self._listener.alive):
            self._timeline.after(self._weather.reconnect_s, self._try)
            return
        self._there = Pipe(self._timeline, self._weather, self._publisher)
        self._back = Pipe(self._timeline, self._weather, self._listener)
        self._publisher.sockets[self] = None
        self._there.send(self._join, self._listener.since_ns(self), self._back)

    def _join(self, since_ns: int, back: Pipe) -> None:
        # at the publisher: the replay first, then all later packets, so that there is no gap
        if back is not self._back:
            return
        for packet in self._publisher.joined(self, self._prefixes, since_ns):
            back.send(self._listener.received, self, packet)
        back.send(self._listener.caught_up, self)
        self._joined = True


class Subscribers:
    """The feeds that receive a publisher's packets in one of its lives."""

    def __init__(self) -> None:
        self._feeds: list[Feed] = []

    def join(self, feed: Feed) -> None:
        if feed not in self._feeds:
            self._feeds.append(feed)

    def leave(self, feed: Feed) -> None:
        if feed in self._feeds:
            self._feeds.remove(feed)

    def publish(self, packet: Packet) -> None:
        for feed in list(self._feeds):
            feed.publish(packet)

    def kill_signal(self) -> None:
        for feed in self._feeds:
            feed.kill_signal()


def _fall_silent(timeline: SimulatedTime, pipes: Sequence[Pipe | None]) -> None:
    for pipe in timeline.random.choice((pipes, pipes[:1], pipes[1:])):
        if pipe is not None:
            pipe.silent = True


def _copy(request: Request) -> Request:
    return Request(request.kind, request.subject, request.payload, request.id)
