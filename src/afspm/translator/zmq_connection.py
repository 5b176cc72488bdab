"""A ZeroMQ connection to a controller that answers one request at a time, and sends only answers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, TypeVar

import zmq
from zmq.utils.monitor import recv_monitor_message

from afspm.basics.errors import ConfigError
from afspm.translator.driver_base import ControllerLost, ControllerSilent
from afspm.translator.hurry import end_if_hurried, step_s
from afspm.translator.trace import TRACE, ZEROMQ, TracedAnswer

T = TypeVar("T")

_NEVER: Final = -1
_OUTCOMES: Final = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_CLOSED | zmq.EVENT_DISCONNECTED


class ZmqConnection:
    """A ZeroMQ connection to a controller. Not thread-safe.

    The socket is a DEALER, since a REQ socket is unusable after one lost reply. A failed call closes the connection: a
    late reply must never be taken for the reply to the next request. The socket never reconnects: another program may
    listen at the address by then.

    Args:
        address: e.g. "tcp://127.0.0.1:5555".
        timeout_s: longest time to a reply, in real time.
        monotonic_s: a clock of real time.
        hints: advice for an invalid address, for a missing program, and for a missing reply.

    Raises:
        ControllerLost: no program listens at the address. ConfigError: `address` has another form.
    """

    def __init__(
        self, address: str, timeout_s: float, monotonic_s: Callable[[], float], hints: tuple[str, str, str]
    ) -> None:
        self._address, self._timeout_s, self._monotonic_s, self._hints = address, timeout_s, monotonic_s, hints
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket: zmq.Socket[bytes] = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)  # closing must not wait for a controller that reads no more
        # a request must not wait for an absent peer, and be executed when it is not expected any more
        self._socket.setsockopt(zmq.IMMEDIATE, 1)
        self._socket.setsockopt(zmq.RECONNECT_IVL, _NEVER)
        self._socket.setsockopt(zmq.SNDTIMEO, max(1, round(timeout_s * 1000)))
        monitor = self._socket.get_monitor_socket(_OUTCOMES)  # before connecting, else its outcome may be missed
        try:
            self._socket.connect(address)
        except zmq.ZMQError as error:
            self.close()
            raise ConfigError(f"{address!r} is not an address: {error}", where="address", hint=hints[0]) from error
        self._await_connection(monitor)
        self._trace = TRACE.connection(ZEROMQ)

    def ask(self, what: str, message: bytes, parse: Callable[[bytes], T | None]) -> T:
        """Send a request and return its reply, decoded by `parse`, which returns None for another request's reply.

        Raises:
            ControllerSilent: no reply. ControllerLost: a reply that `parse` rejects.
        """
        try:
            with self._trace.asking(what, message) as traced:
                until_s = self._monotonic_s() + self._timeout_s
                self._send(what, message)
                while True:
                    self._await_reply(what, until_s)
                    found = parse(self._taken(traced))
                    if found is not None:
                        return found
        except ControllerLost:  # also of `parse`
            self.close()
            raise
        except zmq.ZMQError as error:
            raise self._broken(what, error) from error

    def begin(self, what: str, message: bytes) -> None:
        """Send a request with a slow reply, for `wait` and `reply`.

        Raises:
            ControllerLost
        """
        self._trace.asked(what, message)
        try:
            with self._trace.failing():
                self._send(what, message)
        except zmq.ZMQError as error:
            raise self._broken(what, error) from error

    def wait(self, within_s: float) -> None:
        """Wait for the reply to `begin`, at most `within_s` of real time.

        Raises:
            ControllerLost
        """
        try:
            self._socket.poll(max(0, round(within_s * 1000.0)))
        except zmq.ZMQError as error:
            raise self._broken("a reply", error) from error

    def reply(self, what: str, parse: Callable[[bytes], T]) -> T | None:
        """Return the reply to `begin`, decoded by `parse`; None until the reply has arrived.

        Raises:
            ControllerLost: the connection was lost, or `parse` rejects the reply.
        """
        try:
            if not self._socket.poll(0):
                return None
            with self._trace.answering() as traced:
                raw = self._taken(traced)
            return parse(raw)
        except ControllerLost:  # also of `parse`
            self.close()
            raise
        except zmq.ZMQError as error:
            raise self._broken(what, error) from error

    def close(self) -> None:
        """Close the connection and its context."""
        self._context.destroy(linger=0)

    def _await_connection(self, monitor: zmq.Socket[bytes]) -> None:
        with monitor:
            came = monitor.poll(max(1, round(self._timeout_s * 1000)))
            stands = bool(came) and recv_monitor_message(monitor)["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED
        self._socket.disable_monitor()
        if not stands:
            self.close()
            raise ControllerLost("nothing listens at this address", where=self._address, hint=self._hints[1])

    def _send(self, what: str, message: bytes) -> None:
        try:
            self._socket.send_multipart([b"", message])
        except zmq.Again as error:
            raise self._lost(f"the connection was lost before {what}") from error

    def _await_reply(self, what: str, until_s: float) -> None:
        asked_s = self._monotonic_s()
        while not self._socket.poll(math.ceil(step_s(max(0.0, until_s - self._monotonic_s())) * 1000.0)):
            now_s = self._monotonic_s()
            if now_s >= until_s:
                self.close()
                why = f"no reply to {what} within {self._timeout_s:g} s"
                raise ControllerSilent(why, where=self._address, hint=self._hints[2])
            end_if_hurried(now_s - asked_s, what)

    def _taken(self, traced: TracedAnswer) -> bytes:
        frames = self._socket.recv_multipart()
        if len(frames) != 2 or frames[0]:
            raise self._lost(f"the controller sent a reply of {len(frames)} frames")
        traced.add(frames[1])
        traced.is_whole = True
        return frames[1]

    def _broken(self, what: str, error: zmq.ZMQError) -> ControllerLost:
        return self._lost(f"the connection was lost at {what}: {error}")

    def _lost(self, why: str, hint: str = "") -> ControllerLost:
        self.close()
        return ControllerLost(why, where=self._address, hint=hint)
