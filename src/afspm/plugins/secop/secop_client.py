"""`SecopClient`: the decisions of a SECoP client, without socket and clock.

The caller reports events with `connected`, `take`, `lost` and `tick`, and sends the lines that they return.
"""

from __future__ import annotations

import math
import re
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.basics import ConfigError, Plain, PlainMapping, UnitError, convert
from afspm.model import ControlResponse, InstrumentOrder, InstrumentReading, OrderOutcome
from afspm.plugins.secop import lines
from afspm.plugins.secop.channel import ROUNDED, Channel, ServerRamp, ServerUnfit
from afspm.plugins.secop.lines import SecopLine

POLL_S = 0.75
"""The least time between two requests for a value."""
SILENT_S = 3.0
"""A server that sends nothing for this time is disconnected, and connected again."""
STEP_S = 1.0
"""The least time between two steps of a target, where the server has no ramp of its own."""
_IS_BUSY = "IsBusy"  # the error class of a module that takes no target while it moves
_MOST_DONE = 64


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
        since_s: time since when the value must be measured, for an order to measure.
    """

    order: InstrumentOrder
    channel: Channel
    waits_for: str
    wanted: float
    ramp: RampInSteps | None = None
    ramp_limit: float | None = None
    since_s: float = -math.inf


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
            channel.lost(why)
        for ramp in self._ramps.values():
            ramp.is_interrupted, ramp.in_flight = True, False

    @property
    def is_working(self) -> bool:
        """Whether an answer of the server is awaited for an order."""
        return self._progress is not None

    def is_silent(self, now_s: float) -> bool:
        """Return whether the server has sent nothing for more than 3 s."""
        return now_s - self.heard_s > SILENT_S

    def tick(self, now_s: float) -> list[str]:
        """Return the lines that are due: requests for values, and steps of targets."""
        if not self.is_described:
            return []
        out = list[str]()
        if now_s - self.polled_s >= POLL_S:
            self.polled_s = now_s
            for channel in self.channels.values():
                out += channel.poll(now_s)
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
        if line is None or (not self.is_described and line.is_error):
            raise ServerUnfit(f"this is no SECoP server: it answers {text[:80]!r}")
        if line.action == "describing":
            self._describe(line.data)
            self._progress = None  # it follows the description before; the order comes again, as it has no outcome
            return [lines.ACTIVATE, *self.tick(now_s)]
        if not self.is_described:
            return []
        if line.action in ("update", "reply", "changed", "error_update", "error_read"):
            for channel in self.channels.values():
                channel.take(line, now_s)
        out = self._go_on(line, now_s)
        for name, ramp in list(self._ramps.items()):
            if line.specifier == self.channels[name].described.target and not ramp.in_flight:
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
        reason, ramp = channel.fault, self._ramps.get(channel.name)
        target = channel.target.number if ramp is None else ramp.final
        return InstrumentReading(
            channel.name,
            None if reason else channel.value.number,
            channel.described.unit,
            channel.value.age_s(now_s),
            target if target is not None and math.isfinite(target) else None,
            ramp is not None or channel.is_on_its_way(now_s),
            reason,
        )

    # --- the description ---

    def _describe(self, told: object) -> None:
        modules = told.get("modules") if isinstance(told, dict) else None
        if not isinstance(modules, dict):
            raise ServerUnfit("the server describes no modules")
        for channel in self.channels.values():
            was_wrong = bool(channel.unit_fault)
            channel.describe(modules)
            if channel.unit_fault and not was_wrong:
                self.log.append(f"{channel.name}: {channel.unit_fault}; it is not believed until the unit is back")
        self.is_described = True
        self.polled_s = -math.inf

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
        if not self.is_described and not order.is_reading:
            return []  # the order comes again until it has an outcome, or its client gives up
        reading = self._reading(channel, now_s)
        if order.is_reading and reading.value is not None:
            self._progress = OrderInProgress(order, channel, f"reply {channel.described.value}", math.nan)
            self._progress.since_s = now_s
            return [channel.measure(now_s)]
        if order.is_reading:
            self._finish(order, ControlResponse.PARAM_ERROR, f"{channel.name} is not known: {reading.reason}")
            return []
        try:
            number, rate_per_s = _in_unit(order, channel)
        except UnitError as error:
            self._finish(order, ControlResponse.PARAM_ERROR, str(error))
            return []
        if not channel.described.target:
            self._finish(order, ControlResponse.PARAM_NOT_SUPPORTED, f"{channel.name} can only be read")
            return []
        if reading.value is None:
            self._finish(order, ControlResponse.PARAM_ERROR, f"{channel.name} is not known: {reading.reason}")
            return []
        return self._begin(order, channel, number, rate_per_s, now_s)

    def _begin(
        self, order: InstrumentOrder, channel: Channel, number: float, rate_per_s: float | None, now_s: float
    ) -> list[str]:
        at = channel.described
        is_in_steps = rate_per_s is not None and at.ramp is None
        if is_in_steps and not at.low <= number <= at.high:  # the server would refuse the last steps only
            why = f"{channel.name} = {number:.6g} must be between {at.low:.6g} and {at.high:.6g}"
            self._finish(order, ControlResponse.PARAM_ERROR, f"{why} {at.unit} (the range of the server)")
            return []
        before = self._ramps.pop(channel.name, None)  # a new target replaces the steps to the one before
        if rate_per_s is not None and at.ramp is not None:
            limit = at.ramp.limit(rate_per_s)
            self._progress = OrderInProgress(order, channel, f"changed {at.ramp.rate}", number, ramp_limit=limit)
            return [lines.change(at.ramp.rate, limit)]
        if rate_per_s is not None:
            start = channel.start_of_steps(2.0 * rate_per_s * STEP_S) if before is None else before.sent
            start = min(max(start, at.low), at.high)  # the value itself may be just outside
            ramp = RampInSteps(number, rate_per_s, start, now_s, start)
            self._progress = OrderInProgress(order, channel, f"changed {at.target}", start, ramp)
            return [lines.change(at.target, start)]
        self._progress = OrderInProgress(order, channel, f"changed {at.target}", number)
        return [lines.change(at.target, number)]

    def _go_on(self, line: SecopLine, now_s: float) -> list[str]:
        progress, action = self._progress, "reply" if line.action == "error_read" else line.action
        text = f"{action} {line.specifier}"
        if line.action in ("error_change", "error_do") or line.action.startswith("error_change"):
            return self._take_refusal(line, now_s)
        if line.action == "changed":
            self._take_step(line, now_s)
        if progress is not None and progress.order.is_reading:
            self._take_reading(progress)
            return []
        if progress is None or text != progress.waits_for:
            return []
        channel, at = progress.channel, progress.channel.described
        if at.ramp is not None and progress.ramp_limit is not None and text == f"changed {at.ramp.rate}":
            return self._ramp_set(progress, at.ramp, progress.ramp_limit, line.number)
        if at.ramp is not None and text == f"changed {at.ramp.switch}":
            return self._ramp_switched(progress, at.ramp, line.value)
        if text == f"changed {at.target}":
            if progress.ramp is not None:
                confirmed = line.number
                start = progress.wanted if confirmed is None else confirmed
                ramp = progress.ramp
                self._ramps[channel.name] = RampInSteps(ramp.final, ramp.rate_per_s, start, now_s, ramp.ideal)
            # the module is busy before it answers; value, the target as the module rounded it, and status come next
            progress.waits_for = f"reply {channel.last_asked}"
            return channel.ask(now_s)
        self._finish(progress.order, ControlResponse.SUCCESS)
        return []

    def _take_reading(self, progress: OrderInProgress) -> None:
        channel = progress.channel
        if channel.fault:
            self._finish(progress.order, ControlResponse.PARAM_ERROR, f"{channel.name} is not known: {channel.fault}")
        elif channel.value.measured_s >= progress.since_s:  # a server that repeats an old value is polled again
            self._finish(progress.order, ControlResponse.SUCCESS)

    def _ramp_set(
        self, progress: OrderInProgress, ramp: ServerRamp, limit: float, confirmed: float | None
    ) -> list[str]:
        # 0 means "no ramp" at many controllers
        if confirmed is None or not 0.0 < confirmed <= limit * (1 + ROUNDED):
            why = f"{ramp.rate} should be {limit:.6g}, the server set {confirmed}"
            self._finish(progress.order, ControlResponse.PARAM_ERROR, why)
            return []
        if ramp.switch:
            progress.waits_for = f"changed {ramp.switch}"
            return [lines.switch_on(ramp.switch)]
        return self._set_target(progress)

    def _ramp_switched(self, progress: OrderInProgress, ramp: ServerRamp, confirmed: object) -> list[str]:
        if confirmed not in (True, 1):
            why = f"{ramp.switch} should be true, the server set {confirmed}"
            self._finish(progress.order, ControlResponse.PARAM_ERROR, why)
            return []
        return self._set_target(progress)

    def _set_target(self, progress: OrderInProgress) -> list[str]:
        target = progress.channel.described.target
        progress.waits_for = f"changed {target}"
        return [lines.change(target, progress.wanted)]

    def _take_refusal(self, line: SecopLine, now_s: float) -> list[str]:
        progress = self._progress
        for name, ramp in list(self._ramps.items()):
            if line.specifier == self.channels[name].described.target and ramp.in_flight:
                if line.error.startswith(_IS_BUSY):  # the module takes the step once it has arrived at the one before
                    ramp.sent, ramp.ideal, ramp.sent_s, ramp.in_flight = ramp.before, ramp.before, now_s, False
                    continue
                del self._ramps[name]
                self.log.append(f"{name} stays at {ramp.before:.6g}: the server refused a step ({line.error})")
        if progress is not None and line.specifier in progress.channel.described.set_by_orders:
            self._finish(progress.order, ControlResponse.PARAM_ERROR, f"{line.specifier}: {line.error}")
        return []

    def _next_step(self, channel: Channel, ramp: RampInSteps, now_s: float) -> list[str]:
        target = channel.target.number
        if self._progress is not None and self._progress.channel is channel:
            return []
        if ramp.in_flight or target is None:
            return []
        candidates = [ramp.sent]
        if ramp.is_interrupted:  # the last step may have been lost with the connection
            candidates.append(ramp.before)
        # a server may round a step after its answer; other targets are of another client
        if not any(abs(target - one) <= 2.0 * ramp.rate_per_s * STEP_S for one in candidates):
            self._leave(channel, ramp)
            return []
        ramp.sent = target
        if ramp.is_interrupted:
            ramp.ideal, ramp.sent_s, ramp.is_interrupted = ramp.sent, now_s, False
        passed_s = now_s - ramp.sent_s
        if passed_s < STEP_S:
            return []
        if ramp.target_s < ramp.sent_s:  # the step is sent at the answer, unless another client has set a target
            ramp.target_s = now_s
            return [lines.read(channel.described.target)]
        if channel.target.answered_s < ramp.target_s:
            return []
        if channel.fault:
            ramp.sent_s = now_s
            return []
        way = ramp.final - ramp.ideal
        step = math.copysign(min(abs(way), ramp.rate_per_s * min(passed_s, 2.0 * STEP_S)), way)
        if step == 0.0:
            del self._ramps[channel.name]
            return []
        ramp.ideal += step
        ramp.before, ramp.sent, ramp.in_flight = ramp.sent, ramp.ideal, True
        return [lines.change(channel.described.target, ramp.ideal)]

    def _take_step(self, line: SecopLine, now_s: float) -> None:
        for name, ramp in list(self._ramps.items()):
            if line.specifier != self.channels[name].described.target:
                continue
            confirmed = line.number
            ramp.sent, ramp.sent_s, ramp.in_flight = ramp.sent if confirmed is None else confirmed, now_s, False
            self.channels[name].approach.is_led = True
            if ramp.ideal == ramp.final:
                del self._ramps[name]

    def _leave(self, channel: Channel, ramp: RampInSteps) -> None:
        # a person at the instrument, or another client, has set a target, which afspm must not undo
        del self._ramps[channel.name]
        self.log.append(
            f"{channel.name}: another client set the target {channel.target.number}; the steps to {ramp.final:.6g} end"
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


def _in_unit(order: InstrumentOrder, channel: Channel) -> tuple[float, float | None]:
    wanted, unit = order.parameter, channel.described.unit
    number = _number_of_text(wanted.value)
    if number is None:
        raise UnitError(f"{wanted.name} = {wanted.value!r} is not a finite number")
    if not wanted.unit and unit:
        hint = f"give it, as in '{wanted.value} {unit}'"
        raise UnitError(f"{wanted.name} = {wanted.value} has no unit", hint=hint)
    value = float(convert(number, wanted.unit or "", unit))
    rate = order.rate_per_s
    return value, None if rate is None else float(convert(rate, order.rate_unit, unit))


def _number_of_text(text: str | None) -> float | None:
    try:
        number = float(text or "")
    except ValueError:
        return None
    return number if math.isfinite(number) else None
