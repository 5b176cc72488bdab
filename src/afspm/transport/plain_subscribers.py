"""The subscribers of version 1 of one publisher: plain SUB sockets, which say nothing of themselves."""

from __future__ import annotations

import zmq

from afspm.transport.frames import descriptor_of
from afspm.transport.monitor import DISCONNECTED, Monitor
from afspm.transport.network import Network
from afspm.wire.version import prefixes_of_version_1


class PlainSubscribers:
    """Knows to what each of them has subscribed, from its subscription until its connection is gone."""

    def __init__(self, network: Network, publisher: zmq.Socket[bytes]) -> None:
        self._monitor = Monitor(network, publisher, DISCONNECTED)
        self._prefixes: dict[int | None, set[bytes]] = {}  # by descriptor

    def subscribed(self, frame: zmq.Frame, prefix: bytes) -> list[bytes]:
        """Take in a subscription; returns what is meant by it."""
        self._forget_gone()
        self._prefixes.setdefault(descriptor_of(frame), set()).add(prefix)
        return meant(prefix)

    def unsubscribed(self, frame: zmq.Frame, prefix: bytes) -> list[bytes]:
        """Take in the end of a subscription; returns what is not wanted any more."""
        self._forget_gone()
        others = self._prefixes.get(descriptor_of(frame), set())
        others.discard(prefix)
        still = {one for other in others for one in meant(other)}
        return [one for one in meant(prefix) if one not in still]

    def want(self, envelope: str) -> bool:
        """Whether one of them has subscribed to an envelope."""
        if not self._prefixes:
            return False
        self._forget_gone()
        wanted = tuple(one for prefixes in self._prefixes.values() for prefix in prefixes for one in meant(prefix))
        return envelope.encode().startswith(wanted)

    def _forget_gone(self) -> None:
        if self._monitor.has_news():
            for event in self._monitor.drain():
                self._prefixes.pop(event.value, None)


def meant(prefix: bytes) -> list[bytes]:
    """The prefixes that a peer of version 1 means by one; none if it is no text."""
    try:
        return [one.encode() for one in prefixes_of_version_1([prefix.decode()])]
    except UnicodeDecodeError:
        return []
