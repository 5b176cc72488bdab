"""One TCP connection to Nanonis: one question, then its answer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from afspm.plugins.nanonis import protocol
from afspm.translator.tcp import Receiver, TcpConnection

_HINTS: Final = (
    "is Nanonis running, with its TCP programming interface on this port (File > Settings > TCP)?",
    "Nanonis is silent while a dialog waits for an answer on its screen",
)


class Link:
    """A connection to Nanonis; the arguments are those of `TcpConnection`.

    Attributes:
        release: of the controller's software; it can be changed once it is known.
    """

    def __init__(
        self,
        address: tuple[str, int],
        timeout_s: float,
        monotonic_s: Callable[[], float],
        release: int = protocol.NEWEST,
    ) -> None:
        self.release = release
        self._tcp = TcpConnection(address, timeout_s, monotonic_s, _HINTS)
        self.close = self._tcp.close

    def ask(self, name: str, *arguments: object, longer_s: float = 0.0) -> tuple[Any, ...]:
        """Call a function of Nanonis.

        Args:
            longer_s: so much longer than usual may the answer take.

        Raises:
            NanonisError: it could not do it. InvalidValue: what was asked can't be sent.
            ControllerLost, BadReply: no answer, or none to be trusted; the connection is closed.
        """

        def read(receiver: Receiver) -> tuple[object, ...]:
            size = protocol.body_bytes(bytes(receiver.exactly(protocol.HEADER_BYTES)), name)
            return protocol.results(name, receiver.exactly(size), self.release)

        return self._tcp.ask(name, protocol.request(name, arguments, self.release), read, longer_s=longer_s)
