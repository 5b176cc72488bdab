"""`SecopClient`: the decisions of a SECoP client, without socket and clock.

The caller reports events with `connected`, `take`, `lost` and `tick`, and sends the lines that they return.
"""

from __future__ import annotations

import math
import re
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.basics.errors import ConfigError, UnitError
from afspm.basics.plain_data import Plain, PlainMapping
from afspm.basics.units import convert
from afspm.model import ControlResponse, InstrumentOrder, InstrumentReading, OrderOutcome
from afspm.plugins.secop import lines
from afspm.plugins.secop.lines import SecopLine

POLL_S = 0.75
"""The least time between two requests for a value."""
SILENT_S = 3.0
"""A server that sends nothing for this time is disconnected, and connected again."""
BUSY_S = 3.0
"""A new target counts as on its way for at least this time: some servers report "idle" until their next cycle."""
STEP_S = 1.0
"""The least time between two steps of a target, where the server has no ramp of its own."""
_IDLE, _BUSY, _ERROR = 100, 300, 400
_NUMBERS = ("double", "int")
_IS_BUSY = "IsBusy"  # the error class of a module that takes no target while it moves
_ROUNDED = 1e-6  # relative: a server may keep a value in single precision
_MOST_DONE = 64
_RAMP_SWITCHES = ("ramp_enable", "use_ramp")
"""Names of the parameter of a module that switches its ramp on and off: of SECoP, and of frappy."""
_PER_TIME = re.compile(r"(.*)/\s*(s|sec|min|h|hr)")
_SECONDS = {"s": 1.0, "sec": 1.0, "min": 60.0, "h": 3600.0, "hr": 3600.0}


class ServerUnfit(Exception):
    """Error: the server does not provide what the experiment file demands."""


@dataclass
class Channel:
    """One parameter of the experiment, with its accessibles at the server.

    Attributes:
        value, target, status, ramp, ramp_switch: "module:accessible"; empty if the module has none.
        first_unit: unit in the first description; a later change of unit is a fault.
        per_s: factor from the unit of `ramp` to `unit` per second.
        fastest: highest `ramp`, as described by the server.
        low, high: range of the target, as described by the server.
        asked_s: time of the unanswered request for the value; None if there is none.
        measured_s: time of the request for the newest value.
        last_answer: (server's own time, value) of the last answer.
        changed_s: time when the target was set; target_answered_s: time of the last answer with the target.
        nearest: least distance of the value from the target `nearest_to` so far.
        is_led: whether afspm moved the target to `nearest_to` in steps.
        is_controlled: whether the module regulates to its target (`control_active`).
        fault: reason why there is no value.
        fault_of_status: reason to distrust the value, from the module's status.
    """

    name: str
    module: str
    accessible: str
    value: str = ""
    target: str = ""
    status: str = ""
    ramp: str = ""
    ramp_switch: str = ""
    unit: str = ""
    first_unit: str | None = None
    per_s: float = 0.0
    fastest: float = math.inf
    low: float = -math.inf
    high: float = math.inf
    asked_s: float | None = None
    measured_s: float = -math.inf
    last_answer: tuple[object, float] | None = None
    changed_s: float = -math.inf
    target_answered_s: float = -math.inf
    newest: float | None = None
    newest_target: float | None = None
    nearest: float = math.inf
    nearest_to: float = math.nan
    is_led: bool = False
    is_controlled: bool = True
    is_busy: bool = False
    fault: str = "not connected yet"
    fault_of_status: str = ""

    @property
    def set_by_orders(self) -> tuple[str, ...]:
        return self.ramp, self.ramp_switch, self.target

    @property
    def unit_fault(self) -> str:
        is_same = self.first_unit in (None, self.unit)
        return "" if is_same else f"its unit changed from {self.first_unit!r} to {self.unit!r}"

    def note_distance(self) -> None:
        """Compare the newest value with the newest target."""
        if self.newest is None or self.newest_target is None:
            return
        distance, is_same = abs(self.newest - self.newest_target), _is_close(self.newest_target, self.nearest_to)
        self.nearest, self.nearest_to = min(distance, self.nearest) if is_same else distance, self.newest_target
        self.is_led = self.is_led and is_same


@dataclass
class RampInSteps:
    """A target that is moved to `final` step by step.

    Attributes:
        sent: the last step, as confirmed by the server or as read back; before: the previous step.
        ideal: the last step before its rounding by the server.
        sent_s: time of the last step.
        in_flight: whether the last step is still unconfirmed.
        target_s: time of the request for the target, which must still be within two steps of the last step.
        is_interrupted: whether the connection or the process was lost: the target read afterwards decides how to
            continue.
    """

    final: float
    rate_per_s: float
    sent: float
    sent_s: float
    ideal: float
    before: float = math.nan
    in_flight: bool = False
    target_s: float = -math.inf
    is_interrupted: bool = False


@dataclass
class OrderInProgress:
    """The order that the server is carrying out.

    Attributes:
        waits_for: start of the expected answer, such as "changed module:ramp".
        wanted: the value to send.
        ramp: the steps that begin with `wanted`; None if `wanted` is final.
        ramp_limit: ramp rate that the server must confirm, in the server's unit; None if none was sent.
    """

    order: InstrumentOrder
    channel: Channel
    waits_for: str
    wanted: float
    ramp: RampInSteps | None = None
    ramp_limit: float | None = None


@dataclass
class SecopClient:
    """Client of one SECoP server.

    Args:
        wanted: "module" or "module:accessible", by parameter.
    """

    wanted: Mapping[str, str]
    channels: dict[str, Channel] = field(default_factory=dict)
    is_described: bool = False
    heard_s: float = -math.inf
    polled_s: float = -math.inf
    log: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        for name, spec in self.wanted.items():
            module, _, accessible = spec.partition(":")
            if not module or not re.fullmatch(r"[A-Za-z_]\w*(:[A-Za-z_]\w*)?", spec):
                raise ConfigError(
                    f"{spec!r} names no module", where=f"parameters.{name}", hint='e.g. "tt" or "lockin:sensitivity"'
                )
            self.channels[name] = Channel(name, module, accessible)
        self._ramps: dict[str, RampInSteps] = {}
        self._progress: OrderInProgress | None = None
        self._outcomes: dict[int, OrderOutcome] = {}
        self._done: OrderedDict[str, OrderOutcome] = OrderedDict()

    # --- the connection ---

    def connected(self, now_s: float) -> list[str]:
        """Begin a new connection; return the lines to send."""
        self.heard_s, self.is_described = now_s, False
        return [lines.IDENTIFY, lines.DESCRIBE]

    def lost(self, why: str) -> None:
        """End a connection. An order in progress stays without an outcome; a target moved in steps continues later."""
        self.is_described, self._progress = False, None
        for channel in self.channels.values():
            channel.asked_s, channel.newest_target, channel.fault = None, None, why
        for ramp in self._ramps.values():
            ramp.is_interrupted, ramp.in_flight = True, False

    def is_silent(self, now_s: float) -> bool:
        """Return whether the server has sent nothing for more than 3 s."""
        return now_s - self.heard_s > SILENT_S

    def tick(self, now_s: float) -> list[str]:
        """Return the lines that are due: requests for values, and steps of targets."""
        if not self.is_described:
            return []
        out = []
        if now_s - self.polled_s >= POLL_S:
            self.polled_s = now_s
            for channel in self.channels.values():
                if channel.asked_s is None:
                    channel.asked_s = now_s
                    out.append(lines.read(channel.value))
                    out += [lines.read(one) for one in (channel.status, channel.target) if one]
        for name in list(self._ramps):
            out += self._next_step(self.channels[name], self._ramps[name], now_s)
        return out

    def take(self, text: str, now_s: float) -> list[str]:
        """Process a line of the server; return the lines to send.

        Raises:
            ServerUnfit: the server is no SECoP server, or lacks something that the experiment file demands.
        """
        self.heard_s = now_s
        # the answer to *IDN? names the protocol, and has neither action nor data
        if not self.is_described and "SECoP" in text and not text.startswith("describing"):
            return []
        line = lines.parse(text)
        if line is None or (not self.is_described and line.action.startswith("error")):
            raise ServerUnfit(f"this is no SECoP server: it answers {text[:80]!r}")
        if line.action == "describing":
            self._describe(line.data)
            return [lines.ACTIVATE, *self.tick(now_s)]
        if not self.is_described:
            return []
        if line.action in ("update", "reply", "changed", "error_update", "error_read"):
            self._take_report(line, now_s)
        out = self._go_on(line, now_s)
        for name, ramp in list(self._ramps.items()):
            if line.specifier == self.channels[name].target and not ramp.in_flight:
                out += self._next_step(self.channels[name], ramp, now_s)
        return out

    # --- over a restart of the process ---

    def unfinished(self) -> Plain:
        """Return the targets that are moved in steps, in JSON's types, for `go_on_with`."""
        return {
            name: {
                "unit": self.channels[name].first_unit or "",
                **{key: getattr(ramp, key) for key in ("final", "rate_per_s", "sent", "ideal")},
            }
            for name, ramp in self._ramps.items()
        }

    def go_on_with(self, unfinished: PlainMapping) -> None:
        """Continue the steps of an earlier process, unless the first target read shows that another client set it."""
        for name, kept in unfinished.items():
            if (channel := self.channels.get(name)) is None:
                continue
            channel.first_unit = str(kept["unit"])
            final, rate_per_s, sent, ideal = (float(kept[key]) for key in ("final", "rate_per_s", "sent", "ideal"))
            ramp = RampInSteps(final, rate_per_s, sent, -math.inf, ideal, is_interrupted=True)
            ramp.before = ideal  # the last step may have been on its way
            self._ramps[name] = ramp

    # --- readings ---

    def readings(self, now_s: float) -> tuple[InstrumentReading, ...]:
        """Return the current readings of all parameters."""
        return tuple(self._reading(channel, now_s) for channel in self.channels.values())

    def _reading(self, channel: Channel, now_s: float) -> InstrumentReading:
        reason = channel.fault or channel.unit_fault or channel.fault_of_status
        ramp = self._ramps.get(channel.name)
        value = None if reason else channel.newest
        target = channel.newest_target if ramp is None else ramp.final
        return InstrumentReading(
            channel.name,
            value,
            channel.unit,
            now_s - channel.measured_s if math.isfinite(channel.measured_s) else None,
            target if target is not None and math.isfinite(target) else None,
            channel.is_busy or ramp is not None or now_s - channel.changed_s < BUSY_S,
            reason,
        )

    def _take_report(self, line: SecopLine, now_s: float) -> None:
        module, _, accessible = line.specifier.partition(":")
        specifier = line.specifier if accessible else f"{module}:value"
        for channel in self.channels.values():
            if specifier == channel.value:
                self._take_value(channel, line)
            if specifier == channel.target and not line.action.startswith("error"):
                channel.newest_target = _number(line.value)
                channel.note_distance()
                if line.action == "changed":
                    channel.changed_s = now_s
                if line.action == "reply":
                    channel.target_answered_s = now_s
            elif specifier == channel.status and not line.action.startswith("error"):
                self._take_status(channel, line.value)
            elif specifier == f"{channel.module}:control_active" and not line.action.startswith("error"):
                channel.is_controlled = line.value is not False

    def _take_value(self, channel: Channel, line: SecopLine) -> None:
        is_answer = line.action in ("reply", "error_read")
        asked_s = channel.asked_s if is_answer else None
        if is_answer:
            channel.asked_s = None
        if line.action.startswith("error"):
            channel.fault = line.error or "the server reports an error"
            return
        number = _number(line.value)
        if number is None or not math.isfinite(number):
            channel.fault = f"the server answers {line.value!r}"
            return
        channel.newest, channel.fault = number, ""
        channel.note_distance()
        if asked_s is None:
            return
        # the same value of the same time as in the answer before: the server is alive, its instrument is not. A
        # setting may keep the time of its last change
        answer = (line.time, number)
        is_repeated = line.time is not None and answer == channel.last_answer and not channel.accessible
        channel.last_answer = answer
        if not is_repeated:
            channel.measured_s = asked_s

    def _take_status(self, channel: Channel, status: object) -> None:
        code, text = (status[0], str(status[1])) if isinstance(status, list) and len(status) > 1 else (status, "")
        if not isinstance(code, int):
            channel.fault_of_status = f"the server answers the status {status!r}"
            return
        channel.is_busy = _BUSY <= code < _ERROR
        is_well = _IDLE <= code < _ERROR
        channel.fault_of_status = "" if is_well else f"status {code}: {text[:200] or 'no text'}"

    # --- the description ---

    def _describe(self, told: object) -> None:
        modules = told.get("modules") if isinstance(told, dict) else None
        if not isinstance(modules, dict):
            raise ServerUnfit("the server describes no modules")
        for channel in self.channels.values():
            self._describe_channel(channel, modules)
        self.is_described = True
        self.polled_s = -math.inf

    def _describe_channel(self, channel: Channel, modules: Mapping[str, object]) -> None:
        found = modules.get(channel.module)
        accessibles = found.get("accessibles") if isinstance(found, dict) else None
        if not isinstance(accessibles, dict):
            raise ServerUnfit(f"there is no module {channel.module!r}; the server has {', '.join(sorted(modules))}")
        wanted = channel.accessible or "value"
        info = _info(accessibles, wanted)
        if info is None or info.get("type") not in _NUMBERS:
            having = [name for name in accessibles if (_info(accessibles, name) or {}).get("type") in _NUMBERS]
            what = f"{channel.module}:{wanted} is no number, or is missing"
            raise ServerUnfit(f"{what}; the module has the numbers {', '.join(having) or '(none)'}")
        channel.value, channel.unit = f"{channel.module}:{wanted}", str(info.get("unit", ""))
        if channel.first_unit is None:
            channel.first_unit = channel.unit
        if channel.unit_fault:
            self.log.append(f"{channel.name}: {channel.unit_fault}; it is not believed until the unit is back")
        settable = wanted if channel.accessible else "target"
        channel.target = f"{channel.module}:{settable}" if _is_settable(accessibles, settable) else ""
        bounds = _info(accessibles, settable) or {}
        low, high = (_number(bounds.get(one)) for one in ("min", "max"))
        channel.low, channel.high = -math.inf if low is None else low, math.inf if high is None else high
        channel.status = f"{channel.module}:status" if "status" in accessibles else ""
        channel.is_controlled = True
        channel.ramp, channel.ramp_switch, channel.per_s = "", "", 0.0
        per_s = _per_s(_info(accessibles, "ramp"), channel.unit) if _is_settable(accessibles, "ramp") else None
        switch = next((one for one in _RAMP_SWITCHES if one in accessibles and not _is_on(accessibles, one)), "")
        # without a ramp that is certainly on, the target is moved in steps
        if per_s is not None and not channel.accessible and (not switch or _is_settable(accessibles, switch)):
            channel.ramp, channel.per_s = f"{channel.module}:ramp", per_s
            fastest = _number((_info(accessibles, "ramp") or {}).get("max"))
            channel.fastest = math.inf if fastest is None else fastest
            channel.ramp_switch = f"{channel.module}:{switch}" if switch else ""

    # --- orders ---

    def order(self, order: InstrumentOrder, now_s: float) -> list[str]:
        """Begin an order unless already known; return the lines to send."""
        if self._progress is not None and self._progress.order.id == order.id:
            return []
        if (known := self._done.get(order.id)) is not None:
            self._outcomes[order.number] = OrderOutcome(order.number, known.response, known.reason)
            return []
        channel = self.channels.get(order.parameter.name)
        if channel is None:
            self._finish(order, ControlResponse.PARAM_NOT_SUPPORTED, f"there is no parameter {order.parameter.name!r}")
            return []
        if not self.is_described:
            return []  # the order comes again until it has an outcome, or its client gives up
        try:
            number, rate_per_s = _in_unit(order, channel)
        except UnitError as error:
            self._finish(order, ControlResponse.PARAM_ERROR, str(error))
            return []
        if not channel.target:
            self._finish(order, ControlResponse.PARAM_NOT_SUPPORTED, f"{channel.name} can only be read")
            return []
        reading = self._reading(channel, now_s)
        if reading.value is None:
            self._finish(order, ControlResponse.PARAM_ERROR, f"{channel.name} is not known: {reading.reason}")
            return []
        return self._begin(order, channel, number, rate_per_s, now_s)

    def _begin(
        self, order: InstrumentOrder, channel: Channel, number: float, rate_per_s: float | None, now_s: float
    ) -> list[str]:
        is_in_steps = rate_per_s is not None and not channel.ramp
        if is_in_steps and not channel.low <= number <= channel.high:  # the server would refuse the last steps only
            why = f"{channel.name} = {number:.6g} must be between {channel.low:.6g} and {channel.high:.6g}"
            self._finish(order, ControlResponse.PARAM_ERROR, f"{why} {channel.unit} (the range of the server)")
            return []
        before = self._ramps.pop(channel.name, None)  # a new target replaces the steps to the one before
        if rate_per_s is not None and channel.ramp:
            limit = min(rate_per_s / channel.per_s, channel.fastest)
            self._progress = OrderInProgress(order, channel, f"changed {channel.ramp}", number, ramp_limit=limit)
            return [lines.change(channel.ramp, limit)]
        if rate_per_s is not None:
            start = self._start_of_steps(channel, rate_per_s) if before is None else before.sent
            start = min(max(start, channel.low), channel.high)  # the value itself may be just outside
            ramp = RampInSteps(number, rate_per_s, start, now_s, start)
            self._progress = OrderInProgress(order, channel, f"changed {channel.target}", start, ramp)
            return [lines.change(channel.target, start)]
        self._progress = OrderInProgress(order, channel, f"changed {channel.target}", number)
        return [lines.change(channel.target, number)]

    def _start_of_steps(self, channel: Channel, rate_per_s: float) -> float:
        # At the target, if it is in force: a setpoint that jumps to the value is too fast. Else at the value: the
        # target of a heater that was switched off, or of a magnet that was moved at its panel, may be anywhere.
        assert channel.newest is not None
        target, near = channel.newest_target, 2.0 * rate_per_s * STEP_S
        if target is None or not channel.is_controlled:
            return channel.newest
        distance = abs(target - channel.newest)
        # behind steps of afspm the value may lag, or stay beside the target; a value that leaves it exceeds `nearest`
        is_behind = channel.is_led and distance <= channel.nearest + near
        # a value that has left its target is disturbed while the module is busy; a value that was never near it may be
        # on its way to the target of another client, which may be far away
        is_disturbed = channel.is_busy and (channel.is_led or channel.nearest <= near)
        return target if distance <= near or is_behind or is_disturbed else channel.newest

    def _go_on(self, line: SecopLine, now_s: float) -> list[str]:
        progress, text = self._progress, f"{line.action} {line.specifier}"
        if line.action in ("error_change", "error_do") or line.action.startswith("error_change"):
            return self._take_refusal(line, now_s)
        if line.action == "changed":
            self._take_step(line, now_s)
        if progress is None or text != progress.waits_for:
            return []
        channel = progress.channel
        if progress.ramp_limit is not None and text == f"changed {channel.ramp}":
            return self._ramp_set(progress, _number(line.value))
        if text == f"changed {channel.ramp_switch}":
            return self._ramp_switched(progress, line.value)
        if text == f"changed {channel.target}":
            if progress.ramp is not None:
                confirmed = _number(line.value)
                start = progress.wanted if confirmed is None else confirmed
                ramp = progress.ramp
                self._ramps[channel.name] = RampInSteps(ramp.final, ramp.rate_per_s, start, now_s, ramp.ideal)
            if channel.status:
                # the module is busy before it answers; its status comes next, after the target as the module rounded it
                progress.waits_for = f"reply {channel.status}"
                return [lines.read(channel.target), lines.read(channel.status)]
        self._finish(progress.order, ControlResponse.SUCCESS)
        return []

    def _ramp_set(self, progress: OrderInProgress, confirmed: float | None) -> list[str]:
        channel, limit = progress.channel, progress.ramp_limit
        assert limit is not None
        # 0 means "no ramp" at many controllers
        if confirmed is None or not 0.0 < confirmed <= limit * (1 + _ROUNDED):
            why = f"{channel.ramp} should be {limit:.6g}, the server set {confirmed}"
            self._finish(progress.order, ControlResponse.PARAM_ERROR, why)
            return []
        if channel.ramp_switch:
            progress.waits_for = f"changed {channel.ramp_switch}"
            return [lines.switch_on(channel.ramp_switch)]
        return self._set_target(progress)

    def _ramp_switched(self, progress: OrderInProgress, confirmed: object) -> list[str]:
        channel = progress.channel
        if confirmed not in (True, 1):
            why = f"{channel.ramp_switch} should be true, the server set {confirmed}"
            self._finish(progress.order, ControlResponse.PARAM_ERROR, why)
            return []
        return self._set_target(progress)

    def _set_target(self, progress: OrderInProgress) -> list[str]:
        progress.waits_for = f"changed {progress.channel.target}"
        return [lines.change(progress.channel.target, progress.wanted)]

    def _take_refusal(self, line: SecopLine, now_s: float) -> list[str]:
        progress = self._progress
        for name, ramp in list(self._ramps.items()):
            if line.specifier == self.channels[name].target and ramp.in_flight:
                if line.error.startswith(_IS_BUSY):  # the module takes the step once it has arrived at the one before
                    ramp.sent, ramp.ideal, ramp.sent_s, ramp.in_flight = ramp.before, ramp.before, now_s, False
                    continue
                del self._ramps[name]
                self.log.append(f"{name} stays at {ramp.before:.6g}: the server refused a step ({line.error})")
        if progress is not None and line.specifier in progress.channel.set_by_orders:
            self._finish(progress.order, ControlResponse.PARAM_ERROR, f"{line.specifier}: {line.error}")
        return []

    def _next_step(self, channel: Channel, ramp: RampInSteps, now_s: float) -> list[str]:
        if self._progress is not None and self._progress.channel is channel:
            return []
        if ramp.in_flight or channel.newest_target is None:
            return []
        candidates = [ramp.sent]
        if ramp.is_interrupted:  # the last step may have been lost with the connection
            candidates.append(ramp.before)
        # a server may round a step after its answer; other targets are of another client
        if not any(abs(channel.newest_target - one) <= 2.0 * ramp.rate_per_s * STEP_S for one in candidates):
            self._leave(channel, ramp)
            return []
        ramp.sent = channel.newest_target
        if ramp.is_interrupted:
            ramp.ideal, ramp.sent_s, ramp.is_interrupted = ramp.sent, now_s, False
        passed_s = now_s - ramp.sent_s
        if passed_s < STEP_S:
            return []
        if ramp.target_s < ramp.sent_s:  # the step is sent at the answer, unless another client has set a target
            ramp.target_s = now_s
            return [lines.read(channel.target)]
        if channel.target_answered_s < ramp.target_s:
            return []
        if channel.fault or channel.unit_fault or channel.fault_of_status:
            ramp.sent_s = now_s
            return []
        way = ramp.final - ramp.ideal
        step = math.copysign(min(abs(way), ramp.rate_per_s * min(passed_s, 2.0 * STEP_S)), way)
        if step == 0.0:
            del self._ramps[channel.name]
            return []
        ramp.ideal += step
        ramp.before, ramp.sent, ramp.in_flight = ramp.sent, ramp.ideal, True
        return [lines.change(channel.target, ramp.ideal)]

    def _take_step(self, line: SecopLine, now_s: float) -> None:
        for name, ramp in list(self._ramps.items()):
            if line.specifier != self.channels[name].target:
                continue
            confirmed = _number(line.value)
            ramp.sent, ramp.sent_s, ramp.in_flight = ramp.sent if confirmed is None else confirmed, now_s, False
            self.channels[name].is_led = True
            if ramp.ideal == ramp.final:
                del self._ramps[name]

    def _leave(self, channel: Channel, ramp: RampInSteps) -> None:
        # a person at the instrument, or another client, has set a target, which afspm must not undo
        del self._ramps[channel.name]
        self.log.append(
            f"{channel.name}: another client set the target {channel.newest_target}; the steps to {ramp.final:.6g} end"
        )

    def _finish(self, order: InstrumentOrder, response: ControlResponse, reason: str = "") -> None:
        outcome = OrderOutcome(order.number, int(response), reason)
        self._outcomes[order.number] = outcome
        self._done[order.id] = outcome
        while len(self._done) > _MOST_DONE:
            self._done.popitem(last=False)
        if self._progress is not None and self._progress.order.id == order.id:
            self._progress = None

    def outcomes(self) -> tuple[OrderOutcome, ...]:
        """Return the outcomes that were not delivered to the scheduler yet."""
        return tuple(self._outcomes.values())

    def delivered(self, outcomes: tuple[OrderOutcome, ...]) -> None:
        """Forget the outcomes that were delivered to the scheduler."""
        for one in outcomes:
            self._outcomes.pop(one.number, None)


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


def _per_s(info: Mapping[str, object] | None, unit: str) -> float | None:
    # the factor from the unit of a ramp, such as "K/min", to `unit` per second; None: another kind of unit
    found = _PER_TIME.fullmatch(str((info or {}).get("unit", "")).strip())
    if found is None:
        return None
    try:
        return float(convert(1.0, found[1].strip(), unit)) / _SECONDS[found[2]]
    except UnitError:
        return None


def _in_unit(order: InstrumentOrder, channel: Channel) -> tuple[float, float | None]:
    wanted = order.parameter
    number = _number_of_text(wanted.value)
    if number is None:
        raise UnitError(f"{wanted.name} = {wanted.value!r} is not a finite number")
    if not wanted.unit and channel.unit:
        hint = f"give it, as in '{wanted.value} {channel.unit}'"
        raise UnitError(f"{wanted.name} = {wanted.value} has no unit", hint=hint)
    value = float(convert(number, wanted.unit or "", channel.unit))
    rate = order.rate_per_s
    return value, None if rate is None else float(convert(rate, order.rate_unit, channel.unit))


def _number_of_text(text: str | None) -> float | None:
    try:
        number = float(text or "")
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _is_close(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=_ROUNDED, abs_tol=1e-12)
