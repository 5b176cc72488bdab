"""Spectra on a grid or a list of positions. A restart repeats no spectrum."""

from __future__ import annotations

import logging

from afspm.basics.errors import ConfigError
from afspm.basics.units import Angle, Length
from afspm.client.component import Component
from afspm.components.planned_scans import pair
from afspm.components.scan_plan import grid_centers
from afspm.model import names
from afspm.model.planned_work import PlannedWork

MOST_LINES = 20
"""Limit on log lines about the progress of a grid; `scope.progress` reports each spectrum."""


class SpectroscopyGrid(Component):
    """A spectrum at each point of a grid, back and forth by rows, or at each position of a list.

    A restart after a kill neither repeats nor omits a spectrum.

    Args:
        counts: (columns, rows) of the grid.
        spacing: (x, y) distance from one point to the next.
        center: (x, y) of the middle of the grid; by default (0, 0).
        angle: angle of the grid, counter-clockwise; by default 0.
        positions: a list of (x, y) instead of a grid.
        kind: kind of spectrum, if the microscope has several, e.g. "IV" or "force".
        repeats: number of spectra at each point.
        end_when_done: whether to end the whole experiment after the last spectrum.
    """

    needs_actions = (names.START_SPEC,)

    def __init__(
        self,
        counts: tuple[int, int] | None = None,
        spacing: tuple[Length, Length] | None = None,
        center: tuple[Length, Length] | None = None,
        angle: Angle | None = None,
        positions: list[tuple[Length, Length]] | None = None,
        kind: str | None = None,
        repeats: int = 1,
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
        self.needs_parameters = (names.PROBE_POS_X, names.PROBE_POS_Y, *([names.SPEC_KIND] if kind else []))
        self.repeats = repeats
        self.end_when_done = end_when_done

    def planned_work(self, speed_m_s: float | None) -> PlannedWork:
        spectra, why = len(self.positions) * self.repeats, "the controller sets the duration of a spectrum"
        return PlannedWork(spectra=spectra, ends_experiment=self.end_when_done, why=why)

    def run(self) -> None:
        total = len(self.positions) * self.repeats
        start_s = float(self.memory.setdefault("start_s", self.clock.now_s()))
        for index in range(int(self.memory.get("done", 0)), total):
            place, repeat = divmod(index, self.repeats)
            key = f"spectrum-{place}-{repeat}"
            self.scope.spectrum(self.positions[place], kind=self.kind, key=key)
            self.memory["done"] = index + 1
            if self.memory.save(synced=False):  # if not saved, a restart requests the same spectrum
                self.scope.forget(key)
            per_spectrum_s = (self.clock.now_s() - start_s) / (index + 1)
            self.scope.progress(index + 1, total, left_s=per_spectrum_s * (total - index - 1))
            is_told = total <= MOST_LINES or (index + 1) * MOST_LINES // total > index * MOST_LINES // total
            self.log.log(logging.INFO if is_told else logging.DEBUG, "spectrum %d of %d", index + 1, total)
        if self.end_when_done:
            self.scope.end_experiment()
