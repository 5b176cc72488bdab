"""Answers requests, one at a time, and publishes: a translator's side of the network."""

from __future__ import annotations

from collections.abc import Sequence

import zmq

from afspm.clock import Clock
from afspm.errors import ConfigError
from afspm.transport.frames import descriptor_of, property_of, readable, receive_small, send, user_of
from afspm.transport.history import Published
from afspm.transport.network import Network
from afspm.transport.polling import milliseconds, poller
from afspm.transport.port import RequestReceived, Served, SubscriberJoined
from afspm.transport.publisher import Publisher
from afspm.transport.wakeup import WakeUp
from afspm.wire.version import ANSWER, QUESTION, answer_as_version_1

_WITH_ID = 3  # frames of a request
_WITHOUT_EPOCH = 3  # frames up to the empty one: connection, number; the epoch comes behind them


class ZmqServerPort:
    """See `transport.port.ServerPort`.

    To a requester it is a REP socket: it gives back whatever came before the empty frame, so that a scheduler of ours
    can number its requests, and one of version 1 need not. It is a ROUTER since an answer may also be withheld.

    Args:
        serve: the address to answer requests on.
        publish: the address to publish on.
        allowed: with keys, the only one whose requests are answered (the scheduler); None: whoever is let in.

    Raises:
        TransportError: an address can't be used.
    """

    def __init__(
        self, network: Network, clock: Clock, *, serve: str, publish: str | None, allowed: str | None = None
    ) -> None:
        self._network = network
        self._clock = clock
        self._allowed = allowed
        self._guarded = network.keys is not None and network.keys.binds_encrypted(requests=True)
        self._asker: list[bytes] | None = None
        self._heard: set[int] = set()
        self._asked_by_version_1: int | None = None
        self._closed = False
        self.touched = True
        self._wake_up: WakeUp[Served] = WakeUp()
        self._published = Published(clock)
        self._publisher = None if publish is None else Publisher(network, publish, self._published)
        self._socket = network.socket(zmq.ROUTER)
        # A name belongs to its newest connection, else who connects anew before the old connection is found dead is
        # never heard. And what it says is never freed: the library keeps the queues of those that it does not hear.
        self._socket.setsockopt(zmq.ROUTER_HANDOVER, 1)
        self._socket.setsockopt(zmq.ROUTER_MANDATORY, 1)  # so that it can be seen who is there
        self.serve_address = network.bind(self._socket, serve, requests=True)
        self._poller = poller(self._wake_up)
        self._poller.register(self._socket, self._request, self)
        if self._publisher is not None:
            self._poller.register(self._publisher.socket, self._serve, self._publisher)

    @property
    def clock(self) -> Clock:
        return self._clock

    @property
    def publish_address(self) -> str | None:
        """Where others can subscribe to what we publish, with the port that was found."""
        return self._publisher.address if self._publisher else None

    def poll(self, timeout_s: float | None) -> list[Served]:
        drains, woken = self._poller.wait(milliseconds(timeout_s))
        found: list[Served] = self._wake_up.take() if woken else []
        for drain in drains:
            found += drain()
        return found

    def _serve(self) -> list[Served]:
        return [SubscriberJoined()] if self._publisher is not None and self._publisher.serve() else []

    def _request(self) -> list[Served]:
        """The next request, if the last one was answered."""
        self.touched = True
        while self._asker is None:
            first, parts = receive_small(self._socket)
            if first is None:
                break
            self._heard.add(descriptor_of(first) or -1)
            if not readable(self._socket):
                self._network.connections.settled(self._heard)
                self._heard.clear()
            try:
                start = parts.index(b"", 1) + 1
            except ValueError:
                continue  # not what REQ or DEALER peers send: there is no telling where an answer would go
            if start == len(parts):
                continue  # somebody says its name, as to a scheduler
            self._asker = parts[:start]
            epoch = parts[start - 2] if start > _WITHOUT_EPOCH else b""
            is_of_version_1 = not epoch and len(parts) - start < _WITH_ID
            self._asked_by_version_1 = int.from_bytes(parts[start][:1]) if is_of_version_1 else None
            user = user_of(first) if self._guarded else None
            allowed = self._allowed is None or not self._guarded or user == self._allowed
            if not allowed:
                self._asked_by_version_1 = None  # who may not ask hears why, whoever it is
                self.reply([b"\1", b"", f"only {self._allowed} may ask here, not {user}".encode()])
            elif parts[start:] == [*QUESTION] and property_of(first, "Socket-Type") == "DEALER":
                self.reply(ANSWER)  # a REQ socket is that of a scheduler of version 1, which passes on what it is asked
            else:
                return [RequestReceived(parts[start:], user, epoch, parts[0])]
        return []

    def reply(self, frames: Sequence[bytes] | None) -> None:
        asker, self._asker = self._asker, None
        if asker is not None and frames is not None:
            if self._asked_by_version_1 is not None:
                frames = answer_as_version_1(self._asked_by_version_1, frames)
            self._send([*asker, *frames])

    def is_connected(self, connection: bytes) -> bool:
        return self._send([connection, b""])

    def _send(self, frames: list[bytes]) -> bool:
        """False if the peer is gone, or takes nothing."""
        self.touched = True
        try:
            return send(self._socket, frames)
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
            return False

    def publish(self, envelope: str, payload: bytes, time_ns: int | None = None, *, keep: bool = True) -> None:
        if self._publisher is None:
            raise ConfigError("there is no address to publish on", hint="publish = address")
        self._publisher.publish(self._published.stamp(envelope, payload, time_ns, keep=keep))

    def kill(self) -> None:
        """Tell those who subscribed that the experiment has ended."""
        if self._publisher is not None:
            self._publisher.kill()

    def wake_up(self, incoming: Served | None = None) -> None:
        self._wake_up.post(incoming)

    def close(self) -> None:
        """The network is the port's own: it is closed too."""
        if not self._closed:
            self._closed = True
            self._network.close()
            self._wake_up.close()
