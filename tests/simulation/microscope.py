"""A translator and its microscope as a simulated process that may be slow, hang and die."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

from afspm import wire
from afspm.basics.errors import InvalidValue
from afspm.basics.exit_codes import ExitCode
from afspm.basics.plain_data import Plain
from afspm.model import (
    ActByHand,
    ControlRequest,
    ControlResponse,
    Feedback,
    Packet,
    PanelAct,
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
    TipStatus,
    names,
)
from afspm.model.panel import ChangedValue
from afspm.testing.components.memory_network import ControlLine, Feed, Subscribers
from afspm.testing.components.simulated_process import Process
from afspm.testing.components.simulated_time import SimulatedTime, Timer
from afspm.translator.requests import RequestOutcomes
from afspm.translator.state import KeptState
from tests.simulation.codec import TableCodec
from tests.simulation.panel import MakerPanel

CHANNELS = ("Height", "Height_Retrace")
_STARTS = {names.START_SCAN: ScopeState.SCANNING, names.START_SPEC: ScopeState.SPEC}
_STOPS = {names.STOP_SCAN: ScopeState.SCANNING, names.STOP_SPEC: ScopeState.SPEC}
_HISTORY = 200
GARBLED = b"\xff"
"""The payload of a packet that the scheduler can't read."""
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
        garbles: the chance that an unreadable packet goes before a packet.
    """

    service_s: float = 0.02
    hangs: float = 0.0
    hang_s: float = 20.0
    loses_answer: float = 0.0
    scan_s: float = 300.0
    tip_breaks: float = 0.1
    clock_error_s: float = 0.0
    retracts: bool = True
    garbles: float = 0.0


class FakeMicroscope(Process):
    """Serves one request at a time, as REP does, and publishes its states and scans.

    Attributes:
        executed: how often each command (client's id, or scheduler's number, and kind) was executed, over all restarts.
        scans_done: over all restarts.
        closed: how often the scheduler has closed the translator at the end.
        feedback_on, tip_is_away, region, probe_m, values: of the controller, which outlives its translator.
        on_changed: called with a parameter, its former value and its new one.
        on_closed: called when the scheduler closes the translator.
        on_placed: called after the scan's region or the probe was set.
        turned: settings that a person changed, and the run has not set since.
        panel: the maker's panel, if a person acts there; then the translator refuses a start with a withdrawn tip.
    """

    region = Region((0.0, 0.0), (1e-6, 1e-6))

    def __init__(self, timeline: SimulatedTime, codec: TableCodec, habits: Habits) -> None:
        super().__init__(timeline, "translator")
        self.habits = habits
        self.executed: Counter[tuple[str, int]] = Counter()
        self.on_executed: Callable[[Request], None] = lambda request: None
        self.on_changed: Callable[[str, float, float], None] = lambda name, before, now: None
        self.on_placed: Callable[[], None] = lambda: None
        self.on_closed: Callable[[], None] = lambda: None
        self.probe_m = (0.0, 0.0)
        self.values = {names.TIP_BIAS_VOLTAGE: 1.0, names.ZCTRL_SETPOINT: 1.0, names.MOVE_SPEED: 1e-6}
        self.scans_done = self.closed = 0
        self.tip_is_good = True
        self.feedback_on, self.tip_is_away = True, False
        self.panel: MakerPanel | None = None
        self.turned: set[str] = set()
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
        self._ends_s = 0.0
        self._left_s: float | None = None
        self._is_requested = self._is_spoiled = False

    def begin(self) -> None:
        self._forget()
        self._tell_what_is_in_force()

    def _tell_what_is_in_force(self) -> None:
        self._publish("ScanParameters2d", ScanParameters(self.region, SHAPE))
        self._publish("ProbePosition", ProbePosition(self.probe_m))
        self._publish("ZCtrlParameters", self._feedback())
        self._publish_tip()
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
        if request.kind == wire.CLOSE[0]:
            self.closed += 1
            self.on_closed()
            self.kill(ExitCode.ENDED)
            return
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
        outcomes = RequestOutcomes(cast(KeptState, self._kept), all_or_nothing=False)
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
        if subject in _STARTS and (refusal := self._refusal_without_tip()) is not None:
            return refusal
        if request.id:
            self.executed[request.id, request.kind] += 1
        if subject in _STARTS and self.panel is not None and self.panel.start_engages:
            self.tip_is_away = False
        self.on_executed(request)
        if subject in _STARTS:
            self._begin(_STARTS[subject])
            self._is_requested = True
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
                if subject.name in self.turned:  # of a knob turned a moment ago the run may not know yet
                    self.turned.remove(subject.name)
                else:
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
        self._kept["by_hand"] = ""
        self._switch_feedback(on=True)
        if self.alive:
            self._publish_tip()

    def _switch_feedback(self, *, on: bool) -> None:
        self.feedback_on = on
        if self.alive:
            self._publish("ZCtrlParameters", self._feedback())

    def _refusal_without_tip(self) -> ControlResponse | None:
        if self.panel is None:
            return None
        if self._tip().remedy:
            return ControlResponse.NOT_FREE
        is_away = self.tip_is_away and self.panel.shows_tip and not self.panel.start_engages
        return ControlResponse.ACTION_ERROR if is_away else None

    # --- a person at its panel; the translator sees it while it is there ---

    def act_by_hand(self, what: str) -> None:
        """Do one of `panel.ACTS`, as far as it is possible now."""
        assert self.panel is not None
        if what in ("stop", "stop and scan"):
            self._stop_by_hand()
        if what in ("scan", "stop and scan") and self.alive and self.state is ScopeState.FREE:
            self._tell(PanelAct.SCAN)
            self._begin(ScopeState.SCANNING)
        elif what in ("pause", "pause for ever"):
            self._pause_by_hand()
        elif what == "withdraw":
            self._withdraw_by_hand()
        elif what == "feedback off" and self.panel.shows_feedback:
            self._feedback_off_by_hand()
        elif what == "bias":
            self._turn_by_hand(names.TIP_BIAS_VOLTAGE, self.timeline.random.choice((1.0, 2.0, 12.0)))
        elif what == "setpoint":
            self._turn_by_hand(names.ZCTRL_SETPOINT, self.timeline.random.uniform(0.5, 2.0))
        elif what == "frame" and self.alive:
            self._is_spoiled = self._is_spoiled or self.state is ScopeState.SCANNING  # its lines may be from two places
            self._tell(PanelAct.VALUES, ChangedValue(names.SCAN_ANGLE, "0", "0.5"))

    def go_on_by_hand(self) -> None:
        """Let a paused scan go on."""
        left_s, self._left_s = self._left_s, None
        if left_s is not None and self.alive:
            self._publish_state(self.state)
            self._wait_for_end(left_s)

    def put_right(self) -> None:
        """Do what a person does before the run continues: approach, set back, let a paused scan go on."""
        self.go_on_by_hand()
        if self.values[names.TIP_BIAS_VOLTAGE] > 10.0:
            self._turn_by_hand(names.TIP_BIAS_VOLTAGE, 1.0)
        self.approach()

    def _stop_by_hand(self) -> None:
        assert self.panel is not None
        if not self.alive or self._scan is None:
            return
        if self.panel.stop_withdraws:
            self._move_away()
        if self._is_requested and self.panel.shows_stop:
            self._tell(PanelAct.STOP)
        self._interrupt()

    def _withdraw_by_hand(self) -> None:
        assert self.panel is not None
        is_of_run = self._scan is not None and self._is_requested
        if not self.alive or self.tip_is_away or not (is_of_run or self.panel.shows_tip):
            return  # nobody of the run could know
        self._move_away()
        if self.panel.shows_tip:
            self._tell(PanelAct.WITHDRAW)
        if self._scan is None:
            return
        self._is_spoiled = True
        if self.panel.withdrawal_ends_scan or not self.panel.shows_tip:
            self._stop_by_hand()

    def _move_away(self) -> None:
        assert self.panel is not None
        self.tip_is_away = True
        if self.panel.shows_tip:
            self._kept["by_hand"] = "the tip was withdrawn"
            self._publish_tip()

    def _feedback_off_by_hand(self) -> None:
        if not self.alive or not self.feedback_on or self.tip_is_away:
            return
        self._kept["by_hand"] = "the feedback was switched off"
        self._is_spoiled = self._scan is not None
        self._switch_feedback(on=False)
        self._tell(PanelAct.FEEDBACK_OFF)
        self._publish_tip()

    def _pause_by_hand(self) -> None:
        if not self.alive or self._scan is None or self.state is not ScopeState.SCANNING:
            return
        self._left_s = max(0.0, self._ends_s - self.timeline.monotonic_s())
        self._scan.cancel()
        self._scan = None
        self._tell(PanelAct.PAUSE)
        self._publish("ScopeStateMsg", ScopeStatus(self.state, paused=True))

    def _turn_by_hand(self, name: str, value: float) -> None:
        if not self.alive:
            return
        self.turned.add(name)
        before, self.values[name] = self.values[name], value  # within limits or not: the person is right
        if name == names.ZCTRL_SETPOINT:
            self._publish("ZCtrlParameters", self._feedback())
        self._tell(PanelAct.VALUES, ChangedValue(name, repr(before), repr(value)))

    def _tell(self, act: PanelAct, *changes: ChangedValue) -> None:
        self._publish("ActByHand", ActByHand(self.timeline.now_ns(), act, "seen", changes))

    def _tip(self) -> TipStatus:
        panel = self.panel or MakerPanel()
        engaged = not self.tip_is_away if panel.shows_tip else None
        return TipStatus(engaged, self.feedback_on if panel.shows_feedback else None, self._kept.get("by_hand", ""))

    def _publish_tip(self) -> None:
        if self.panel is not None:
            self._publish("TipStatus", self._tip())

    def _begin(self, state: ScopeState) -> None:
        self._is_requested = self._is_spoiled = False
        self._publish_state(state)
        self._wait_for_end(self.timeline.real_s(self.habits.scan_s * (0.5 + self.timeline.random.random())))

    def _wait_for_end(self, left_s: float) -> None:
        self._ends_s = self.timeline.monotonic_s() + left_s
        self._scan = self.later(left_s, self._done, self.state)

    def _done(self, state: ScopeState) -> None:
        self._scan = None
        if self._is_spoiled or (self.panel is not None and self.timeline.chance(self.panel.ends_scans)):
            self._interrupt()
            return
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
        self._left_s = None
        self._publish_state(ScopeState.INTERRUPTED)
        self._publish_state(ScopeState.FREE)

    def _publish_state(self, state: ScopeState) -> None:
        self.state = state
        self._publish("ScopeStateMsg", ScopeStatus(state))

    # --- as a publisher ---

    def _publish(self, message: str, thing: object) -> None:
        time_ns = self.timeline.now_ns() + round(self.habits.clock_error_s * 1e9)
        self._newest_ns = max(time_ns, self._newest_ns + 1)
        if self.timeline.chance(self.habits.garbles):
            self._send(Packet(message, GARBLED, self._newest_ns))
            self._newest_ns += 1
        self._send(Packet(message, self._codec.encode(thing), self._newest_ns))

    def _send(self, packet: Packet) -> None:
        self._history.append(packet)
        self._subscribers.publish(packet)

    def joined(self, feed: Feed, prefixes: Sequence[str], since_ns: int) -> Sequence[Packet]:
        self._subscribers.join(feed)
        self.later(0.0, self._tell_what_is_in_force)
        return [packet for packet in self._history if packet.time_ns is not None and packet.time_ns > since_ns]

    def left(self, feed: Feed) -> None:
        self._subscribers.leave(feed)
