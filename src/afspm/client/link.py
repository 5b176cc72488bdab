"""The one place that waits: takes what the port brings to whom it is for, and asks the scheduler."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from afspm import wire
from afspm.client.published_state import PublishedState
from afspm.clock import Clock
from afspm.errors import ConfigError, ExperimentEnded, NoResponse, WireError
from afspm.logic.sessions import run_of
from afspm.model import (
    CLOCK_REQUEST,
    HAS_ENDED,
    OTHER_RUN_RESPONSE,
    RELAY_REQUEST,
    ControlRequest,
    Packet,
    RelayedMessage,
    Request,
    Response,
    ResponseDetail,
    request_name,
)
from afspm.process.context import STATE_MESSAGES, ProcessActivity
from afspm.process.stopping import StopRequested
from afspm.transport.port import (
    CaughtUp,
    ControlConnected,
    ControlDisconnected,
    Incoming,
    Killed,
    PacketReceived,
    ParentGone,
    Port,
    ReplyReceived,
)

LONGER_THAN_THE_SCHEDULER = 1.2
"""By so much we wait longer than the scheduler does for the microscope: what it says then is an answer, and who asks
again instead makes the connection anew, as if the scheduler were gone."""
CAUGHT_UP_WITHIN_S = 2.0  # a scheduler of version 1 replays without saying when it is done
MOST_UNANSWERED = 4
"""Of what is told without waiting for the answer."""
Listener = Callable[[Packet, bool], None]


class ExperimentLink:
    """A component's connection to its experiment, for use from one thread.

    Args:
        source: the address of the scheduler's publisher, whose packets tell the state; None: all do.
        session: differs between two lives of a component of the same name.
    """

    def __init__(
        self,
        port: Port,
        name: str,
        *,
        source: str | None = None,
        session: str = "0",
        request_timeout_s: float = 5.0,
        request_retries: int = 3,
        activity: ProcessActivity | None = None,
        log: logging.Logger | None = None,
    ) -> None:
        self.port = port
        self.name = name
        self.clock: Clock = port.clock
        self.view = PublishedState()
        self.activity = activity or ProcessActivity(self.clock)
        self.log = log or logging.getLogger(f"afspm.{name}")
        self.ended = False
        self.stopping = False
        self._left = False
        self._refused = ""
        self.connections = 0
        self.connected = False
        self.request_timeout_s = request_timeout_s
        self._retries = request_retries
        self._source = source
        self._session = session
        self._requests = 0
        self._asked = ""
        self._answer: Response | None = None
        self.version = wire.Version.UNKNOWN
        self._told: dict[str, float] = {}  # ids of what was told and not answered yet, with the monotonic time
        self._untold: dict[str, RelayedMessage] = {}
        self._caught_up: set[str] = set()
        self._listeners: dict[int, Listener] = {}
        self._listened = 0

    # --- waiting ---

    def wait(self, done: Callable[[], bool], until_s: float | None = None) -> bool:
        """Wait until `done()`, which is tried after whatever arrives; False if `until_s` (monotonic) comes first.

        Raises:
            ExperimentEnded, StopRequested: there is nothing more to wait for.
        """
        with self.activity.waiting():
            while not done():
                left_s = None if until_s is None else until_s - self.clock.monotonic_s()
                if left_s is not None and left_s <= 0.0:
                    return False
                self.pump(left_s)
        return True

    def wait_connected(self, done: Callable[[], bool], within_s: float, until_s: float | None = None) -> bool:
        """Wait until `done()`, as long as the scheduler is not there and then for `within_s` at most.

        What it has to say can't come while it is being restarted.
        """
        while not done():
            if not self.wait(lambda: self.connected or done(), until_s):
                return False
            connections = self.connections
            if not self.wait(
                lambda n=connections: done() or not self.connected or self.connections != n,  # type: ignore[misc]
                self._earlier(within_s, until_s),
            ):
                return False
        return True

    def pump(self, timeout_s: float | None) -> None:
        """Wait for what arrives, once, and bring it to whom it is for."""
        self.check()
        for incoming in self.port.poll(timeout_s):
            self._take(incoming)
        self.check()

    def check(self) -> None:
        """Raises ExperimentEnded or StopRequested if it is so; NoResponse if we have left.

        Raises:
            ConfigError: the scheduler is that of another run.
        """
        if self._left:
            raise NoResponse(
                "the experiment was left, by close()", where=self.name, hint="afspm.connect() joins it again"
            )
        if self.stopping:
            raise StopRequested
        if self._refused:
            hint = "end the other experiment, or give this one other addresses"
            raise ConfigError(self._refused, where=self.name, hint=hint)
        if self.ended:
            raise ExperimentEnded(HAS_ENDED, where=self.name)

    def leave(self) -> None:
        """Close the port: nothing is heard any more, and nobody can be asked."""
        self._left = True
        self.port.close()

    def wait_caught_up(self, until_s: float | None = None) -> None:
        """Wait until everything the scheduler has cached is here; once that is so, returns at once.

        A scheduler that is not there is waited for: what it has to say may be that we have been measured already.
        """
        if not self.wait_connected(self.is_caught_up, CAUGHT_UP_WITHIN_S, until_s) and self.connected:
            self._caught_up.add(self._source or "")  # it does not say, it is of version 1

    def is_caught_up(self) -> bool:
        return self._source in self._caught_up if self._source else bool(self._caught_up)

    # --- listening ---

    def listen(self, listener: Listener) -> Callable[[], None]:
        """`listener(packet, ours)` is called with every packet from now on; `ours`: it is the scheduler's.

        Returns what ends that.
        """
        self._listened += 1
        number = self._listened
        self._listeners[number] = listener

        def forget() -> None:
            self._listeners.pop(number, None)

        return forget

    @contextmanager
    def listening(self, listener: Listener) -> Iterator[None]:
        """`listen` while in the block."""
        forget = self.listen(listener)
        try:
            yield
        finally:
            forget()

    # --- asking ---

    def next_id(self) -> str:
        """An id for a request, not used before in any life of this component."""
        self._requests += 1
        return f"{self.name}/{self._session}/{self._requests}"

    def request(
        self, kind: int, subject: Any = None, *, request_id: str = "", until_s: float | None = None
    ) -> Response:
        """Ask the scheduler and wait for its answer, whatever it is.

        A request that stays unanswered is repeated with its id, which has it executed once. While the scheduler is
        gone it is waited for.

        Raises:
            ExperimentEnded: that was the answer.
            NoResponse: no answer to any repetition, or none until `until_s` (monotonic).
        """
        request = Request(kind, subject, id=request_id or self.next_id())
        frames = wire.encode_request(request)
        self._asked, self._answer = request.id, None
        answered_within_s = self.request_timeout_s * LONGER_THAN_THE_SCHEDULER
        sent = 0
        try:
            while sent < self._tries(kind):
                self._wait_connected(until_s)
                connection = self.connections
                self.port.send(frames)
                answer = self._await_answer(connection, self._earlier(answered_within_s, until_s))
                if answer is not None:
                    if answer.detail is ResponseDetail.EXPERIMENT_ENDED:
                        self.ended = True  # this may come before the signal itself
                    self.check()
                    return answer
                if until_s is not None and self.clock.monotonic_s() >= until_s:
                    break
                # a connection that was lost is the scheduler's restart, not its silence; one of version 1 may have
                # ended over just this request
                sent += connection == self.connections or self.version is wire.Version.ONE
                self.log.debug("%s (%s) is asked again", request_name(kind), request.id)
        finally:
            self._asked = ""
        raise NoResponse(
            f"{request_name(kind)} was not answered, asked {max(sent, 1)} times",
            where=self.name,
            hint="whether it was carried out is not known",
        )

    def send_only(self, kind: ControlRequest, subject: Any = None) -> None:
        """Ask without waiting for the answer, for what is done on the way out."""
        self.port.send(wire.encode_request(Request(kind, subject, id=self.next_id())))

    def tell(self, thing: Any) -> None:
        """Have the scheduler publish something of ours, and don't wait for it.

        While some of it is not answered, only the newest of each kind is kept to be sent later.
        """
        if self.version is not wire.Version.OURS:
            return  # its answer could be taken for that to the next request
        told, since_s = RelayedMessage(*wire.encode(thing)), self.clock.monotonic_s() - self.request_timeout_s
        self._told = {told_id: at_s for told_id, at_s in self._told.items() if at_s > since_s}
        if len(self._told) < MOST_UNANSWERED:
            self._send_told(told)
        else:
            self._untold[told.message] = told

    def _send_told(self, told: RelayedMessage) -> None:
        request = Request(RELAY_REQUEST, told, id=self.next_id())
        self._told[request.id] = self.clock.monotonic_s()
        self.port.send(wire.encode_request(request))

    def until(self, timeout_s: float | None) -> float | None:
        """A timeout as the moment, in monotonic time, when it is over."""
        return None if timeout_s is None else self.clock.monotonic_s() + timeout_s

    def _wait_connected(self, until_s: float | None) -> None:
        if self.wait(lambda: self.connected, self._earlier(self.request_timeout_s, until_s)):
            return
        self.log.warning("the scheduler is not there; waiting for it")
        if not self.wait(lambda: self.connected, until_s):
            raise NoResponse("the scheduler is not there", where=self.name, hint="is the experiment running?")

    def _earlier(self, timeout_s: float, until_s: float | None) -> float:
        soon_s = self.clock.monotonic_s() + timeout_s
        return soon_s if until_s is None else min(soon_s, until_s)

    def _tries(self, kind: int) -> int:
        # a scheduler of version 1 does not know ids: what it may have done must not be asked for twice
        if kind == ControlRequest.ACTION and self.version is wire.Version.ONE:
            return 1
        return 1 + self._retries

    def _await_answer(self, connection: int, until_s: float) -> Response | None:
        self.wait(lambda: self._answer is not None or self.connections != connection, until_s)
        return self._answer

    def _take(self, incoming: Incoming) -> None:
        match incoming:
            case PacketReceived(packet, source):
                self._take_packet(packet, source)
            case ReplyReceived(response):
                self._take_reply(response)
            case CaughtUp(source):
                self._caught_up.add(source)
            case ControlConnected():
                self.connections += 1
                self.connected = True
                self._told.clear()  # what was on its way then may be lost, and its answer with it
                self._show_run()
            case ControlDisconnected():
                self.connected = False
            case Killed():
                self.ended = True
            case ParentGone():
                self.stopping = True

    def _show_run(self) -> None:
        """Have the scheduler see by the id of a request whether it is of our run. Only one of ours has such runs."""
        if run_of(self.name, f"{self.name}/{self._session}/0"):
            self.port.send(wire.encode_request(Request(CLOCK_REQUEST, id=self.next_id())))

    def _take_reply(self, response: Response) -> None:
        if response.code == OTHER_RUN_RESPONSE:
            self._refused = response.reason
        if response.id in self._told:
            del self._told[response.id]
            if self._untold:
                self._send_told(self._untold.pop(next(iter(self._untold))))
            return
        if not self._asked:
            return  # late: it was given up on
        if response.id in ("", self._asked):
            self.version = wire.version_of(self._asked, response)
            self._answer = response

    def _take_packet(self, packet: Packet, source: str) -> None:
        ours = self._source is None or source == self._source
        if ours:
            self.view.take_time(packet.time_ns)
            self._look_at(packet)
        for listener in tuple(self._listeners.values()):
            listener(packet, ours)

    def _look_at(self, packet: Packet) -> None:
        try:
            message = wire.message_of(packet.envelope)
            if message in STATE_MESSAGES:
                self.view.take(message, wire.decode(message, packet.payload))
        except WireError as error:
            self.log.debug("a packet that can't be read: %s", error)
