"""Connection to ZeroMQ-XOP: one request, then its reply. Igor sends nothing unrequested."""

from __future__ import annotations

import itertools
from collections.abc import Callable

from afspm.driver import ZmqConnection
from afspm.plugins.asylum import xop

_HINTS = (
    '"tcp://host:port", as given to zeromq_server_bind',
    "is Igor running, with zeromq_server_bind on this address?",
    "Igor does not answer while a dialog is open on its screen, nor with text that is not UTF-8",
)


class Link:
    """A connection for one thread, closed by a missing reply and by a malformed reply.

    Args:
        address: e.g. "tcp://127.0.0.1:5555".
        timeout_s: longest wait for a reply, real time.
        monotonic_s: returns real time.

    Raises:
        ControllerLost: the port does not accept connections. ConfigError: the address is malformed.
    """

    def __init__(self, address: str, timeout_s: float, monotonic_s: Callable[[], float]) -> None:
        self._address = address
        self._numbers = itertools.count(1)
        # a DEALER, since a REQ is unusable after one lost reply; without an identity, as the XOP refuses duplicates
        self._connection = ZmqConnection(address, timeout_s, monotonic_s, _HINTS)

    def ask(self, name: str, *parameters: xop.Parameter) -> xop.Result:
        """Call an Igor function that has one result.

        Raises:
            BadReply: another number of results; the connection stays open. Also the errors of `call`.
        """
        results = self.call(name, *parameters).results
        if len(results) != 1:
            raise xop.BadReply(f"{name} returned {len(results)} results instead of one", where=self._address)
        return results[0]

    def call(self, name: str, *parameters: xop.Parameter) -> xop.Reply:
        """Call an Igor function.

        Raises:
            XopError: Igor reports an error. InvalidValue: the arguments can't be sent.
            ControllerLost: no reply. BadReply: a malformed reply. Both close the connection.
        """
        message_id = str(next(self._numbers))
        message = xop.request(name, parameters, message_id)

        def parse(payload: bytes) -> xop.Reply | None:
            found = xop.reply(payload)
            # errors 3 to 7, which the XOP finds without Igor, have no id: they belong to the only request in flight
            is_ours = found.message_id == message_id or (found.message_id is None and found.error is not None)
            return found if is_ours else None

        found = self._connection.ask(name, message, parse)
        if found.error is not None:
            raise xop.XopError(*found.error, where=name)
        return found

    def close(self) -> None:
        self._connection.close()


def text(result: object) -> str:
    """Return a result as text. Raises BadReply: the result has another type."""
    if isinstance(result, str):
        return result
    raise xop.BadReply(f"Igor returned {result!r} instead of a text")


def number(result: object) -> float:
    """Return a result as a number, possibly NaN. Raises BadReply: the result has another type."""
    if isinstance(result, float):
        return result
    raise xop.BadReply(f"Igor returned {result!r} instead of a number")
