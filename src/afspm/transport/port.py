"""A process's access to the network: it receives and sends packets and requests.

No socket library is named here, so that the in-memory network of `afspm.testing` can replace the real one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from afspm.basics.clock import Clock
from afspm.model import Packet, Response

CUT_OFF_SHOWS_WITHIN_S = 10.0
"""Longest time until a cut connection to the scheduler is noticed."""

# Not frozen: packets, replies and requests come by the thousand, and frozen dataclasses take twice as long to make.


@dataclass(slots=True)
class PacketReceived:
    """A packet from the publisher at the address `source`; each arrives once, replayed or not."""

    packet: Packet
    source: str


@dataclass(slots=True)
class ReplyReceived:
    """An answer of the scheduler; `response.id` is the id of its request."""

    response: Response


@dataclass(frozen=True, slots=True)
class CaughtUp:
    """The event that the publisher at `source` has sent all its cached packets; live packets follow.

    It comes again after every reconnection.
    """

    source: str


@dataclass(frozen=True, slots=True)
class Killed:
    """The signal KILL: the experiment has ended, and the process must close."""


@dataclass(frozen=True, slots=True)
class ParentGone:
    """The event that the parent process has ended, or stops this process, which then must close."""


@dataclass(frozen=True, slots=True)
class ControlConnected:
    """The event that the scheduler is connected, for the first time or again.

    Earlier requests without an answer may be lost: repeat them with the same id.
    """


@dataclass(frozen=True, slots=True)
class ControlDisconnected:
    """The event that the scheduler is disconnected; the socket reconnects by itself."""


Incoming = PacketReceived | ReplyReceived | CaughtUp | Killed | ParentGone | ControlConnected | ControlDisconnected


class Port(Protocol):
    """A component's access to the network, for one thread; only `wake_up` may be called from others."""

    @property
    def clock(self) -> Clock:
        """Return the clock of the experiment."""

    def send(self, frames: Sequence[bytes]) -> None:
        """Send a request to the scheduler, as frames of `wire.encode_request`; `poll` returns the answer.

        Never blocks. Without a connection the request is dropped; repeat it after `ControlConnected`.
        """

    def poll(self, timeout_s: float | None) -> list[Incoming]:
        """Return all arrived events in order, after a wait of up to `timeout_s` real seconds (None: without limit).

        Returns early after `wake_up`.
        """

    def publish(self, envelope: str, payload: bytes) -> None:
        """Publish on the component's own publisher, at a later experiment time than each earlier packet.

        Raises:
            ConfigError: the component has no address to publish on.
        """

    def request_since(self, since_ns: int) -> None:
        """Request all kept packets after `since_ns` again; `poll` returns the new ones. Never blocks."""

    def wake_up(self, incoming: Incoming | None = None) -> None:
        """End the present or next `poll`, which returns `incoming` with all other events.

        Thread-safe: the watch over the parent process posts `ParentGone()` this way.
        """

    def wakeup_fileno(self) -> int:
        """Return the descriptor for `signal.set_wakeup_fd`, so that a signal ends `poll`; -1 without one."""

    def close(self) -> None:
        """Close all sockets after all sent messages have left, within a fraction of a second. Safe to repeat."""


@dataclass(slots=True)
class RequestReceived:
    """A request to a server, as frames for `wire.decode_request`.

    Attributes:
        user: owner of the key of its connection; None without keys.
        epoch: epoch of the sending scheduler; empty for other senders.
        connection: identity of its connection, for `ServerPort.is_connected`.
    """

    frames: Sequence[bytes]
    user: str | None = None
    epoch: bytes = b""
    connection: bytes = field(default=b"", compare=False)


@dataclass(frozen=True, slots=True)
class SubscriberJoined:
    """The event that a peer, such as the scheduler, has subscribed, after the kept packets were sent to the peer."""


Served = RequestReceived | SubscriberJoined | ParentGone


class ServerPort(Protocol):
    """A translator's access to the network: it answers requests, one at a time, and publishes.

    Its last packets are kept for later subscribers.
    """

    @property
    def clock(self) -> Clock:
        """Return the clock of the experiment."""

    def poll(self, timeout_s: float | None) -> list[Served]:
        """Return all arrived events in order, with at most one request, which `reply` must answer before the next.

        Waits up to `timeout_s` real seconds (None: without limit); returns early after `wake_up`.
        """

    def waiting_request(self) -> RequestReceived | None:
        """Return the request that the next `poll` returns, if it has arrived, without taking it."""

    def reply(self, frames: Sequence[bytes] | None) -> None:
        """Answer the request, with frames of `wire.encode_response`. Never blocks.

        None drops the answer (a fault for tests with a simulated microscope).
        """

    def is_connected(self, connection: bytes) -> bool:
        """Return whether the connection of a scheduler with an epoch still exists."""

    def publish(self, envelope: str, payload: bytes, time_ns: int | None = None, *, keep: bool = True) -> None:
        """Publish a packet, at a later experiment time than each earlier packet.

        Args:
            time_ns: time of the packet. After a kill, a restarted translator publishes possibly lost packets again,
                with their first times, so that a receiver ignores repetitions.
            keep: whether to keep the packet for later subscribers; False for packets about the present moment.
        """

    def wake_up(self, incoming: Served | None = None) -> None:
        """End the present or next `poll`, which returns `incoming` with all other events. Thread-safe."""

    def close(self) -> None:
        """Close all sockets after all sent messages have left, within a fraction of a second. Safe to repeat."""
