"""`Adaptive`: the component that maps a quantity of spectra over a region, mostly where the map is uncertain."""

from __future__ import annotations

import csv
import io
import logging
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any, ClassVar, Final

from afspm import Component
from afspm.basics import Angle, ConfigError, Length, MeasurementFailed, counted, quantity
from afspm.components import CurveTable, OutageLog, PlannedWork, curve_parameters, write_atomic
from afspm.model import Region, names
from afspm.plugins.adaptive.mapping import (
    MOST_SPECTRA,
    MapProgress,
    MeasuredPoint,
    Until,
    optimizer_of,
    rows,
)
from afspm.plugins.adaptive.quantities import QUANTITIES, evaluation
from afspm.plugins.adaptive.refinement import AdaptiveMap

MOST_LINES: Final = 20
"""Approximate largest number of log lines about the progress of a map."""


class Adaptive(Component):
    """A component that maps a quantity over a region: spectra mostly where the map is uncertain.

    A Gaussian process gives the map and its expected error, and follows drift from the values. After a first lattice,
    each spectrum is taken at the position with the largest expected square error per second. No spectrum is taken
    twice, even if processes are killed. Where values can't be predicted from those nearby, it goes on as a nested grid.

    The expected error is for another value measured in the region, so it contains the noise of the values: a limit
    on `error` below the noise is never reached.

    The table `map.csv` and the picture `map.png`, also as `map.pdf`, are written into the run folder at the end, from
    at least three spectra.

    Args:
        size: (width, height) of the region.
        quantity: "gap" (I(V) curves, in eV), "adhesion" (force curves, in N), "contact_potential" (I(V) curves with the
            frequency shift, in V), or a function of a spectrum as "module.name".
        until: limits of the map, at least one; the first that is reached ends the map: `error`, the expected rms error
            in the unit of the quantity; `spectra`, the number of spectra; `time`, experiment time since the first
            spectrum.
        center: (x, y), middle of the region.
        angle: angle of the region, counter-clockwise.
        unit: unit of the result of your own function.
        kind: kind of the spectra; by default the kind of the quantity, or the kind set at the microscope.
        curve: settings of the spectra, as for a `SpectroscopyGrid`: {sweep = ["-500 mV", "500 mV"], points = 201}.
        optimizer: "adaptive", "nested" (complete lattices), or a function of region and quantity as "module.name" that
            returns an optimiser with `suggest` and `ingest` of bluesky-adaptive, with the parameters `x` and `y`.
        coarsest: number of positions along the longer side of the first lattice, 3 to 9.
        levels: number of refinements, 1 to 9, each twice as fine as the last; those after the third are measured only
            between measured positions.
        drift: whether the map follows a drift of the sample, found from more than 80 values that clearly agree better
            with it; false where the sample stands still or its drift is corrected elsewhere.
        keep_control: whether to keep control between spectra; by default others may measure meanwhile.
        end_when_done: whether to end the whole experiment after the last spectrum.
        file: name of table and picture, without suffix.
    """

    file_suffix: ClassVar[str] = ".csv"
    needs_actions = (names.START_SPEC,)
    longest_step_s = 120.0  # a fit with a drift takes seconds on a busy computer
    _outage = OutageLog("the table of the map can't be written", logging.getLogger("afspm.records"))

    def __init__(
        self,
        size: tuple[Length, Length],
        quantity: str,
        until: dict[str, float | str],
        center: tuple[Length, Length] = (0.0, 0.0),
        angle: Angle = 0.0,
        unit: str = "",
        kind: str | None = None,
        curve: CurveTable | None = None,
        optimizer: str = "adaptive",
        coarsest: int = 5,
        levels: int = 5,
        drift: bool = True,
        keep_control: bool = False,
        end_when_done: bool = False,
        file: str = "map",
    ) -> None:
        for name, value, least in (("coarsest", coarsest, 3), ("levels", levels, 1)):
            if not least <= value <= 9:
                raise ConfigError(f"{value} is not between {least} and 9", where=name)
        self._region = Region((center[0], center[1]), (size[0], size[1]), angle)
        self._evaluation = evaluation(quantity, unit, kind)
        self._until = Until.of(until, self._evaluation.unit)
        own: dict[str, Any] = {}
        if optimizer in ("adaptive", "nested"):
            own = {"coarsest": coarsest, "levels": levels, "velocity_m_s": None if drift else (0.0, 0.0)}
        elif not drift:
            raise ConfigError("is a setting of the optimisers of afspm", where="drift", hint="leave it out")
        self._optimizer = optimizer_of(optimizer, self._region, self._evaluation.name, **own)
        self.kind = self._evaluation.kind
        with_kind = (names.SPEC_KIND,) if self.kind else ()
        self.curve = curve or {}
        self.planned_parameters = {"curve": curve_parameters(self.curve, self.kind)}
        of_curves = (one.name for one in self.planned_parameters["curve"])
        self.needs_parameters = (names.PROBE_POS_X, names.PROBE_POS_Y, *with_kind, *of_curves)
        self.positions = tuple((float(x), float(y)) for x, y in self._region.corners_m())
        self.keep_control, self.end_when_done, self.file = keep_control, end_when_done, file
        self._progress: MapProgress | None = None
        self._velocity = (0.0, 0.0)
        self._is_grid = False

    def planned_work(self, speed_m_s: float | None) -> PlannedWork:
        most = self._until.spectra or MOST_SPECTRA
        return PlannedWork(
            spectra=most, at_most=True, ends_experiment=self.end_when_done, why="the values decide where it measures"
        )

    def run(self) -> None:
        kept = self.scope.control() if self.keep_control else nullcontext()
        with kept, self.scope.curves(self.curve, kind=self.kind):
            self._measure()
        if self.end_when_done:
            self.scope.end_experiment()

    def _measure(self) -> None:
        found = MapProgress(self._optimizer, self._region, self._evaluation, self._until, self.clock.late)
        self._progress = found
        kept = [MeasuredPoint(**row) for row in self.memory.setdefault("measured", [])]
        failed = self.memory.setdefault("failed", [])
        found.restore(kept, failed)
        if kept:
            self.log.info("going on after %s", counted(len(kept), "spectrum", "spectra"))
        while not (why := found.finished()):
            # saved, so that a restart requests the same spectrum
            point = self.memory.get("next") or found.suggestion()
            if point is None:
                why = "the finest lattice is measured"
                break
            number = len(found.measured) + len(failed) + 1
            if self.memory.get("next") != point:
                self.memory["next"] = point
                self.memory.save(synced=False)
            one = found.measure(self.scope, point, key=f"map-{number}")
            if one is None:
                failed.append(point["_id"])
            else:
                self.memory["measured"] += rows([one])
            self.memory["next"] = None
            if self.memory.save(synced=False):  # if not saved, a restart requests the same spectrum
                self.scope.forget(f"map-{number}")
            self._report(found)
        self.log.info("%s: %s%s", self._state(found), why, self._failures(found))
        if failed and not found.measured:
            raise MeasurementFailed(f"none of the {len(failed)} positions of the map gave a value")

    @classmethod
    def needed_variables(cls, settings: Mapping[str, Any]) -> tuple[tuple[str, ...], ...]:
        """Return the roles of variables that the quantity of these settings reads, for `afspm check`."""
        known = QUANTITIES.get(str(settings.get("quantity", "")))
        return () if known is None else known.needs

    def on_end(self) -> None:
        found = self._progress
        if found is None or len(found.measured) < 3:
            self.log.warning("fewer than three spectra: there is no map")
            return
        folder = Path(self.run_dir)
        with self._outage.trying():  # on a full disk the error is logged, and the picture is tried
            write_atomic(folder / f"{self.file}.csv", [self._table(found).encode()])
        from afspm.drawing import save_figure
        from afspm.plugins.adaptive.map_picture import DPI, draw_map  # matplotlib: needed at the end alone

        drawn = draw_map(found, self._region, title=self.name, simulated=self.simulated)
        path = folder / f"{self.file}.png"
        for suffix in (".png", ".pdf"):  # the second for `afspm export --to pdf`: the fit is not in the record
            save_figure(drawn, path.with_suffix(suffix), DPI)
        self.log.info("the map is drawn: %s", path)

    def _table(self, found: MapProgress) -> str:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        unit = f" [{self._evaluation.unit}]" if self._evaluation.unit else ""
        writer.writerow(["x [m]", "y [m]", f"{self._evaluation.name}{unit}", "time [s]", "x_start [m]", "y_start [m]"])
        for one, (x_m, y_m) in zip(found.measured, found.map.model.positions_m, strict=True):
            places = (f"{place:.9g}" for place in (one.x_m, one.y_m))
            writer.writerow([*places, f"{one.value:.9g}", f"{one.time_s:.3f}", f"{x_m:.9g}", f"{y_m:.9g}"])
        return text.getvalue()

    def _report(self, found: MapProgress) -> None:
        done, until = len(found.measured), self._until
        most = until.spectra or MOST_SPECTRA
        self.scope.progress(done, most)
        velocity = found.map.parameters.velocity_m_s
        if velocity != self._velocity and any(velocity):
            by = " and ".join(quantity(each, "m/s", 2) for each in velocity)
            self.log.info("the values contradict each other less with a drift of %s (x and y): the map follows it", by)
        elif any(self._velocity) and not any(velocity):
            self.log.info("the values agree as well without a drift: the map follows none")
        self._velocity = velocity
        is_grid = isinstance(found.optimizer, AdaptiveMap) and found.optimizer.is_grid
        if is_grid and not self._is_grid:
            self.log.info("the values can't be predicted from those nearby: the map goes on as a nested grid")
        elif self._is_grid and not is_grid:
            self.log.info("the values can be predicted from those nearby: the map goes on where it is uncertain")
        self._is_grid = is_grid
        every = max(1, most // MOST_LINES)
        if done and done % every == 0:
            self.log.info("%s", self._state(found))

    def _state(self, found: MapProgress) -> str:
        error = "" if found.error is None else f", expected error {quantity(found.error, self._evaluation.unit, 2)}"
        return f"{counted(len(found.measured), 'spectrum', 'spectra')}{error}"

    @staticmethod
    def _failures(found: MapProgress) -> str:
        return f"; {counted(found.failures, 'position')} without a value" if found.failures else ""
