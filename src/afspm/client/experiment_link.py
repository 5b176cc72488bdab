"""A component's connection to its experiment, and the only place where a component waits for events and answers."""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from afspm import wire
from afspm.basics.clock import Clock
from afspm.basics.errors import AfspmError, ConfigError, ExperimentEnded, NoResponse, WireError
from afspm.basics.launch import Launch
from afspm.client.interrupts import Interrupts
from afspm.model import (
    CLOCK_REQUEST,
    HAS_ENDED,
    RELAY_REQUEST,
    ActByHand,
    ChannelRoles,
    ControlMode,
    ControlState,
    Feedback,
    MeasurementConditions,
    Packet,
    Parameter,
    ProbePosition,
    RelayedMessage,
    Request,
    Response,
    ResponseDetail,
    Scan,
    ScanLines,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    Spectrum,
    TipStatus,
    request_name,
)
from afspm.model.requests import (
    AS_PLANNED_REQUEST,
    KEEP_REQUEST,
    LEND_REQUEST,
    OTHER_RUN_RESPONSE,
    RETURN_REQUEST,
    Settings,
)
from afspm.model.sessions import run_of
from afspm.model.state import FeedbackUnits
from afspm.transport import Port
from afspm.transport.port import (
    CaughtUp,
    ControlConnected,
    ControlDisconnected,
    Incoming,
    Killed,
    PacketReceived,
    ParentGone,
    ReplyReceived,
)
from afspm.transport.process.context import ProcessActivity
from afspm.transport.process.parent import StopRequested
from afspm.wire.messages import CONDITIONS

_CONDITIONS = 16
"""Measurements whose conditions are kept: a component may handle the packets of earlier ones."""


class PublishedState:
    """The newest published states, and the number of publications of each, so that a caller can wait for the next.

    Args:
        began_ns: start of this process; an earlier pause is no part of `manual_ns`.
    """

    def __init__(self, began_ns: int = 0) -> None:
        self._began_ns = began_ns
        self.status: ScopeStatus | None = None
        self.control: ControlState | None = None
        self.scan_parameters: ScanParameters | None = None
        self.feedback: Feedback | None = None
        self.probe_position: ProbePosition | None = None
        self.tip: TipStatus | None = None
        self.by_hand: ActByHand | None = None
        self.channels = ChannelRoles()
        self.feedback_units = FeedbackUnits()
        self.newest_ns: int | None = None
        self._manual_ns = 0
        self._manual_since_ns: int | None = None
        self._published: Counter[str] = Counter()
        self._conditions: deque[MeasurementConditions] = deque(maxlen=_CONDITIONS)
        self.simulated = False

    @property
    def state(self) -> ScopeState:
        return self.status.state if self.status else ScopeState.UNDEFINED

    def take(self, message: str, thing: object) -> None:
        """Store `thing`, published as the message `message`."""
        setattr(self, wire.declaration(message).attribute, thing)
        self._published[message] += 1
        if isinstance(thing, ControlState):
            self._note_mode(thing.mode)

    def manual_ns(self, now_ns: int) -> int:
        """Return the time in MANUAL."""
        return self._manual_ns + (0 if self._manual_since_ns is None else max(0, now_ns - self._manual_since_ns))

    def _note_mode(self, mode: ControlMode) -> None:
        # a mode of the scheduler's cache may be older than this process
        at_ns = max(self._began_ns, self.newest_ns or 0)
        if mode is ControlMode.MANUAL:
            self._manual_since_ns = self._manual_since_ns or at_ns
        else:
            self._manual_ns, self._manual_since_ns = self.manual_ns(at_ns), None

    def take_conditions(self, conditions: MeasurementConditions) -> None:
        """Store the conditions of a measurement, which are published right before it."""
        self._conditions.append(conditions)

    def conditions_of(self, result: Scan | Spectrum | None) -> MeasurementConditions | None:
        """Return the conditions of a result, or of the newest one; None if they are not known (any more)."""
        of_it = (one for one in reversed(self._conditions) if result is None or one.is_of(result))
        return next(of_it, None)

    def described(self, thing: Any) -> Any:
        """Return a scan, lines of one, or a curve with the roles of what it measures; any other thing unchanged.

        A scan or curve has the settings in force, too.
        """
        shown = self.channels.shown(thing) if isinstance(thing, Scan | ScanLines | Spectrum) else thing
        if not isinstance(shown, Scan | Spectrum):
            return shown
        of_it = self.conditions_of(shown)
        shown = shown if of_it is None else replace(shown, in_force=of_it.in_force)
        return replace(shown, simulated=True) if self.simulated and isinstance(shown, Scan) else shown

    def take_time(self, time_ns: int | None) -> None:
        """Update `newest_ns` with the time of a packet from the scheduler."""
        if time_ns is not None and (self.newest_ns is None or time_ns > self.newest_ns):
            self.newest_ns = time_ns

    def count(self, message: str) -> int:
        """Return the number of publications of `message`."""
        return self._published[message]


LONGER_THAN_THE_SCHEDULER = 1.2
"""Ratio of a component's timeout to the scheduler's timeout for the microscope. The scheduler's NO_RESPONSE then
arrives before the component repeats its request on a new connection."""
CAUGHT_UP_WITHIN_S = 2.0
"""Time before the warning that the scheduler's packets do not arrive."""
UNHEARD = "the scheduler is connected, but its packets do not arrive"
Send = Callable[[Sequence[bytes]], None]
Listener = Callable[[Packet, bool], None]


class RequestTracker:
    """Ids of a component's requests, and the answers. The component waits for one answer at a time.

    Args:
        session: text that differs after each restart of a component of the same name.

    Attributes:
        connections: number of connections to the scheduler so far.
        answer: answer to the request chosen by `expect`; None until the answer arrives.
    """

    def __init__(self, send: Send, name: str, session: str) -> None:
        self._send = send
        self._name = name
        self._session = session
        self._requests = 0
        self._asked = ""
        self._relayed: tuple[str, float] | None = None  # id and time of the unanswered relay request
        self._waiting: dict[str, RelayedMessage] = {}
        self.connections = 0
        self.connected = False
        self.answer: Response | None = None

    def next_id(self) -> str:
        """Return an id for a request, unique over all restarts of this component."""
        self._requests += 1
        return f"{self._name}/{self._session}/{self._requests}"

    def expect(self, request_id: str) -> None:
        """Choose the request whose answer `answer` will hold; an empty id chooses none."""
        self._asked, self.answer = request_id, None

    def send_only(self, kind: int, subject: object = None, request_id: str = "") -> str:
        """Send a request without waiting for its answer, and return its id."""
        request = Request(kind, subject, id=request_id or self.next_id())
        self._send(wire.encode_request(request))
        return request.id

    def relay(self, thing: object, now_s: float, timeout_s: float) -> None:
        """Ask the scheduler to publish `thing`. While a message is unanswered, only the newest of each kind waits."""
        relayed = RelayedMessage(*wire.encode(thing))
        self._waiting[relayed.message] = relayed
        if self._relayed is None or self._relayed[1] < now_s - timeout_s:
            self._relay_next(now_s)

    def on_connected(self) -> None:
        self.connections += 1
        self.connected = True
        self._relayed = None  # its answer may be lost with the connection
        if run_of(self._name, f"{self._name}/{self._session}/0"):
            self.send_only(CLOCK_REQUEST)  # its id contains the run: the scheduler of another run refuses it

    def on_reply(self, response: Response, now_s: float) -> None:
        if self._relayed is not None and response.id == self._relayed[0]:
            self._relayed = None
            self._relay_next(now_s)
        elif self._asked and response.id == self._asked:  # otherwise a late answer to a request that was given up
            self.answer = response

    def _relay_next(self, now_s: float) -> None:
        if self._waiting:
            relayed = self._waiting.pop(next(iter(self._waiting)))
            self._relayed = (self.send_only(RELAY_REQUEST, relayed), now_s)


class ExperimentLink:
    """A component's connection to its experiment, for use from one thread.

    Args:
        source: address of the scheduler's publisher, whose packets hold the state; None: packets of any publisher.
        session: text that differs after each restart of a component of the same name.
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
        self._began_ns = self.clock.now_ns()
        self.view = PublishedState(self._began_ns)
        self.activity = activity or ProcessActivity(self.clock)
        self.log = log or logging.getLogger(f"afspm.{name}")
        self.ended = False
        self.request_timeout_s = request_timeout_s
        self.requests = RequestTracker(port.send, name, session)
        self.interrupts = Interrupts(port)
        self._retries = request_retries
        self._source = source
        self._over: BaseException | None = None
        self._thread: int | None = None  # the thread that waits for events
        self._caught_up: set[str] = set()
        self._listeners: dict[object, Listener] = {}

    @classmethod
    def of_launch(cls, launch: Launch, port: Port, session: str, **given: Any) -> ExperimentLink:
        """Return the link for a process with this launch line.

        Args:
            given: name, activity or log, as to the constructor.
        """
        link = cls(
            port,
            given.pop("name", launch.name),
            source=launch.sockets.subscribe[0] if launch.sockets.subscribe else None,
            session=session,
            request_timeout_s=launch.request_timeout_s,
            request_retries=launch.request_retries,
            **given,
        )
        link.view.simulated = launch.simulated
        return link

    # --- waiting ---

    def wait(self, done: Callable[[], bool], until_s: float | None = None) -> bool:
        """Wait until `done()`, tested after each event; return False if `until_s` (monotonic) comes first.

        Raises:
            ExperimentEnded: the experiment has ended.
            StopRequested: the process is being stopped.
            NoResponse: the link was closed.
            ConfigError: the scheduler belongs to another run.
            KeyboardInterrupt: the user interrupts.
        """
        with self._alone(), self.activity.waiting(), self.interrupts.heeded():
            while not done():
                left_s = None if until_s is None else until_s - self.clock.monotonic_s()
                if left_s is not None and left_s <= 0.0:
                    return False
                self.pump(left_s)
        return True

    def wait_connected(self, done: Callable[[], bool], within_s: float, until_s: float | None = None) -> bool:
        """Wait until `done()`, for at most `within_s` of uninterrupted connection; return False after that.

        While the scheduler is away, only `until_s` (monotonic) limits the wait.
        """
        while not done():
            if not self.wait(lambda: self.connected or done(), until_s):
                return False
            is_settled = self.or_reconnected(lambda: done() or not self.connected)
            if not self.wait(is_settled, self.earlier(within_s, until_s)):
                return False
        return True

    def pump(self, timeout_s: float | None) -> int:
        """Wait for events once, pass them to their listeners, and return their number. Raises as `wait`."""
        self.check()
        with self._alone():
            came = self.port.poll(timeout_s)
            for incoming in came:
                self._take(incoming)
        self.interrupts.heed()
        self.check()
        return len(came)

    def take_in(self) -> None:
        """Pass all events that have arrived to their listeners, without waiting for more. Raises as `wait`."""
        while self.pump(0.0):  # one poll returns a few packets only
            pass

    def check(self) -> None:
        """Raise an error if no more events can arrive.

        Raises:
            ExperimentEnded, StopRequested: the experiment has ended, or the process is being stopped.
            NoResponse: this link was closed.
            ConfigError: the scheduler belongs to another run.
            AfspmError: another thread waits in a call.
        """
        if self._thread not in (None, threading.get_ident()):
            raise AfspmError(
                "another thread waits in a call of this scope",
                where=self.name,
                hint="connect again under another name, and use that scope in this thread",
            )
        if self._over is not None:
            raise self._over
        if self.ended:
            raise ExperimentEnded(HAS_ENDED, where=self.name)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        # the frames of a message would be divided between two threads: packets and answers would be lost
        before, self._thread = self._thread, threading.get_ident()
        try:
            yield
        finally:
            self._thread = before

    def leave(self) -> None:
        """Close the port; all later calls raise NoResponse."""
        hint = "afspm.connect() joins it again"
        self._over = NoResponse("close() has left the experiment", where=self.name, hint=hint)
        self.port.close()

    def wait_caught_up(self, until_s: float | None = None) -> None:
        """Wait until all packets of the scheduler's cache have arrived; later calls return at once.

        The wait goes on while the scheduler is away or its packets do not arrive: its cache may show that a measurement
        is already done.

        Raises:
            NoResponse: the packets have not arrived by `until_s` (monotonic).
        """
        has_warned = False
        while not self.wait_connected(self.is_caught_up, CAUGHT_UP_WITHIN_S, until_s):
            if until_s is not None and self.clock.monotonic_s() >= until_s:
                raise NoResponse(UNHEARD, where=self._source or self.name, hint="does a firewall block this address?")
            if not has_warned:
                has_warned = True
                self.log.warning("%s; waiting for that (%s)", UNHEARD, self._source or "any address")

    def is_caught_up(self) -> bool:
        return self._source in self._caught_up if self._source else bool(self._caught_up)

    def worked_s(self) -> float:
        """Return the experiment time since the start of this link, without the time in MANUAL."""
        now_ns = self.clock.now_ns()
        return (now_ns - self._began_ns - self.view.manual_ns(now_ns)) * 1e-9

    def until(self, timeout_s: float | None) -> float | None:
        """Return the end of a timeout in monotonic time; None for no timeout."""
        return None if timeout_s is None else self.clock.monotonic_s() + timeout_s

    def earlier(self, timeout_s: float, until_s: float | None) -> float:
        """Return the end of a timeout, or `until_s` if that comes first."""
        soon_s = self.clock.monotonic_s() + timeout_s
        return soon_s if until_s is None else min(soon_s, until_s)

    def or_reconnected(self, done: Callable[[], bool]) -> Callable[[], bool]:
        """Return a condition that holds when `done()` holds, or the scheduler has reconnected."""
        connections = self.connections
        return lambda: done() or self.connections != connections

    # --- listening ---

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call `listener(packet, ours)` with every packet from now on; `ours`: whether the scheduler sent the packet.

        Returns:
            A function that removes the listener.
        """
        key = object()
        self._listeners[key] = listener
        return lambda: self._listeners.pop(key, None) and None

    # --- asking ---

    @property
    def connected(self) -> bool:
        return self.requests.connected

    @property
    def connections(self) -> int:
        return self.requests.connections

    def next_id(self) -> str:
        return self.requests.next_id()

    def request(
        self, kind: int, subject: object = None, *, request_id: str = "", until_s: float | None = None
    ) -> Response:
        """Send a request to the scheduler, and return the answer, even a refusal.

        A request without an answer is repeated with its id, so that it is executed once. While the scheduler is away,
        the wait goes on.

        Raises:
            ExperimentEnded: the experiment has ended.
            NoResponse: no repetition was answered, or none by `until_s` (monotonic).
        """
        request = Request(kind, subject, id=request_id or self.next_id())
        frames, requests, sent = wire.encode_request(request), self.requests, 0
        self.check()
        requests.expect(request.id)
        try:
            while sent <= self._retries:
                self._wait_for_scheduler(until_s)
                connections = self.connections
                self.port.send(frames)
                self.wait(
                    self.or_reconnected(lambda: requests.answer is not None),
                    self.earlier(self.request_timeout_s * LONGER_THAN_THE_SCHEDULER, until_s),
                )
                if requests.answer is not None:
                    return self._checked(requests.answer)
                if until_s is not None and self.clock.monotonic_s() >= until_s:
                    break
                # a lost connection means a restart of the scheduler, which does not count as silence
                sent += connections == self.connections
                self.log.debug("asking %s (%s) again", request_name(kind), request.id)
        finally:
            requests.expect("")
        raise NoResponse(
            f"{request_name(kind)} was not answered, sent {max(sent, 1)} times",
            where=self.name,
            hint="the request may or may not have been carried out",
        )

    def lend(self, settings: Sequence[Parameter], until_s: float | None = None) -> Response:
        """State the settings of the next measurement, and return the answer, even a refusal. Raises as `request`."""
        return self.request(LEND_REQUEST, Settings.of(*settings), until_s=until_s)

    def give_back(self, until_s: float | None = None) -> Response:
        """Let the scheduler set back all that this client has lent. Raises as `request`."""
        return self.request(RETURN_REQUEST, Settings(), until_s=until_s)

    def settle_plans(self, parameters: Sequence[str], *, keeps: bool, until_s: float | None = None) -> Response:
        """Let plans measure with what a person has set in MANUAL, or as planned; without parameters, in all of them.

        Returns the answer, even a refusal. Raises as `request`.
        """
        kind = KEEP_REQUEST if keeps else AS_PLANNED_REQUEST
        return self.request(kind, Settings.of(*map(Parameter, parameters)), until_s=until_s)

    def send_only(self, kind: int, subject: object = None, request_id: str = "") -> None:
        """Send a request without waiting for the answer; without a connection the request is lost."""
        self.requests.send_only(kind, subject, request_id)

    def relay(self, thing: object) -> None:
        """Ask the scheduler to publish a message of this component, without waiting."""
        self.requests.relay(thing, self.clock.monotonic_s(), self.request_timeout_s)

    def _checked(self, answer: Response) -> Response:
        if answer.detail is ResponseDetail.EXPERIMENT_ENDED:
            self.ended = True  # this answer may come before the signal KILL
        self.check()
        return answer

    def _wait_for_scheduler(self, until_s: float | None) -> None:
        if self.wait(lambda: self.connected, self.earlier(self.request_timeout_s, until_s)):
            return
        self.log.warning("the scheduler does not answer; waiting for it")
        if not self.wait(lambda: self.connected, until_s):
            raise NoResponse("the scheduler does not answer", where=self.name, hint="is the experiment running?")

    # --- what arrives ---

    def _take(self, incoming: Incoming) -> None:
        match incoming:
            case PacketReceived(packet, source):
                self._take_packet(packet, source)
            case ReplyReceived(response):
                if response.code == OTHER_RUN_RESPONSE and self._over is None:
                    hint = "end the other experiment, or give this one other addresses"
                    self._over = ConfigError(response.reason, where=self.name, hint=hint)
                self.requests.on_reply(response, self.clock.monotonic_s())
            case CaughtUp(source):
                self._caught_up.add(source)
            case ControlConnected():
                self.requests.on_connected()
            case ControlDisconnected():
                self.requests.connected = False
            case Killed():
                self.ended = True
            case ParentGone():
                self._over = StopRequested()

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
            if wire.declaration(message).kind is wire.MessageKind.STATE:
                self.view.take(message, wire.decode(message, packet.payload))
            elif message == CONDITIONS.name:
                self.view.take_conditions(wire.decode(message, packet.payload))
        except WireError as error:
            self.log.debug("a packet can't be read: %s", error)
