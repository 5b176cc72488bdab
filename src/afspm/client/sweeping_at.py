"""A sweep of one parameter at a place: set it, read others after each set, and return the readings as a spectrum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from afspm import wire
from afspm.basics.errors import ControlLost, InvalidValue, NoResponse, Refused
from afspm.basics.plain_data import Plain
from afspm.client.command_retry import PATIENCE_S, RETRY_S, CommandRetry, refused
from afspm.client.control_hold import ControlHold
from afspm.client.experiment_link import ExperimentLink
from afspm.client.former_targets import FormerTargets
from afspm.client.instrument_targets import InstrumentTargets
from afspm.client.keyed_results import KeyedResults, MeasurementResult
from afspm.client.measurement_setup import MeasurementSetup
from afspm.client.targets import SpectrumTarget
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Frame,
    MeasurementConditions,
    Parameter,
    Spectrum,
    is_of_instrument,
)
from afspm.model.instruments import newest_of
from afspm.model.snapshot import to_plain
from afspm.model.sweep_plan import SweepAxis

Reading = tuple[float, str]


@dataclass(frozen=True)
class PlacedSweep:
    """A sweep of one parameter at one place.

    Attributes:
        axis: the parameter and its values, all numbers.
        read: the parameters that are read after each set.
        target: the place, and the kind of the spectrum.
        settle_s: experiment time between a set and its readings.

    Raises:
        InvalidValue: a value is no number, nothing is read, or the swept parameter is read.
    """

    axis: SweepAxis
    read: tuple[str, ...]
    target: SpectrumTarget
    settle_s: float = 0.0

    def __post_init__(self) -> None:
        if any(isinstance(value, str | bool) for value in self.axis.values):
            raise InvalidValue(
                f"{self.axis.name} is swept over a text or a switch", hint="give numbers, with their unit"
            )
        names = (self.axis.name, *self.read)
        if not self.read or len(set(names)) < len(names):
            raise InvalidValue(f"{names} are to be set and read", where="read", hint="name each parameter to read once")
        if not 0.0 <= self.settle_s < float("inf"):
            raise InvalidValue(f"a settling time of {self.settle_s} s", where="settle", hint="zero or more")

    def facts(self) -> Plain:
        """Return the sweep in JSON's types, so that the component recognises it after a restart."""
        return {"what": "sweep at", **to_plain(self)}


class PlacedSweeper:
    """A sweeper of one parameter at a place. Raises as `InstrumentTargets` and `CommandRetry`."""

    def __init__(
        self,
        link: ExperimentLink,
        control: ControlHold,
        commands: CommandRetry,
        targets: InstrumentTargets,
        setup: MeasurementSetup,
        results: KeyedResults,
    ) -> None:
        self._link, self._control, self._commands = link, control, commands
        self._targets, self._setup, self._results = targets, setup, results

    def take(
        self, sweep: PlacedSweep, key: str | None, former: FormerTargets, until_s: float | None
    ) -> MeasurementResult:
        """Return the sweep's spectrum, and the conditions to publish with it; with a key, it is taken only once.

        If control is lost on the way, to a tip repair for instance, the whole sweep is taken again.
        """
        facts = sweep.facts()
        if key is not None and (found := self._results.find(key, facts)) is not None:
            return found
        interruptions: list[str] = []
        while True:
            try:
                with self._control.hold(until_s=until_s, unbroken=True):
                    former.remember(until_s)
                    spectrum, conditions = self._measure(sweep, until_s)
                    former.add_decided()
                break
            except ControlLost as lost:
                self._control.regain(until_s)
                interruptions.append(lost.what)
                self._link.log.warning("the sweep of %s was interrupted: %s; retrying", sweep.axis.name, lost.what)
        result = MeasurementResult([spectrum], interruptions, conditions)
        if key is not None:
            self._results.fulfil(key, facts, result)
        return result

    def _measure(self, sweep: PlacedSweep, until_s: float | None) -> tuple[Spectrum, MeasurementConditions]:
        import numpy as np  # late: most components sweep nothing, and it takes a tenth of a second

        link, target = self._link, sweep.target
        if (tip := link.view.tip) is not None and tip.engaged is False:
            raise Refused(ControlResponse.ACTION_ERROR, "the tip is withdrawn: bring it to the sample first")
        if target.at_m is not None:
            self._setup.move_probe(target.at_m, until_s, drifts=target.frame is Frame.SAMPLE)
        began_ns, rows = link.clock.now_ns(), []
        for place in range(len(sweep.axis.values)):
            in_force = self._set(sweep.axis.parameter(place), until_s)
            self._settle(sweep.settle_s)
            readings = [self._read(name, until_s) for name in sweep.read]
            if not self._control.held:  # others may have changed the setting while it was read
                raise ControlLost(f"control was lost: {self._control.why_lost}", where=link.name)
            rows.append([_number(in_force, link.name), *readings])
        names = (sweep.axis.name, *sweep.read)
        columns = [_column(name, [row[number] for row in rows]) for number, name in enumerate(names)]
        values, units = np.array([values for values, _ in columns]).T, tuple(unit for _, unit in columns)
        position = link.view.probe_position
        place_m = target.at_m if position is None else position.xy_m
        time_ns = link.clock.now_ns()
        spectrum = Spectrum(place_m, target.kind or "", names, units, values, time_ns, frame=target.frame)
        return spectrum, MeasurementConditions(time_ns, "", began_ns=began_ns, holder=link.name)

    def _set(self, wanted: Parameter, until_s: float | None) -> Parameter:
        if is_of_instrument(wanted.name):
            return self._targets.reach(wanted, until_s)
        return self._setup.lend((), (wanted,), until_s, 0.0).get(wanted.name, wanted)

    def _settle(self, settle_s: float) -> None:
        clock = self._link.clock
        end_s = clock.now_s() + settle_s
        with clock.late(end_s):
            while (left_s := end_s - clock.now_s()) > 0.0 and self._control.held:
                self._link.wait(lambda: not self._control.held, self._link.until(clock.real_s(left_s)))

    def _read(self, name: str, until_s: float | None) -> Reading:
        # an instrument that has no value for a moment, by an overload or a restart, is read again
        give_up_s = self._link.earlier(PATIENCE_S, until_s)
        while True:
            response = self._commands.read(ControlRequest.PARAM, Parameter(newest_of(name)), until_s)
            if response.ok:
                return _number(wire.decode_parameter(response.payload), name)
            if response.code != ControlResponse.PARAM_ERROR or not is_of_instrument(name):
                raise refused(ControlRequest.PARAM, response, name)
            if self._link.clock.monotonic_s() >= give_up_s:
                what = f"{name} has had no value for {PATIENCE_S:g} s"
                raise NoResponse(what, where=self._link.name, hint=response.reason)
            self._link.wait(lambda: False, self._link.earlier(RETRY_S, give_up_s))


def _number(parameter: Parameter, where: str) -> Reading:
    try:
        return float(parameter.value or ""), parameter.unit or ""
    except ValueError:
        what = f"{parameter.name} reads {parameter.value!r}, which is no number"
        raise Refused(ControlResponse.PARAM_ERROR, what, where=where) from None


def _column(name: str, readings: Sequence[Reading]) -> tuple[list[float], str]:
    units = {unit for _, unit in readings}
    if len(units) > 1:
        raise Refused(
            ControlResponse.PARAM_ERROR, f"{name} changed its unit within a sweep: {', '.join(sorted(units))}"
        )
    return [value for value, _ in readings], units.pop()
