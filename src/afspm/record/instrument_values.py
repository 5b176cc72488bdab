"""The values of other instruments during a measurement, from the readings that the scheduler published."""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from afspm import wire
from afspm.basics.errors import WireError
from afspm.basics.formatting import quantity
from afspm.model import InstrumentReading, InstrumentReadings

if TYPE_CHECKING:
    from afspm.record.allowed_bands import AllowedBands

OLDEST_S = 60.0
"""Readings are published every 10 s at least, real time; older readings come from a lost instrument."""
PublishedReading = tuple[int, InstrumentReading]
"""The time of publication in ns, and the reading."""


@dataclass(frozen=True, slots=True)
class InstrumentValue:
    """The value of one instrument parameter at the end of a measurement.

    Attributes:
        value: in `unit`; None if unknown, then `reason` gives the cause.
        target: in `unit`; None if the parameter can't be set.
        age_s: real time since the instrument measured the value; None if unknown.
        lowest, highest: the range during the measurement; None if no value arrived meanwhile.
        outside: the conditions whose band did not contain a value during the measurement.
    """

    name: str
    value: float | None
    unit: str
    target: float | None
    age_s: float | None
    reason: str
    lowest: float | None
    highest: float | None
    outside: tuple[str, ...] = ()

    @property
    def columns(self) -> dict[str, float | None]:
        """The columns of a table: {"cryo.temperature [K]": 4.2, "cryo.temperature.age [s]": 0.3}."""
        unit = f" [{self.unit}]" if self.unit else ""
        return {f"{self.name}{unit}": self.value, f"{self.name}.age [s]": self.age_s}

    @property
    def text(self) -> str:
        """The value and its range for a person: "4.2 K (4.19 K to 4.21 K)"."""
        if self.value is None:
            return f"unknown: {self.reason}" if self.reason else "unknown"
        text = quantity(self.value, self.unit)
        if self.lowest is None or self.highest is None or self.lowest == self.highest:
            return text
        return f"{text} ({quantity(self.lowest, self.unit)} to {quantity(self.highest, self.unit)})"


def value_at_end(
    readings: Sequence[PublishedReading],
    end_ns: int,
    since_ns: int | None,
    speed: float,
    bands: AllowedBands,
    action: str,
) -> InstrumentValue | None:
    """Return the value of one parameter at the end of a measurement; None without a reading in the minute before it.

    Args:
        readings: published readings of this parameter, in the order of time.
        since_ns: the start of the measurement; None: unknown.
        speed: experiment seconds per real second.
        bands: the bands of all parameters; a band that does not guard `action` is left out.
    """
    stop = bisect_right(readings, end_ns, key=lambda reading: reading[0])
    if not stop or readings[stop - 1][0] <= earliest_ns(end_ns, speed):
        return None
    at_ns, last = readings[stop - 1]
    start = stop if since_ns is None else bisect_right(readings, since_ns - 1, hi=stop, key=lambda reading: reading[0])
    during = [reading for _, reading in readings[start:stop]]
    values = [reading.value for reading in during if reading.value is not None and reading.is_number]
    outside = tuple(
        dict.fromkeys(
            band.condition
            for band in bands.get(last.name, ())
            if action in band.actions
            # without a reading meanwhile the last one is still true
            for reading in during or [last]
            if not band.contains(reading.value if reading.is_number else None, reading.target, reading.unit)
        )
    )
    return InstrumentValue(
        last.name,
        last.value if last.is_number else None,
        last.unit,
        last.target,
        None if last.age_s is None else last.age_s + (end_ns - at_ns) * 1e-9 / speed,
        last.reason,
        min(values, default=None),
        max(values, default=None),
        outside,
    )


def earliest_ns(end_ns: int, speed: float) -> int:
    """Return the time before which a reading is too old to describe a measurement that ended at `end_ns`."""
    return end_ns - round(OLDEST_S * speed * 1e9)


@dataclass
class RecordedReadings:
    """The published readings of a record, read on as the record grows.

    Attributes:
        speed: experiment seconds per real second.
        of: readings by parameter, in the order of time.
    """

    speed: float = 1.0
    of: dict[str, list[PublishedReading]] = field(default_factory=lambda: defaultdict(list))
    _row: int = 0

    def read_on(self, query: Callable[[str], Iterable[tuple[Any, ...]]]) -> None:
        """Decode the readings that were recorded since the last call."""
        rows = query(
            "SELECT rowid, time_ns, payload FROM packets WHERE message = 'InstrumentReadings'"
            f" AND rowid > {self._row} ORDER BY rowid"
        )
        for self._row, time_ns, payload in rows:
            self.take(time_ns, payload)

    def take(self, time_ns: int, payload: bytes) -> None:
        """Add the readings of a packet; a packet of another version is left out."""
        with suppress(WireError):
            report = wire.decode("InstrumentReadings", payload)
            for reading in report.readings if isinstance(report, InstrumentReadings) else ():
                self.of[reading.name].append((time_ns, reading))

    def values(
        self, end_ns: int, since_ns: int | None, bands: AllowedBands | None = None, action: str = ""
    ) -> tuple[InstrumentValue, ...]:
        """Return the values of all parameters at the end of a measurement, as `value_at_end`."""
        values = (
            value_at_end(readings, end_ns, since_ns, self.speed, bands or {}, action) for readings in self.of.values()
        )
        return tuple(value for value in values if value is not None)
