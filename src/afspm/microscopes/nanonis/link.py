"""One TCP connection to Nanonis: one question, then its answer. Nanonis never speaks unasked."""

from __future__ import annotations

import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

from afspm.microscopes.nanonis import protocol
from afspm.translator.driver import ControllerLost

_SLOWEST_BYTES_PER_S: Final = 1e6
_AT_ONCE: Final = 1 << 20


class Link:
    """A connection. For one thread at a time, but for `close`.

    Whatever goes wrong on it but an error of Nanonis' own, it is closed: a late answer must never be taken for that
    to the next question.

    Args:
        timeout_s: how long an answer may take, in real time.
        monotonic_s: real time.
        release: of the controller's software; it can be changed once it is known.

    Raises:
        ControllerLost: nobody listens there.
    """

    def __init__(
        self,
        address: tuple[str, int],
        timeout_s: float,
        monotonic_s: Callable[[], float],
        release: int = protocol.NEWEST,
    ) -> None:
        self.release = release
        self._timeout_s = timeout_s
        self._monotonic_s = monotonic_s
        self._where = f"{address[0]}:{address[1]}"
        try:
            self._socket = socket.create_connection(address, timeout_s)
        except OSError as error:
            hint = "is Nanonis running, with its TCP programming interface on this port (File > Settings > TCP)?"
            raise ControllerLost(f"no connection: {error}", where=self._where, hint=hint) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def ask(self, name: str, *arguments: Any, longer_s: float = 0.0) -> tuple[Any, ...]:
        """Call a function of Nanonis.

        Args:
            longer_s: so much longer than usual may the answer take.

        Raises:
            NanonisError: it could not do it. InvalidValue: what was asked can't be sent.
            ControllerLost, BadReply: no answer, or none to be trusted; the connection is closed.
        """
        message = protocol.request(name, arguments, self.release)
        try:
            body = self._exchange(name, message, self._timeout_s + longer_s)
            return protocol.results(name, body, self.release)
        except TimeoutError as error:
            self.close()
            raise ControllerLost(
                f"no answer to {name} within {self._timeout_s + longer_s:g} s",
                where=self._where,
                hint="Nanonis is silent while a dialog waits for an answer on its screen",
            ) from error
        except OSError as error:
            self.close()
            raise ControllerLost(f"the connection was lost at {name}: {error}", where=self._where) from error
        except ControllerLost:
            self.close()
            raise

    def close(self) -> None:
        """Let go of it, from any thread: who waits for an answer hears that the connection is lost."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _exchange(self, name: str, message: bytes, timeout_s: float) -> bytearray:
        until_s = self._monotonic_s() + timeout_s
        self._socket.settimeout(timeout_s)
        self._socket.sendall(message)
        size = protocol.body_bytes(bytes(self._receive(protocol.HEADER_BYTES, name, until_s)), name)
        return self._receive(size, name, until_s + size / _SLOWEST_BYTES_PER_S)

    def _receive(self, size: int, name: str, until_s: float) -> bytearray:
        """Exactly so many bytes; memory is taken for what has come, not for what was announced."""
        received = bytearray()
        while len(received) < size:
            left_s = until_s - self._monotonic_s()
            if left_s <= 0.0:
                raise TimeoutError
            self._socket.settimeout(left_s)
            part = self._socket.recv(min(size - len(received), _AT_ONCE))
            if not part:
                raise ControllerLost(
                    f"the connection was closed after {len(received)} of {size} bytes of the reply to {name}",
                    where=self._where,
                )
            received += part
        return received
