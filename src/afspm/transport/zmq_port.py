"""A component's port over ZeroMQ, and the poller that it shares with a translator's port."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from afspm.basics.clock import Clock
from afspm.basics.errors import ConfigError
from afspm.basics.launch import Launch
from afspm.transport.control_client import ControlClient
from afspm.transport.late_joiners import PublishedHistory
from afspm.transport.network import Network
from afspm.transport.polling import Poller, WakeUp, milliseconds
from afspm.transport.port import Incoming
from afspm.transport.publisher import Publisher
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.subscriber import Subscriber

T = TypeVar("T")


class BasePort(Generic[T]):
    """Base of the ports, with the wait for events and the publisher.

    Args:
        publish: address to publish on; None: no publisher.
    """

    def __init__(self, network: Network, clock: Clock, publish: str | None) -> None:
        self._network = network
        self._clock = clock
        self._wake_up: WakeUp[T] = WakeUp()
        self._poller: Poller[Callable[[], Sequence[T]]] = Poller(self._wake_up)
        self._published = PublishedHistory(clock)
        self._publisher = None
        self._closed = False
        self._log = RateLimitedLog(logging.getLogger("afspm.transport"), clock)
        if publish is not None:
            self._publisher = Publisher(network, publish, self._published, self._published.newest, self._log)
            self._poller.register(self._publisher.socket, self._serve)

    @property
    def clock(self) -> Clock:
        return self._clock

    @property
    def publish_address(self) -> str | None:
        """Return the address of the publisher, with the chosen port."""
        return self._publisher.address if self._publisher else None

    def poll(self, timeout_s: float | None) -> list[T]:
        if self._publisher is not None and self._publisher.due_s != math.inf:
            due_s = self._publisher.due_s - time.monotonic()
            timeout_s = due_s if timeout_s is None else min(timeout_s, due_s)
        receivers, woken = self._poller.wait(milliseconds(timeout_s))
        found = self._wake_up.take() if woken else []
        for receive in receivers:
            found += receive()
        if self._publisher is not None and time.monotonic() >= self._publisher.due_s:
            found += self._serve()
        return found

    def wake_up(self, incoming: T | None = None) -> None:
        self._wake_up.post(incoming)

    def wakeup_fileno(self) -> int:
        return self._wake_up.writer_fileno()

    def close(self) -> None:
        """Close the port and its own network."""
        if not self._closed:
            self._closed = True
            self._network.close()
            self._wake_up.close()

    def _serve(self) -> Sequence[T]:
        if self._publisher is not None:
            self._publisher.serve()
        return []


class ZmqPort(BasePort[Incoming]):
    """A component's port, see `transport.port.Port`.

    Args:
        name: name of the component.
        clock: clock of the experiment.
        subscribe: addresses of the publishers.
        envelopes: prefixes of the envelopes to subscribe to; None: all.
        control: the scheduler's address for requests; None: no requests.
        publish: address to publish on; None: no publisher.

    Raises:
        TransportError: an address can't be used.
        ConfigError: the prefixes are too long, or an address of another computer needs keys.
    """

    def __init__(
        self,
        network: Network,
        name: str,
        clock: Clock,
        *,
        subscribe: Sequence[str] = (),
        envelopes: Sequence[str] | None = None,
        control: str | None = None,
        publish: str | None = None,
    ) -> None:
        super().__init__(network, clock, publish)
        self._name = name
        self._control = None
        if control is not None:
            self._control = ControlClient(network, name, control, self._log)
            self._poller.register(self._control.socket, self._control.receive)
            self._poller.register(self._control.monitor.socket, self._control.follow)
        self._subscribers = [Subscriber(network, name, address, envelopes, self._log) for address in subscribe]
        for subscriber in self._subscribers:
            self._poller.register(subscriber.socket, subscriber.receive)
            self._poller.register(subscriber.monitor.socket, subscriber.follow)

    def send(self, frames: Sequence[bytes]) -> None:
        if self._control is None:
            raise ConfigError(
                "this component has no address of a scheduler", where=self._name, hint="control = address"
            )
        self._control.send(frames)

    def publish(self, envelope: str, payload: bytes) -> None:
        if self._publisher is None:
            raise ConfigError("this component has no address to publish on", where=self._name, hint="publish = address")
        self._publisher.publish(self._published.stamp(envelope, payload))

    def request_since(self, since_ns: int) -> None:
        for subscriber in self._subscribers:
            subscriber.request_since(since_ns)


def open_port(launch: Launch, clock: Clock) -> ZmqPort:
    """Open a component's port, as its launch line describes.

    Raises:
        TransportError: an address can't be used.
        ConfigError: a key is missing or can't be used, the prefixes are too long, or an address of another computer
            needs keys.
    """
    sockets = launch.sockets
    return ZmqPort(
        Network.from_launch(launch.name, launch.keys),
        launch.name,
        clock,
        subscribe=sockets.subscribe,
        envelopes=launch.envelopes,
        control=sockets.control,
        publish=sockets.publish,
    )
