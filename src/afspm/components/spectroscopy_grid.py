"""Spectra on a grid or a list of positions. A restart repeats no spectrum."""

from __future__ import annotations

import logging
from contextlib import nullcontext, suppress

from afspm.basics import Angle, RequestError
from afspm.basics.errors import ConfigError, Refused
from afspm.basics.formatting import position_text
from afspm.basics.units import Length
from afspm.client.component import Component
from afspm.components.pace import Pace
from afspm.components.planned_scans import pair
from afspm.components.scan_plan import XY, RefusedPlaces, grid_centers
from afspm.model import names
from afspm.model.curve_request import CurveTable, curve_parameters, time_of_curves
from afspm.model.planned_work import PlannedWork

MOST_LINES = 20
"""Limit on log lines about the progress of a grid; `scope.progress` reports each spectrum."""


class SpectroscopyGrid(Component):
    """A spectrum at each point of a grid, back and forth by rows, or at each position of a list.

    A restart after a kill neither repeats nor omits a spectrum. A position that a limit or the microscope refuses is
    left out; an error in the log and a note say so. If all positions are refused, or ten in a row, the component ends
    with the reason.

    Args:
        counts: (columns, rows) of the grid.
        spacing: (x, y) distance from one point to the next.
        center: (x, y) of the middle of the grid; by default (0, 0).
        angle: angle of the grid, counter-clockwise; by default 0.
        positions: a list of (x, y) instead of a grid.
        kind: kind of spectrum, if the microscope has several, e.g. "IV" or "force".
        curve: settings of the curves, as in `curve_parameters`: {sweep = ["-500 mV", "500 mV"], points = 201,
            lock_in = {amplitude = "10 mV"}}; set back at the end.
        repeats: number of spectra at each point.
        keep_control: whether to keep control between spectra; by default others may measure meanwhile.
        end_when_done: whether to end the whole experiment after the last spectrum.
    """

    needs_actions: tuple[str, ...] = (names.START_SPEC,)

    def __init__(
        self,
        counts: tuple[int, int] | None = None,
        spacing: tuple[Length, Length] | None = None,
        center: tuple[Length, Length] | None = None,
        angle: Angle | None = None,
        positions: list[tuple[Length, Length]] | None = None,
        kind: str | None = None,
        curve: CurveTable | None = None,
        repeats: int = 1,
        keep_control: bool = False,
        end_when_done: bool = False,
    ) -> None:
        if (positions is None) == (counts is None):
            raise ConfigError("either `positions` or `counts` says where to measure")
        of_grid = {"spacing": spacing, "center": center, "angle": angle}
        if positions is not None:
            for name, value in of_grid.items():
                if value is not None:
                    raise ConfigError(
                        "is of a grid, and says nothing of `positions`, which are in scan coordinates", where=name
                    )
            self.positions = tuple(pair(position) for position in positions)
        elif counts is not None and spacing is not None:
            self.positions = grid_centers(
                pair(center or (0.0, 0.0)), (counts[0], counts[1]), pair(spacing), angle or 0.0
            )
        else:
            raise ConfigError("a grid needs its `spacing`", hint='e.g. spacing = ["10 nm", "10 nm"]')
        if not self.positions:
            raise ConfigError("no position is listed", where="positions")
        if repeats < 1:
            raise ConfigError(f"{repeats} is not at least 1", where="repeats")
        self.kind = kind
        self.curve = curve or {}
        self.planned_parameters = {"curve": curve_parameters(self.curve, kind)}
        of_curves = (one.name for one in self.planned_parameters["curve"])
        self.needs_parameters = (
            *(names.PROBE_POS_X, names.PROBE_POS_Y, *([names.SPEC_KIND] if kind else [])),
            *of_curves,
        )
        self.repeats, self.keep_control = repeats, keep_control
        self.end_when_done = end_when_done

    def planned_work(self, speed_m_s: float | None) -> PlannedWork:
        spectra = len(self.positions) * self.repeats
        return PlannedWork(spectra=spectra, ends_experiment=self.end_when_done, why=time_of_curves(self.curve, spectra))

    def run(self) -> None:
        kept = self.scope.control() if self.keep_control else nullcontext()
        with kept, self.scope.curves(self.curve, kind=self.kind):
            refused = self._measure()
        if refused:
            self.log.error("%d of %d spectra were refused", refused, len(self.positions) * self.repeats)
        if self.end_when_done:
            self.scope.end_experiment()

    def _measure(self) -> int:
        total = len(self.positions) * self.repeats
        pace = Pace(self.scope, self.memory)
        refusals = RefusedPlaces(len(self.positions), self.memory)
        while (index := int(self.memory.get("done", 0))) < total:
            place, repeat = divmod(index, self.repeats)
            done, key = index + 1, f"spectrum-{place}-{repeat}"
            try:
                self._take(self.positions[place], key)
            except Refused as refused:
                done = (place + 1) * self.repeats
                refusals.add(refused, done - index)
                self._leave_out(self.positions[place], refused)
            else:
                refusals.accepted()
                is_told = total <= MOST_LINES or done * MOST_LINES // total > index * MOST_LINES // total
                self.log.log(logging.INFO if is_told else logging.DEBUG, "spectrum %d of %d", done, total)
            self.memory["done"] = done
            pace.note()
            if self.memory.save(synced=False):  # if not saved, a restart requests the same spectrum
                self.scope.forget(key)
            self.scope.progress(done, total, left_s=pace.left_s(done, total))
        return refusals.number

    def _take(self, at_m: XY, key: str) -> None:
        self.scope.spectrum(at_m, kind=self.kind, key=key)

    def _leave_out(self, at_m: XY, refused: Refused) -> None:
        message = f"the position {position_text(at_m)} is left out: {refused.reason}"
        self.log.error("%s", message)
        with suppress(RequestError):  # a scheduler of another make may have no notes
            self.scope.note(message)
