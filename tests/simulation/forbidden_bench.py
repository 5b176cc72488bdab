"""Random forbidden states and requests against a scheduler's core: nothing sent may begin a forbidden state.

The truth is kept here, with a second evaluation of the rules. The microscope executes one request after the other, and
loses answers; the instrument carries its orders out late; a person acts at the panel; the scheduler is killed.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any

from afspm.model import (
    RELAY_REQUEST,
    ActByHand,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Feedback,
    InstrumentOrder,
    InstrumentReading,
    InstrumentReadings,
    OrderOutcome,
    Packet,
    PacketHeader,
    PanelAct,
    Parameter,
    RegionChange,
    RelayedMessage,
    Request,
    Response,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    names,
)
from afspm.model.panel import ChangedValue
from afspm.model.snapshot import restored, snapshot
from afspm.scheduler.control.arbitration import RoleTable, Rules
from afspm.scheduler.events import (
    Connected,
    Forward,
    PacketIn,
    Reply,
    RequestIn,
    SaveState,
    Tick,
    TranslatorCaughtUp,
    TranslatorReply,
    TranslatorUp,
)
from afspm.scheduler.instruments.conditions import InstrumentSettings
from afspm.scheduler.safety.limits import ExperimentLimits, ForbiddenState
from afspm.scheduler.saved_state import KIND, VERSION, SavedState
from afspm.scheduler.scheduler_core import SchedulerCore
from afspm.scheduler.settings import SchedulerSettings
from tests.simulation.codec import TableCodec
from tests.simulation.invariants import InvariantViolated

BIAS, SETPOINT, SPEED, SIZE = names.TIP_BIAS_VOLTAGE, names.ZCTRL_SETPOINT, names.SCAN_SPEED, names.SCAN_SIZE_X
FEEDBACK, TEMPERATURE, SCANNING, HIGH = names.FEEDBACK_ON, "cryo.t", "SCANNING", "x-high"
_UNITS = {BIAS: "V", SETPOINT: "A", SPEED: "m/s", SIZE: "m", TEMPERATURE: "K"}
_START = {
    BIAS: 1.0, SETPOINT: 1.0, SPEED: 1.0, SIZE: 1.0, FEEDBACK: True, names.SCAN_SIZE_Y: 1.0,
    names.SCAN_TOP_LEFT_X: 0.0, names.SCAN_TOP_LEFT_Y: 0.0,
}  # fmt: skip
_NUMBERS = (BIAS, SETPOINT, SPEED, SIZE)
_TIMEOUT_S = 5.0
Rule = Any
"""("and" | "or", rules), ("not", rule), (name,) for a switch, or (name, is absolute, sign, number)."""
Step = tuple[Any, ...]

_VALUES = (-2.0, -1.0, 0.0, 1.0, 2.0)
_SIGNS = ("<", "<=", ">", ">=")


def _above(name: str, number: float = 1.0) -> Rule:
    return (name, False, ">", number)


_BOTH = ("and", (_above(TEMPERATURE), _above(BIAS)))
_HANDED: tuple[Step, ...] = (("serve", 9), ("order", 2.0), ("serve", 9), ("report", False, False))
_BIAS_SET: tuple[Step, ...] = (("set", "series", BIAS, 2.0), ("serve", 9))
_CARRIED_OUT: Step = ("report", True, True)
SCENARIOS: dict[str, tuple[list[Rule], tuple[Step, ...]]] = {
    "set": ([_above(BIAS)], (("serve", 9), *_BIAS_SET)),
    "set below zero": ([(BIAS, True, ">", 1.0)], (("serve", 9), ("set", "person", BIAS, -2.0), ("serve", 9))),
    "either": ([("or", (_above(SPEED, 9.0), _above(BIAS)))], (("serve", 9), *_BIAS_SET)),
    "part of a frame": ([_above(SIZE, 2.0)], (("serve", 9), ("size", 3.0), ("serve", 30))),
    "action that sets": ([_above(BIAS)], (("serve", 9), ("action", HIGH), ("serve", 9))),
    "stop in a forbidden state": (
        [(BIAS, False, ">=", 1.0)], (("serve", 9), ("action", names.STOP_SCAN), ("serve", 9))
    ),
    "one of two values moves away": (
        [("or", (("and", (_above(SETPOINT), (BIAS, False, ">=", 1.0))), ("and", ((FEEDBACK,), _above(BIAS, 5.0)))))],
        (("serve", 9), ("feedback", 2.0, False), ("serve", 30)),
    ),
    "lost answer": (
        [("and", (_above(BIAS), _above(SETPOINT)))],
        (("serve", 9), ("set", "series", BIAS, 2.0), ("serve", 2), ("lose", True), ("set", "person", SETPOINT, 2.0),
         ("serve", 9)),
    ),
    "scan before its state": (
        [("and", ((SCANNING,), _above(BIAS)))], (("serve", 9), ("action", names.START_SCAN), ("serve", 30), *_BIAS_SET)
    ),
    "lost answer without a read": (
        [("and", (_above(BIAS), _above(SETPOINT)))],
        (("serve", 9), ("set", "series", BIAS, 0.0), ("serve", 9), ("set", "series", SETPOINT, 0.0), ("serve", 9),
         ("set", "series", BIAS, 2.0), ("lose", True), ("set", "person", SETPOINT, 2.0), ("serve", 9)),
    ),
    "unknown instrument": (
        [("and", ((TEMPERATURE, False, ">=", 1.0), _above(BIAS)))], (("kill", False), ("serve", 9), *_BIAS_SET)
    ),
    "command after an order": ([_BOTH], (*_HANDED, *_BIAS_SET, _CARRIED_OUT)),
    "command after an order and a kill": (
        [_BOTH],
        (*_HANDED, ("kill", False), ("report", False, False), ("report", False, False), *_BIAS_SET, _CARRIED_OUT),
    ),
    "order beside a command": (
        [_BOTH],
        (("serve", 9), ("set", "series", BIAS, 2.0), ("serve", 1), ("order", 2.0), ("report", False, False),
         ("serve", 9), ("report", False, False), _CARRIED_OUT),
    ),
    "order after a command": (
        [_BOTH],
        (("serve", 9), ("order", 2.0), ("serve", 9), *_BIAS_SET, ("report", False, False), _CARRIED_OUT),
    ),
    "command before a dialled target is reached": ([_BOTH], (("serve", 9), ("dial", 2.0), *_BIAS_SET)),
}  # fmt: skip
"""Rules and steps in which a decision without care begins a forbidden state, or refuses a stop."""


def case(seed: int, length: int = 60) -> tuple[list[Rule], list[Step]]:
    """Return one or two random rules, and random steps."""
    chance = Random(seed)
    rules = [_rule(chance, 2)]
    if chance.random() < 0.5:  # a state of microscope and instrument together, which are reached by two ways
        rules.append(("and", (_atom(chance, TEMPERATURE), _atom(chance, chance.choice([BIAS, SETPOINT])))))
    return rules, [_step(chance) for _ in range(length)]


def _rule(chance: Random, depth: int) -> Rule:
    kind = chance.choice(["and", "and", "or", "not", "atom", "atom"]) if depth else "atom"
    if kind == "not":
        return ("not", _rule(chance, depth - 1))
    if kind != "atom":
        return (kind, tuple(_rule(chance, depth - 1) for _ in range(chance.choice([2, 2, 3]))))
    if chance.random() < 0.25:
        return (chance.choice([FEEDBACK, SCANNING]),)
    return _atom(chance, chance.choice([BIAS, BIAS, SETPOINT, SPEED, SIZE, TEMPERATURE, TEMPERATURE]))


def _atom(chance: Random, name: str) -> Rule:
    return (name, chance.random() < 0.3, chance.choice(_SIGNS), chance.choice(_VALUES))


def _step(chance: Random) -> Step:
    pick = chance.choice
    value, both = pick(_VALUES), (True, False)
    kinds: list[tuple[float, Step]] = [
        (4, ("set", pick(["series", "series", "person"]), pick([BIAS, BIAS, SETPOINT]), value)),
        (1, ("set", "series", SPEED, value)),
        (1, ("feedback", pick([None, value]), pick([None, True, False]))),
        (1, ("size", abs(value) + 1.0)),
        (2, ("action", pick([names.START_SCAN, names.START_SCAN, HIGH, "x-engage"]))),
        (1, ("action", pick([names.STOP_SCAN, names.RETRACT]))),
        (3, ("order", value)),
        (8, ("serve", pick([1, 3, 9, 30]))),
        (0.5, ("lose", pick(both))),
        (5, ("report", chance.random() < 0.7, pick(both))),
        (2, ("publish",)),
        (1, ("end",)),
        (1, ("continue",)),
        (0.5, ("panel", pick([BIAS, SETPOINT]), value)),
        (0.5, ("dial", value)),
        (0.5, ("kill", pick(both))),
        (0.5, ("wait", pick([0.5, 4.5, 6.0]))),
    ]
    return chance.choices([step for _, step in kinds], [weight for weight, _ in kinds])[0]


def text_of(rule: Rule) -> str:
    """Return a rule in the language of the experiment file."""
    match rule:
        case ("and" | "or" as word, parts):
            return "(" + f" {word} ".join(map(text_of, parts)) + ")"
        case ("not", inner):
            return f"not ({text_of(inner)})"
        case (name,):
            return str(name)
    name, is_absolute, sign, number = rule
    return f"{f'abs({name})' if is_absolute else name} {sign} {number} {_UNITS[name]}"


def is_true(rule: Rule, truth: dict[str, Any]) -> bool:
    """Return whether a rule holds, by a second evaluation."""
    match rule:
        case ("and", parts):
            return all(is_true(part, truth) for part in parts)
        case ("or", parts):
            return any(is_true(part, truth) for part in parts)
        case ("not", inner):
            return not is_true(inner, truth)
        case (name,):
            return bool(truth[name])
    name, is_absolute, sign, number = rule
    value = abs(truth[name]) if is_absolute else truth[name]
    return bool({"<": value < number, "<=": value <= number, ">": value > number, ">=": value >= number}[sign])


def _names_of(rule: Rule) -> Iterator[str]:
    match rule:
        case ("and" | "or", parts):
            for part in parts:
                yield from _names_of(part)
        case ("not", inner):
            yield from _names_of(inner)
        case _:
            yield rule[0]


@dataclass
class Instrument:
    """A cryostat: its temperature, its target, and orders that are not carried out yet."""

    value: float = 1.0
    target: float = 1.0
    orders: list[InstrumentOrder] = field(default_factory=list)
    done: dict[str, OrderOutcome] = field(default_factory=dict)
    token: int = 0


class ForbiddenBench:
    """One scheduler with its microscope, instrument, component and person.

    Attributes:
        counts: what happened: requests that were executed and refused, and why.
    """

    def __init__(self, rules: Sequence[Rule]) -> None:
        self.rules = rules
        self.truth: dict[str, Any] = {**_START, SCANNING: False}
        self.cryo = Instrument()
        self.counts: Counter[str] = Counter()
        self._codec = TableCodec()
        self._now_s, self._now_ns = 100.0, 10**18
        self._saved: SavedState | None = None
        self._flight: Forward | None = None
        self._executed: set[str] = set()
        self._untold: list[ScopeState] = []
        self._state = ScopeState.FREE
        self._asked: dict[str, Request] = {}
        self._answer_to_report = b""
        self._begin()
        for _ in range(2):  # an instrument is known from its second report on
            self._do_report(False, False)

    # --- the scheduler ---

    def _begin(self) -> None:
        operators = RoleTable(operate=("person",))
        control = Rules(operators, adjustable=frozenset({BIAS, SETPOINT}))
        forbid = {
            f"rule {i}": ForbiddenState(
                text_of(rule), {name: _UNITS[name] for name in _names_of(rule) if name in _UNITS}
            )
            for i, rule in enumerate(self.rules)
        }
        limits = ExperimentLimits(forbid=forbid, sets={HIGH: (Parameter(BIAS, "2.0", "V"),)})
        settings = SchedulerSettings(rules=control, limits=limits, instruments=InstrumentSettings(("cryo",)))
        self._core = SchedulerCore(settings, self._codec)
        if self._saved is not None:
            plain = json.loads(json.dumps(snapshot(self._saved, KIND, VERSION)))
            self._core.restore(restored(SavedState, plain, KIND, VERSION))
        self._connections: dict[str, int] = {}
        self._take(self._core.start(self._now_s, self._now_ns))
        self._step(TranslatorUp())
        self._publish_all(at_least_one=True)
        self._step(TranslatorCaughtUp())
        self._do_continue()

    def _take(self, effects: Sequence[Any]) -> None:
        for effect in effects:
            if isinstance(effect, SaveState):
                self._saved = effect.state
            elif isinstance(effect, Forward):
                if self._flight is not None:  # its answer was overdue, and the translator serves in order
                    self._execute(self._flight.request)
                self._flight = effect
            elif isinstance(effect, Reply):
                self._replied(effect)

    def _step(self, event: Any) -> None:
        self._now_ns += 1000
        self._take(self._core.step(event, self._now_s, self._now_ns))

    def _ask(self, name: str, kind: int, subject: Any) -> str:
        if name not in self._connections:
            self._connections[name] = len(self._connections) + 1
            self._step(Connected(self._connections[name]))
        request_id = f"{name}/1/{len(self._asked) + 1}"
        self._asked[request_id] = Request(int(kind), subject, self._codec.encode(subject), request_id)
        self._step(RequestIn(self._connections[name], name, self._asked[request_id]))
        return request_id

    def _replied(self, reply: Reply) -> None:
        answered, asked = reply.response, self._asked.get(reply.response.id)
        if asked is not None and asked.kind == RELAY_REQUEST:
            self._answer_to_report = answered.payload
        kinds = {"is forbidden": "forbidden", "can't be checked": "unknown"}
        why = next((kind for text, kind in kinds.items() if text in answered.reason), "")
        if asked is None or not why:
            return
        self.counts[why] += 1
        if asked.kind == ControlRequest.ACTION and asked.subject in (names.STOP_SCAN, names.RETRACT):
            raise InvariantViolated(f"{asked.subject} was refused: {answered.reason}")

    # --- the truth ---

    def _forbidden(self) -> list[bool]:
        now = [{**self.truth, TEMPERATURE: at} for at in (self.cryo.value, self.cryo.target)]
        return [any(is_true(rule, one) for one in now) for rule in self.rules]

    def _execute(self, request: Request) -> Response:
        before, subject = self._forbidden(), request.subject
        answer = Response(int(ControlResponse.SUCCESS), b"", "", request.id)
        if isinstance(subject, Parameter) and subject.value is None:
            return self._read(request)
        if request.id and request.id in self._executed:
            return answer
        self._executed.add(request.id)
        match subject:
            case Parameter(name, value):
                self.truth[name] = float(value or "nan")
            case Feedback():
                self.truth |= {} if subject.on is None else {FEEDBACK: subject.on}
                self.truth |= {} if subject.setpoint is None else {SETPOINT: subject.setpoint}
            case ScanParameters(region=RegionChange(width_m=float(width))):
                self.truth[SIZE] = width
            case names.START_SCAN:
                self._become(ScopeState.SCANNING)
            case names.STOP_SCAN:
                self._become(ScopeState.FREE)
            case str() if subject == HIGH:
                self.truth[BIAS] = 2.0
        if request.kind != ControlRequest.ACTION_SUPPORT:
            self.counts["executed"] += 1
        if subject != names.STOP_SCAN and request.kind != ControlRequest.ACTION_SUPPORT:  # a stop is never refused
            self._must_not_enter(before, f"{subject} is executed")
        return answer

    def _must_not_enter(self, before: list[bool], what: str) -> None:
        for rule, was, now in zip(self.rules, before, self._forbidden(), strict=True):
            if now and not was:
                raise InvariantViolated(f"{what}, and begins the forbidden state {text_of(rule)}: {self.truth}")

    def _read(self, request: Request) -> Response:
        name = request.subject.name
        if name not in self.truth:
            return Response(int(ControlResponse.PARAM_NOT_SUPPORTED), b"", "", request.id)
        value = self.truth[name]
        text = ("true" if value else "false") if isinstance(value, bool) else repr(value)
        found = Parameter(name, text, _UNITS.get(name))
        return Response(int(ControlResponse.SUCCESS), self._codec.encode(found), "", request.id)

    def _become(self, state: ScopeState) -> None:
        self.truth[SCANNING] = state is ScopeState.SCANNING
        self._state = state
        self._untold.append(state)

    # --- the steps of a case ---

    def run(self, steps: Sequence[Step]) -> None:
        for what, *how in steps:
            getattr(self, f"_do_{what}")(*how)

    def _do_set(self, who: str, name: str, value: float) -> None:
        self._ask(who, ControlRequest.PARAM, Parameter(name, repr(value), _UNITS[name]))

    def _do_feedback(self, setpoint: float | None, on: bool | None) -> None:
        self._ask("series", ControlRequest.SET_ZCTRL_PARAMS, Feedback(on=on, setpoint=setpoint))

    def _do_size(self, width_m: float) -> None:
        self._ask("series", ControlRequest.SET_SCAN_PARAMS, ScanParameters(RegionChange(width_m=width_m)))

    def _do_action(self, action: str) -> None:
        self._ask("series", ControlRequest.ACTION, action)

    def _do_order(self, value: float) -> None:
        self._ask("series", ControlRequest.PARAM, Parameter(TEMPERATURE, repr(value), "K"))

    def _do_serve(self, count: int) -> None:
        for _ in range(count):
            if (flight := self._flight) is None:
                return
            self._flight = None
            self._step(TranslatorReply(flight.number, self._execute(flight.request)))

    def _do_lose(self, is_executed: bool) -> None:
        if self._flight is None:
            return
        if is_executed:
            self._execute(self._flight.request)
        self._flight = None
        self._do_wait(2 * _TIMEOUT_S + 0.1)  # only then the next request is sent

    def _do_report(self, carries_out: bool, arrives: bool) -> None:
        cryo, outcomes = self.cryo, list[OrderOutcome]()
        if arrives:
            cryo.value = cryo.target
        if carries_out:
            for order in cryo.orders:
                before = self._forbidden()
                if order.id not in cryo.done:
                    cryo.target = float(order.parameter.value or "nan")
                    self.counts["ordered"] += 1
                cryo.done[order.id] = OrderOutcome(order.number, 0)
                outcomes.append(cryo.done[order.id])
                self._must_not_enter(before, f"{order.parameter} is carried out")
            cryo.orders = []
        busy = cryo.value != cryo.target or bool(cryo.orders)
        reading = InstrumentReading(TEMPERATURE, cryo.value, "K", 0.1, cryo.target, busy)
        report = InstrumentReadings(self._now_ns, "cryo", (reading,), tuple(outcomes), cryo.token)
        relayed = RelayedMessage("InstrumentReadings", self._codec.encode(report))
        self._answer_to_report = b""
        self._ask("cryo", RELAY_REQUEST, relayed)
        if self._answer_to_report:
            given = self._codec.decode(self._answer_to_report)
            cryo.token = given.token
            known = {order.number for order in cryo.orders}
            cryo.orders += [order for order in given.orders if order.number not in known]

    def _do_publish(self) -> None:
        self._publish_all()

    def _publish_all(self, *, at_least_one: bool = False) -> None:
        states = self._untold or ([self._state] if at_least_one else [])
        self._untold = []
        for state in states:
            self._publish("ScopeStateMsg", ScopeStatus(state))

    def _publish(self, message: str, thing: Any) -> None:
        self._now_ns += 1000
        self._step(PacketIn(Packet(message, self._codec.encode(thing), self._now_ns), PacketHeader(message)))

    def _do_continue(self) -> None:
        self._ask("person", ControlRequest.SET_CONTROL_MODE, int(ControlMode.AUTOMATED))
        self._ask("series", ControlRequest.REQUEST_CTRL, 0)

    def _do_end(self) -> None:
        # a state that begins by itself counts from its packet on, and no earlier
        if self.truth[SCANNING] and self._is_quiet:
            self._become(ScopeState.FREE)
            self._publish_all()

    def _do_panel(self, name: str, value: float) -> None:
        if not self._is_quiet:
            return
        before, self.truth[name] = self.truth[name], value
        change = ChangedValue(name, repr(before), repr(value), _UNITS[name])
        self._publish("ActByHand", ActByHand(self._now_ns, PanelAct.VALUES, "seen", (change,)))

    @property
    def _is_quiet(self) -> bool:
        # whether nothing is decided on values known before: no program can know what a person does next
        state = self._core.state
        is_deciding = self._flight is not None or state.pending.turn is not None or bool(state.instruments.given)
        return not is_deciding and not any(known.open for known in state.instruments.known.values())

    def _do_dial(self, value: float) -> None:
        if not self._is_quiet:
            return
        self.cryo.target = value
        for _ in range(2):
            self._do_report(False, False)

    def _do_kill(self, is_executed: bool) -> None:
        if self._flight is not None and is_executed:
            self._execute(self._flight.request)
        self._flight = None
        self._begin()

    def _do_wait(self, seconds: float) -> None:
        self._publish_all()  # a state is published within the time of a request
        self._now_s += seconds
        self._now_ns += round(seconds * 1e9)
        for _ in range(4):
            self._step(Tick())
