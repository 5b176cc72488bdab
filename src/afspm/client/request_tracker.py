"""Matches the scheduler's answers with the requests of a component."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from afspm import wire
from afspm.model import CLOCK_REQUEST, RELAY_REQUEST, RelayedMessage, Request, Response
from afspm.model.sessions import run_of

Send = Callable[[Sequence[bytes]], None]


class RequestTracker:
    """Gives requests their ids, and takes the answers. One request at a time is waited for.

    Args:
        session: differs between two lives of a component of the same name.

    Attributes:
        connections: how often the scheduler was connected.
        answer: to the request that is waited for; None: not yet there.
    """

    def __init__(self, send: Send, name: str, session: str) -> None:
        self._send = send
        self._name = name
        self._session = session
        self._requests = 0
        self._asked = ""
        self._told: tuple[str, float] | None = None  # the id of what was told and not answered yet, and when
        self._untold: dict[str, RelayedMessage] = {}
        self.connections = 0
        self.connected = False
        self.answer: Response | None = None

    def next_id(self) -> str:
        """Return an id for a request, not used before in any life of this component."""
        self._requests += 1
        return f"{self._name}/{self._session}/{self._requests}"

    def expect(self, request_id: str) -> None:
        """Take the answer to this request from now on; empty: to none."""
        self._asked, self.answer = request_id, None

    def send_only(self, kind: int, subject: object = None) -> str:
        """Send a request whose answer is not waited for, and return its id."""
        request = Request(kind, subject, id=self.next_id())
        self._send(wire.encode_request(request))
        return request.id

    def tell(self, thing: object, now_s: float, timeout_s: float) -> None:
        """Have the scheduler publish `thing`. Until that is answered, only the newest of each kind waits."""
        told = RelayedMessage(*wire.encode(thing))
        self._untold[told.message] = told
        if self._told is None or self._told[1] < now_s - timeout_s:
            self._tell_next(now_s)

    def on_connected(self) -> None:
        self.connections += 1
        self.connected = True
        self._told = None  # its answer may be lost with the connection
        if run_of(self._name, f"{self._name}/{self._session}/0"):
            self.send_only(CLOCK_REQUEST)  # shows by its id which run is ours

    def on_reply(self, response: Response, now_s: float) -> None:
        if self._told is not None and response.id == self._told[0]:
            self._told = None
            self._tell_next(now_s)
        elif self._asked and response.id == self._asked:  # else it is late: it was given up on
            self.answer = response

    def _tell_next(self, now_s: float) -> None:
        if self._untold:
            told = self._untold.pop(next(iter(self._untold)))
            self._told = (self.send_only(RELAY_REQUEST, told), now_s)
