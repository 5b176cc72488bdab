"""A laboratory in memory: one port, a scheduler with the real decision table, and a microscope, on a fake clock."""

from __future__ import annotations

import heapq
import itertools
import logging
import signal
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from afspm import wire
from afspm.basics.clock import NeverLate
from afspm.basics.launch import Launch, Sockets
from afspm.client.component import Component
from afspm.client.experiment_link import ExperimentLink
from afspm.client.scope import Scope
from afspm.model import (
    RELAY_REQUEST,
    ControlRequest,
    ControlResponse,
    ControlState,
    Feedback,
    Packet,
    Parameter,
    ProbePosition,
    ProblemNames,
    Region,
    RelayedMessage,
    Request,
    Response,
    Scan,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    Spectrum,
)
from afspm.model.requests import LEND_REQUEST, RETURN_REQUEST, Settings
from afspm.model.state import FeedbackUnits
from afspm.scheduler.control import arbitration as a
from afspm.simulation.simulator import Simulator
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
from afspm.transport.process.context import ProcessActivity, ProcessContext

T = TypeVar("T")
SOURCE = "memory://scheduler"
PROBLEMS = ProblemNames({f"other-{number}": number for number in range(11, 20)})
EPOCH_S = 1_700_000_000.0
SCAN_S = 100.0
REGION = Region((0.0, 0.0), (1e-6, 1e-6))
OTHER_REGION = Region((5e-6, 0.0), (1e-6, 1e-6))


class FakeClock(NeverLate):
    """A clock that only the test moves."""

    def __init__(self) -> None:
        self.passed_s = 0.0

    def now_ns(self) -> int:
        return round((EPOCH_S + self.passed_s) * 1e9)

    def now_s(self) -> float:
        return EPOCH_S + self.passed_s

    def monotonic_s(self) -> float:
        return self.passed_s

    def real_s(self, experiment_s: float) -> float:
        return experiment_s


class Nothing(AssertionError):
    """The component waits for an event that will never come."""


class Lab:
    """A laboratory whose events are in the order of time; `poll` moves the clock to the next event.

    Attributes:
        bases: the values before those that were lent.
        most_at_once: number of events that a poll returns, with answers before packets, as from real sockets; None:
            all, in their order.
    """

    def __init__(self, name: str = "experiment") -> None:
        self.name = name
        self.clock = FakeClock()
        self.control = a.ArbitrationState()
        self.state = ScopeState.FREE
        self.parameters = ScanParameters(OTHER_REGION, (8, 8))
        self.position = ProbePosition((0.0, 0.0))
        self.values: dict[str, str] = {"tip-bias-voltage": "0.5"}
        self.bases: dict[str, str] = {}
        self.channels: tuple[str, ...] = ("Height", "Phase")
        self.executed: list[str] = []
        self.requests: list[Request] = []
        self.published: list[tuple[str, bytes]] = []
        self.answers: dict[str, Response] = {}
        self.intercept: Callable[[Request], Response | str | None] = lambda request: "go on"
        self.begun_scans = 0
        self.finished: list[Region] = []
        self.cached: dict[str, Packet] = {}
        self.happenings: list[tuple[float, int, Callable[[], object]]] = []
        self._numbers = itertools.count()
        self.inbox: list[Incoming] = []
        self.lost: list[Any] = []
        self._newest_ns = 0
        self.most_at_once: int | None = None
        self.open = True
        self.connect()
        self.publish(Simulator.declared_channels({"feedback": {"mode": "amplitude"}}).with_topography(feedback_on=True))
        self.publish(FeedbackUnits(setpoint="V"))
        self.publish(ScopeStatus(self.state))
        self.publish(self.parameters)
        self.publish(self.position)
        self.publish(self.control.published())
        self.inbox.append(CaughtUp(SOURCE))

    # --- the port ---

    def send(self, frames: Sequence[bytes]) -> None:
        request = wire.decode_request(frames)
        self.requests.append(request)
        answer = self.intercept(request)
        if answer == "go on":
            answer = self.answer_once(request)
        if isinstance(answer, Response):
            answer.id = request.id
            if self.most_at_once is None:
                self.at(0.01, lambda: self.inbox.append(ReplyReceived(answer)))
            else:  # a socket of its own: the answer waits for no packet
                self.inbox.insert(0, ReplyReceived(answer))

    def poll(self, timeout_s: float | None) -> list[Incoming]:
        until_s = None if timeout_s is None else self.clock.passed_s + timeout_s
        self._is_woken = False
        while not self.inbox and not self._is_woken:
            if not self.happenings:
                if until_s is None:
                    raise Nothing
                self.clock.passed_s = max(until_s, self.clock.passed_s)
                break
            if until_s is not None and self.happenings[0][0] > until_s:
                self.clock.passed_s = max(until_s, self.clock.passed_s)
                break
            at_s, _, happen = heapq.heappop(self.happenings)
            self.clock.passed_s = max(at_s, self.clock.passed_s)
            happen()
        found, self.inbox = self.inbox[: self.most_at_once], self.inbox[len(self.inbox[: self.most_at_once]) :]
        return found

    def publish_out(self, envelope: str, payload: bytes) -> None:
        self.published.append((envelope, payload))

    def close(self) -> None:
        self.open = False

    # --- what can be made to happen ---

    def at(self, in_s: float, happen: Callable[[], object]) -> None:
        heapq.heappush(self.happenings, (self.clock.passed_s + in_s, next(self._numbers), happen))

    def publish(self, thing: Any, envelope: str | None = None) -> Packet:
        message, payload = wire.encode(thing)
        self._newest_ns = max(self._newest_ns + 1, self.clock.now_ns())
        packet = Packet(envelope or message, payload, self._newest_ns)
        self.cached[f"{message}-{getattr(thing, 'channel', '')}"] = packet
        self.inbox.append(PacketReceived(packet, SOURCE))
        return packet

    def request_since(self, since_ns: int) -> None:
        """Bring the lost packets that are newer and kept."""
        found = [one for one in self.lost if (one.packet.time_ns or 0) > since_ns]
        self.at(0.01, lambda: self.inbox.extend(found))
        self.lost.clear()

    def answer_now(self, response: Response) -> None:
        """Send an answer that `intercept` withheld."""
        self.inbox.append(ReplyReceived(response))

    def connect(self) -> None:
        self.inbox.append(ControlConnected())

    def wake_up(self) -> None:
        """End the present `poll`."""
        self._is_woken = True

    def ctrl_c(self) -> None:
        """Interrupt as the user does, which ends the present `poll`."""
        self.wake_up()
        signal.raise_signal(signal.SIGINT)

    def disconnect(self) -> None:
        self.inbox.append(ControlDisconnected())

    def kill(self) -> None:
        self.inbox.append(Killed())

    def parent_goes(self) -> None:
        self.inbox.append(ParentGone())

    def does(self, event: a.ArbitrationEvent, who: str, number: int = 0) -> Response:
        """Send a request of another component to the scheduler."""
        ask = a.ControlInput(event, who, number)
        rules = a.Rules(problems=PROBLEMS)
        row = a.row_for(self.control, ask, rules)
        reason = a.reason(row, self.control, ask, rules)
        before, self.control = self.control, a.apply(row, self.control, ask)
        if self.control.published() != before.published():
            self.publish(self.control.published())
            if before.holder is not None and self.control.holder is None and row.cause is not a.Cause.RELEASED:
                self.stop()
        if self.control.ended:
            self.kill()
        return Response(int(row.response or 0), reason=reason)

    def flag(self, problem: int) -> None:
        self.does(a.ArbitrationEvent.FLAG, "classifier", problem)

    def clear(self, problem: int) -> None:
        self.does(a.ArbitrationEvent.CLEAR, "corrector", problem)

    def set_mode(self, mode: int) -> None:
        self.does(a.ArbitrationEvent.SET_MODE, "person", mode)

    def stop(self) -> None:
        """Stop what the microscope is doing."""
        if self.state in (ScopeState.SCANNING, ScopeState.SPEC):
            self.go(ScopeState.INTERRUPTED)
            self.go(ScopeState.FREE)

    def restart_translator(self) -> None:
        """Drop the running measurement without a state."""
        self.go(ScopeState.FREE)

    def begin_unheard(self, region: Region, in_s: float, asked: str = "start-scan") -> None:
        """Kill the translator at the start of a scan of `region`, and restart it with the scan `in_s` later."""
        back_s = self.clock.passed_s + in_s

        def dies(request: Request) -> Response | str:
            if request.subject != asked or self.clock.passed_s >= back_s:
                return "go on"
            if request.id not in self.answers:
                self.begun_scans += 1
                self.answers[request.id] = Response(ControlResponse.SUCCESS)
            return Response(ControlResponse.NO_RESPONSE, reason="the translator is not connected")

        def back() -> None:
            self.go(ScopeState.SCANNING)
            self.publish_scan(region)
            self.go(ScopeState.FREE)

        self.intercept = dies
        self.at(in_s, back)

    def publish_scan(self, region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        for channel in self.channels:
            self.publish(Scan(region, channel, "m", np.zeros(shape), self.clock.now_ns()))

    def replay(self) -> list[Incoming]:
        """Return the packets for a component that starts now."""
        packets = sorted(self.cached.values(), key=lambda packet: packet.time_ns or 0)
        return [ControlConnected(), *(PacketReceived(p, SOURCE) for p in packets), CaughtUp(SOURCE)]

    def restart_component(self) -> None:
        """Kill the component: its unread packets are lost, and the cache is sent again."""
        self.inbox = self.replay()

    def count(self, kind: int) -> int:
        return sum(request.kind == kind for request in self.requests)

    def told(self, message: str) -> list[RelayedMessage]:
        """Return the relayed messages of one kind."""
        relayed = [request.subject for request in self.requests if request.kind == RELAY_REQUEST]
        return [one for one in relayed if one.message == message]

    # --- scheduler and microscope ---

    def answer_once(self, request: Request) -> Response:
        if request.id and request.id in self.answers:
            return self.answers[request.id]
        response = self.answers[request.id] = self.answer(request)
        return response

    def answer(self, request: Request) -> Response:
        asks: Mapping[int, a.ArbitrationEvent] = {
            ControlRequest.REQUEST_CTRL: a.ArbitrationEvent.REQUEST_CONTROL,
            ControlRequest.RELEASE_CTRL: a.ArbitrationEvent.RELEASE_CONTROL,
            ControlRequest.ADD_EXP_PRBLM: a.ArbitrationEvent.FLAG,
            ControlRequest.RMV_EXP_PRBLM: a.ArbitrationEvent.CLEAR,
            ControlRequest.SET_CONTROL_MODE: a.ArbitrationEvent.SET_MODE,
            ControlRequest.END_EXPERIMENT: a.ArbitrationEvent.END,
        }
        if request.kind in asks:
            return self.does(asks[request.kind], self.name, request.subject or 0)
        if request.kind == RELAY_REQUEST:
            return Response(ControlResponse.SUCCESS)
        if request.kind == RETURN_REQUEST:
            for name in [one.name for one in request.subject.parameters] or [*self.bases]:
                self.values[name] = self.bases.pop(name, self.values[name])
            return Response(ControlResponse.SUCCESS)
        reads = request.kind == ControlRequest.PARAM and request.subject.value is None
        if self.control.holder != self.name and not reads and request.kind != ControlRequest.ACTION_SUPPORT:
            return Response(ControlResponse.NOT_IN_CONTROL, reason="you are not in control")
        if request.subject in ("stop-scan", "stop-spec"):
            self.stop()
            return Response(ControlResponse.SUCCESS)
        if self.state is not ScopeState.FREE and not reads:
            return Response(ControlResponse.NOT_FREE)
        return self.execute(request)

    def execute(self, request: Request) -> Response:
        match request.kind, request.subject:
            case ControlRequest.SET_SCAN_PARAMS, ScanParameters() as wanted:
                self.parameters = ScanParameters(
                    wanted.region or self.parameters.region, wanted.shape or self.parameters.shape
                )
                self.move(self.parameters)
            case ControlRequest.SET_PROBE_POS, ProbePosition() as position:
                self.position = position
                self.move(position)
            case ControlRequest.SET_ZCTRL_PARAMS, Feedback() as feedback:
                self.publish(feedback)
            case ControlRequest.ACTION, "start-scan":
                self._start(ScopeState.SCANNING, self.finish_scan)
            case ControlRequest.ACTION, "start-spec":
                self._start(ScopeState.SPEC, self.finish_spectrum)
            case ((ControlRequest.ACTION | ControlRequest.ACTION_SUPPORT), "x-crash"):
                return Response(ControlResponse.ACTION_NOT_SUPPORTED, reason="no such action")
            case kind, Settings() as wanted if kind == LEND_REQUEST:
                for one in wanted.parameters:
                    self.bases.setdefault(one.name, self.values[one.name])
                    self.values[one.name] = one.value or ""
                return Response(0, wire.encode(wanted)[1])
            case ControlRequest.PARAM, Parameter(name, value, unit):
                if value is not None:
                    self.values[name] = value
                elif name.removesuffix(".now") not in self.values:
                    return Response(ControlResponse.PARAM_NOT_SUPPORTED, reason=f"no parameter {name}")
                return Response(0, wire.encode(Parameter(name, self.values[name.removesuffix(".now")], unit or "V"))[1])
        self.executed.append(request.id)
        return Response(ControlResponse.SUCCESS)

    def move(self, thing: Any) -> None:
        self.go(ScopeState.MOVING)
        self.publish(thing)
        self.state = ScopeState.MOVING
        self.at(1.0, lambda: self.go(ScopeState.FREE))

    def go(self, state: ScopeState) -> None:
        self.state = state
        self.publish(ScopeStatus(state))

    def _start(self, state: ScopeState, finish: Callable[[], None]) -> None:
        self.begun_scans += 1
        mine = self.begun_scans
        self.go(state)

        def end() -> None:
            if self.state is state and self.begun_scans == mine:
                finish()
                self.go(ScopeState.FREE)

        self.at(SCAN_S, end)

    def finish_scan(self) -> None:
        assert isinstance(self.parameters.region, Region)
        assert isinstance(self.parameters.shape, tuple)
        self.finished.append(self.parameters.region)
        self.publish_scan(self.parameters.region, self.parameters.shape)

    def finish_spectrum(self) -> None:
        values, kind = np.zeros((3, 2)), self.values.get("x-spec-kind") or "IV"
        self.publish(Spectrum(self.position.xy_m, kind, ("U", "I"), ("V", "A"), values, self.clock.now_ns()))


class Kill9(BaseException):
    """The component is killed in the middle of its work."""


class LabPort:
    """The port of the laboratory for one life of a component.

    After a kill, at a call to the network or from outside, nothing that it sends arrives.

    Args:
        deadly_call: number of the call that kills it.
        is_late: whether this call still does its work.
    """

    def __init__(self, lab: Lab, deadly_call: int = 0, *, is_late: bool = False) -> None:
        self._lab = lab
        self.clock = lab.clock
        self.calls = 0
        self.is_dead = False
        self._deadly_call, self._is_late = deadly_call, is_late

    def send(self, frames: Sequence[bytes]) -> None:
        self._live(lambda: self._lab.send(frames))

    def poll(self, timeout_s: float | None) -> list[Incoming]:
        return self._live(lambda: self._lab.poll(timeout_s))

    def publish(self, envelope: str, payload: bytes) -> None:
        self._lab.publish_out(envelope, payload)

    def request_since(self, since_ns: int) -> None:
        self._lab.request_since(since_ns)

    def close(self) -> None:
        self._lab.close()

    def wake_up(self, incoming: Incoming | None = None) -> None:
        assert incoming is None
        self._lab.wake_up()

    def wakeup_fileno(self) -> int:
        return -1

    def _live(self, work: Callable[[], T]) -> T:
        self.calls += 1
        is_struck = self.calls == self._deadly_call
        if self.is_dead or (is_struck and not self._is_late):
            self.is_dead = True
            raise Kill9
        done = work()
        if is_struck or self.is_dead:
            self.is_dead = True
            raise Kill9
        return done


def context_of(lab: Lab, state_dir: Path | None = None, **launch: Any) -> ProcessContext:
    """Return the host's context for a component in this laboratory."""
    return ProcessContext(
        Launch(lab.name, sockets=Sockets(subscribe=(SOURCE,)), state_dir=str(state_dir or ""), **launch),
        lab.clock,
        open_port=lambda: LabPort(lab),
        log=logging.getLogger("afspm.test"),
        activity=ProcessActivity(lab.clock),
    )


def run(component: Component, lab: Lab, state_dir: Path | None = None, **launch: Any) -> int:
    """Run a component to its end."""
    return component.run_process(context_of(lab, state_dir, **launch))


def state_of(lab: Lab) -> ControlState:
    return lab.control.published()


def scope_of(lab: Lab, folder: Path | None = None, life: int = 0, port: LabPort | None = None) -> Scope:
    """Return the scope of a life of the lab's component."""
    return Scope(ExperimentLink(port or LabPort(lab), lab.name, source=SOURCE, session=str(life)), state_dir=folder)
