"""Conditions for measuring: bands in which instrument values must stay for a given time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from afspm.basics.errors import UnitError
from afspm.basics.formatting import duration_text, quantity
from afspm.basics.units import convert
from afspm.model import InstrumentReading
from afspm.model.instruments import instrument_of
from afspm.model.parameter_names import START_SCAN, START_SPEC
from afspm.scheduler.safety.limits import ExperimentLimits

OLDEST_S = 4.0
"""A reading older than this, real, does not count: a lost instrument is noticed within 5 s."""


@dataclass(frozen=True)
class AllowedBand:
    """The band of one parameter.

    Attributes:
        low, high: in `unit`; None: no bound.
        within: largest distance from the target, in `unit`; None: no bound.
        for_s: experiment time for which the value must have been inside.
    """

    low: float | None = None
    high: float | None = None
    within: float | None = None
    for_s: float = 0.0
    unit: str = ""

    def reason_outside(self, reading: InstrumentReading) -> str:
        """Return the reason why a reading is outside the band; empty for a reading inside."""
        if not reading.is_number or reading.value is None:
            return f"{reading.name} is not known: {reading.reason or 'not a number'}"
        try:
            value = convert(reading.value, reading.unit, self.unit)
        except UnitError as error:
            return f"{reading.name} can't be compared with its band: {error.what}"
        text = f"{reading.name} is {quantity(value, self.unit)}"
        if self.low is not None and value < self.low:
            return f"{text}, below {quantity(self.low, self.unit)}"
        if self.high is not None and value > self.high:
            return f"{text}, above {quantity(self.high, self.unit)}"
        if self.within is None:
            return ""
        if reading.target is None:
            return f"{reading.name} has no target"
        target = convert(reading.target, reading.unit, self.unit)
        if not abs(value - target) <= self.within:  # also for a target that is not a number
            allowed = quantity(self.within, self.unit)
            return f"{text}, more than {allowed} from its target {quantity(target, self.unit)}"
        return ""


@dataclass(frozen=True)
class MeasuringCondition:
    """A condition of the experiment file.

    Attributes:
        bands: the bands by parameter; all must hold.
        actions: the actions refused while the condition does not hold.
        problem: the problem flagged while the condition does not hold; empty: no problem.
        source: the place in the experiment file, e.g. "experiment.toml:42".
    """

    bands: Mapping[str, AllowedBand] = field(default_factory=dict)
    actions: tuple[str, ...] = (START_SCAN, START_SPEC)
    problem: str = ""
    source: str = "[conditions]"


@dataclass(frozen=True)
class InstrumentSettings:
    """The instruments and the conditions of an experiment.

    Attributes:
        instruments: the components that report values.
        conditions: the conditions by name.
        problems: by name, the number of each problem that a condition flags.
    """

    instruments: tuple[str, ...] = ()
    conditions: Mapping[str, MeasuringCondition] = field(default_factory=dict)
    problems: Mapping[str, int] = field(default_factory=dict)

    def unrated(self, limits: ExperimentLimits) -> ExperimentLimits:
        """Return the limits without rates of instrument parameters: each instrument limits its rate itself."""
        parameters = {
            name: replace(limit, rate_per_s=None) if instrument_of(name) in self.instruments else limit
            for name, limit in limits.parameters.items()
        }
        return replace(limits, parameters=parameters)


@dataclass(frozen=True)
class ConditionState:
    """The state of one condition.

    Attributes:
        inside_since_ns: by parameter, the experiment time since which the value is inside its band.
        reason: the reason why the condition does not hold; empty while the condition holds.
    """

    inside_since_ns: Mapping[str, int] = field(default_factory=dict)
    reason: str = "no instrument has reported yet"

    def updated(
        self, condition: MeasuringCondition, readings: Mapping[str, InstrumentReading], now_ns: int
    ) -> ConditionState:
        """Return the state of the condition for recent readings; a parameter without a reading is outside its band."""
        since, reasons = dict[str, int](), list[str]()
        for name, band in condition.bands.items():
            reason = band.reason_outside(readings.get(name) or InstrumentReading(name, reason="no recent reading"))
            if reason:
                reasons.append(reason)
                continue
            since[name] = self.inside_since_ns.get(name, now_ns)
            inside_s = (now_ns - since[name]) * 1e-9
            if inside_s < band.for_s:
                reasons.append(
                    f"{name} has been in its band for {duration_text(inside_s)} of {duration_text(band.for_s)}"
                )
        return ConditionState(since, "; ".join(reasons))
