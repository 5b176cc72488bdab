"""A TCP connection to a controller that answers one request at a time, and sends only answers."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final, TypeVar

from afspm.basics.errors import ConfigError
from afspm.translator.driver_base import ControllerLost, ControllerSilent
from afspm.translator.hurry import end_if_hurried, step_s
from afspm.translator.trace import TCP, TRACE, TracedAnswer

_AT_ONCE: Final = 1 << 20  # bounds the buffer of one `recv`: a reply may announce any size
_SLOWEST_BYTES_PER_S: Final = 1e6  # a whole scan may take longer than the timeout of a small answer

_DRAIN_S: Final = 2.0

T = TypeVar("T")


class Receiver:
    """A reader of the answer to one question, with a deadline."""

    def __init__(
        self,
        connected: socket.socket,
        monotonic_s: Callable[[], float],
        until_s: float,
        what: str,
        traced: TracedAnswer,
    ) -> None:
        self._socket = connected
        self._traced = traced
        self._monotonic_s = monotonic_s
        self._until_s = until_s
        self._what = what

    def some(self, most: int = _AT_ONCE, after: str = "some") -> bytes:
        """Return at least one byte and at most `most`.

        Raises:
            TimeoutError: no byte came in time. ControllerLost: the connection was closed. OSError.
        """
        asked_s = self._monotonic_s()
        while True:
            left_s = self._until_s - self._monotonic_s()
            if left_s <= 0.0:
                raise TimeoutError
            self._socket.settimeout(step_s(left_s))
            with suppress(TimeoutError):
                part = self._socket.recv(min(most, _AT_ONCE))
                break
            end_if_hurried(self._monotonic_s() - asked_s, self._what)
        if not part:
            raise ControllerLost(f"the connection was closed after {after} bytes of the reply to {self._what}")
        self._traced.add(part)
        return part

    def exactly(self, size: int) -> bytearray:
        """Return `size` bytes, and extend the deadline for a large answer.

        Memory is allocated for the bytes received, not for the size announced.
        """
        self._until_s += size / _SLOWEST_BYTES_PER_S
        received = bytearray()
        while len(received) < size:
            received += self.some(size - len(received), f"{len(received)} of {size}")
        return received


class TcpConnection:
    """A TCP connection to a controller. Not thread-safe, except `close`.

    Any error closes the connection: a late answer must never be taken for the answer to the next question.

    Args:
        timeout_s: longest time to an answer, in real time.
        monotonic_s: a clock of real time.
        hints: advice for a refused connection, and for a missing answer.

    Attributes:
        where: "HOST:PORT", as given.
        peer: the controller's numeric address and port.

    Raises:
        ControllerLost: no program listens at the address.
    """

    def __init__(
        self, address: tuple[str, int], timeout_s: float, monotonic_s: Callable[[], float], hints: tuple[str, str]
    ) -> None:
        self._timeout_s = timeout_s
        self._monotonic_s = monotonic_s
        self._awaits_answer = self._is_closed = False
        self._silent_hint = hints[1]
        self.where = f"{address[0]}:{address[1]}"
        try:
            self._socket = socket.create_connection(address, timeout_s)
        except OSError as error:
            raise ControllerLost(f"no connection: {error}", where=self.where, hint=hints[0]) from error
        # a small question must not wait for more data to fill a segment
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.peer = "{}:{}".format(*self._socket.getpeername()[:2])
        self._trace = TRACE.connection(TCP)

    def ask(
        self,
        what: str,
        message: bytes,
        read: Callable[[Receiver], T],
        *,
        longer_s: float = 0.0,
        is_secret: bool = False,
    ) -> T:
        """Send a question, and return its answer, decoded by `read`. See `send` and `receive`."""
        self.send(what, message, is_secret=is_secret)
        return self.receive(what, read, longer_s=longer_s)

    def send(self, what: str, message: bytes, *, is_secret: bool = False) -> None:
        """Send a question; receive its answer before sending the next.

        Args:
            what: the question in words, for messages.
            is_secret: the question must not be written into a trace.

        Raises:
            ControllerLost: the question could not be sent; the connection is closed.
        """

        def send() -> None:
            self._socket.settimeout(self._timeout_s)
            self._awaits_answer = True
            self._socket.sendall(message)

        self._trace.asked(what, None if is_secret else message)
        with self._trace.failing():
            self._guarded(what, self._timeout_s, send)

    def receive(self, what: str, read: Callable[[Receiver], T], *, longer_s: float = 0.0) -> T:
        """Receive an answer, decoded by `read`.

        Args:
            longer_s: added to the usual timeout.

        Raises:
            ControllerSilent: no answer in time. ControllerLost: a malformed one. The connection is closed.
        """
        timeout_s = self._timeout_s + longer_s
        with self._trace.answering() as traced:
            receiver = Receiver(self._socket, self._monotonic_s, self._monotonic_s() + timeout_s, what, traced)
            found = self._guarded(what, timeout_s, lambda: read(receiver))
            traced.is_whole = True
            self._awaits_answer = False
            return found

    def has_answer(self, within_s: float = 0.0) -> bool:
        """Return True if an answer begins to arrive within a time, or if the connection is lost."""
        try:
            self._socket.settimeout(within_s)
            self._socket.recv(1, socket.MSG_PEEK)
        except (BlockingIOError, TimeoutError):
            return False
        except OSError:
            return True
        return True

    def _guarded(self, what: str, timeout_s: float, do: Callable[[], T]) -> T:
        try:
            return do()
        except TimeoutError as error:
            self.close()
            message = f"no answer to {what} within {timeout_s:g} s"
            raise ControllerSilent(message, where=self.where, hint=self._silent_hint) from error
        except OSError as error:
            self.close()
            message = f"the connection was lost during {what}: {error}"
            raise ControllerLost(message, where=self.where, hint=self._silent_hint) from error
        except ControllerLost as error:
            self.close()
            error.where = error.where or self.where
            raise

    def close(self) -> None:
        """Close the connection, from any thread; a waiting thread gets ControllerLost.

        While an answer is awaited it is only half-closed, and a thread reads what still comes until the controller
        closes its half, for at most `_DRAIN_S`. Others report of a real Nanonis that a port whose client resets the
        connection in mid-answer stays silent until Nanonis is restarted.
        """
        if self._is_closed:
            return
        self._is_closed = True
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)
        if self._awaits_answer:
            # no daemon: the end of the process waits for it, too
            threading.Thread(target=self._drain, name=f"draining {self.where}").start()
        else:
            self._socket.close()

    def _drain(self) -> None:
        until_s = time.monotonic() + _DRAIN_S
        with suppress(OSError):
            while (left_s := until_s - time.monotonic()) > 0.0:
                self._socket.settimeout(left_s)
                if not self._socket.recv(_AT_ONCE):
                    break
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes a thread that waits for an answer
        self._socket.close()


def host_and_port(address: str, hint: str = '"host:port"') -> tuple[str, int]:
    """Split the setting `address` into host and port.

    Raises:
        ConfigError: `address` has another form.
    """
    host, _, port = address.rpartition(":")
    if not (host and port.isdigit()):
        raise ConfigError(f"{address!r} is not an address", where="address", hint=hint)
    return host, int(port)
