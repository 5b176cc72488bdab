"""`Instruments`: the last readings of other instruments, and their open orders."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from afspm.basics.frozen import replace
from afspm.model import ControlResponse, InstrumentOrder, InstrumentReading, InstrumentReadings, OrderOutcome, Parameter
from afspm.model.instruments import GivenOrder, instrument_of, split
from afspm.scheduler.events import RequestIn
from afspm.scheduler.instruments.conditions import OLDEST_S, ConditionState, InstrumentSettings, MeasuringCondition
from afspm.scheduler.requests.forwarder import ForwardedRequest

PUBLISH_S = 10.0
"""Interval of publications of unchanged readings, real."""
PUBLISH_CHANGED_S = 1.0
"""Least interval of publications of changed numbers, real."""
_MOST_PARAMETERS = 100  # of one instrument: memory must stay bounded
_NEVER_S = float("-inf")
_JUST_AFTER_S = 1e-3  # a reading of exactly the oldest age still counts


@dataclass(frozen=True)
class KnownReading:
    """A reading, and the earliest real time at which it can have been measured; -inf: unknown."""

    reading: InstrumentReading
    measured_s: float = _NEVER_S


@dataclass(frozen=True)
class OpenOrder:
    """A request for an instrument, to set or to measure.

    Attributes:
        job: the request of the client.
        order: the order given to the instrument; None: the request still waits for a report.
        read: the values of the microscope that forbidden states need, by name; None where it reports no value.
        read_s: the real time at which these were asked for; None: not yet.
    """

    job: ForwardedRequest
    order: InstrumentOrder | None = None
    read: Mapping[str, Parameter | None] = field(default_factory=dict)
    read_s: float | None = None


@dataclass(frozen=True)
class KnownInstrument:
    """The last readings and open orders of one instrument.

    Attributes:
        token: the token of the last answer to a report; given_s: the real time of that answer.
        published: the readings published last; published_s: their time, real.
        held: the last report, while its answer is held back; held_until_s: at the latest until then, real.
    """

    token: int = 0
    given_s: float = _NEVER_S
    readings: Mapping[str, KnownReading] = field(default_factory=dict)
    open: tuple[OpenOrder, ...] = ()
    published: tuple[InstrumentReading, ...] = ()
    published_s: float = _NEVER_S
    held: RequestIn | None = None
    held_until_s: float = _NEVER_S


@dataclass(frozen=True)
class Instruments:
    """The instruments of an experiment.

    Attributes:
        units: the first unit of each parameter, kept over a restart: a reading in another unit is rejected.
        number: the number of the newest order or token.
        states: the states of the conditions, by name.
        given: the orders that may still be carried out, or whose value is on its way.
        awaited_until_s: the real time until which a first reading is awaited; None: conditions were not evaluated yet.
        changed_s: the real time of the last answer to a request that may have changed something, or of the start.
    """

    settings: InstrumentSettings = field(default_factory=InstrumentSettings)
    known: Mapping[str, KnownInstrument] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    number: int = 0
    states: Mapping[str, ConditionState] = field(default_factory=dict)
    given: tuple[GivenOrder, ...] = ()
    awaited_until_s: float | None = None
    changed_s: float = _NEVER_S

    # --- readings ---

    def owns(self, parameter: str) -> bool:
        """Return whether a parameter belongs to an instrument of this experiment."""
        return instrument_of(parameter) in self.settings.instruments

    def reading(self, parameter: str, now_s: float) -> InstrumentReading:
        """Return the last reading of a parameter, without a value if there is no recent reading."""
        known = self._of(instrument_of(parameter)).readings.get(parameter)
        if known is None:
            return InstrumentReading(parameter, reason=f"{instrument_of(parameter)} has not reported it")
        if now_s - known.measured_s <= OLDEST_S:
            return known.reading
        why = known.reading.reason or f"its last reading is older than {OLDEST_S:g} s"
        return replace(known.reading, value=None, reason=why)

    def age_s(self, parameter: str, now_s: float) -> float:
        """Return the longest time since a parameter can have been measured; inf: never."""
        known = self._of(instrument_of(parameter)).readings.get(parameter)
        return now_s - (_NEVER_S if known is None else known.measured_s)

    def is_from_before_a_change(self, parameter: str, now_s: float) -> bool:
        """Return whether a parameter may have been measured before the last change of anything by the run."""
        return self.age_s(parameter, now_s) > now_s - self.changed_s

    def changed(self, now_s: float) -> Instruments:
        """Store that something may have changed until now: older readings are no answer to a later request."""
        return replace(self, changed_s=now_s)

    def candidates(self, parameter: str, now_s: float) -> tuple[Parameter, ...] | str:
        """Return the values between which a parameter may be: reading, target, and a target that is being set.

        Returns:
            The reason, if they are unknown.
        """
        base, part = split(parameter)
        name = base if part == "busy" else parameter
        reading = self.reading(name, now_s)
        if reading.value is None:
            return reading.reason or "it has no value"
        orders = [order.order.parameter for order in self.given if order.parameter == name]
        if part == "busy":
            return (Parameter(parameter, "true" if reading.busy or orders else "false"),)
        unit = reading.unit or "1"  # a parameter without a unit would be taken in the unit of the rule
        numbers = (reading.value,) if reading.target is None else (reading.value, reading.target)
        values = [Parameter(parameter, repr(number), unit) for number in numbers]
        return tuple(dict.fromkeys((*values, *orders)))

    def reported(self, report: InstrumentReadings, now_s: float, now_ns: int) -> Instruments:
        """Store a report; the caller settles the outcomes in it."""
        before = self._of(report.instrument)
        # a report waits in queues for an unknown time, and clocks of other computers may lie: it is certain only that
        # it was made after the answer whose token it repeats
        made_s = before.given_s if report.token and report.token == before.token else _NEVER_S
        units, readings = dict(self.units), dict[str, KnownReading]()
        for reading in report.readings[:_MOST_PARAMETERS]:
            if reading.value is not None:
                first = units.setdefault(reading.name, reading.unit)
                if first != reading.unit:
                    why = f"its unit changed from {first!r} to {reading.unit!r}"
                    reading = replace(reading, value=None, target=None, reason=why)
            age_s = reading.age_s if reading.age_s is not None and reading.age_s >= 0.0 else float("inf")
            readings[reading.name] = KnownReading(reading, made_s - age_s)
        changed = self._with(report.instrument, replace(before, readings=readings))
        arrived = {reading.name for reading in report.readings if reading.value is not None and not reading.busy}
        given = tuple(order for order in self.given if not (order.is_done and order.parameter in arrived))
        return replace(changed, units=units, given=given).evaluated(now_s, now_ns)

    def to_publish(self, report: InstrumentReadings, now_s: float) -> Instruments | None:
        """Return the instruments after publishing a report; None if its publication is not due."""
        known = self._of(report.instrument)
        passed_s = now_s - known.published_s
        new = tuple(self.reading(name, now_s) for name in known.readings)
        is_same = [*map(_state, new)] == [*map(_state, known.published)]
        if is_same and passed_s < PUBLISH_S:
            values = [reading.value for reading in new], [reading.value for reading in known.published]
            if values[0] == values[1] or passed_s < PUBLISH_CHANGED_S:
                return None
        return self._with(report.instrument, replace(known, published=new, published_s=now_s))

    def published(self, instrument: str) -> tuple[InstrumentReading, ...]:
        """Return the readings of an instrument that were published last."""
        return self._of(instrument).published

    # --- conditions ---

    def evaluated(self, now_s: float, now_ns: int) -> Instruments:
        """Return the instruments with their conditions evaluated at this time."""
        states = {}
        for name, condition in self.settings.conditions.items():
            readings = {parameter: self.reading(parameter, now_s) for parameter in condition.bands}
            states[name] = self.states.get(name, ConditionState()).updated(condition, readings, now_ns)
        until_s = now_s + OLDEST_S if self.awaited_until_s is None else self.awaited_until_s
        until_s = until_s if now_s <= until_s else _NEVER_S
        is_same = states == self.states and until_s == self.awaited_until_s
        return self if is_same else replace(self, states=states, awaited_until_s=until_s)

    def refusal(self, action: str, now_s: float, now_ns: int) -> str:
        """Return the reason why an action may not start now; empty if no condition forbids the start."""
        if not self.settings.conditions:
            return ""
        states = self.evaluated(now_s, now_ns).states
        reasons = [
            f"the condition {name} does not hold: {states[name].reason} ({condition.source})"
            for name, condition in self.settings.conditions.items()
            if action in condition.actions and states[name].reason
        ]
        return "; ".join(reasons)

    def problems(self, flagged: Collection[int]) -> dict[int, str]:
        """Return the problems of the conditions that do not hold, each with one reason.

        An instrument connects after the start of the scheduler: until its first reading, or until `awaited_until_s`, a
        problem that is not `flagged` is left out. Measurements are refused all the same.
        """
        wanted = dict[int, str]()
        for name, condition in self.settings.conditions.items():
            reason = self.states.get(name, ConditionState()).reason
            if reason and condition.problem:
                number = self.settings.problems[condition.problem]
                if number in flagged or not self._is_awaited(condition):
                    wanted.setdefault(number, f"{name}: {reason}")
        return wanted

    def _is_awaited(self, condition: MeasuringCondition) -> bool:
        if self.awaited_until_s == _NEVER_S:
            return False
        known = (self._of(instrument_of(name)).readings.get(name) for name in condition.bands)
        return any(one is None or one.measured_s == _NEVER_S for one in known)

    # --- orders ---

    def asked(self, job: ForwardedRequest) -> Instruments:
        """Queue a set request under a new number."""
        owner = instrument_of(job.request.subject.name)
        number = self.number + 1
        known = self._of(owner)
        waiting = replace(known, open=(*known.open, OpenOrder(job._replace(number=number))))
        return replace(self._with(owner, waiting), number=number)

    def first(self, instrument: str) -> OpenOrder | None:
        """Return the first open order of an instrument: orders are served one at a time."""
        return next(iter(self._of(instrument).open), None)

    def handed_out(self, instrument: str, order: OpenOrder) -> Instruments:
        """Store that the instrument was given its first order."""
        known = self._of(instrument)
        changed = self._with(instrument, replace(known, open=(order, *known.open[1:])))
        if order.order is None or order.order.is_reading:
            return changed
        return replace(changed, given=(*self.given, GivenOrder(order.order))[-_MOST_PARAMETERS:])

    def reported_outcome(self, outcome: OrderOutcome) -> Instruments:
        """Store the outcome of an order: a success replaces earlier targets, a refusal leaves them."""
        answered = next((order for order in self.given if order.order.number == outcome.number), None)
        if answered is None or outcome.response == ControlResponse.NO_RESPONSE:
            return self
        if outcome.response != ControlResponse.SUCCESS:
            return replace(self, given=tuple(order for order in self.given if order is not answered))
        newer = (
            order
            for order in self.given
            if order.parameter != answered.parameter or order.order.number > outcome.number
        )
        return replace(self, given=(replace(answered, is_done=True), *newer))

    def asked_to_read(self, instrument: str, now_s: float) -> Instruments:
        """Store that the values for the first order of an instrument are being read."""
        first, *rest = self._of(instrument).open
        known = replace(self._of(instrument), open=(replace(first, read={}, read_s=now_s), *rest))
        return self._with(instrument, known)

    def was_read(self, number: int, name: str, value: Parameter | None) -> Instruments:
        """Store a value of the microscope that was read for an order."""
        changed = self
        for owner, known in self.known.items():
            for order in known.open:
                if order.job.number == number and order.read_s is not None:
                    filled = replace(order, read={**order.read, name: value})
                    orders = tuple(filled if other is order else other for other in known.open)
                    changed = changed._with(owner, replace(known, open=orders))
        return changed

    def without_reads(self, names: Collection[str]) -> Instruments:
        """Forget the values read for waiting orders that are judged with one of these names."""
        changed = self
        for owner, known in self.known.items():
            if any(
                order.read_s is not None and order.order is None and order.read.keys() & names for order in known.open
            ):
                orders = tuple(order if order.order else replace(order, read={}, read_s=None) for order in known.open)
                changed = changed._with(owner, replace(known, open=orders))
        return changed

    def settled(self, instrument: str, number: int) -> Instruments:
        """Remove the order with this number."""
        known = self._of(instrument)
        rest = tuple(order for order in known.open if order.job.number != number)
        return self._with(instrument, replace(known, open=rest))

    def found(self, instrument: str, outcome: OrderOutcome) -> OpenOrder | None:
        """Return the open order that an outcome belongs to; None if the order was settled before."""
        for order in self._of(instrument).open:
            if order.order is not None and order.order.number == outcome.number:
                return order
        return None

    def overdue(self, now_s: float) -> list[tuple[str, OpenOrder]]:
        """Return the orders whose deadline has passed, each with its instrument."""
        return [
            (name, order) for name, known in self.known.items() for order in known.open if now_s >= order.job.deadline_s
        ]

    def answered(self, instrument: str, now_s: float) -> Instruments:
        """Store that a report is being answered, under a new token."""
        token = self.number + 1
        known = replace(self._of(instrument), token=token, given_s=now_s, held=None)
        return replace(self._with(instrument, known), number=token)

    def held(self, instrument: str, report: RequestIn, until_s: float) -> Instruments:
        """Store a report whose answer waits for an order."""
        return self._with(instrument, replace(self._of(instrument), held=report, held_until_s=until_s))

    def held_report(self, instrument: str) -> RequestIn | None:
        """Return the report whose answer waits for an order."""
        return self._of(instrument).held

    def held_too_long(self, now_s: float) -> list[str]:
        """Return the instruments whose reports must be answered now."""
        return [name for name, known in self.known.items() if known.held is not None and now_s >= known.held_until_s]

    def token(self, instrument: str) -> int:
        """Return the token of the answer to an instrument's last report."""
        return self._of(instrument).token

    # --- time ---

    def due_s(self) -> float | None:
        """Return the next real time at which a condition or an order must be checked; None: no deadline."""
        dues = [order.job.deadline_s for known in self.known.values() for order in known.open]
        dues += [known.held_until_s for known in self.known.values() if known.held is not None]
        if self.settings.problems and self.awaited_until_s is not None and self.awaited_until_s > _NEVER_S:
            dues.append(self.awaited_until_s + _JUST_AFTER_S)
        for name, condition in self.settings.conditions.items():
            if self.states.get(name, ConditionState()).reason:
                continue
            for parameter in condition.bands:
                known = self._of(instrument_of(parameter)).readings.get(parameter)
                if known is not None:
                    dues.append(known.measured_s + OLDEST_S + _JUST_AFTER_S)
        return min(dues, default=None)

    def _of(self, instrument: str) -> KnownInstrument:
        return self.known.get(instrument, KnownInstrument())

    def _with(self, instrument: str, known: KnownInstrument) -> Instruments:
        return replace(self, known={**self.known, instrument: known})


def _state(reading: InstrumentReading) -> tuple[object, ...]:
    # all but the numbers that change all the time
    return reading.name, reading.value is None, reading.unit, reading.target, reading.busy, reading.reason
