"""A sweep of parameters: at each point they are set and a scan or spectrum is taken; at the end they are set back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

from afspm import wire
from afspm.basics.errors import Refused
from afspm.client.command_retry import CommandRetry, refused
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import ExperimentLink
from afspm.client.keyed_results import KeyedResults, MeasurementResult
from afspm.client.measurement import MeasurementRunner
from afspm.client.targets import Target
from afspm.model import ControlRequest, Parameter, ScanSet, Spectrum
from afspm.model.sweep_plan import SweepPlan, SweptValue


@dataclass(frozen=True)
class SweepPoint:
    """A point of a sweep and the scan or spectrum taken there.

    Attributes:
        number: counts from 1, in the order of measurement.
        of: the number of points.
        key: of the measurement; empty if the sweep has none.
        values: by their parameters; numbers in SI, or in the unit that they were given in.
    """

    number: int
    of: int
    key: str
    values: Mapping[str, SweptValue]
    _result: MeasurementResult

    @property
    def scans(self) -> ScanSet:
        """All channels of the scan."""
        return self._result.scans

    @property
    def spectrum(self) -> Spectrum:
        """The spectrum."""
        return self._result.spectrum


class ParameterSweep:
    """The measurement of a plan's points. Values before the first point are kept until they are in force again.

    A sweep with a key keeps them on disk: a component that is killed and started again goes on with the point after
    the last, and sets the parameters back to what they were before its first life.

    Args:
        target: of each measurement.
        key: of the sweep; its measurements have keys "<key>-1", "<key>-2" …
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
        runner: MeasurementRunner,
        results: KeyedResults,
    ) -> None:
        self._plan, self._target, self._key = plan, target, key
        self._link, self._control, self._commands = link, control, commands
        self._runner, self._results = runner, results
        self._before = None if key is None else results.before_sweep(key)

    def points(self, done: int, until_s: float | None) -> Iterator[SweepPoint]:
        """Measure and yield each point, but for the first `done`. Raises as a measurement."""
        for index, places in list(enumerate(self._plan.places()))[done:]:
            key = None if self._key is None else f"{self._key}-{index + 1}"
            target = replace(self._target, settings=self._plan.settings(places))
            result = None if key is None else self._results.find(key, target.facts())
            if result is None:
                if self._before is None:
                    self._keep(self._read(until_s))
                result = self._runner.take(target, key, until_s)
            yield SweepPoint(index + 1, self._plan.total, key or "", self._plan.values(places), result)

    def set_back(self, until_s: float | None) -> None:
        """Set the parameters to their values before the sweep; what the microscope refuses is logged.

        Raises:
            ControlLost, NoResponse: not until `until_s`; another life, or another call, sets them back.
        """
        if self._before is None:
            return
        with self._control.hold(until_s=until_s):
            for parameter in reversed(self._before):
                try:
                    self._commands.set_parameter(parameter, until_s)
                except Refused as error:
                    self._link.log.error("%s stays as the sweep has set it: %s", _text(parameter), error.what)
            self._commands.publish_settings((), "")
        self._keep(None)

    @property
    def left_behind(self) -> str:
        """The values before the sweep, for a person, where they are not in force again; else empty."""
        return ", ".join(map(_text, self._before or ()))

    def _read(self, until_s: float | None) -> list[Parameter]:
        return [self._in_force(axis.name, until_s) for axis in self._plan.axes]

    def _in_force(self, name: str, until_s: float | None) -> Parameter:
        response = self._commands.read(ControlRequest.PARAM, Parameter(name), until_s)
        if not response.ok:
            raise refused(ControlRequest.PARAM, response, name)
        return wire.decode_parameter(response.payload)

    def _keep(self, before: list[Parameter] | None) -> None:
        self._before = before
        if self._key is not None:
            self._results.keep_before_sweep(self._key, before)


def _text(parameter: Parameter) -> str:
    return " ".join(filter(None, (parameter.name, parameter.value, parameter.unit)))
