"""The sockets of a scheduler, in one poller."""

from __future__ import annotations

from collections.abc import Hashable

from afspm.basics.clock import Clock
from afspm.basics.errors import ConfigError
from afspm.basics.launch import Launch
from afspm.model import Packet
from afspm.transport.network import Monitor, Network
from afspm.transport.polling import Poller, WakeUp
from afspm.transport.publisher import Publisher
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.router import Router
from afspm.transport.subscriber import Subscriber
from afspm.transport.translator_link import TranslatorLink

Source = Router | TranslatorLink | Subscriber | Publisher | Monitor


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
        self.publisher = Publisher(self._network, sockets.publish, _nothing)
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

    def wait(self, timeout_ms: int | None) -> list[Source]:
        """Return the sources with something to receive; returns early, perhaps without sources, after `wake_up`."""
        sources, woken = self._poller.wait(timeout_ms)
        if woken:
            self._wake_up.take()
        return sources

    def wake_up(self) -> None:
        """End the present or next `wait`. From any thread."""
        self._wake_up.post()

    def close(self) -> None:
        """Close all sockets after all sent messages have left, within a fraction of a second."""
        self._network.close()
        self._wake_up.close()


def _nothing(_who: Hashable, _prefixes: tuple[str, ...], _since_ns: int) -> tuple[Packet, ...]:
    return ()
