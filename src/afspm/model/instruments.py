"""Other instruments of an experiment: their readings, and their orders from the scheduler."""

from __future__ import annotations

import math
from dataclasses import dataclass

from afspm.model.requests import Parameter

SEPARATOR = "."
"""The separator of component and parameter in a parameter's name: "cryo.temperature"."""
PARTS = ("target", "busy")
"""Suffixes of read-only parameter names: "cryo.temperature.target", "cryo.temperature.busy"."""


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
    """

    time_ns: int
    instrument: str
    readings: tuple[InstrumentReading, ...] = ()
    outcomes: tuple[OrderOutcome, ...] = ()
    token: int = 0


@dataclass(frozen=True, slots=True)
class InstrumentOrder:
    """A target for an instrument to set.

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
