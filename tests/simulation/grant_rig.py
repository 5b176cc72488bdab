"""An agent, a scheduler and a microscope in one process and in one thread, on simulated time.

The scheduler's decisions and the wire format are the real ones. The network is a function call that may lose
a request or its answer, and the scheduler may die before or after it. `Watchman` stands at the microscope, and knows of
approvals only what persons were answered: it decides by its own few lines whether a request may arrive.
"""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from fake_clock import FakeClock

from afspm import wire
from afspm.basics.errors import WireError
from afspm.model import (
    CLOCK_REQUEST,
    GRANT_REQUEST,
    LEASE_REQUEST,
    STOPPED_BY_AGENT,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Grant,
    LoggedPacket,
    Packet,
    Parameter,
    ProbePosition,
    ProblemNames,
    Region,
    Request,
    Response,
    Scan,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    Spectrum,
    component_of,
    names,
)
from afspm.model.problems import HIGHEST_PROBLEM
from afspm.model.snapshot import restored, snapshot
from afspm.scheduler import events
from afspm.scheduler.control.arbitration import RoleTable
from afspm.scheduler.safety.limits import ExperimentLimits, Limit, RoleLimits
from afspm.scheduler.saved_state import KIND, VERSION, SavedState
from afspm.scheduler.scheduler_core import SchedulerCore
from afspm.scheduler.settings import ControlSettings, RunFacts, SchedulerSettings
from afspm.scheduler.wire_codec import WireCodec

AGENT, ADA, STOP = "agent:claude", "dashboard:Ada", HIGHEST_PROBLEM
OK = int(ControlResponse.SUCCESS)
UM = 1e-6
ROLE_REGION_M = 2 * UM
"""Half of the side of the role's region."""
ROLE_BIAS_V = 1.0
ROLE_SCANS = 30
STOPS = (names.STOP_SCAN, names.STOP_SPEC)
_START_NS = 1_750_000_000 * 10**9
_ROLE = RoleLimits(
    ExperimentLimits(
        parameters={names.TIP_BIAS_VOLTAGE: Limit(-ROLE_BIAS_V, ROLE_BIAS_V, unit="V")},
        region=Region((0.0, 0.0), (2 * ROLE_REGION_M, 2 * ROLE_REGION_M)),
    ),
    parameters_only=True,
    actions=(names.START_SCAN, names.START_SPEC),
    per_hour={names.START_SCAN: ROLE_SCANS},
)


def settings() -> SchedulerSettings:
    control = ControlSettings(agents=("agent",), roles=RoleTable(operate=("dashboard",), approve=("dashboard",)))
    rules = control.rules(ProblemNames({STOPPED_BY_AGENT: STOP}))
    limits = ExperimentLimits(parameters={names.TIP_BIAS_VOLTAGE: Limit(-5.0, 5.0, unit="V")}, roles={"agent": _ROLE})
    return SchedulerSettings(
        control=control, rules=rules, watchdog=control.watchdog(), limits=limits, run=RunFacts(name="")
    )


class AgentViolation(AssertionError):
    """A request of the agent reached the microscope that no person had approved."""


@dataclass
class Approved:
    """An approval as a person was answered."""

    grant: Grant
    until_ns: int
    step: int = 0
    used: dict[str, int] = field(default_factory=dict)


class Watchman:
    """Decides by itself whether a request of the agent may reach the microscope."""

    def __init__(self, rig: GrantRig) -> None:
        self._rig = rig
        self.plan: Approved | None = None
        self.grant: Approved | None = None
        self.stopped = False
        self.lease_s = 60.0
        self.alive_s = -math.inf
        self.seen: dict[str, tuple[int, bytes, str, int]] = {}
        self.started_ns: list[int] = []
        self.checked = 0
        self.disturbed_ns = 0

    def approved(self, grant: Grant, now_ns: int) -> None:
        held = Approved(grant, now_ns + round(grant.lasts_s * 1e9))
        is_fresh = self.disturbed_ns < grant.since_ns and now_ns - grant.since_ns <= 3600 * 10**9
        if not (grant.revokes or is_fresh):
            raise AgentViolation(f"a stale approval was accepted: {grant}")
        if grant.revokes:
            self.plan = self.grant = None
        elif grant.plan:
            self.plan = held
        else:
            self.grant = held

    def disturbed(self, now_ns: int, *, manual: bool, stopped: bool) -> None:
        self.plan, self.disturbed_ns = None, now_ns
        if manual or stopped:
            self.grant = None

    def control_lost(self) -> None:
        if self.plan is not None and self.plan.step:
            self.plan = None
        self.lease_s = 60.0

    def may_arrive(self, request: Request) -> None:
        """Raise AgentViolation if it may not."""
        rig = self._rig
        self.checked += 1
        holder, subject = rig.core.control.holder, request.subject
        self._must(holder == AGENT, f"{holder} is in control", request)
        self._must(rig.core.control.mode is ControlMode.AUTOMATED, "the mode is MANUAL", request)
        self._must(not self.stopped, "the agent has stopped the experiment", request)
        self._must(rig.clock.t_s <= self.alive_s + self.lease_s + 1e-6, "the lease has ended", request)
        self.alive_s = rig.clock.t_s
        known = self.seen.get(request.id)
        if known is not None:
            self._must(known[:2] == (request.kind, request.payload), "an id with another content", request)
            return
        if request.kind == ControlRequest.ACTION and subject in STOPS:
            return
        self._within_role(request)
        by = "plan" if self._is_next_step(request) else "grant"
        if by == "plan":
            assert self.plan is not None
            self.plan.step += 1
        else:
            self._within_grant(request)
        self.seen[request.id] = (request.kind, request.payload, by, rig.now_ns)
        if subject == names.START_SCAN:
            self.started_ns.append(rig.now_ns)

    def may_arrive_again(self, request: Request) -> None:
        """Raise AgentViolation if an id of the last hour, known to scheduler and microscope, is of another request."""
        known = self.seen.get(request.id)
        if known is not None and self._rig.now_ns - known[3] < 3600 * 10**9:
            self._must(known[:2] == (request.kind, request.payload), "an id with another content", request)

    def not_done(self, request: Request) -> None:
        """Take back a request that the microscope refused."""
        if (seen := self.seen.pop(request.id, None)) is None:
            return
        if seen[2] == "plan" and self.plan is not None:
            self.plan.step -= 1
        elif self.grant is not None and request.kind == ControlRequest.ACTION:
            self.grant.used[request.subject] = self.grant.used.get(request.subject, 0) - 1
        if request.subject == names.START_SCAN:
            self.started_ns.pop()

    def _is_next_step(self, request: Request) -> bool:
        plan = self.plan
        if plan is None or plan.until_ns <= self._rig.now_ns or plan.step >= len(plan.grant.steps):
            return False
        step = plan.grant.steps[plan.step]
        return (step.request, step.payload) == (request.kind, request.payload)

    def _within_role(self, request: Request) -> None:
        subject = request.subject
        self._must(all(abs(one) <= ROLE_REGION_M * 1.001 for one in _corners(subject)), "outside the role", request)
        if isinstance(subject, Parameter):
            self._must(subject.name == names.TIP_BIAS_VOLTAGE, "a parameter outside the role", request)
            self._must(abs(_volts(subject)) <= ROLE_BIAS_V, "a bias outside the role", request)
        if request.kind == ControlRequest.ACTION:
            self._must(subject in (names.START_SCAN, names.START_SPEC), "an action outside the role", request)
            lately = [one for one in self.started_ns if self._rig.now_ns - one < 3600 * 10**9]
            self._must(subject != names.START_SCAN or len(lately) < ROLE_SCANS, "too many scans in an hour", request)
            at = self._rig.region if subject == names.START_SCAN else ProbePosition(self._rig.probe_m)
            self._must(all(abs(one) <= ROLE_REGION_M * 1.001 for one in _corners(at)), "it stands outside", request)

    def _within_grant(self, request: Request) -> None:
        held = self.grant
        self._must(held is not None and held.until_ns > self._rig.now_ns, "there is no approval", request)
        plan = self.plan
        is_between = plan is not None and 0 < plan.step < len(plan.grant.steps) and plan.until_ns > self._rig.now_ns
        self._must(not is_between, "between two steps of a plan", request)
        assert held is not None
        grant, subject = held.grant, request.subject
        if request.kind == ControlRequest.ACTION:
            most = next((one.count for one in grant.counts if one.action == subject), 0)
            held.used[subject] = held.used.get(subject, 0) + 1
            self._must(held.used[subject] <= most, "more often than granted", request)
            at = self._rig.region if subject == names.START_SCAN else ProbePosition(self._rig.probe_m)
            self._must(_is_inside(grant, at), "it stands outside of the grant", request)
        elif isinstance(subject, Parameter):
            low, high = next(((o.low, o.high) for o in grant.ranges if o.parameter == subject.name), (1.0, 0.0))
            self._must(low - 1e-9 <= _volts(subject) <= high + 1e-9, "a value outside of the grant", request)
        else:
            is_place = isinstance(subject, ScanParameters | ProbePosition)
            is_shape = isinstance(subject, ScanParameters) and subject.region is None and bool(grant.region_m)
            is_within = is_shape or _is_inside(grant, subject)
            self._must(is_place and is_within, "a place outside of the grant", request)

    def _must(self, holds: bool, why: str, request: Request) -> None:
        if not holds:
            raise AgentViolation(f"{why}: {request}")


def _volts(parameter: Parameter) -> float:
    scale = {"V": 1.0, "mV": 1e-3, None: 1.0}.get(parameter.unit, math.nan)
    return float(parameter.value or "nan") * scale


def _corners(subject: object) -> list[float]:
    region = subject.region if isinstance(subject, ScanParameters) else subject
    if isinstance(region, Region):
        return [float(one) for corner in region.corners_m() for one in corner]
    return list(subject.xy_m) if isinstance(subject, ProbePosition) else []


def _is_inside(grant: Grant, subject: object) -> bool:
    if not grant.region_m:
        return False
    x, y, width, height = grant.region_m
    corners = _corners(subject)
    points = list(zip(corners[::2], corners[1::2], strict=True))
    return bool(points) and all(abs(a - x) <= width / 2 * 1.001 and abs(b - y) <= height / 2 * 1.001 for a, b in points)


class _Link:
    """The connection of one name: `ExperimentLink`, as far as a person's commands need it."""

    def __init__(self, rig: GrantRig, name: str) -> None:
        self._rig, self.name, self.clock = rig, name, rig.clock
        self._requests = 0

    def pump(self, timeout_s: float) -> None: ...

    def until(self, within_s: float) -> float:
        return self.clock.t_s + within_s

    def request(self, kind: int, subject: Any = None, *, request_id: str = "", until_s: float = 0.0) -> Response:
        self._requests += 1
        return self._rig.request(self.name, Request(int(kind), subject, b"", request_id or self._id()))

    def _id(self) -> str:
        return f"{self.name}/{self._rig.life}/{self._requests}"


class GrantRig:
    """The whole. Everything follows from the seed and the calls."""

    def __init__(
        self, seed: int = 1, *, loses: float = 0.0, kills: float = 0.0, texts: Callable[[str], str] = str
    ) -> None:
        self.random = random.Random(seed)
        self.clock = FakeClock(_START_NS / 1e9)
        self.settings, self.codec = settings(), WireCodec()
        self.loses, self.kills, self.texts = loses, kills, texts
        self.life = "a"
        self.effects: list[str] = []
        self.done: dict[str, Response] = {}
        self.region, self.probe_m = Region((4 * UM, 0.0), (UM, UM)), (4 * UM, 0.0)
        self.values = {names.TIP_BIAS_VOLTAGE: "0.0", names.SCAN_SPEED: "2e-06"}
        self.not_free = 0.0
        self.log: list[LoggedPacket] = []
        self.saved: SavedState | None = None
        self.kills_done = 0
        self.watchman = Watchman(self)
        self.links: dict[str, _Link] = {}
        self.connections: dict[str, int] = {}
        self.newest = 0
        self.core = SchedulerCore(self.settings, self.codec)
        self._queue: list[events.Effect] = []
        self.prepare()
        self._start()

    def prepare(self) -> None:
        """Called before the scheduler starts."""

    def link(self, name: str) -> Any:
        return self.links.setdefault(name, _Link(self, name))

    # --- the network ---

    @property
    def now_ns(self) -> int:
        return self.clock.now_ns()

    def request(self, name: str, request: Request) -> Response:
        """Send a request as `ExperimentLink` does: again under its id, while no answer comes."""
        for _ in range(3):
            self.clock.t_s += 0.01
            if self.random.random() < self.kills / 2:
                self.restart()
            if self.random.random() < self.loses:
                continue
            answer = self.ask(name, request)
            if self.random.random() < self.kills / 2:
                self.restart()
                continue
            if answer is not None and self.random.random() >= self.loses:
                self.settle()
                return answer
        self.settle()
        return Response(int(ControlResponse.NO_RESPONSE), b"", "silence", request.id)

    def ask(self, name: str, request: Request) -> Response | None:
        frames = wire.encode_request(request)
        try:
            read = wire.decode_request(frames)
        except WireError as error:
            return Response(int(error.response), b"", str(error), request.id)
        connection = self.connections.get(name)
        if connection is None:
            self.newest += 1
            connection = self.connections[name] = self.newest
            self._step(events.Connected(connection))
        before = self.core.control
        effects = self._step(events.RequestIn(connection, name, read))
        for _ in range(3):  # what a restarted scheduler kept until its barrier opened
            if any(isinstance(one, events.Reply) and one.name == name for one in effects):
                break
            self.clock.t_s += 1.0
            effects += self._step(events.Tick())
        answers = [one.response for one in effects if isinstance(one, events.Reply) and one.name == name]
        found = next((one for one in reversed(answers) if one.id == request.id), None)
        self._note(name, read, found, before)
        return found

    def _note(self, name: str, request: Request, answer: Response | None, before: Any) -> None:
        # what the watchman must know: by the state of the scheduler's control, and by answers to persons
        if answer is not None and answer.ok and request.kind == GRANT_REQUEST and name == ADA:
            self.watchman.approved(request.subject, self.now_ns)
        if name == AGENT and answer is not None and answer.ok and request.kind == LEASE_REQUEST:
            self.watchman.lease_s, self.watchman.alive_s = float(request.subject), self.clock.t_s

    def restart(self) -> None:
        """Kill the scheduler, and start it again from its disk."""
        self.kills_done += 1
        self.core = SchedulerCore(self.settings, self.codec)
        if self.saved is not None:
            plain = json.loads(json.dumps(snapshot(self.saved, KIND, VERSION)))
            self.core.restore(restored(SavedState, plain, KIND, VERSION))
            self.core.restore_cache(self.log[-300:])
        self.connections = {}
        self._start()
        for _ in range(3):
            self.clock.t_s += 1.1
            self._step(events.Tick())

    def _start(self) -> None:
        self._carry_out(self.core.start(self.clock.monotonic_s(), self.now_ns))
        self._step(events.TranslatorUp())
        self._step(events.TranslatorCaughtUp())
        self.publish(ScopeStatus(ScopeState.FREE))

    def later(self, real_s: float) -> None:
        """Let time pass; deadlines are processed."""
        self.clock.t_s += real_s
        for _ in range(3):
            self._step(events.Tick())

    def _step(self, event: events.Input) -> list[events.Effect]:
        before = self.core.control
        effects = self.core.step(event, self.clock.monotonic_s(), self.now_ns)
        after = self.core.control
        if after is not before:
            self._control_changed(before, after, event)
        return [*effects, *self._carry_out(effects)]

    def _control_changed(self, before: Any, after: Any, event: events.Input) -> None:
        is_manual = after.mode is not before.mode
        flagged = after.problems.keys() - before.problems.keys()
        cleared = before.problems.keys() - after.problems.keys()
        is_agents = isinstance(event, events.RequestIn) and event.name == AGENT
        if is_agents and (is_manual or cleared or after.ended or flagged - {STOP}):
            raise AgentViolation(f"the agent has changed control: {event}")
        if is_manual or flagged:
            self.watchman.disturbed(self.now_ns, manual=is_manual, stopped=STOP in flagged or 2 in flagged)
        self.watchman.stopped = STOP in after.problems
        if before.holder == AGENT and after.holder != AGENT:
            self.watchman.control_lost()
        if after.holder == AGENT and before.holder != AGENT:
            self.watchman.alive_s = self.clock.t_s

    def _carry_out(self, effects: list[events.Effect]) -> list[events.Effect]:
        more: list[events.Effect] = []
        for effect in effects:
            match effect:
                case events.SaveState():
                    self.saved = effect.state
                case events.Forward():
                    more += self._forwarded(effect)
                case events.Publish():
                    self._published(effect)
        return more

    def _published(self, effect: events.Publish) -> None:
        packet = effect.packet
        self.log.append(LoggedPacket(packet, effect.source_ns, effect.history))
        self.on_published(packet)

    def on_published(self, packet: Packet) -> None:
        """Called with each published packet."""

    # --- the microscope ---

    def publish(self, thing: object) -> None:
        """Publish a packet of the microscope."""
        self.clock.t_s += 1e-3
        name, payload = wire.encode(thing)
        packet = Packet(name, payload, self.now_ns)
        self._step(events.PacketIn(packet, wire.header(name, payload)))

    def _forwarded(self, effect: events.Forward) -> list[events.Effect]:
        request = wire.decode_request(wire.encode_request(effect.request))
        is_get = isinstance(request.subject, Parameter) and request.subject.value is None
        is_agent = component_of(request.id.partition("/")[0]) == "agent"
        is_command = not is_get and request.kind != ControlRequest.ACTION_SUPPORT
        if is_command:
            self.effects.append(f"{request.id} {request.kind} {request.subject}")
        known = self.done.get(request.id) if request.id else None
        if is_agent and is_command:
            if known is None:
                self.watchman.may_arrive(request)
            else:
                self.watchman.may_arrive_again(request)
        if known is None:
            known = self._execute(request)
            if request.id:
                self.done[request.id] = known
            if is_agent and is_command and not known.ok and known.code != ControlResponse.NO_RESPONSE:
                self.watchman.not_done(request)
        return self._step(events.TranslatorReply(effect.number, known))

    def _execute(self, request: Request) -> Response:
        subject = request.subject
        if request.kind == ControlRequest.PARAM:
            return self._parameter(request)
        if request.kind == ControlRequest.ACTION and subject not in STOPS and self.random.random() < self.not_free:
            return Response(int(ControlResponse.NOT_FREE), b"", "busy", request.id)
        if isinstance(subject, ScanParameters) and isinstance(subject.region, Region):
            self.region = subject.region
        elif isinstance(subject, ProbePosition):
            self.probe_m = subject.xy_m
        elif request.kind == ControlRequest.ACTION and subject in (names.START_SCAN, names.START_SPEC):
            self._queue_measurement(str(subject))
        return Response(OK, b"", "", request.id)

    def _parameter(self, request: Request) -> Response:
        parameter = request.subject
        left, low = (self.region.center_m[i] - self.region.size_m[i] / 2 for i in (0, 1))
        read = {
            **self.values,
            names.SCAN_SIZE_X: repr(self.region.size_m[0]), names.SCAN_SIZE_Y: repr(self.region.size_m[1]),
            names.SCAN_TOP_LEFT_X: repr(left), names.SCAN_TOP_LEFT_Y: repr(low), names.SCAN_ANGLE: "0",
            names.PROBE_POS_X: repr(self.probe_m[0]), names.PROBE_POS_Y: repr(self.probe_m[1]),
        }  # fmt: skip
        if parameter.value is not None:
            if parameter.name not in read:
                return Response(int(ControlResponse.PARAM_NOT_SUPPORTED), b"", self.texts("none"), request.id)
            self.values[parameter.name] = parameter.value
            read[parameter.name] = parameter.value
        if parameter.name not in read:
            return Response(int(ControlResponse.PARAM_NOT_SUPPORTED), b"", self.texts("none"), request.id)
        unit = parameter.unit or names.BASE_PARAMETERS.get(parameter.name)
        return Response(OK, wire.encode(Parameter(parameter.name, read[parameter.name], unit))[1], "", request.id)

    def _queue_measurement(self, action: str) -> None:
        # published after the answer, before the next request
        self._pending = action

    _pending = ""

    def settle(self) -> None:
        """Let a started measurement come to its end."""
        action, self._pending = self._pending, ""
        if not action:
            return
        is_scan = action == names.START_SCAN
        self.publish(ScopeStatus(ScopeState.SCANNING if is_scan else ScopeState.SPEC))
        if is_scan:
            values = np.zeros((2, 2))
            self.publish(Scan(self.region, self.texts("Height"), "m", values, self.now_ns, self.texts("scan.sxm")))
        else:
            values = np.zeros((2, 2))
            self.publish(Spectrum(self.probe_m, "IV", ("bias", "current"), ("V", "A"), values, self.now_ns))
        self.publish(ScopeStatus(ScopeState.FREE))


def facts(rig: GrantRig) -> Any:
    """Return the facts of an approval, as a person's program asks for them."""
    return json.loads(rig.ask(ADA, Request(CLOCK_REQUEST, id=f"{ADA}/p/{rig.random.random()}")).payload)  # type: ignore[union-attr]
