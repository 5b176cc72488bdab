"""A component's access to the network: packets come in, requests and packets go out.

No socket library is named here, so that the in-memory network of `afspm.testing` can stand in for the
real one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from afspm.basics.clock import Clock
from afspm.model import Packet, Response

CUT_OFF_SHOWS_WITHIN_S = 10.0
"""Until then a connection to a scheduler that is cut off may look as it was: nothing is heard, and nobody knows why."""

# Packets, replies and requests come by the thousand, and would take twice as long to make if they were frozen.


@dataclass(slots=True)
class PacketReceived:
    """A packet arrived from the publisher at the address `source`; each arrives once, replayed or not."""

    packet: Packet
    source: str


@dataclass(slots=True)
class ReplyReceived:
    """The scheduler answered; `response.id` is the id of the request that it answers."""

    response: Response


@dataclass(frozen=True, slots=True)
class CaughtUp:
    """The publisher at `source` has sent all that it had cached for us; what follows is live.

    Comes again after every reconnection.
    """

    source: str


@dataclass(frozen=True, slots=True)
class Killed:
    """The signal KILL came: the experiment has ended, close."""


@dataclass(frozen=True, slots=True)
class ParentGone:
    """The parent process has gone or wants this one to stop: close."""


@dataclass(frozen=True, slots=True)
class ControlConnected:
    """The scheduler can be asked, for the first time or again.

    What was asked before and not answered may be lost: ask again with the same id.
    """


@dataclass(frozen=True, slots=True)
class ControlDisconnected:
    """The scheduler is gone for now; the connection is made again by itself."""


Incoming = PacketReceived | ReplyReceived | CaughtUp | Killed | ParentGone | ControlConnected | ControlDisconnected


class Port(Protocol):
    """One component's access to the network, for one thread; only `wake_up` may be called from others."""

    @property
    def clock(self) -> Clock:
        """The clock of the experiment."""

    def send(self, frames: Sequence[bytes]) -> None:
        """Ask the scheduler: `frames` are those of `wire.encode_request`; the answer comes by `poll`.

        Never blocks. While the scheduler is not connected the request is dropped: `ControlConnected` says
        when to ask again.
        """

    def poll(self, timeout_s: float | None) -> list[Incoming]:
        """Return all that has arrived, in order; waits up to `timeout_s` real seconds (None: as long as it takes).

        Returns early after `wake_up`.
        """

    def publish(self, envelope: str, payload: bytes) -> None:
        """Publish on the component's own publisher; its time is the experiment's, made strictly increasing.

        Raises:
            ConfigError: the component was given no address to publish on.
        """

    def wake_up(self, incoming: Incoming | None = None) -> None:
        """End the `poll` under way, or the next; it returns `incoming` with whatever else has arrived.

        May be called from any thread: the watch over the parent process says `ParentGone()` this way.
        """

    def wakeup_fileno(self) -> int:
        """Return the descriptor for `signal.set_wakeup_fd`, by which a signal ends the `poll` under way; -1: none."""

    def close(self) -> None:
        """Close all once what was sent has gone out, within a fraction of a second. Safe to repeat."""


@dataclass(slots=True)
class RequestReceived:
    """A request for a server to answer, as frames for `wire.decode_request`.

    Attributes:
        user: whose keys it came with.
        epoch: of the scheduler that asks; empty: it tells none.
        connection: that it came by.
    """

    frames: Sequence[bytes]
    user: str | None = None
    epoch: bytes = b""
    connection: bytes = field(default=b"", compare=False)


@dataclass(frozen=True, slots=True)
class SubscriberJoined:
    """Somebody (a scheduler, to a translator) subscribed, and was sent what we had published before."""


Served = RequestReceived | SubscriberJoined | ParentGone


class ServerPort(Protocol):
    """A translator's access to the network: it answers requests, one at a time, and publishes.

    What it has published lately is kept, and sent to whoever subscribes later.
    """

    @property
    def clock(self) -> Clock:
        """The clock of the experiment."""

    def poll(self, timeout_s: float | None) -> list[Served]:
        """Return what has arrived, in order: at most one request, which `reply` has to answer before another comes.

        Waits up to `timeout_s` real seconds (None: as long as it takes); returns early after `wake_up`.
        """

    def reply(self, frames: Sequence[bytes] | None) -> None:
        """Answer the request, with the frames of `wire.encode_response`. Never blocks.

        None: not at all, as if the answer was lost (a fault that a simulated microscope may be told to have).
        """

    def is_connected(self, connection: bytes) -> bool:
        """Return whether the connection of a scheduler that told its epoch is still there."""

    def publish(self, envelope: str, payload: bytes, time_ns: int | None = None, *, keep: bool = True) -> None:
        """Publish; the time is the experiment's, made strictly increasing.

        Args:
            time_ns: the time to publish it with. A restarted translator publishes again what may have been lost in
                the kill, at the times of the first attempt, so that whoever has had it ignores it.
            keep: whether it is sent to who subscribes later; False for what is of this moment only.
        """

    def wake_up(self, incoming: Served | None = None) -> None:
        """End the `poll` under way, or the next; it returns `incoming` with what has arrived. From any thread."""

    def close(self) -> None:
        """Close all once what was sent has gone out, within a fraction of a second. Safe to repeat."""
