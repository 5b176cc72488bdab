"""`Channel`: one parameter of the experiment at a SECoP server, without socket and clock.

| part | from | answers |
| --- | --- | --- |
| `ChannelDescription` | the server's description | names at the server, unit, range, ramp of the server |
| `PolledValue` | replies and updates of the value | the newest value, its age, the reason why there is none |
| `ReportedTarget` | replies and updates of the target | the target, whether it was set just now |
| `ModuleState` | status and `control_active` | busy, regulating, the reason to distrust the value |
| `Approach` | value and target | how near the value has come to the target |
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.basics import UnitError, convert, escaped
from afspm.plugins.secop import lines
from afspm.plugins.secop.lines import SecopLine, number_in

BUSY_S = 3.0
"""An idle module whose value is still away from a new target is not believed for this time: some servers report "idle"
until their next cycle."""
ARRIVED = 0.05
"""Distance from a new target, as a part of the way to it, at which an idle module is believed at once."""
ROUNDED = 1e-6
"""Relative difference of equal numbers: a server may keep a value in single precision."""
_IDLE, _BUSY, _ERROR = 100, 300, 400
_NUMBERS = ("double", "int")
_RAMP_SWITCHES = ("ramp_enable", "use_ramp")
"""Names of the parameter of a module that switches its ramp on and off: of SECoP, and of frappy."""
_PER_TIME = re.compile(r"(.*)/\s*(s|sec|min|h|hr)")
_SECONDS = {"s": 1.0, "sec": 1.0, "min": 60.0, "h": 3600.0, "hr": 3600.0}


class ServerUnfit(Exception):
    """Error: the server does not provide what the experiment file demands."""


# --- the description


@dataclass(frozen=True)
class ServerRamp:
    """The ramp of a module, which limits the rate of its target.

    Attributes:
        rate: "module:ramp", the rate in the server's unit.
        switch: "module:accessible" that switches the ramp on; empty if it is always on.
        per_s: factor from the server's unit of the rate to the unit of the value per second.
        fastest: highest rate in the server's unit.
    """

    rate: str
    switch: str
    per_s: float
    fastest: float

    def limit(self, rate_per_s: float) -> float:
        """Return the rate to set, in the server's unit, for a rate in the unit of the value per second."""
        return min(rate_per_s / self.per_s, self.fastest)


@dataclass(frozen=True)
class ChannelDescription:
    """A parameter as the server describes it.

    Attributes:
        value, target, status: "module:accessible"; empty if the module has none.
        low, high: range of the target.
        ramp: None if no ramp of the server is certainly on: the target is then moved in steps.
    """

    value: str = ""
    target: str = ""
    status: str = ""
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    ramp: ServerRamp | None = None

    @property
    def set_by_orders(self) -> tuple[str, ...]:
        """The accessibles that an order may set."""
        rate, switch = ("", "") if self.ramp is None else (self.ramp.rate, self.ramp.switch)
        return tuple(filter(None, (rate, switch, self.target)))


def described(modules: Mapping[str, object], module: str, accessible: str) -> ChannelDescription:
    """Return one parameter from a server's description of its modules.

    Args:
        accessible: empty for the value and the target of the module itself.

    Raises:
        ServerUnfit: the module is missing, or has no such number.
    """
    found = modules.get(module)
    accessibles = found.get("accessibles") if isinstance(found, dict) else None
    if not isinstance(accessibles, dict):
        raise ServerUnfit(f"there is no module {module!r}; the server has {escaped(', '.join(sorted(modules)))}")
    value = accessible or "value"
    info = _info(accessibles, value)
    if info is None or info.get("type") not in _NUMBERS:
        having = [name for name in accessibles if (_info(accessibles, name) or {}).get("type") in _NUMBERS]
        what = f"{module}:{value} is no number, or is missing"
        raise ServerUnfit(f"{what}; the module has the numbers {escaped(', '.join(having)) or '(none)'}")
    unit = escaped(str(info.get("unit", "")))
    target = accessible or "target"
    bounds = _info(accessibles, target) or {}
    low, high = (number_in(bounds.get(one)) for one in ("min", "max"))
    return ChannelDescription(
        value=f"{module}:{value}",
        target=f"{module}:{target}" if _is_settable(accessibles, target) else "",
        status=f"{module}:status" if "status" in accessibles else "",
        unit=unit,
        low=-math.inf if low is None else low,
        high=math.inf if high is None else high,
        ramp=None if accessible else _ramp(accessibles, module, unit),
    )


def _ramp(accessibles: Mapping[str, object], module: str, unit: str) -> ServerRamp | None:
    # None unless the ramp is certainly on, or can be switched on
    info = _info(accessibles, "ramp") or {}
    per_s = _per_s(info, unit) if _is_settable(accessibles, "ramp") else None
    switch = next((one for one in _RAMP_SWITCHES if one in accessibles and not _is_on(accessibles, one)), "")
    if per_s is None or (switch and not _is_settable(accessibles, switch)):
        return None
    fastest = number_in(info.get("max"))
    return ServerRamp(
        f"{module}:ramp", f"{module}:{switch}" if switch else "", per_s, math.inf if fastest is None else fastest
    )


def _info(accessibles: Mapping[str, object], name: str) -> Mapping[str, object] | None:
    found = accessibles.get(name)
    info = found.get("datainfo") if isinstance(found, dict) else None
    return info if isinstance(info, dict) else None


def _is_settable(accessibles: Mapping[str, object], name: str) -> bool:
    found = accessibles.get(name)
    return isinstance(found, dict) and not found.get("readonly", True) and _info(accessibles, name) is not None


def _is_on(accessibles: Mapping[str, object], name: str) -> bool:
    # a switch with a constant value
    found = accessibles.get(name)
    return isinstance(found, dict) and found.get("constant") is True


def _per_s(info: Mapping[str, object], unit: str) -> float | None:
    # the factor from the unit of a ramp, such as "K/min", to `unit` per second; None: another kind of unit
    found = _PER_TIME.fullmatch(str(info.get("unit", "")).strip())
    if found is None:
        return None
    try:
        return float(convert(1.0, found[1].strip(), unit)) / _SECONDS[found[2]]
    except UnitError:
        return None


# --- the reports


@dataclass
class PolledValue:
    """The newest value of a parameter, and its freshness.

    Attributes:
        number: None before the first value.
        fault: reason why there is no value.
        asked_s: times of the unanswered requests, oldest first: a server answers in order.
        measured_s: time of the request for the newest value.
        last_answer: (server's own time, value) of the last answer.
    """

    number: float | None = None
    fault: str = "not connected yet"
    asked_s: list[float] = field(default_factory=list)
    measured_s: float = -math.inf
    last_answer: tuple[object, float] | None = None

    def lost(self, why: str) -> None:
        self.asked_s, self.fault = [], why

    def age_s(self, now_s: float) -> float | None:
        return now_s - self.measured_s if math.isfinite(self.measured_s) else None

    def take(self, line: SecopLine, *, is_setting: bool) -> bool:
        """Process a report; return whether it has a number.

        Args:
            is_setting: whether the value may keep the time of its last change.
        """
        is_answer = line.action in ("reply", "error_read")
        asked_s = self.asked_s.pop(0) if is_answer and self.asked_s else None
        if line.is_error:
            self.fault = line.error or "the server reports an error"
            return False
        number = line.number
        if number is None or not math.isfinite(number):
            self.fault = f"the server answers {escaped(repr(line.value))}"
            return False
        self.number, self.fault = number, ""
        if asked_s is not None:
            # the same value of the same time as in the answer before: the server is alive, its instrument is not
            answer = (line.time, number)
            is_repeated = line.time is not None and answer == self.last_answer and not is_setting
            self.last_answer = answer
            if not is_repeated:
                self.measured_s = asked_s
        return True


@dataclass
class ReportedTarget:
    """The target at the server, set by afspm or by another client.

    Attributes:
        number: None if unknown.
        changed_s: time of the last answer to a change by afspm; -inf before.
        answered_s: time of the last answer to a request for the target.
        way: distance of the value from the target when afspm has changed it.
    """

    number: float | None = None
    changed_s: float = -math.inf
    answered_s: float = -math.inf
    way: float = 0.0

    def take(self, line: SecopLine, value: float | None, now_s: float) -> None:
        self.number = line.number
        if line.action == "changed":
            self.changed_s = now_s
            self.way = 0.0 if value is None or self.number is None else abs(self.number - value)
        if line.action == "reply":
            self.answered_s = now_s


@dataclass
class ModuleState:
    """The state of a module.

    Attributes:
        is_controlled: whether the module regulates to its target (`control_active`).
        fault: reason to distrust the value, from the status.
        answered_s: time of the last answer to a request for the status.
        busy_s: time of the last report that the module is busy.
    """

    is_busy: bool = False
    is_controlled: bool = True
    fault: str = ""
    answered_s: float = -math.inf
    busy_s: float = -math.inf

    def take_status(self, status: object, now_s: float) -> None:
        code, text = (status[0], str(status[1])) if isinstance(status, list) and len(status) > 1 else (status, "")
        if not isinstance(code, int):
            self.fault = f"the server answers the status {escaped(repr(status))}"
            return
        self.is_busy = _BUSY <= code < _ERROR
        self.busy_s = now_s if self.is_busy else self.busy_s
        is_well = _IDLE <= code < _ERROR
        self.fault = "" if is_well else f"status {code}: {escaped(text) or 'no text'}"


@dataclass
class Approach:
    """The way of the value to one target.

    Attributes:
        target: the target that `nearest` and `is_led` refer to.
        nearest: least distance of the value from the target so far.
        is_led: whether afspm moved the target here in steps.
    """

    target: float = math.nan
    nearest: float = math.inf
    is_led: bool = False

    def note(self, value: float, target: float) -> None:
        """Compare the newest value with the newest target."""
        distance, is_same = abs(value - target), math.isclose(target, self.target, rel_tol=ROUNDED, abs_tol=1e-12)
        self.nearest, self.target = min(distance, self.nearest) if is_same else distance, target
        self.is_led = self.is_led and is_same


@dataclass
class Channel:
    """One parameter of the experiment at its server.

    Attributes:
        accessible: empty for the value and the target of the module itself.
        first_unit: unit in the first description; a later change of unit is a fault.
    """

    name: str
    module: str
    accessible: str
    first_unit: str | None = None
    described: ChannelDescription = field(default_factory=ChannelDescription)
    value: PolledValue = field(default_factory=PolledValue)
    target: ReportedTarget = field(default_factory=ReportedTarget)
    state: ModuleState = field(default_factory=ModuleState)
    approach: Approach = field(default_factory=Approach)

    @property
    def unit_fault(self) -> str:
        unit = self.described.unit
        is_same = self.first_unit in (None, unit)
        return "" if is_same else f"its unit changed from {self.first_unit!r} to {unit!r}"

    @property
    def fault(self) -> str:
        """The reason to report no value; empty if the newest value holds."""
        return self.value.fault or self.unit_fault or self.state.fault

    def describe(self, modules: Mapping[str, object]) -> None:
        """Take the description of a new connection. Raises ServerUnfit."""
        self.described = described(modules, self.module, self.accessible)
        if self.first_unit is None:
            self.first_unit = self.described.unit
        self.state.is_controlled = True

    def lost(self, why: str) -> None:
        """End a connection: another client may set the target meanwhile."""
        self.value.lost(why)
        self.target.number = None

    def is_on_its_way(self, now_s: float) -> bool:
        """Return whether the value is on its way to a target."""
        target, state = self.target, self.state
        if state.is_busy or (self.described.status and state.answered_s < target.changed_s):
            return True
        if now_s - target.changed_s >= BUSY_S or state.busy_s > target.changed_s:
            return False
        value, number = self.value, target.number
        if value.number is None or number is None or value.measured_s < target.changed_s:
            return True
        return abs(value.number - number) > max(ARRIVED * target.way, ROUNDED * abs(number))

    def poll(self, now_s: float) -> list[str]:
        """Return the requests for value, status and target, unless an earlier request is unanswered."""
        return [] if self.value.asked_s else self.ask(now_s)

    def ask(self, now_s: float) -> list[str]:
        """Return the requests for value, target and status; the last one's answer has the specifier `last_asked`."""
        at = self.described
        others = [one for one in (at.target, at.status) if one and one != at.value]
        return [self.measure(now_s), *map(lines.read, others)]

    @property
    def last_asked(self) -> str:
        at = self.described
        return at.status or at.target or at.value

    def measure(self, now_s: float) -> str:
        """Return the request for the value."""
        self.value.asked_s.append(now_s)
        return lines.read(self.described.value)

    def take(self, line: SecopLine, now_s: float) -> None:
        """Process a report of the server on any of its parameters."""
        module, _, accessible = line.specifier.partition(":")
        specifier = line.specifier if accessible else f"{module}:value"
        if specifier == self.described.value and self.value.take(line, is_setting=bool(self.accessible)):
            self._note_approach()
        if line.is_error:
            return
        if specifier == self.described.target:
            self.target.take(line, self.value.number, now_s)
            self._note_approach()
        elif specifier == self.described.status:
            self.state.take_status(line.value, now_s)
            if line.action == "reply":
                self.state.answered_s = now_s
        elif specifier == f"{self.module}:control_active":
            self.state.is_controlled = line.value is not False

    def _note_approach(self) -> None:
        if self.value.number is not None and self.target.number is not None:
            self.approach.note(self.value.number, self.target.number)

    def start_of_steps(self, near: float) -> float:
        """Return where steps to a new target begin: at the target if it is in force, otherwise at the value.

        A setpoint that jumps to the value is too fast; the target of a heater that was switched off, or of a magnet
        that was moved at its panel, may be anywhere.

        Args:
            near: distance between value and target that steps at the wanted rate may leave.
        """
        value, target = self.value.number, self.target.number
        assert value is not None
        if target is None or not self.state.is_controlled:
            return value
        distance, approach = abs(target - value), self.approach
        # behind steps of afspm the value may lag, or stay beside the target; a value that leaves it exceeds `nearest`
        is_behind = approach.is_led and distance <= approach.nearest + near
        # a value that has left its target is disturbed while the module is busy; a value that was never near it may be
        # on its way to the target of another client, which may be far away
        is_disturbed = self.state.is_busy and (approach.is_led or approach.nearest <= near)
        return target if distance <= near or is_behind or is_disturbed else value
