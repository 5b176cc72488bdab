"""Published messages, one after the other, for scripts that look at everything themselves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from afspm import wire
from afspm.basics.errors import ExperimentEnded, WireError
from afspm.client.backlog import PacketBacklog
from afspm.client.experiment_link import ExperimentLink
from afspm.model import Packet


@dataclass(frozen=True, slots=True)
class PublishedEvent:
    """A message that was published.

    Attributes:
        envelope: by which it was subscribed to.
        message: an object of `afspm.model`, or a generated message.
        time_ns: when, in the experiment; None if the publisher does not say.
    """

    envelope: str
    message: Any
    time_ns: int | None

    if not TYPE_CHECKING:  # for the type checker the attributes above are all there is

        def __getattr__(self, name: str) -> Any:
            raise AttributeError(
                f"an event has no {name!r}: it has envelope, time_ns and message, which is the thing itself"
            )


class Events(Iterator[PublishedEvent]):
    """Iterates over what is published from now on; nothing is lost while the loop's body is busy.

    Ends with the experiment, or when nothing came for `timeout_s` (a later `for` goes on).

    Args:
        prefixes: of the envelopes wanted; empty: all.
    """

    def __init__(self, link: ExperimentLink, prefixes: tuple[str, ...], timeout_s: float | None) -> None:
        self._link = link
        self._timeout_s = timeout_s
        backlog = self._backlog = PacketBacklog()

        # no reference to self: an iterator that was dropped is forgotten by its __del__
        def keep(packet: Packet, ours: bool) -> None:
            if not prefixes or packet.envelope.startswith(prefixes):
                backlog.put(packet)

        self._forget = link.listen(keep)

    def __next__(self) -> PublishedEvent:
        while True:
            try:
                if not self._link.wait(lambda: len(self._backlog) > 0, self._link.until(self._timeout_s)):
                    raise StopIteration
            except ExperimentEnded:
                self.close()
                raise StopIteration from None
            packet = self._backlog.take()
            if packet is None:
                continue
            try:
                message = wire.decode(wire.message_of(packet.envelope), packet.payload)
            except WireError as error:
                self._link.log.warning("a packet can't be read: %s", error)
                continue
            return PublishedEvent(packet.envelope, message, packet.time_ns)

    def close(self) -> None:
        """Keep nothing more."""
        self._forget()
        self._backlog.close()

    def __enter__(self) -> Events:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    __del__ = close
