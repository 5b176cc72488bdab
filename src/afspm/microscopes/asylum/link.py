"""The connection to ZeroMQ-XOP: one request, then its reply. Igor never speaks unasked."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import zmq
from zmq.utils.monitor import recv_monitor_message

from afspm.errors import ConfigError
from afspm.microscopes.asylum import xop
from afspm.translator.driver import ControllerLost
from afspm.translator.trace import TRACE, ZEROMQ, TracedAnswer

_NEVER = -1
_OUTCOMES = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_CLOSED | zmq.EVENT_DISCONNECTED
_SILENT = "Igor does not answer while a dialog is open on its screen, nor with text that is not UTF-8"


class Link:
    """A connection. For one thread.

    A DEALER, since a REQ socket is of no use any more after one lost reply. Whatever goes wrong but an error of
    Igor's own, it is closed: a late reply must never be taken for that to the next request. It never connects a second
    time: there may be somebody else by then.

    Args:
        address: e.g. "tcp://127.0.0.1:5555".
        timeout_s: how long a reply may take, in real time.
        monotonic_s: real time.

    Raises:
        ControllerLost: nobody listens there. ConfigError: it is no address.
    """

    def __init__(self, address: str, timeout_s: float, monotonic_s: Callable[[], float]) -> None:
        self._address = address
        self._timeout_s = timeout_s
        self._monotonic_s = monotonic_s
        self._numbers = itertools.count(1)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket: zmq.Socket[bytes] = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        # nothing waits for a peer that is not there, and is then done when nobody expects it any more
        self._socket.setsockopt(zmq.IMMEDIATE, 1)
        self._socket.setsockopt(zmq.RECONNECT_IVL, _NEVER)
        self._socket.setsockopt(zmq.SNDTIMEO, max(1, round(timeout_s * 1000)))
        try:
            self._socket.connect(address)
        except zmq.ZMQError as error:
            self.close()
            hint = '"tcp://host:port", as given to zeromq_server_bind'
            raise ConfigError(f"{address!r} is not an address: {error}", where="address", hint=hint) from error
        self._await_connection()
        self._trace = TRACE.connection(ZEROMQ)

    def _await_connection(self) -> None:
        """Return once the connection stands. Raises ControllerLost."""
        monitor = self._socket.get_monitor_socket(_OUTCOMES)
        came = monitor.poll(max(1, round(self._timeout_s * 1000)))
        stands = bool(came) and recv_monitor_message(monitor)["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED
        self._socket.disable_monitor()
        if not stands:
            self.close()
            hint = "is Igor running, with zeromq_server_bind on this address?"
            raise ControllerLost("nothing listens at this address", where=self._address, hint=hint)

    def ask(self, name: str, *parameters: xop.Parameter) -> xop.Result:
        """Call a function of Igor's that has one result. Raises: as `call`."""
        results = self.call(name, *parameters).results
        if len(results) != 1:
            raise xop.BadReply(f"{name} returned {len(results)} results instead of one", where=self._address)
        return results[0]

    def call(self, name: str, *parameters: xop.Parameter) -> xop.Reply:
        """Call a function of Igor's.

        Raises:
            XopError: it could not be done. InvalidValue: what was asked can't be sent.
            ControllerLost, BadReply: no reply, or none to be trusted; the connection is closed.
        """
        message_id = str(next(self._numbers))
        message = xop.request(name, parameters, message_id)
        try:
            with self._trace.asking(name, message) as traced:
                found = self._exchange(message, message_id, name, traced)
        except ControllerLost:
            self.close()
            raise
        except zmq.ZMQError as error:
            self.close()
            raise ControllerLost(f"the connection was lost at {name}: {error}", where=self._address) from error
        if found.error is not None:
            raise xop.XopError(*found.error, where=name)
        return found

    def close(self) -> None:
        """Let go of it."""
        self._context.destroy(linger=0)

    def _exchange(self, message: bytes, message_id: str, name: str, traced: TracedAnswer) -> xop.Reply:
        until_s = self._monotonic_s() + self._timeout_s
        try:
            self._socket.send_multipart([b"", message])
        except zmq.Again as error:
            raise ControllerLost(f"the connection was lost before {name}", where=self._address) from error
        while True:
            left_s = until_s - self._monotonic_s()
            if left_s <= 0.0 or not self._socket.poll(math.ceil(left_s * 1000.0)):
                told = f"no reply to {name} within {self._timeout_s:g} s"
                raise ControllerLost(told, where=self._address, hint=_SILENT)
            payload = _payload(self._socket.recv_multipart())
            traced.add(payload)
            traced.is_whole = True
            found = xop.reply(payload)
            # an error found before Igor is asked comes without the id, and can only be that of what is in flight
            if found.message_id == message_id or (found.message_id is None and found.error is not None):
                return found


def _payload(frames: list[bytes]) -> bytes:
    if len(frames) != 2 or frames[0]:
        raise xop.BadReply(f"ZeroMQ-XOP sent a reply of {len(frames)} frames")
    return frames[1]


def text(result: object) -> str:
    """A result that has to be a text. Raises BadReply."""
    if isinstance(result, str):
        return result
    raise xop.BadReply(f"Igor returned {result!r} instead of a text")


def number(result: object) -> float:
    """A result that has to be a number, NaN too. Raises BadReply."""
    if isinstance(result, float):
        return result
    raise xop.BadReply(f"Igor returned {result!r} instead of a number")
