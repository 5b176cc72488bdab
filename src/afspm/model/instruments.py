"""Other instruments of an experiment: their readings, and their orders from the scheduler."""

from __future__ import annotations

import math
from dataclasses import dataclass

from afspm.model.requests import Parameter

SEPARATOR = "."
"""The separator of component and parameter in a parameter's name: "cryo.temperature"."""
NOW = "now"
PARTS = ("target", "busy", "age", NOW)
"""Suffixes of read-only parameter names, such as "cryo.temperature.target". "now" lets the instrument measure; "age" is
the real time in s since the last value was measured, at most."""


def instrument_of(parameter: str) -> str:
    """Return the component that owns a parameter; empty for a parameter of the microscope."""
    owner, separator, _ = parameter.partition(SEPARATOR)
    return owner if separator else ""


def is_of_instrument(parameter: str) -> bool:
    """Return whether a parameter belongs to another instrument by its name, in any experiment."""
    return bool(instrument_of(parameter)) and not parameter.startswith("x-")  # the name of a driver's may have a dot


def target_of(parameter: str) -> str:
    """Return the name under which the target of a parameter is read."""
    return f"{parameter}{SEPARATOR}{PARTS[0]}"


def newest_of(parameter: str) -> str:
    """Return the name under which a parameter is measured now; a parameter of the microscope keeps its name."""
    return f"{parameter}{SEPARATOR}{NOW}" if is_of_instrument(parameter) else parameter


def split(parameter: str) -> tuple[str, str]:
    """Return a parameter and the part in its name: "cryo.temperature.busy" has the part "busy", others have ""."""
    base, _, part = parameter.rpartition(SEPARATOR)
    return (base, part) if part in PARTS and instrument_of(base) else (parameter, "")


@dataclass(frozen=True, slots=True)
class InstrumentReading:
    """One value of an instrument.

    Attributes:
        name: the name of the parameter, such as "cryo.temperature".
        value: the value in `unit`; None if unknown, then `reason` gives the cause.
        age_s: real time since the instrument measured it; None: never.
        target: the target in `unit`; None if the parameter can't be set.
        busy: whether the value is on its way to the target.
    """

    name: str
    value: float | None = None
    unit: str = ""
    age_s: float | None = None
    target: float | None = None
    busy: bool = False
    reason: str = ""

    @property
    def is_number(self) -> bool:
        """Return whether the value is a finite number."""
        return self.value is not None and math.isfinite(self.value)


@dataclass(frozen=True, slots=True)
class OrderOutcome:
    """The outcome of an order.

    Attributes:
        number: the number of the order.
        response: a `ControlResponse`.
    """

    number: int
    response: int
    reason: str = ""


@dataclass(frozen=True, slots=True)
class InstrumentReadings:
    """A report of an instrument: all of its values, and the outcomes of orders since the last report.

    Attributes:
        token: the token of the scheduler's last answer before the report.
        patience_s: real time for which the scheduler may hold back its answer until it has an order.
    """

    time_ns: int
    instrument: str
    readings: tuple[InstrumentReading, ...] = ()
    outcomes: tuple[OrderOutcome, ...] = ()
    token: int = 0
    patience_s: float = 0.0


@dataclass(frozen=True, slots=True)
class InstrumentOrder:
    """A target for an instrument to set, or a parameter without a value, to measure now.

    Attributes:
        number: identifies the order in its outcome.
        id: the id of the client's request; a repeated request has the same id, so that it is carried out once.
        rate_per_s: the fastest change allowed, in `rate_unit` per real second; None: no limit.
    """

    number: int
    id: str
    parameter: Parameter
    rate_per_s: float | None = None
    rate_unit: str = ""

    @property
    def is_reading(self) -> bool:
        return self.parameter.value is None


@dataclass(frozen=True)
class GivenOrder:
    """An order whose target the instrument may still be moving to; kept over a restart.

    Attributes:
        is_done: whether the instrument has reported its success.
    """

    order: InstrumentOrder
    is_done: bool = False

    @property
    def parameter(self) -> str:
        return self.order.parameter.name


@dataclass(frozen=True, slots=True)
class InstrumentOrders:
    """The scheduler's answer to a report.

    Attributes:
        token: the token to repeat in the next report.
    """

    token: int
    orders: tuple[InstrumentOrder, ...] = ()
