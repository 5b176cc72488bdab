"""A sweep of parameters: set them at each point, take a scan or spectrum, and set them back at the end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

from afspm import wire
from afspm.basics.errors import Refused, UnitError
from afspm.basics.units import convert
from afspm.client.command_retry import CommandRetry, refused
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import ExperimentLink
from afspm.client.instrument_targets import InstrumentTargets
from afspm.client.keyed_results import KeyedResults, MeasurementResult
from afspm.client.measurement import MeasurementRunner
from afspm.client.targets import Target
from afspm.model import ControlRequest, MeasurementConditions, Parameter, ScanSet, Spectrum, is_of_instrument
from afspm.model.sweep_plan import SweepAxis, SweepPlan, SweptValue


class ValueInForce(NamedTuple):
    """A swept value as read at the begin and at the end of a measurement; None where it was not read."""

    begin: SweptValue | None
    end: SweptValue | None


@dataclass(frozen=True)
class SweepPoint:
    """A point of a sweep and the scan or spectrum taken there.

    Attributes:
        number: number of the point, from 1, in the order of measurement.
        of: the number of points.
        key: key of the measurement; empty if the sweep has no key.
        values: value of each parameter by the plan; a number is in SI, or in the microscope's own unit
            (`SweepAxis.unit`).
        in_force: the same values as the microscope showed them at begin and end of the measurement, in the same units.
            Without parameters of other instruments, those of the frame, measured values, and a value that was set
            during the measurement; empty for results of an earlier version, or from another translator.
    """

    number: int
    of: int
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
    """A sweep in progress, which measures each point of a plan and then sets the parameters back.

    With a key the original values are saved on disk: after a restart of the component the sweep goes on with the next
    point, and still sets the parameters back to the original values.

    Args:
        target: scan or spectrum to take at each point.
        key: key of the sweep; its measurements have the keys "<key>-1", "<key>-2" …
    """

    def __init__(
        self,
        plan: SweepPlan,
        target: Target,
        key: str | None,
        *,
        link: ExperimentLink,
        control: ControlHold,
        commands: CommandRetry,
        targets: InstrumentTargets,
        runner: MeasurementRunner,
        results: KeyedResults,
    ) -> None:
        self._plan, self._target, self._key = plan, target, key
        self._link, self._control, self._commands, self._targets = link, control, commands, targets
        self._runner, self._results = runner, results
        self._before = None if key is None else results.before_sweep(key)

    def points(self, done: int, until_s: float | None) -> Iterator[SweepPoint]:
        """Measure and yield each point, except the first `done`. Raises as `MeasurementRunner.take`."""
        for index, places in list(enumerate(self._plan.places()))[done:]:
            key = None if self._key is None else f"{self._key}-{index + 1}"
            target = replace(self._target, settings=self._plan.settings(places))
            result = None if key is None else self._results.find(key, target.facts())
            if result is None:
                if self._before is None:
                    self._keep(self._read(until_s))
                result = self._runner.take(target, key, until_s)
            in_force = _shown(self._plan, result.conditions)
            yield SweepPoint(index + 1, self._plan.total, key or "", self._plan.values(places), in_force, result)

    def set_back(self, until_s: float | None) -> None:
        """Set the parameters to their values before the sweep; a value that the microscope refuses is logged.

        Other instruments get their targets from before; nothing waits until they have arrived.

        Raises:
            ControlLost, NoResponse: the parameters are not set back by `until_s`. A later call can still do so, with a
                key even after a restart.
        """
        if self._before is None:
            return
        is_back = True
        with self._control.hold(until_s=until_s):
            for parameter in reversed(self._before):
                try:
                    self._set_back(parameter, until_s)
                except Refused as error:
                    is_back = False
                    text = "%s stays as the sweep has set it, and is not set back to %s: %s"
                    self._link.log.error(text, parameter.name, _amount(parameter), error.what)
            self._commands.publish_settings((), "")
        self._keep(None)
        if is_back:
            self._link.log.info("the parameters are set back")

    def _set_back(self, before: Parameter, until_s: float | None) -> None:
        try:
            self._commands.set_parameter(before, until_s)
        except Refused:
            # a limit on steps may refuse the whole way, and allow the steps of the sweep
            between = self._values_between(self._in_force(before.name, until_s), before)
            if not between:
                raise
            for parameter in (*between, before):
                self._commands.set_parameter(parameter, until_s)

    def _values_between(self, now: Parameter, before: Parameter) -> list[Parameter]:
        axis = next(axis for axis in self._plan.axes if axis.name == before.name)
        ends = [_number(one, axis.unit) for one in (now, before)]
        if None in ends or axis.in_steps() is axis:  # texts or switches have no order
            return []
        low, high = sorted(end for end in ends if end is not None)
        places = [place for place, value in enumerate(axis.values) if low < float(value) < high]
        places.sort(key=lambda place: float(axis.values[place]), reverse=ends[0] == high)
        return [axis.parameter(place) for place in places]

    @property
    def left_behind(self) -> str:
        """Return the parameter values from before the sweep that are not in force again, as text; empty if all are."""
        return ", ".join(map(_text, self._before or ()))

    def _read(self, until_s: float | None) -> list[Parameter]:
        return [self._in_force(axis.name, until_s) for axis in self._plan.axes]

    def _in_force(self, name: str, until_s: float | None) -> Parameter:
        if is_of_instrument(name):
            return self._targets.in_force(name, until_s)
        response = self._commands.read(ControlRequest.PARAM, Parameter(name), until_s)
        if not response.ok:
            raise refused(ControlRequest.PARAM, response, name)
        return wire.decode_parameter(response.payload)

    def _keep(self, before: list[Parameter] | None) -> None:
        self._before = before
        if self._key is not None:
            self._results.keep_before_sweep(self._key, before)


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


def _text(parameter: Parameter) -> str:
    return f"{parameter.name} {_amount(parameter)}"


def _amount(parameter: Parameter) -> str:
    return " ".join(filter(None, (parameter.value, parameter.unit)))


def _number(parameter: Parameter, unit: str | None) -> float | None:
    # in the unit of the axis; None for a text, or a unit that does not fit
    try:
        return convert(float(parameter.value or ""), parameter.unit or unit or "", unit or parameter.unit or "")
    except (ValueError, UnitError):
        return None
