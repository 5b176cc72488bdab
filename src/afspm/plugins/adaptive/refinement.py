"""Optimisers that map a quantity over a region, behind the protocol of bluesky-adaptive 1.0: `suggest` and `ingest`.

**Theory of operation.** The region carries nested lattices, each twice as fine as the last. A round of
`AdaptiveMap` takes positions of the next finer lattice, but only beside positions that are measured already, and only
where the Gaussian process expects an error worth the seconds. On a map that is rough everywhere the whole lattice
is taken, exactly as by a nested grid; on a map that is rough in a few places, mostly these places.

The usual choice, the position of the largest variance, is not taken for two reasons. The variance of a stationary
process depends on positions alone, so it measures even ground as densely as a spot; and with slow moves the ways
between such positions take longer than the curves. `NestedGrid` has the same process and follows drift alike: a grid
with a weaker map would make the comparison look better, and show nothing about the choice of positions.

    comes in      measured values with their times and the seconds that they took
    state         the measurements, the rest of the round, the parameters of the process
    goes out      positions to measure next, the map, its expected error
    always holds  the same measurements give the same suggestions; a position is suggested once
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence, Set
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np

from afspm import Array
from afspm.basics import InvalidValue
from afspm.model import Region
from afspm.plugins.adaptive.gaussian_process import GaussianProcess, Parameters, fitted
from afspm.plugins.adaptive.tours import Cell, MeasurementCost, learnt_cost, short_tour, snake, way_m

Point = Mapping[str, Any]

ID: Final = "_id"
COARSEST: Final = 5  # positions along the longer side of the first lattice
LEVELS: Final = 6  # number of refinements
_MORE: Final = 1.2  # times as many measurements as at the last fit
_PART: Final = 0.5  # share of the good positions in a round where ways cost little: the next round knows more
_EVEN: Final = 0.6  # share of good positions above which a map is rough everywhere
_WORTH: Final = 0.2  # least gain of a good position, as a part of the gain of a typical good position


@runtime_checkable
class Optimizer(Protocol):
    """The part of bluesky-adaptive's protocol that the measurement of a map needs."""

    def suggest(self, num_points: int | None = None) -> Sequence[Point]:
        """Return positions to measure next, each with `_id`, `x` and `y` (m)."""
        ...

    def ingest(self, points: Sequence[Point]) -> None:
        """Take measured values: `x`, `y` (m) and the quantity by its name; with `_id` if the position was suggested."""
        ...


class NestedLattices:
    """Nested lattices over a region. Cells are (column, row) of the finest lattice."""

    def __init__(self, region: Region, coarsest: int = COARSEST, levels: int = LEVELS) -> None:
        self.region, self.levels = region, levels
        longer = max(region.size_m)
        steps = [max(1, round((coarsest - 1) * size / longer)) for size in region.size_m]
        self.counts = (steps[0] * 2**levels + 1, steps[1] * 2**levels + 1)
        self.finest_m: float = max(size / (count - 1) for size, count in zip(region.size_m, self.counts, strict=True))

    def stride(self, level: int) -> int:
        """Return the distance between neighbouring positions of a level, in cells."""
        return 1 << (self.levels - level)

    def spacing_m(self, level: int) -> float:
        """Return the distance between neighbouring positions of a level in m, the larger of both axes."""
        return float(self.finest_m * self.stride(level))

    def cells(self, level: int) -> list[Cell]:
        """Return all cells of a level, row by row."""
        stride = self.stride(level)
        return [(i, j) for j in range(0, self.counts[1], stride) for i in range(0, self.counts[0], stride)]

    def level(self, cell: Cell) -> int:
        """Return the coarsest level with this cell."""
        shared = math.gcd(cell[0], cell[1], self.stride(0))
        return self.levels - (shared.bit_length() - 1)

    def new(self, level: int) -> list[Cell]:
        """Return the cells of a level that no coarser level has, row by row."""
        return [cell for cell in self.cells(level) if self.level(cell) == level]

    def parents(self, cell: Cell, level: int) -> list[Cell]:
        """Return the cells of the next coarser level around a new cell of `level`."""
        coarse = self.stride(level - 1)
        columns = {cell[0] - cell[0] % coarse, cell[0] + -cell[0] % coarse}
        rows = {cell[1] - cell[1] % coarse, cell[1] + -cell[1] % coarse}
        return [(i, j) for i in columns for j in rows]

    def xy_m(self, cells: Iterable[Cell]) -> Array:
        """Return the positions of cells, shape (n, 2), in m."""
        at = np.array(list(cells), dtype=np.float64).reshape(-1, 2)
        last = np.array(self.counts, dtype=np.float64) - 1.0
        along = (at / last - 0.5) * np.asarray(self.region.size_m)
        cos, sin = math.cos(self.region.angle_rad), math.sin(self.region.angle_rad)
        return np.asarray(along @ np.array([[cos, sin], [-sin, cos]]) + np.asarray(self.region.center_m))


class LatticeMap:
    """Measurements on nested lattices, and the map that follows from them.

    Args:
        region: region of the map.
        quantity: name of the measured value.
        velocity_m_s: known velocity (x, y) of the sample; None: estimated from the values.
        coarsest: number of positions along the longer side of the first lattice.
        levels: number of refinements, each twice as fine as the last.

    Attributes:
        lattice: nested lattices over the region.
        parameters: parameters of the Gaussian process from the last fit.
        cost: cost of a measurement in seconds, learnt from the run.
    """

    def __init__(
        self,
        region: Region,
        quantity: str,
        *,
        velocity_m_s: tuple[float, float] | None = None,
        coarsest: int = COARSEST,
        levels: int = LEVELS,
    ) -> None:
        self.lattice, self.quantity = NestedLattices(region, coarsest, levels), quantity
        self.parameters = Parameters(0.5 * self.lattice.spacing_m(0), 0.01, velocity_m_s or (0.0, 0.0))
        self.cost = MeasurementCost()
        self._follows_drift = velocity_m_s is None
        self._fitted = 0
        self._done: set[Cell] = set()
        self._asked: dict[str, Cell] = {}
        self._queue: list[Cell] = []
        self._rows: list[tuple[float, float, float, float]] = []  # x, y, value, time
        self._ways_m: list[float] = []
        self._seconds: list[float] = []
        self._model: GaussianProcess | None = None
        self._check = self.lattice.xy_m(self.lattice.cells(min(3, levels)))

    # -- the protocol

    def suggest(self, num_points: int | None = None) -> Sequence[Point]:
        """Return positions to measure next, by default one position.

        Fewer than `num_points`, or none, at the end of a round whose measurements are incomplete, and after the finest
        lattice.
        """
        count = 1 if num_points is None else num_points
        found: list[Point] = []
        while len(found) < count:
            if not self._queue:
                if self._asked or found:
                    break  # plan a round only from complete measurements
                self._queue = self._round()
                if not self._queue:
                    break
            cell = self._queue.pop(0)
            name = f"{cell[0]}-{cell[1]}"
            self._asked[name] = cell
            ((x, y),) = self._under_tip(cell, found)
            found.append({ID: name, "x": float(x), "y": float(y)})
        return found

    def ingest(self, points: Sequence[Point]) -> None:
        """Take measured values; optional keys are `time_s` and `seconds`, the duration with the way to the position.

        Raises:
            InvalidValue: a value is missing or not finite, and no point is taken; or an `_id` is not of this map.
        """
        rows = [self._row(point) for point in points]
        for point, row in zip(points, rows, strict=True):
            if ID in point:
                self._done.add(self._cell(point[ID]))
                self._asked.pop(str(point[ID]), None)
            if self._rows and "seconds" in point:
                self._ways_m.append(math.dist(row[:2], self._rows[-1][:2]))
                self._seconds.append(float(point["seconds"]))
            self._rows.append(row)
        self._model = None
        self.cost = learnt_cost(self._ways_m, self._seconds)

    def register_failures(self, suggestions: Sequence[Point]) -> None:
        """Leave out suggested positions that can't be measured."""
        for point in suggestions:
            self._done.add(self._cell(point[ID]))
            self._asked.pop(str(point[ID]), None)

    def get_best_points(self) -> Sequence[tuple[int, Point, Point]]:
        """Return a list with the highest measured value as (number, position, value); empty without measurements."""
        if not self._rows:
            return []
        number, (x, y, value, _) = max(enumerate(self._rows), key=lambda one: one[1][2])
        return [(number, {"x": x, "y": y}, {self.quantity: value})]

    @property
    def has_planned(self) -> bool:
        """Whether the next suggestion is planned already."""
        return bool(self._queue)

    # -- the map

    @property
    def measurements(self) -> Array:
        """The measurements, (n, 4): x and y in m, value, time in s."""
        return np.array(self._rows, dtype=np.float64).reshape(-1, 4)

    @property
    def model(self) -> GaussianProcess:
        """The process after all measurements, with the parameters fitted last."""
        if self._model is None:
            x, y, values, times = self.measurements.T
            self._model = GaussianProcess(np.stack([x, y], axis=1), values, times, self.parameters)
        return self._model

    def fit(self) -> None:
        """Fit the process to all measurements, if their number has grown by a fifth since the last fit."""
        if len(self._rows) < _MORE * self._fitted:
            return
        self._fitted = len(self._rows)
        x, y, values, times = self.measurements.T
        shortest = 0.3 * self._reached_m()
        self.parameters = fitted(
            np.stack([x, y], axis=1), values, times, self.parameters, shortest,
            drifts=self._follows_drift and len(values) > 40,
        )  # fmt: skip
        self._model = None

    def map(self, xy_m: Array) -> Array:
        """Return the expected values at positions (m, 2) of the sample as it lay at the first measurement."""
        return self.model.predict(xy_m)

    def expected_error(self) -> float:
        """Return the expected rms error of the map over the region."""
        return math.sqrt(float(self.model.variance(self._check).mean()))

    # -- inside

    def _round(self) -> list[Cell]:
        raise NotImplementedError

    def _rest_of_lattice(self) -> list[Cell]:
        for level in range(self.lattice.levels + 1):
            cells = [cell for cell in self.lattice.new(level) if cell not in self._done]
            if cells:
                return snake(cells)
        return []

    def _reached(self, done: Set[Cell]) -> int:
        return max((self.lattice.level(cell) for cell in done), default=0)

    def _reached_m(self) -> float:
        return self.lattice.spacing_m(self._reached(self._done))

    def _at_m(self) -> Array:
        return np.array(self._rows[-1][:2]) if self._rows else self.lattice.xy_m([(0, 0)])[0]

    def _under_tip(self, cell: Cell, before: Sequence[Point]) -> Array:
        # where the sample's position is expected when the probe gets there
        home = self.lattice.xy_m([cell])
        if not self._rows:
            return home
        since_s = self._rows[-1][3] - self._rows[0][3]
        at = self._at_m()
        for point in before:
            to = np.array([point["x"], point["y"]])
            since_s += self.cost.of(math.dist(at, to))
            at = to
        since_s += self.cost.of(math.dist(at, home[0]))
        return np.asarray(home + since_s * np.asarray(self.parameters.velocity_m_s))

    def _cell(self, name: object) -> Cell:
        column, _, row = str(name).partition("-")
        if not (column.isdigit() and row.isdigit()):
            raise InvalidValue(f"{name!r} is no _id of this map", hint="leave _id out for a position of your own")
        return int(column), int(row)

    def _row(self, point: Point) -> tuple[float, float, float, float]:
        missing = [name for name in ("x", "y", self.quantity) if name not in point]
        if missing:
            raise InvalidValue(f"a measurement without {', '.join(missing)}", hint=f"it has {', '.join(point)}")
        time_s = point.get("time_s", self._rows[-1][3] + self.cost.fixed_s if self._rows else 0.0)
        row = (float(point["x"]), float(point["y"]), float(point[self.quantity]), float(time_s))
        if not all(map(math.isfinite, row)):
            raise InvalidValue(f"{self.quantity} = {row[2]} at ({row[0]}, {row[1]}) m, {row[3]} s is not finite")
        return row


class NestedGrid(LatticeMap):
    """Complete nested lattices, one after the other, each back and forth row by row."""

    def _round(self) -> list[Cell]:
        if self._rows:
            self.fit()
        return self._rest_of_lattice()


class AdaptiveMap(LatticeMap):
    """Nested lattices, refined where the expected error is worth the seconds."""

    def _round(self) -> list[Cell]:
        first = [cell for cell in self.lattice.cells(0) if cell not in self._done]
        if first:
            return snake(first)
        if not self._rows:  # no position of the first lattice has a value
            return self._rest_of_lattice()
        self.fit()
        cells, gains = self._candidates()
        if not cells:
            return []
        if not gains.any():  # all values are the same: no position is better than another
            gains = np.ones(len(cells))
        # the gain of a typical good position: the mean, weighted by the gain itself
        least = _WORTH * float((gains**2).sum() / gains.sum())
        good = [cell for cell, gain in zip(cells, gains, strict=True) if gain >= least]
        if len(good) > _EVEN * len(cells):
            level = min(self.lattice.level(cell) for cell in cells)
            return snake([cell for cell in cells if self.lattice.level(cell) == level])
        if self._travels():
            good += self._finer(good, least)
        else:
            best = sorted(zip(gains, cells, strict=True), reverse=True)[: math.ceil(_PART * len(good))]
            good = [cell for _, cell in best]
        order = self._ordered(good)
        taken = set(order)
        others = [(cell, float(gain)) for cell, gain in zip(cells, gains, strict=True) if cell not in taken]
        return self._with_those_on_the_way(order, others, least)

    def _travels(self) -> bool:
        # whether the way to the next position costs more than its curve
        return self.cost.per_m_s * self._reached_m() > self.cost.fixed_s

    def _finer(self, good: list[Cell], least: float) -> list[Cell]:
        # positions of the next level that will be good after these: a second visit would cost the way again
        done = self._done.union(good)
        cells, areas = self._beside(done)
        if not cells:
            return []
        gains = self.model.variance(self.lattice.xy_m(cells), self.lattice.xy_m(good)) * areas
        return [cell for cell, gain in zip(cells, gains, strict=True) if gain >= least]

    def _seconds_of(self, order: list[Cell]) -> float:
        return len(order) * self.cost.fixed_s + self.cost.per_m_s * way_m(self.lattice.xy_m(order), self._at_m())

    def _candidates(self) -> tuple[list[Cell], Array]:
        cells, areas = self._beside(self._done)
        return cells, self.model.variance(self.lattice.xy_m(cells)) * areas if cells else areas

    def _beside(self, done: Set[Cell]) -> tuple[list[Cell], Array]:
        # the next finer cells around these, and the area that each stands for
        found = [
            (cell, level)
            for level in range(1, min(self._reached(done) + 1, self.lattice.levels) + 1)
            for cell in self.lattice.new(level)
            if cell not in done and all(one in done for one in self.lattice.parents(cell, level))
        ]
        return [cell for cell, _ in found], np.array([self.lattice.spacing_m(level) ** 2 for _, level in found])

    def _ordered(self, cells: list[Cell]) -> list[Cell]:
        start = self._at_m()
        rows, toured = snake(cells), cells
        xy = self.lattice.xy_m(cells)
        toured = [cells[i] for i in short_tour(xy, start)]
        return min((rows, toured), key=lambda order: way_m(self.lattice.xy_m(order), start))

    def _with_those_on_the_way(self, order: list[Cell], others: list[tuple[Cell, float]], least: float) -> list[Cell]:
        # a position of little gain is worth its curve where it costs hardly any way
        xy = np.vstack([self._at_m(), self.lattice.xy_m(order)])
        legs = np.hypot(*np.diff(xy, axis=0).T)
        worth_per_s = least / self.cost.of(float(legs.mean()))
        added: dict[int, list[tuple[float, Cell]]] = {}
        for cell, gain in others:
            at = self.lattice.xy_m([cell])[0]
            reach = np.hypot(*(xy - at).T)
            detours = reach[:-1] + reach[1:] - legs
            leg = int(np.argmin(detours))
            if gain >= worth_per_s * self.cost.of(float(detours[leg])):
                added.setdefault(leg, []).append((float(reach[leg]), cell))
        result: list[Cell] = []
        for leg, cell in enumerate(order):
            result += [one for _, one in sorted(added.get(leg, []))]
            result.append(cell)
        return result
