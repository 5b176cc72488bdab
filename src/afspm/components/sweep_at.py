"""`SweepAt`: any parameter against any reading, at each position of a grid or a list."""

from __future__ import annotations

from typing import Any, ClassVar

from afspm.basics.errors import ConfigError, InvalidValue, UnitError
from afspm.basics.units import Duration
from afspm.client.sweeping_at import PlacedSweep
from afspm.client.targets import SpectrumTarget
from afspm.components.scan_plan import XY
from afspm.components.spectroscopy_grid import SpectroscopyGrid
from afspm.model import names
from afspm.model.planned_work import PlannedWork
from afspm.model.sweep_plan import SweepAxis


class SweepAt(SpectroscopyGrid):
    """A sweep of one parameter at each point of a grid, or at each position of a list, with readings after each set.

    The frequency of a generator against a lock-in (ESR), a wavelength against the current: any parameter that can be
    set, against any that can be read, of the microscope or of another instrument. At each value the instrument first
    arrives, then `settle` passes, then each instrument measures. Each sweep is recorded as a spectrum, whose variables
    have the names of the parameters.

    A restart after a kill repeats no finished sweep. Positions that are refused are left out, as by a
    `SpectroscopyGrid`. The parameter is set back after each sweep.

    Args:
        parameter: the parameter to set, such as "lab.rf".
        values: its values in order, which may come again: a list, such as ["13 GHz", "15 GHz"], or a range, such as
            {from = "13 GHz", to = "17 GHz", points = 101}, or with `step` instead of `points`.
        read: the parameters to read after each set, such as ["lab.x", "lab.y"].
        settle: experiment time from each set to its readings.
        name_of_kind: kind of the spectra in the record; by default the name of the parameter.
        counts: (columns, rows) of the grid.
        spacing: (x, y) distance from one point to the next.
        center: (x, y) of the middle of the grid; by default (0, 0).
        angle: angle of the grid, counter-clockwise; by default 0.
        positions: a list of (x, y) instead of a grid.
        repeats: number of sweeps at each point.
        keep_control: whether to keep control between sweeps; by default others may measure meanwhile.
        end_when_done: whether to end the whole experiment after the last sweep.
    """

    publishes: ClassVar = ("Spec1d", "MeasurementConditions")

    def __init__(
        self,
        parameter: str,
        values: list[str | float] | dict[str, str | float],
        read: list[str],
        settle: Duration = 0.0,
        name_of_kind: str = "",
        **grid: Any,
    ) -> None:
        for name in ("kind", "curve"):
            if name in grid:
                raise ConfigError("is of the microscope's own spectra", where=name, hint="leave it out")
        super().__init__(**grid)
        self.parameter, self.values, self.read, self.settle = parameter, values, tuple(read), settle
        self.name_of_kind = name_of_kind or parameter
        try:
            axis = SweepAxis.of(parameter, values)
            PlacedSweep(axis, self.read, SpectrumTarget(None, self.name_of_kind), settle)
        except (InvalidValue, UnitError) as error:
            raise ConfigError(error.what, where=error.where or "values", hint=error.hint) from error
        self.planned_parameters = {"values": tuple(axis.parameter(place) for place in range(len(axis.values)))}
        self.needs_actions = ()
        self.needs_parameters = (names.PROBE_POS_X, names.PROBE_POS_Y, parameter, *self.read)

    def planned_work(self, speed_m_s: float | None) -> PlannedWork:
        return PlannedWork(
            spectra=len(self.positions) * self.repeats,
            ends_experiment=self.end_when_done,
            why="the instruments set the duration of a sweep",
        )

    def _take(self, at_m: XY, key: str) -> None:
        self.scope.sweep_at(
            self.parameter, self.values, self.read, at=at_m, settle=self.settle, kind=self.name_of_kind, key=key,
            publish=self.publish,
        )  # fmt: skip
