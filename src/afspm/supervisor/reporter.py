"""The reporter of process states and log lines to the scheduler, which answers with orders.

The reporter has a thread of its own, so that a slow or dead scheduler never delays the supervisor. The supervisor opens
no port: the scheduler publishes all reports, so record, page and late joiners need no connection to a supervisor.
"""

from __future__ import annotations

import json
import logging
import math
import os
import platform
import re
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from afspm import wire
from afspm.basics.addresses import connectable
from afspm.basics.clock import Clock, ExperimentClock
from afspm.basics.errors import AfspmError, WireError
from afspm.basics.launch import Launch, Sockets
from afspm.experiment import Experiment, ProcessStart, Role
from afspm.model import (
    CLOCK_REQUEST,
    RELAY_REQUEST,
    ControlRequest,
    ControlResponse,
    LogLine,
    ProcessState,
    ProcessStates,
    RelayedMessage,
    Request,
    Response,
)
from afspm.model.events import LONGEST_ANNOUNCEMENT, SUPERVISOR, LogLines
from afspm.model.requests import OTHER_RUN_RESPONSE
from afspm.supervisor.supervision.supervisor_events import (
    AskUse,
    EndExperiment,
    EndRefused,
    RestartOrdered,
    SchedulerAnswered,
    UseReported,
)
from afspm.transport import ZmqPort
from afspm.transport.port import ControlConnected, ControlDisconnected, Incoming, ReplyReceived
from afspm.transport.process.context import new_session
from afspm.transport.zmq_port import open_port

STATES_PERIOD_S = 2.0
"""Longest real time between two reports of all states."""
LINES_PERIOD_S = 0.2
"""Shortest real time between two reports of lines."""
RESEND_AFTER_S = 5.0
"""Real time after which a report without an answer is sent again."""
MOST_LINES = 5000
"""Limit on lines that wait for a missing scheduler; the oldest are dropped."""
LONGEST_LINE = 2000
"""Limit on the length of a line, in characters."""
_BATCH_BYTES = LONGEST_ANNOUNCEMENT // 4
_CLOSE_WITHIN_S = 1.0
# each reason is logged once; ever new reasons must not fill the memory
_MOST_FAILURES = 100


@dataclass(frozen=True, slots=True)
class ReportFailed:
    """The event that the scheduler has not accepted a report."""

    text: str


ReporterEvent = RestartOrdered | ReportFailed | SchedulerAnswered | UseReported | EndRefused
_REQUESTS = {AskUse: CLOCK_REQUEST, EndExperiment: int(ControlRequest.END_EXPERIMENT)}


class ReportQueue:
    """A thread-safe queue of the newest process states, and of log lines, to report.

    Args:
        clock: of the experiment.
        name: sender of the line that reports dropped lines.
    """

    def __init__(self, clock: Clock, name: str) -> None:
        self._clock, self._name = clock, name
        self._lock = threading.Lock()
        self._lines: deque[LogLine] = deque()
        self._dropped = 0
        self._states: tuple[ProcessState, ...] = ()
        self._has_changed = False
        self._states_s = self._lines_s = -math.inf

    def put_states(self, states: tuple[ProcessState, ...], *, changed: bool) -> None:
        self._states, self._has_changed = states, self._has_changed or changed

    def put_line(self, name: str, level: str, text: str) -> bool:
        """Append a line; return whether the queue was empty."""
        line = LogLine(self._clock.now_ns(), name, level, text[:LONGEST_LINE])
        with self._lock:
            if len(self._lines) >= MOST_LINES:
                self._lines.popleft()
                self._dropped += 1
            self._lines.append(line)
            return len(self._lines) == 1

    def take(self, supervisor: str) -> ProcessStates | LogLines | None:
        """Return the next report that is due; None if there is none yet."""
        now_s = self._clock.monotonic_s()
        if self._states and (self._has_changed or now_s >= self._states_s + STATES_PERIOD_S):
            self._has_changed, self._states_s = False, now_s
            return ProcessStates(self._clock.now_ns(), supervisor, self._states)
        if self._lines and now_s >= self._lines_s + LINES_PERIOD_S:
            self._lines_s = now_s
            return LogLines(self.take_lines())
        return None

    def take_lines(self) -> tuple[LogLine, ...]:
        """Return the oldest lines, as many as fit into one report, after a line about dropped lines."""
        batch, size = [], 0
        with self._lock:
            if self._dropped:
                what = f"dropped {self._dropped} lines that the scheduler did not take"
                batch.append(LogLine(self._lines[0].time_ns, self._name, "WARNING", what))
                self._dropped = 0
            while self._lines and size < _BATCH_BYTES:
                batch.append(self._lines.popleft())
                size += 4 * len(batch[-1].text) + 100
        return tuple(batch)

    def due_s(self) -> float:
        if self._has_changed:
            return -math.inf
        states_s = self._states_s if self._states else self._clock.monotonic_s()
        lines_s = self._lines_s + LINES_PERIOD_S if self._lines else math.inf
        return min(states_s + STATES_PERIOD_S, lines_s)


class Reporter:
    """A thread that reports states and lines to the scheduler, from `start` to `close`.

    Args:
        launch: launch line for requests to the scheduler; its name is "supervisor:" and the name of this supervisor.
        clock: of the experiment.
        supervisor: name that distinguishes this supervisor from others.

    Attributes:
        post: called with events, in the reporter's thread.
    """

    def __init__(self, launch: Launch, clock: Clock, supervisor: str) -> None:
        self.post: Callable[[ReporterEvent], None] = lambda event: None
        self._launch, self._clock, self._supervisor = launch, clock, supervisor
        self._queue = ReportQueue(clock, launch.name)
        self._is_closing = False
        self._port: ZmqPort | None = None
        self._thread = threading.Thread(target=self._run, name="reporter", daemon=True)
        self._request = _OpenRequest(launch.name, launch.run)
        self._failures: set[str] = set()
        self._asked: deque[int] = deque()

    # --- called by the supervisor, from any thread ---

    def start(self) -> None:
        self._thread.start()

    def states(self, states: tuple[ProcessState, ...], *, changed: bool) -> None:
        """Queue the states of all processes; report them at once if they have `changed`."""
        self._queue.put_states(states, changed=changed)
        if changed:
            self._wake()

    def line(self, name: str, level: int, text: str) -> None:
        """Queue a log line above DEBUG, of a process or the supervisor; `level` is a number of `logging`."""
        if level > logging.DEBUG and self._queue.put_line(name, logging.getLevelName(level), text):
            self._wake()

    def ask(self, wanted: AskUse | EndExperiment) -> None:
        """Queue a request to the scheduler, to be sent before the next report."""
        self._asked.append(_REQUESTS[type(wanted)])
        self._wake()

    def close(self) -> None:
        """Stop reporting. Takes a second at most."""
        self._is_closing = True
        self._wake()
        if self._thread.is_alive():
            self._thread.join(_CLOSE_WITHIN_S)

    def _wake(self) -> None:
        if (port := self._port) is not None:
            port.wake_up()

    # --- in the reporter's thread ---

    def _run(self) -> None:
        try:
            port = open_port(self._launch, ExperimentClock.real())
        except AfspmError as error:
            self._fail(str(error))
            self.post(SchedulerAnswered())  # components must not wait for a scheduler that can't be asked
            return
        try:
            self._port = port
            while not self._is_closing:
                self._send(port)
                for incoming in port.poll(self._timeout_s()):
                    self._receive(incoming)
        finally:
            port.close()

    def _send(self, port: ZmqPort) -> None:
        request, now_s = self._request, self._clock.monotonic_s()
        if not request.connected or (request.sent and now_s < request.sent_s + RESEND_AFTER_S):
            return
        if request.sent is None and self._asked:
            request.open(self._asked.popleft())
        elif request.sent is None and (message := self._queue.take(self._supervisor)) is not None:
            request.open(RELAY_REQUEST, RelayedMessage(*wire.encode(message)))
        sent = request.sent
        if sent is not None:
            request.sent_s = now_s
            port.send(wire.encode_request(sent))

    def _timeout_s(self) -> float:
        request, now_s = self._request, self._clock.monotonic_s()
        if not request.connected:
            return STATES_PERIOD_S
        due_s = request.sent_s + RESEND_AFTER_S if request.sent else now_s if self._asked else self._queue.due_s()
        return max(0.0, due_s - now_s)

    def _receive(self, incoming: Incoming) -> None:
        request = self._request
        if isinstance(incoming, ControlConnected):
            request.connected, request.sent_s = True, -math.inf  # the request may be lost with the old connection
        elif isinstance(incoming, ControlDisconnected):
            request.connected = False
        elif isinstance(incoming, ReplyReceived) and request.sent and incoming.response.id == request.sent.id:
            kind, request.sent = request.sent.kind, None
            if not request.answered and incoming.response.code != OTHER_RUN_RESPONSE:
                request.answered = True
                self.post(SchedulerAnswered())
            self._answered(kind, incoming.response)

    def _answered(self, kind: int, response: Response) -> None:
        if kind == CLOCK_REQUEST:
            if (why := _in_use(response)) is not None:
                self.post(UseReported(why))
            return
        if kind == ControlRequest.END_EXPERIMENT:
            if not response.ok:
                self.post(EndRefused(response.reason))
            return
        if not response.ok:
            self._is_closing = self._is_closing or response.code == ControlResponse.CMD_NOT_SUPPORTED
            self._fail(response.reason)
            return
        try:
            orders = wire.decode_orders(response.payload)
        except WireError as error:
            self._fail(str(error))
            return
        for name in orders:
            self.post(RestartOrdered(name))

    def _fail(self, why: str) -> None:
        if why not in self._failures and len(self._failures) < _MOST_FAILURES:
            self._failures.add(why)
            self.post(ReportFailed(f"the scheduler refused the report on the processes here: {why}"))


class _OpenRequest:
    """The single request whose answer is awaited."""

    def __init__(self, name: str, run: str) -> None:
        self.connected = self.answered = False
        self.sent: Request | None = None
        self.sent_s = -math.inf
        self._name, self._session, self._count = name, new_session(run), 0

    def open(self, kind: int, subject: object = None) -> None:
        self._count += 1
        self.sent = Request(kind, subject, id=f"{self._name}/{self._session}/{self._count}")


def _in_use(response: Response) -> str | None:
    # empty: not in use; None: an older scheduler, which has no such answer
    try:
        answer = json.loads(response.payload) if response.ok else {}
        return str(answer["in_use"])
    except (ValueError, KeyError, TypeError):  # an older scheduler
        return None


_LONGEST_COMPUTER_NAME = 60


def reporter_of(
    experiment: Experiment,
    starts: Sequence[ProcessStart],
    clock: Clock,
    run: str = "",
    keys: Mapping[str, object] | None = None,
) -> Reporter | None:
    """Return a reporter for the processes started here; None if the scheduler is unreachable or not afspm's.

    Args:
        keys: keys made for the reporter; None: the file gives a keys folder, or there are no keys.
    """
    scheduler = next((start for start in starts if start.role is Role.SCHEDULER), None)
    here = computer_name()
    if scheduler is None:
        launch = experiment.asking([start.launch.name for start in starts])
        launch = launch and replace(launch, run=run)
        here = f"{here}-{os.getpid()}"  # several parts may run on one computer
    else:
        launch = _local_launch(scheduler)
    if launch is None:
        return None
    return Reporter(replace(launch, name=f"{SUPERVISOR}:{here}", keys=keys or launch.keys), clock, here)


def computer_name() -> str:
    """Return the name of this computer for the names of supervisors: letters, digits, ".", "_" and "-"."""
    return re.sub(r"[^\w.-]+", "-", platform.node())[:_LONGEST_COMPUTER_NAME] or "computer"


def _local_launch(scheduler: ProcessStart) -> Launch | None:
    launch = scheduler.launch
    if scheduler.command or launch.sockets.serve is None:
        return None
    address, keys = connectable(launch.sockets.serve), launch.keys
    if keys is not None and "folder" in keys:
        keys = {"folder": keys["folder"], address: launch.name}
    return Launch(SUPERVISOR, sockets=Sockets(control=address), keys=keys, run=launch.run)
