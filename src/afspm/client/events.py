"""Iteration over published messages, for scripts that need every message."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from afspm import wire
from afspm.basics.errors import ExperimentEnded, WireError
from afspm.client.backlog import PacketBacklog
from afspm.client.experiment_link import ExperimentLink
from afspm.model import Packet


@dataclass(frozen=True, slots=True)
class PublishedEvent:
    """A published message.

    Attributes:
        envelope: topic of the message.
        message: an object of `afspm.model`, or a generated message.
        time_ns: experiment time of the message; None if the publisher gives no time.
    """

    envelope: str
    message: Any
    time_ns: int | None

    if not TYPE_CHECKING:  # hidden from type checkers, which should see only the attributes above

        def __getattr__(self, name: str) -> Any:
            raise AttributeError(
                f"an event has no {name!r}: it has envelope, time_ns and message, which is the thing itself"
            )


class Events(Iterator[PublishedEvent]):
    """An iterator over messages published from now on; no message is lost while the loop's body is busy.

    It ends with the experiment, or after `timeout_s` without a message (a later `for` continues).

    Args:
        prefixes: prefixes of the wanted envelopes; empty: all.
        before_wait: called before each wait for a message.
    """

    def __init__(
        self,
        link: ExperimentLink,
        prefixes: tuple[str, ...],
        timeout_s: float | None,
        before_wait: Callable[[], None] = lambda: None,
    ) -> None:
        self._link = link
        self._before_wait = before_wait
        self._timeout_s = timeout_s
        backlog = self._backlog = PacketBacklog()

        # no reference to self, so that a dropped iterator is deleted, and its __del__ removes the listener
        def keep(packet: Packet, ours: bool) -> None:
            if not prefixes or packet.envelope.startswith(prefixes):
                backlog.put(packet)

        self._forget = link.listen(keep)

    def __next__(self) -> PublishedEvent:
        while True:
            try:
                if not len(self._backlog):
                    self._before_wait()
                if not self._link.wait(lambda: len(self._backlog) > 0, self._link.until(self._timeout_s)):
                    raise StopIteration
            except ExperimentEnded:
                self.close()
                raise StopIteration from None
            if (event := self._next_kept()) is not None:
                return event

    def waiting(self) -> Iterator[PublishedEvent]:
        """Yield the messages that have arrived, without waiting for more."""
        while len(self._backlog) > 0:
            if (event := self._next_kept()) is not None:
                yield event

    def _next_kept(self) -> PublishedEvent | None:
        packet = self._backlog.take()
        if packet is None:
            return None
        try:
            decoded = wire.decode(wire.message_of(packet.envelope), packet.payload)
        except WireError as error:
            self._link.log.warning("a packet can't be read: %s", error)
            return None
        return PublishedEvent(packet.envelope, self._link.view.described(decoded), packet.time_ns)

    def close(self) -> None:
        """Drop all waiting messages, and stop collecting new ones."""
        self._forget()
        self._backlog.close()

    def __enter__(self) -> Events:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    __del__ = close
