"""Tells the scheduler how it is with the processes and what they say, and hears what it orders.

All of it in a thread of its own: the supervisor hands over and goes on, whether the scheduler is there, slow or dead.
"""

from __future__ import annotations

import logging
import math
import os
import platform
import re
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from afspm import wire
from afspm.addresses import connectable
from afspm.clock import Clock, ExperimentClock
from afspm.errors import AfspmError, WireError
from afspm.experiment import Experiment, ProcessStart, Role
from afspm.launch import Launch, Sockets
from afspm.logic.supervision.supervisor_events import RestartOrdered, SchedulerAnswered
from afspm.logic.supervisor_registry import LONGEST, SUPERVISOR
from afspm.model import (
    OTHER_RUN_RESPONSE,
    RELAY_REQUEST,
    ControlResponse,
    LogLine,
    LogLines,
    ProcessState,
    ProcessStates,
    RelayedMessage,
    Request,
    Response,
)
from afspm.process.context import new_session
from afspm.transport.port import ControlConnected, ControlDisconnected, Incoming, ReplyReceived
from afspm.transport.zmq_port import ZmqPort, open_port

STATES_S = 2.0
"""Real time between two times that all states are told, at most."""
LINES_S = 0.2
"""Real time between two times that lines are told, at least."""
AGAIN_S = 5.0
"""Real time after which what is not answered is told again."""
MOST_LINES = 5000
"""So many lines wait for a scheduler that is not there; of more the oldest are left out."""
LONGEST_LINE = 2000
"""Characters."""
_BATCH_BYTES = LONGEST // 4
_CLOSED_S = 1.0


@dataclass(frozen=True, slots=True)
class ReportFailed:
    """The scheduler can't be told."""

    text: str


ReporterEvent = RestartOrdered | ReportFailed | SchedulerAnswered


class Reporter:
    """Begins to tell with `start`, ends with `close`.

    Args:
        launch: how the scheduler is asked; its name is "supervisor:" and what tells this supervisor from others.
        clock: of the experiment.
        supervisor: what tells this supervisor from others.

    Attributes:
        post: called with news, in the reporter's thread.
    """

    def __init__(self, launch: Launch, clock: Clock, supervisor: str) -> None:
        self.post: Callable[[ReporterEvent], None] = lambda news: None
        self._launch = launch
        self._clock = clock
        self._supervisor = supervisor
        self._lock = threading.Lock()
        self._lines: deque[LogLine] = deque()
        self._left_out = 0
        self._states: tuple[ProcessState, ...] = ()
        self._is_new = False
        self._closing = False
        self._port: ZmqPort | None = None
        self._thread = threading.Thread(target=self._run, name="reporter", daemon=True)
        self._talk = _Talk(launch.name, launch.run)
        self._states_s = self._lines_s = -math.inf
        self._complaints: set[str] = set()

    # --- of the supervisor, any thread ---

    def start(self) -> None:
        """Begin to tell."""
        self._thread.start()

    def states(self, states: tuple[ProcessState, ...], *, changed: bool) -> None:
        """Take the states of all processes; report them at once if they have `changed`."""
        self._states, self._is_new = states, self._is_new or changed
        if changed:
            self._wake()

    def line(self, name: str, level: int, text: str) -> None:
        """A process, or the supervisor itself, said something; `level` is that of `logging`."""
        if level <= logging.DEBUG:
            return
        line = LogLine(self._clock.now_ns(), name, logging.getLevelName(level), text[:LONGEST_LINE])
        with self._lock:
            if len(self._lines) >= MOST_LINES:
                self._lines.popleft()
                self._left_out += 1
            self._lines.append(line)
            is_first = len(self._lines) == 1
        if is_first:
            self._wake()

    def close(self) -> None:
        """Tell no more. Takes a second at most."""
        self._closing = True
        self._wake()
        if self._thread.is_alive():
            self._thread.join(_CLOSED_S)

    def _wake(self) -> None:
        if (port := self._port) is not None:
            port.wake_up()

    # --- of its own thread ---

    def _run(self) -> None:
        try:
            port = open_port(self._launch, ExperimentClock.real())
        except AfspmError as error:
            self._complain(str(error))
            self.post(SchedulerAnswered())  # or not: there is no asking
            return
        try:
            self._port = port
            while not self._closing:
                self._tell(port)
                for incoming in port.poll(self._timeout_s()):
                    self._hear(incoming)
        finally:
            port.close()

    def _tell(self, port: ZmqPort) -> None:
        """Ask again, or what comes next, if it is time for either."""
        talk, now_s = self._talk, self._clock.monotonic_s()
        if not talk.connected:
            return
        if talk.asked is None:
            thing = self._next(now_s)
            if thing is None:
                return
            talk.ask(thing)
        elif now_s < talk.asked_s + AGAIN_S:
            return
        assert talk.asked is not None
        talk.asked_s = now_s
        port.send(wire.encode_request(talk.asked))

    def _next(self, now_s: float) -> ProcessStates | LogLines | None:
        if self._states and (self._is_new or now_s >= self._states_s + STATES_S):
            self._is_new, self._states_s = False, now_s
            return ProcessStates(self._clock.now_ns(), self._supervisor, self._states)
        if self._lines and now_s >= self._lines_s + LINES_S:
            self._lines_s = now_s
            return LogLines(self._some_lines())
        return None

    def _some_lines(self) -> tuple[LogLine, ...]:
        some, size = [], 0
        with self._lock:
            if self._left_out:
                what = f"{self._left_out} lines are left out here: the scheduler did not take them"
                some.append(LogLine(self._lines[0].time_ns, self._launch.name, "WARNING", what))
                self._left_out = 0
            while self._lines and size < _BATCH_BYTES:
                some.append(self._lines.popleft())
                size += 4 * len(some[-1].text) + 100
        return tuple(some)

    def _timeout_s(self) -> float:
        talk, now_s = self._talk, self._clock.monotonic_s()
        if not talk.connected:
            return STATES_S
        if talk.asked is not None:
            return max(0.0, talk.asked_s + AGAIN_S - now_s)
        due_s = self._states_s + STATES_S if self._states else now_s + STATES_S
        if self._lines:
            due_s = min(due_s, self._lines_s + LINES_S)
        return 0.0 if self._is_new else max(0.0, due_s - now_s)

    def _hear(self, incoming: Incoming) -> None:
        talk = self._talk
        if isinstance(incoming, ControlConnected):
            talk.connected, talk.asked_s = True, -math.inf  # what was asked may be lost
        elif isinstance(incoming, ControlDisconnected):
            talk.connected = False
        elif isinstance(incoming, ReplyReceived) and talk.is_answer(incoming.response):
            talk.asked = None
            if not talk.answered and incoming.response.code != OTHER_RUN_RESPONSE:
                talk.answered = True
                self.post(SchedulerAnswered())
            self._answered(incoming.response)

    def _answered(self, response: Response) -> None:
        if not response.ok:
            self._closing = self._closing or response.code == ControlResponse.CMD_NOT_SUPPORTED
            self._complain(response.reason)
            return
        try:
            orders = wire.decode_orders(response.payload)
        except WireError as error:
            self._complain(str(error))
            return
        for name in orders:
            self.post(RestartOrdered(name))

    def _complain(self, why: str) -> None:
        if why not in self._complaints and len(self._complaints) < 100:
            self._complaints.add(why)
            self.post(ReportFailed(f"the scheduler is not told how it is with the processes here: {why}"))


class _Talk:
    """The question that is open, of which there is one at a time."""

    def __init__(self, name: str, run: str) -> None:
        self.connected = self.answered = False
        self.asked: Request | None = None
        self.asked_s = -math.inf
        self._name, self._session, self._count = name, new_session(run), 0

    def ask(self, thing: ProcessStates | LogLines) -> None:
        self._count += 1
        told = RelayedMessage(*wire.encode(thing))
        self.asked = Request(RELAY_REQUEST, told, id=f"{self._name}/{self._session}/{self._count}")

    def is_answer(self, response: Response) -> bool:
        return self.asked is not None and response.id == self.asked.id


_LONGEST_COMPUTER_NAME = 60


def reporter_of(
    experiment: Experiment,
    starts: Sequence[ProcessStart],
    clock: Clock,
    run: str = "",
    keys: Mapping[str, Any] | None = None,
) -> Reporter | None:
    """One for what is started here; None where the scheduler can't be asked, or is perhaps none of ours.

    Args:
        keys: that were made for it; None: the file says where they are, or there are none.
    """
    scheduler = next((start for start in starts if start.role is Role.SCHEDULER), None)
    here = re.sub(r"[^\w.-]+", "-", platform.node())[:_LONGEST_COMPUTER_NAME] or "computer"
    if scheduler is None:
        launch = experiment.asking([start.launch.name for start in starts])
        launch = launch and replace(launch, run=run)
        here = f"{here}-{os.getpid()}"  # there may be several parts on one computer
    else:
        launch = _local(scheduler)
    if launch is None:
        return None
    return Reporter(replace(launch, name=f"{SUPERVISOR}:{here}", keys=keys or launch.keys), clock, here)


def _local(scheduler: ProcessStart) -> Launch | None:
    """Return how a scheduler is asked that is started here."""
    launch = scheduler.launch
    if scheduler.command or launch.sockets.serve is None:
        return None
    address, keys = connectable(launch.sockets.serve), launch.keys
    if keys is not None and "folder" in keys:
        keys = {"folder": keys["folder"], address: launch.name}
    return Launch(SUPERVISOR, sockets=Sockets(control=address), keys=keys, run=launch.run)
