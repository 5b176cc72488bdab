"""A translator and its microscope as a simulated process that may be slow, hang and die."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from afspm.basics.errors import InvalidValue
from afspm.basics.plain_data import Plain
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Feedback,
    Packet,
    Parameter,
    PositionChange,
    ProbePosition,
    Region,
    RegionChange,
    Request,
    Response,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    names,
)
from afspm.testing.components.memory_network import ControlLine, Feed, Subscribers
from afspm.testing.components.simulated_process import Process
from afspm.testing.components.simulated_time import SimulatedTime, Timer
from afspm.translator.requests import RequestOutcomes
from tests.simulation.codec import TableCodec

CHANNELS = ("Height", "Height_Retrace")
_STARTS = {names.START_SCAN: ScopeState.SCANNING, names.START_SPEC: ScopeState.SPEC}
_STOPS = {names.STOP_SCAN: ScopeState.SCANNING, names.STOP_SPEC: ScopeState.SPEC}
_HISTORY = 200
SHAPE = (4, 4)
WHILE_BUSY = frozenset({names.ZCTRL_SETPOINT})
"""The parameters that may be set during a scan."""
_PARTS: dict[str, Callable[[Region], float]] = {
    names.SCAN_TOP_LEFT_X: lambda region: region.top_left_m[0],
    names.SCAN_TOP_LEFT_Y: lambda region: region.top_left_m[1],
    names.SCAN_SIZE_X: lambda region: region.size_m[0],
    names.SCAN_SIZE_Y: lambda region: region.size_m[1],
    names.SCAN_ANGLE: lambda region: region.angle_rad,
}
_CHANGES: dict[str, Callable[[float], RegionChange]] = {
    names.SCAN_TOP_LEFT_X: lambda value: RegionChange(left_m=value),
    names.SCAN_TOP_LEFT_Y: lambda value: RegionChange(low_m=value),
    names.SCAN_SIZE_X: lambda value: RegionChange(width_m=value),
    names.SCAN_SIZE_Y: lambda value: RegionChange(height_m=value),
    names.SCAN_ANGLE: lambda value: RegionChange(angle_rad=value),
}
_PROBE = (names.PROBE_POS_X, names.PROBE_POS_Y)


@dataclass(frozen=True)
class FakeScan:
    """Stands for the values of a scan: its number, and whether the tip was good."""

    number: int
    channel: str
    tip_is_good: bool


@dataclass
class Habits:
    """The behaviour of the translator; may be changed while it runs.

    Attributes:
        service_s: the longest time for a request, mostly much less.
        hangs: the chance that a request takes up to `hang_s`.
        loses_answer: the chance that an answer never comes.
        scan_s: how long (experiment) a scan takes.
        tip_breaks: the chance that a scan damages the tip.
        clock_error_s: of its clock; may decrease.
        retracts: whether it has an action that withdraws the tip.
    """

    service_s: float = 0.02
    hangs: float = 0.0
    hang_s: float = 20.0
    loses_answer: float = 0.0
    scan_s: float = 300.0
    tip_breaks: float = 0.1
    clock_error_s: float = 0.0
    retracts: bool = True


class FakeMicroscope(Process):
    """Serves one request at a time, as REP does, and publishes its states and scans.

    Attributes:
        executed: how often each command (client's id, or scheduler's number, and kind) was executed, over all restarts.
        scans_done: over all restarts.
        feedback_on, tip_is_away, region, probe_m, values: of the controller, which outlives its translator.
        on_changed: called with a parameter, its former value and its new one.
        on_placed: called after the scan's region or the probe was set.
    """

    region = Region((0.0, 0.0), (1e-6, 1e-6))

    def __init__(self, timeline: SimulatedTime, codec: TableCodec, habits: Habits) -> None:
        super().__init__(timeline, "translator")
        self.habits = habits
        self.executed: Counter[tuple[str, int]] = Counter()
        self.on_executed: Callable[[Request], None] = lambda request: None
        self.on_changed: Callable[[str, float, float], None] = lambda name, before, now: None
        self.on_placed: Callable[[], None] = lambda: None
        self.probe_m = (0.0, 0.0)
        self.values = {names.TIP_BIAS_VOLTAGE: 1.0, names.ZCTRL_SETPOINT: 1.0, names.MOVE_SPEED: 1e-6}
        self.scans_done = 0
        self.tip_is_good = True
        self.feedback_on, self.tip_is_away = True, False
        self._codec = codec
        self._kept: Plain = {}  # on its disk
        self._newest_ns = 0
        self._history: deque[Packet] = deque(maxlen=_HISTORY)
        self._forget()

    def _forget(self) -> None:
        self.state = ScopeState.FREE
        self._history = deque(maxlen=_HISTORY)
        self._newest_ns = 0
        self._lines: list[ControlLine] = []
        self._subscribers = Subscribers()
        self._queue: deque[tuple[ControlLine, Request, int]] = deque()
        self._serving = False
        self._scan: Timer | None = None

    def begin(self) -> None:
        self._forget()
        self._tell_what_is_in_force()

    def _tell_what_is_in_force(self) -> None:
        self._publish("ScanParameters2d", ScanParameters(self.region, SHAPE))
        self._publish("ProbePosition", ProbePosition(self.probe_m))
        self._publish("ZCtrlParameters", self._feedback())
        self._publish_state(self.state)

    def _feedback(self) -> Feedback:
        return Feedback(on=self.feedback_on, setpoint=self.values[names.ZCTRL_SETPOINT])

    # --- as a server ---

    def peer_connected(self, line: ControlLine) -> None:
        self._lines.append(line)

    def peer_disconnected(self, line: ControlLine) -> None:
        if line in self._lines:
            self._lines.remove(line)

    def peer_asked(self, line: ControlLine, request: Request, number: int) -> None:
        self._queue.append((line, request, number))
        self._serve()

    def _serve(self) -> None:
        if self._serving or not self._queue:
            return
        self._serving = True
        habits, chance = self.habits, self.timeline.random
        takes_s = habits.service_s * chance.random() ** 3
        if self.timeline.chance(habits.hangs):
            takes_s = habits.hang_s * chance.random()
        line, request, number = self._queue.popleft()
        # it may be carried out at the beginning or at the end of the time that it takes
        if self.timeline.chance(0.5):
            self.later(takes_s, self._answer, line, number, self._handle(request))
        else:
            self.later(takes_s, lambda: self._answer(line, number, self._handle(request)))

    def _answer(self, line: ControlLine, number: int, response: Response) -> None:
        self._serving = False
        if line in self._lines and not self.timeline.chance(self.habits.loses_answer):
            line.answer(response, number)
        self._serve()

    def _handle(self, request: Request) -> Response:
        outcomes = RequestOutcomes(self._kept, all_or_nothing=False)
        if (known := outcomes.outcome(request)) is not None:
            return known
        code = self._carry_out(request)
        payload = b""
        if request.kind == ControlRequest.PARAM and code is ControlResponse.SUCCESS:
            assert isinstance(request.subject, Parameter)
            payload = self._codec.encode(self._in_force(request.subject))
        response = Response(int(code), payload, "" if code is ControlResponse.SUCCESS else f"it is {self.state.name}")
        if request.id:
            response.id = request.id
            outcomes.begin(request)
            outcomes.finish(request, response)
        return response

    def _in_force(self, asked: Parameter) -> Parameter:
        name = asked.name
        if name == names.FEEDBACK_ON:
            return Parameter(name, "on" if self.feedback_on else "off")
        if name in _PARTS:
            return Parameter(name, repr(_PARTS[name](self.region)), "rad" if name == names.SCAN_ANGLE else "m")
        if name in _PROBE:
            return Parameter(name, repr(self.probe_m[_PROBE.index(name)]), "m")
        return (
            Parameter(name, repr(self.values[name])) if name in self.values else Parameter(name, asked.value or "1.0")
        )

    def _carry_out(self, request: Request) -> ControlResponse:
        subject = request.subject
        if subject == names.RETRACT and not self.habits.retracts:
            return ControlResponse.ACTION_NOT_SUPPORTED
        if request.kind == ControlRequest.ACTION_SUPPORT:
            return ControlResponse.SUCCESS
        if request.kind == ControlRequest.PARAM and isinstance(subject, Parameter) and subject.value is None:
            return ControlResponse.SUCCESS
        if subject in _STOPS:
            if self.state is _STOPS[subject]:
                self._interrupt()
            return ControlResponse.SUCCESS
        adjusts = isinstance(subject, Parameter) and subject.name in WHILE_BUSY
        if self.state is not ScopeState.FREE and not adjusts:
            return ControlResponse.NOT_FREE
        if request.id:
            self.executed[request.id, request.kind] += 1
        self.on_executed(request)
        if subject in _STARTS:
            self._begin(_STARTS[subject])
        elif subject == names.PULSE:
            self.tip_is_good = self.tip_is_good or self.timeline.chance(0.7)
        elif subject == names.RETRACT:
            self.tip_is_away = True
        elif isinstance(subject, Parameter) and subject.name == names.FEEDBACK_ON:
            self._switch_feedback(on=subject.value == "on")
        else:
            return self._set(subject)
        return ControlResponse.SUCCESS

    def _set(self, subject: object) -> ControlResponse:
        x_m, y_m = self.probe_m
        match subject:
            case ScanParameters(region=Region() | RegionChange() as region):
                return self._place(region)
            case ProbePosition(xy_m=(x_m, y_m)):
                self._move_probe(x_m, y_m)
            case PositionChange():
                self._move_probe(
                    x_m if subject.x_m is None else subject.x_m, y_m if subject.y_m is None else subject.y_m
                )
            case Parameter(value=str(text)) if subject.name in _CHANGES:
                return self._place(_CHANGES[subject.name](float(text)))
            case Parameter(value=str(text)) if subject.name in _PROBE:
                is_x = subject.name == names.PROBE_POS_X
                self._move_probe(float(text) if is_x else x_m, y_m if is_x else float(text))
            case Parameter(value=str(text)) if subject.name in self.values:
                before, self.values[subject.name] = self.values[subject.name], float(text)
                self.on_changed(subject.name, before, float(text))
                if subject.name == names.ZCTRL_SETPOINT:
                    self._publish("ZCtrlParameters", self._feedback())
        return ControlResponse.SUCCESS

    def _place(self, region: Region | RegionChange) -> ControlResponse:
        try:
            self.region = region.onto(self.region) if isinstance(region, RegionChange) else region
        except InvalidValue:
            return ControlResponse.PARAM_ERROR
        self.on_placed()
        self._publish_region()
        return ControlResponse.SUCCESS

    def _publish_region(self) -> None:
        self._publish("ScanParameters2d", ScanParameters(self.region, SHAPE))

    def _move_probe(self, x_m: float, y_m: float) -> None:
        self.probe_m = (x_m, y_m)
        self.on_placed()
        self._publish("ProbePosition", ProbePosition(self.probe_m))

    # --- the microscope ---

    @property
    def endangers_tip(self) -> bool:
        """True while the tip is at the surface and no feedback holds it."""
        return not self.feedback_on and not self.tip_is_away

    def approach(self) -> None:
        """Bring the tip back to the surface, as a person does at the controller's panel."""
        self.tip_is_away = False
        self._switch_feedback(on=True)

    def _switch_feedback(self, *, on: bool) -> None:
        self.feedback_on = on
        if self.alive:
            self._publish("ZCtrlParameters", self._feedback())

    def _begin(self, state: ScopeState) -> None:
        self._publish_state(state)
        takes_s = self.timeline.real_s(self.habits.scan_s * (0.5 + self.timeline.random.random()))
        self._scan = self.later(takes_s, self._done, state)

    def _done(self, state: ScopeState) -> None:
        self._scan = None
        self.scans_done += 1
        if self.timeline.chance(self.habits.tip_breaks):
            self.tip_is_good = False
        channels = CHANNELS if state is ScopeState.SCANNING else CHANNELS[:1]
        for channel in channels:
            message = "Scan2d" if state is ScopeState.SCANNING else "Spec1d"
            self._publish(message, FakeScan(self.scans_done, channel, self.tip_is_good))
        self._publish_state(ScopeState.FREE)

    def _interrupt(self) -> None:
        if self._scan is not None:
            self._scan.cancel()
            self._scan = None
        self._publish_state(ScopeState.INTERRUPTED)
        self._publish_state(ScopeState.FREE)

    def _publish_state(self, state: ScopeState) -> None:
        self.state = state
        self._publish("ScopeStateMsg", ScopeStatus(state))

    # --- as a publisher ---

    def _publish(self, message: str, thing: object) -> None:
        time_ns = self.timeline.now_ns() + round(self.habits.clock_error_s * 1e9)
        self._newest_ns = max(time_ns, self._newest_ns + 1)
        packet = Packet(message, self._codec.encode(thing), self._newest_ns)
        self._history.append(packet)
        self._subscribers.publish(packet)

    def joined(self, feed: Feed, prefixes: Sequence[str], since_ns: int) -> Sequence[Packet]:
        self._subscribers.join(feed)
        self.later(0.0, self._tell_what_is_in_force)
        return [packet for packet in self._history if packet.time_ns is not None and packet.time_ns > since_ns]

    def left(self, feed: Feed) -> None:
        self._subscribers.leave(feed)
