"""A sweep of parameters: set them at each point, and take one or more scans and spectra there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from afspm.basics.errors import UnitError
from afspm.basics.units import convert
from afspm.client.former_targets import FormerTargets
from afspm.client.keyed_results import KeyedResults, MeasurementResult
from afspm.client.measurement import MeasurementRunner
from afspm.client.targets import Target
from afspm.model import MeasurementConditions, Parameter, ScanSet, Spectrum
from afspm.model.sweep_plan import SweepAxis, SweepPlan, SweptValue

Measure = Literal["scan", "spectrum", "both"]


class ValueInForce(NamedTuple):
    """A swept value as read at the begin and at the end of a measurement; None where it was not read."""

    begin: SweptValue | None
    end: SweptValue | None


@dataclass(frozen=True)
class SweepPoint:
    """A scan or spectrum of a sweep, and the values of its point.

    Attributes:
        number: number of the measurement, from 1, in order: of the point, where one measurement is taken at each.
        of: the number of measurements.
        point: number of the point, from 1; points may have equal values.
        key: key of the measurement; empty if the sweep has no key.
        values: value of each parameter by the plan; a number is in SI, or in the microscope's own unit
            (`SweepAxis.unit`).
        in_force: the same values as the microscope showed them at begin and end of the measurement, in the same units.
            Without parameters of other instruments, those of the frame, measured values, and a value that was set
            during the measurement; empty for results of an earlier version, or from another translator.
    """

    number: int
    of: int
    point: int
    key: str
    values: Mapping[str, SweptValue]
    in_force: Mapping[str, ValueInForce]
    _result: MeasurementResult

    @property
    def scans(self) -> ScanSet:
        """Return all channels of the scan taken at this point."""
        return self._result.scans

    @property
    def spectrum(self) -> Spectrum:
        """Return the spectrum taken at this point."""
        return self._result.spectrum


class ParameterSweep:
    """A sweep in progress, which measures each point of a plan.

    Args:
        targets: scans and spectra to take at each point.
        key: key of the sweep; its measurements have the keys "<key>-1", "<key>-2" …
        former: remembers the targets of other instruments before the first point.
    """

    def __init__(
        self,
        plan: SweepPlan,
        targets: Sequence[Target],
        key: str | None,
        former: FormerTargets,
        *,
        runner: MeasurementRunner,
        results: KeyedResults,
    ) -> None:
        self._plan, self._targets, self._key, self._former = plan, targets, key, former
        self._runner, self._results = runner, results

    def points(self, done: int, until_s: float | None) -> Iterator[SweepPoint]:
        """Take and yield each measurement, except the first `done`. Raises as `MeasurementRunner.take`."""
        each = [
            (point, places, target) for point, places in enumerate(self._plan.places(), 1) for target in self._targets
        ]
        for index, (point, places, planned) in list(enumerate(each))[done:]:
            key = None if self._key is None else f"{self._key}-{index + 1}"
            settings = (*planned.settings, *self._plan.settings(places))
            target = replace(planned, settings=settings, point=point)
            result = None if key is None else self._results.find(key, target.facts())
            if result is None:
                self._former.remember(until_s)
                result = self._runner.take(target, key, until_s)
                self._former.add_decided()
            in_force = _shown(self._plan, result.conditions)
            values = self._plan.values(places)
            yield SweepPoint(index + 1, len(each), point, key or "", values, in_force, result)


def _shown(plan: SweepPlan, conditions: MeasurementConditions | None) -> dict[str, ValueInForce]:
    if conditions is None:
        return {}
    begin, end = ({one.name: one for one in given} for given in (conditions.begin_values, conditions.end_values))
    shown = [axis for axis in plan.axes if axis.name in begin or axis.name in end]
    return {axis.name: ValueInForce(_value(begin, axis), _value(end, axis)) for axis in shown}


def _value(given: Mapping[str, Parameter], axis: SweepAxis) -> SweptValue | None:
    if (parameter := given.get(axis.name)) is None:
        return None
    if isinstance(axis.values[0], bool):
        return parameter.value == "true"
    return parameter.value if isinstance(axis.values[0], str) else _number(parameter, axis.unit)


def _number(parameter: Parameter, unit: str | None) -> float | None:
    # in the unit of the axis; None for a text, or a unit that does not fit
    try:
        return convert(float(parameter.value or ""), parameter.unit or unit or "", unit or parameter.unit or "")
    except (ValueError, UnitError):
        return None
