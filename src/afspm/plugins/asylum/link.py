"""The connection to ZeroMQ-XOP: one request, then its reply. Igor never speaks unasked."""

from __future__ import annotations

import itertools
from collections.abc import Callable

from afspm.plugins.asylum import xop
from afspm.translator.zmq_connection import ZmqConnection

_HINTS = (
    '"tcp://host:port", as given to zeromq_server_bind',
    "is Igor running, with zeromq_server_bind on this address?",
    "Igor does not answer while a dialog is open on its screen, nor with text that is not UTF-8",
)


class Link:
    """A connection. For one thread. Whatever goes wrong but an error of Igor's own, it is closed.

    Args:
        address: e.g. "tcp://127.0.0.1:5555".
        timeout_s: how long a reply may take, in real time.
        monotonic_s: real time.

    Raises:
        ControllerLost: nobody listens there. ConfigError: it is no address.
    """

    def __init__(self, address: str, timeout_s: float, monotonic_s: Callable[[], float]) -> None:
        self._address = address
        self._numbers = itertools.count(1)
        self._connection = ZmqConnection(address, timeout_s, monotonic_s, _HINTS)

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

        def parse(payload: bytes) -> xop.Reply | None:
            found = xop.reply(payload)
            # an error found before Igor is asked comes without the id, and can only be that of what is in flight
            is_ours = found.message_id == message_id or (found.message_id is None and found.error is not None)
            return found if is_ours else None

        found = self._connection.ask(name, message, parse)
        if found.error is not None:
            raise xop.XopError(*found.error, where=name)
        return found

    def close(self) -> None:
        """Let go of it."""
        self._connection.close()


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
