"""`Sweep`: scans and spectra at each combination of the values of some parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Any

from afspm.basics import Angle
from afspm.basics.errors import ConfigError, InvalidValue, UnitError
from afspm.basics.formatting import quantity
from afspm.basics.plain_data import Plain
from afspm.basics.units import Duration, Length
from afspm.client.component import Component
from afspm.client.sweeping import Measure
from afspm.components.pace import Pace
from afspm.components.planned_scans import FRAME, ListedRegion, Pixels, pair, shape_of
from afspm.components.scan_plan import XY, ScanPlan, grid_centers
from afspm.model import Parameter, Region, names
from afspm.model.curve_request import CurveTable, curve_parameters, time_of_curves
from afspm.model.instruments import is_of_instrument
from afspm.model.planned_work import PlannedWork, planned_rounds
from afspm.model.snapshot import to_plain
from afspm.model.sweep_plan import SweepOrder, SweepPlan, SweptValue

KEY = "sweep"
_PIXELS = (names.SCAN_RESOLUTION_X, names.SCAN_RESOLUTION_Y)
_PROBE = (names.PROBE_POS_X, names.PROBE_POS_Y)


@dataclass(frozen=True)
class ListedGrid:
    """Positions of spectra: a grid of the experiment file, as of a `SpectroscopyGrid`.

    Args:
        counts: (columns, rows).
        spacing: (x, y) distance from one point to the next.
        center: (x, y) of the middle.
        angle: counter-clockwise.
    """

    counts: tuple[int, int]
    spacing: tuple[Length, Length]
    center: tuple[Length, Length] = (0.0, 0.0)
    angle: Angle = 0.0

    @property
    def positions(self) -> tuple[XY, ...]:
        return grid_centers(pair(self.center), (self.counts[0], self.counts[1]), pair(self.spacing), self.angle)


class Sweep(Component):
    """Scans and spectra at each combination of the values of some parameters.

    Each measurement carries the values of its point, and others may measure between two points with their own. At the
    end the parameters have their values of before the sweep, also after a kill and restart. A restart repeats no point;
    a point that was interrupted, by the repair of a tip for instance, is measured again. A sweep over a parameter of
    another instrument keeps control over all its points.

    The keys of its measurements are `sweep-1`, `sweep-2` …, in the order of measurement, and the swept parameters are
    columns of `run.scans` and `run.spectra`. The report shows the scans beside each other in `sweep.png`.

    Args:
        parameters: the values of each parameter: a list, such as ["50 pA", "100 pA"], or a range, such as {from =
            "0.5 um/s", to = "4 um/s", points = 4, spacing = "log"}, or with `step` instead of `points`. The first
            parameter changes least often. A parameter of another instrument, such as "cryo.temperature", is set as its
            target; each point waits until the value has arrived.
        measure: the measurement at each point: "scan", "spectrum", or "both", first the scans.
        order: "snake": from point to point one parameter changes, to a neighbouring value; "listed": nested loops over
            the values as listed, which may come again, as in a hysteresis loop; "random": shuffled by `seed`.
        seed: seed of the random order.
        repeat: number of points with the same values, one after the other.
        settle: experiment time after a change of bias, setpoint or gains, before the measurement begins.
        withdraw: whether the tip is withdrawn while another instrument, such as a cryostat, goes to its target. At the
            end it then stays withdrawn. A list of actions, such as ["COARSE_OUT"], moves the tip away besides, as a
            lateral move of a stage needs it; then it is brought back by an approach.
        size: (width, height) of the scans; by default the present region.
        center: (x, y) of the middle of the scans; (0, 0) if not given.
        angle: angle of the scans, counter-clockwise; 0 if not given.
        pixels: (columns, rows) of the scans; by default the present numbers.
        regions: several regions instead of `size`, each with center, size and angle: a scan of each at each point.
        at: (x, y) of the spectra; by default where the probe stands.
        positions: several positions instead of `at`: a spectrum at each of them at each point.
        grid: a grid of positions instead of `at`: {counts = [8, 8], spacing = ["2 nm", "2 nm"]}, and `center`, `angle`.
        kind: kind of the spectra, where the microscope can choose, e.g. "IV" or "force".
        curve: settings of the spectra, as for a `SpectroscopyGrid`: {sweep = ["-500 mV", "500 mV"], points = 201}.
        end_when_done: whether to end the whole experiment after the last point.
    """

    def __init__(
        self,
        parameters: dict[str, list[str | float | bool] | dict[str, str | float]],
        measure: Measure = "scan",
        order: SweepOrder = "snake",
        seed: int = 0,
        repeat: int = 1,
        settle: Duration = 0.0,
        withdraw: bool | list[str] = False,
        size: tuple[Length, Length] | None = None,
        center: tuple[Length, Length] | None = None,
        angle: Angle | None = None,
        pixels: Pixels | None = None,
        regions: list[ListedRegion] | None = None,
        at: tuple[Length, Length] | None = None,
        positions: list[tuple[Length, Length]] | None = None,
        grid: ListedGrid | None = None,
        kind: str | None = None,
        curve: CurveTable | None = None,
        end_when_done: bool = False,
    ) -> None:
        self.sweep, self.measure, self.end_when_done = _plan(parameters, order, seed, repeat), measure, end_when_done
        self.kind = kind
        self._given: Plain = {
            "parameters": parameters, "order": order, "seed": seed, "repeat": repeat, "withdraw": withdraw,
            "settle": settle,
        }  # fmt: skip
        of_scans = {"size": size, "center": center, "angle": angle, "pixels": pixels, "regions": regions}
        of_spectra = {"at": at, "positions": positions, "grid": grid, "kind": kind, "curve": curve}
        of_others: dict[str, dict[str, Any]] = {"scan": of_spectra, "spectrum": of_scans, "both": {}}
        for name, value in of_others[measure].items():
            if value is not None:
                raise ConfigError(f"says nothing of a {measure}", where=name)
        _refuse_both({"regions": regions, "size": size})
        _refuse_both({"at": at, "positions": positions, "grid": grid})
        for name, value in {"center": center, "angle": angle}.items():
            if value is not None and size is None:
                raise ConfigError("needs the `size` of the scans", where=name)
        instruments = [axis.name for axis in self.sweep.axes if is_of_instrument(axis.name)]
        if withdraw and not instruments:
            raise ConfigError("no parameter of another instrument is swept", where="withdraw", hint="leave it out")
        self.regions: tuple[Region, ...] = ()
        if size is not None:
            self.regions = (Region(pair(center or (0.0, 0.0)), pair(size), angle or 0.0),)
        elif regions is not None:
            listed = (given if isinstance(given, ListedRegion) else ListedRegion(**given) for given in regions)
            self.regions = tuple(entry.region for entry in listed)
        self.positions: tuple[XY, ...] = ()
        if grid is not None:
            self.positions = (grid if isinstance(grid, ListedGrid) else ListedGrid(**grid)).positions
        else:
            self.positions = tuple(map(pair, [at] if at else positions or []))
        for name, value, found in (("regions", regions, self.regions), ("positions", positions, self.positions)):
            if value is not None and not found:
                raise ConfigError("lists nothing", where=name)
        self._shape = shape = None if pixels is None else shape_of(pixels)
        self._what: Plain = {}
        if measure != "spectrum":
            self._what |= {"region": self.regions or None, "shape": shape}
        if measure != "scan":
            self._what |= {"at": self.positions or None, "kind": kind}
        self.curve = curve or {}
        self._of_curves = curve_parameters(self.curve, kind)
        starts = {"scan": (names.START_SCAN,), "spectrum": (names.START_SPEC,)}
        of_tip: tuple[str, ...] = (names.RETRACT, names.ENGAGE) if withdraw else ()
        of_tip += () if isinstance(withdraw, bool) else tuple(withdraw)
        self.needs_actions = (*starts.get(measure, (names.START_SCAN, names.START_SPEC)), *of_tip)
        with_kind = bool(kind or self.curve)  # the settings of `curve` are those of one kind
        fixed = (
            *((*FRAME, names.SCAN_ANGLE) if self.regions else ()),
            *(_PIXELS if pixels else ()),
            *(_PROBE if self.positions else ()),
            *((names.SPEC_KIND,) if with_kind else ()),
            *(one.name for one in self._of_curves),
        )
        for axis in self.sweep.axes:
            if axis.name in fixed:
                raise ConfigError("is swept, and fixed by another setting", where=f"parameters.{axis.name}")
        swept = tuple(axis.name for axis in self.sweep.axes)
        self.needs_parameters = (*swept, *(name for name in fixed if name != names.SCAN_ANGLE))
        if self.regions:
            self.plan = ScanPlan(self.regions, shape)  # the part that `afspm check` can look at

    @property
    def planned_parameters(self) -> dict[str, tuple[Parameter, ...]]:
        """All values that the sweep sets, by the setting that gives them, for comparison with the limits."""
        return {
            "curve": self._of_curves,
            "parameters": tuple(axis.parameter(place) for axis in self.sweep.axes for place in range(len(axis.values))),
        }

    @property
    def _at_each(self) -> tuple[int, int]:
        # the scans and the spectra of a point
        scans, spectra = (max(len(places), 1) for places in (self.regions, self.positions))
        return scans * (self.measure != "spectrum"), spectra * (self.measure != "scan")

    def planned_work(self, speed_m_s: float | None) -> PlannedWork:
        total, ends = self.sweep.total, self.end_when_done
        scans, spectra = (total * each for each in self._at_each)
        why = time_of_curves(self.curve, spectra)
        if self.measure == "spectrum":
            return PlannedWork(spectra=spectra, ends_experiment=ends, why=why)
        if not self.regions or self._shape is None:
            why = "the file sets no size and pixels"
            return PlannedWork(scans, spectra=spectra, path_m=None, pixels=None, ends_experiment=ends, why=why)
        speeds = next((axis.values for axis in self.sweep.axes if axis.name == names.SCAN_SPEED), (speed_m_s,))
        each = total // len(speeds)
        rounds = (planned_rounds(self.regions, self._shape, each, 0.0, speed) for speed in map(_number, speeds))
        work = reduce(add, rounds)
        if spectra:
            work = replace(work, spectra=spectra, duration_s=None, why=why)
        if arrivals := [axis.name for axis in self.sweep.axes if is_of_instrument(axis.name)]:
            work = replace(work, duration_s=None, why=f"the time in which {arrivals[0]} arrives is unknown")
        return replace(work, ends_experiment=ends)

    def run(self) -> None:
        sweep = to_plain(self.sweep) | {"measure": self.measure}
        if self.sweep.repeat == 1:
            del sweep["repeat"]  # not in what runs of earlier versions have saved
        places = to_plain({"regions": self.regions, "positions": self.positions})
        if self.memory.setdefault("sweep", sweep) != sweep or self.memory.setdefault("places", places) != places:
            raise ConfigError(
                "the sweep was begun with other values or places, which are in the record of this run",
                where="parameters",
                hint="undo the change, or begin a new run",
            )
        each = sum(self._at_each)
        total, done = self.sweep.total * each, int(self.memory.get("done", 0))
        what = "point" if each == 1 else "measurement"
        pace = Pace(self.scope, self.memory)
        self.memory.save()
        if 0 < done < total:
            self.log.info("going on with %s %d of %d", what, done + 1, total)
        with (
            self.scope.curves(self.curve, kind=self.kind),
            self.scope.sweep(**self._given, **self._what, measure=self.measure, key=KEY, done=done) as points,
        ):
            for point in points:
                self.memory["done"] = point.number
                pace.note()
                if self.memory.save(synced=False):  # else a restart asks for it again
                    self.scope.forget(point.key)
                self.scope.progress(point.number, total, left_s=pace.left_s(point.number, total))
                self.log.info("%s %d of %d: %s", what, point.number, total, self._text(point.values))
        self.log.info("all %d points are measured", self.sweep.total)
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


def _refuse_both(given: Mapping[str, object]) -> None:
    if len(named := [name for name, value in given.items() if value is not None]) > 1:
        raise ConfigError(f"{named[0]!r} is given, too: one of them says where to measure", where=named[1])


def _plan(parameters: Plain, order: SweepOrder, seed: int, repeat: int) -> SweepPlan:
    for name, given in parameters.items():
        try:
            SweepPlan.of({name: given}, order)
        except (InvalidValue, UnitError) as error:
            raise ConfigError(error.what, where=f"parameters.{name}", hint=error.hint) from error
    try:
        return SweepPlan.of(parameters, order, seed, repeat)
    except InvalidValue as error:
        raise ConfigError(error.what, where=error.where or "parameters", hint=error.hint) from error
