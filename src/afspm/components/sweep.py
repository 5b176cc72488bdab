"""`Sweep`: a scan or a spectrum at each combination of the values of some parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import reduce
from operator import add
from typing import Literal

from afspm.basics import Angle
from afspm.basics.errors import ConfigError, InvalidValue, UnitError
from afspm.basics.formatting import quantity
from afspm.basics.plain_data import Plain
from afspm.basics.units import Length
from afspm.client.component import Component
from afspm.components.pace import Pace
from afspm.components.planned_scans import FRAME, Pixels, pair, shape_of
from afspm.components.scan_plan import ScanPlan
from afspm.model import Parameter, Region, names
from afspm.model.curve_request import CurveTable, curve_parameters
from afspm.model.instruments import is_of_instrument
from afspm.model.planned_work import PlannedWork, planned_rounds
from afspm.model.snapshot import to_plain
from afspm.model.sweep_plan import SweepOrder, SweepPlan, SweptValue

KEY = "sweep"
_PIXELS = (names.SCAN_RESOLUTION_X, names.SCAN_RESOLUTION_Y)
_PROBE = (names.PROBE_POS_X, names.PROBE_POS_Y)


class Sweep(Component):
    """A scan or a spectrum at each combination of the values of some parameters.

    At the end the parameters are set back to their values before the sweep, also after a kill and restart. A restart
    repeats no point. Control is kept over the whole sweep; a point that was interrupted, by the repair of a tip for
    instance, is measured again with its parameters set again.

    The keys of its measurements are `sweep-1`, `sweep-2` …, in the order of measurement, and the swept parameters are
    columns of `run.scans` and `run.spectra`. The report shows the scans beside each other in `sweep.png`.

    Args:
        parameters: the values of each parameter: a list, such as ["50 pA", "100 pA"], or a range, such as {from =
            "0.5 um/s", to = "4 um/s", points = 4, spacing = "log"}, or with `step` instead of `points`. The first
            parameter changes least often. A parameter of another instrument, such as "cryo.temperature", is set as its
            target; each point waits until the value has arrived.
        measure: the measurement at each point.
        order: "snake": from point to point one parameter changes, to a neighbouring value; "listed": nested loops over
            the values as listed; "random": shuffled by `seed`.
        seed: seed of the random order.
        size: (width, height) of the scans; by default the present region.
        center: (x, y) of the middle of the scans; (0, 0) if not given.
        angle: angle of the scans, counter-clockwise; 0 if not given.
        pixels: (columns, rows) of the scans; by default the present numbers.
        at: (x, y) of the spectra; by default where the probe stands.
        kind: kind of the spectra, where the microscope can choose, e.g. "IV" or "force".
        curve: settings of the spectra, as for a `SpectroscopyGrid`: {sweep = ["-500 mV", "500 mV"], points = 201}.
        end_when_done: whether to end the whole experiment after the last point.
    """

    def __init__(
        self,
        parameters: dict[str, list[str | float | bool] | dict[str, str | float]],
        measure: Literal["scan", "spectrum"] = "scan",
        order: SweepOrder = "snake",
        seed: int = 0,
        size: tuple[Length, Length] | None = None,
        center: tuple[Length, Length] | None = None,
        angle: Angle | None = None,
        pixels: Pixels | None = None,
        at: tuple[Length, Length] | None = None,
        kind: str | None = None,
        curve: CurveTable | None = None,
        end_when_done: bool = False,
    ) -> None:
        self.sweep, self.measure, self.end_when_done = _plan(parameters, order, seed), measure, end_when_done
        self.kind = kind
        self._given: Plain = {"parameters": parameters, "order": order, "seed": seed}
        of_scans = {"size": size, "center": center, "angle": angle, "pixels": pixels}
        for name, value in ({"at": at, "kind": kind, "curve": curve} if measure == "scan" else of_scans).items():
            if value is not None:
                raise ConfigError(f"says nothing of a {measure}", where=name)
        for name, value in {"center": center, "angle": angle}.items():
            if value is not None and size is None:
                raise ConfigError("needs the `size` of the scans", where=name)
        region = None if size is None else Region(pair(center or (0.0, 0.0)), pair(size), angle or 0.0)
        shape = None if pixels is None else shape_of(pixels)
        self._frame = region, shape
        self._what = {"region": region, "shape": shape} if measure == "scan" else {"at": at and pair(at), "kind": kind}
        self.curve = curve or {}
        self._of_curves = curve_parameters(self.curve, kind)
        self.needs_actions = (names.START_SCAN if measure == "scan" else names.START_SPEC,)
        with_kind = bool(kind or self.curve)  # the settings of `curve` are those of one kind
        fixed = (
            *((*FRAME, names.SCAN_ANGLE) if size else ()),
            *(_PIXELS if pixels else ()),
            *(_PROBE if at else ()),
            *((names.SPEC_KIND,) if with_kind else ()),
            *(one.name for one in self._of_curves),
        )
        for axis in self.sweep.axes:
            if axis.name in fixed:
                raise ConfigError("is swept, and fixed by another setting", where=f"parameters.{axis.name}")
        swept = tuple(axis.name for axis in self.sweep.axes)
        self.needs_parameters = (*swept, *(name for name in fixed if name != names.SCAN_ANGLE))
        if region is not None:
            self.plan = ScanPlan((region,), shape)  # the part that `afspm check` can look at
        self.positions = (pair(at),) if at else ()

    @property
    def planned_parameters(self) -> dict[str, tuple[Parameter, ...]]:
        """All values that the sweep sets, by the setting that gives them, for comparison with the limits."""
        return {
            "curve": self._of_curves,
            "parameters": tuple(axis.parameter(place) for axis in self.sweep.axes for place in range(len(axis.values))),
        }

    def planned_work(self, speed_m_s: float | None) -> PlannedWork:
        total, ends = self.sweep.total, self.end_when_done
        if self.measure != "scan":
            why = "the controller sets the duration of a spectrum"
            return PlannedWork(spectra=total, ends_experiment=ends, why=why)
        region, shape = self._frame
        if region is None or shape is None:
            why = "the file sets no size and pixels"
            return PlannedWork(total, path_m=None, pixels=None, ends_experiment=ends, why=why)
        speeds = next((axis.values for axis in self.sweep.axes if axis.name == names.SCAN_SPEED), (speed_m_s,))
        each = total // len(speeds)
        work = reduce(add, (planned_rounds((region,), shape, each, 0.0, speed) for speed in map(_number, speeds)))
        if arrivals := [axis.name for axis in self.sweep.axes if is_of_instrument(axis.name)]:
            work = replace(work, duration_s=None, why=f"the time in which {arrivals[0]} arrives is unknown")
        return replace(work, ends_experiment=ends)

    def run(self) -> None:
        sweep = to_plain(self.sweep) | {"measure": self.measure}
        if self.memory.setdefault("sweep", sweep) != sweep:
            raise ConfigError(
                "the sweep was begun with other values, which are in the record of this run",
                where="parameters",
                hint="undo the change, or begin a new run",
            )
        total, done = self.sweep.total, int(self.memory.get("done", 0))
        pace = Pace(self.scope, self.memory)
        self.memory.save()
        if 0 < done < total:
            self.log.info("going on with point %d of %d", done + 1, total)
        with (
            self.scope.curves(self.curve, kind=self.kind, key="curve"),
            self.scope.sweep(**self._given, **self._what, measure=self.measure, key=KEY, done=done) as points,
        ):
            for point in points:
                self.memory["done"] = point.number
                pace.note()
                if self.memory.save(synced=False):  # else a restart asks for it again
                    self.scope.forget(point.key)
                self.scope.progress(point.number, total, left_s=pace.left_s(point.number, total))
                self.log.info("point %d of %d: %s", point.number, total, self._text(point.values))
        self.log.info("all %d points are measured", total)
        if self.end_when_done:
            self.scope.end_experiment()

    def _text(self, values: Mapping[str, SweptValue]) -> str:
        units = {axis.name: axis.unit or "" for axis in self.sweep.axes}
        return ", ".join(f"{name} {value_text(value, units[name])}" for name, value in values.items())


def _number(value: SweptValue | None) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def value_text(value: SweptValue, unit: str) -> str:
    """Return a swept value as text for people: "50 pA", "12.5", "on"."""
    if isinstance(value, bool):
        return "on" if value else "off"
    return value if isinstance(value, str) else quantity(value, unit)


def _plan(parameters: Plain, order: SweepOrder, seed: int) -> SweepPlan:
    for name, given in parameters.items():
        try:
            SweepPlan.of({name: given})
        except (InvalidValue, UnitError) as error:
            raise ConfigError(error.what, where=f"parameters.{name}", hint=error.hint) from error
    try:
        return SweepPlan.of(parameters, order, seed)
    except InvalidValue as error:
        raise ConfigError(error.what, where="parameters", hint=error.hint) from error
