"""Optimisers that map a quantity over a region, behind the protocol of bluesky-adaptive 1.0: `suggest` and `ingest`.

**Theory of operation.** The region carries nested lattices, each twice as fine as the last. `AdaptiveMap` measures the
first one row by row, and then always the position with the largest variance of the Gaussian process per second: curve
and way. The variance is scaled by the local roughness, so even ground is measured less densely than a spot. A spot is
found only by a measurement nearby, so the candidates reach over the whole region in the third refinement. Those nearer
to a failure than to a value come last: where one position has no value, the next may have none either.

Each fit judges the process by the values since the fit before. Where their typical error is larger than expected, the
expected error grows by as much. Where it is about the spread of the values, the process knows no better position than a
lattice, and the rest of one is measured before it is judged again. Typical is the median, which spots don't shift.

`NestedGrid` has the same process and follows drift alike: a grid with a weaker map would make the comparison look
better, and show nothing about the choice of positions.

    comes in      measured values with their times and the seconds that they took
    state         the measurements, the rest of a lattice, the parameters of the process
    goes out      positions to measure next, the map, its expected error
    always holds  the same measurements give the same suggestions; a position is suggested once
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np

from afspm.basics import InvalidValue
from afspm.components import SD_PER_MAD, Array
from afspm.model import Region
from afspm.plugins.adaptive.gaussian_process import GaussianProcess, Parameters, PredictedPlaces, distances, fitted

Point = Mapping[str, Any]
Cell = tuple[int, int]

ID: Final = "_id"
COARSEST: Final = 5  # positions along the longer side of the first lattice
LEVELS: Final = 6  # number of refinements
_DRIFT_FROM: Final = 80  # measurements: one of 64 smooth still maps followed a drift by 45 curves, and none by more
_MORE: Final = 1.2  # times as many measurements as at the last fit
_REMEMBERED: Final = 60  # latest measurements, from which the costs are learnt
_CANDIDATES: Final = 3  # refinements of the candidates everywhere: 33 x 33 positions with a first lattice of 5 x 5
_PREDICTED: Final = 40  # latest predictions, which judge the process
_LEAST_PREDICTED: Final = 25
# of the variance of the values: on maps with a larger typical error of the predictions the adaptive choice was up to
# 14 % worse than a grid. A spotty map has large errors at its spots alone
_UNEXPLAINED: Final = 0.8
_JUDGED_FROM: Final = 50  # measurements
_TIED: Final = 1e-9  # relative difference of two gains by rounding
_LEAST_S: Final = 1e-9  # a learnt cost may be of ways alone, and a way zero


@runtime_checkable
class Optimizer(Protocol):
    """The part of bluesky-adaptive's protocol that the measurement of a map needs."""

    def suggest(self, num_points: int | None = None) -> Sequence[Point]:
        """Return positions to measure next, each with `_id`, `x` and `y` (m)."""
        ...

    def ingest(self, points: Sequence[Point]) -> None:
        """Take measured values: `x`, `y` (m) and the quantity by its name; with `_id` if the position was suggested."""
        ...


@dataclass(frozen=True)
class MeasurementCost:
    """Cost of a measurement in seconds: a fixed part (settling, curve, requests), and a part per distance moved."""

    fixed_s: float = 1.0
    per_m_s: float = 0.0

    def of(self, distance_m: float) -> float:
        return self.fixed_s + self.per_m_s * distance_m


def learnt_cost(distances_m: Sequence[float], seconds: Sequence[float]) -> MeasurementCost:
    """Return the cost that fits the latest measurements best; neither part is negative.

    Measurements that took more than five times the median are left out.
    """
    way_m, took_s = np.asarray(distances_m[-_REMEMBERED:]), np.asarray(seconds[-_REMEMBERED:])
    if len(took_s) == 0:
        return MeasurementCost()
    # the median: an interruption by a person or a tip repair is no cost of a way
    usual = took_s <= 5.0 * np.median(took_s)
    way_m, took_s = way_m[usual], took_s[usual]
    spread = float(np.var(way_m))
    slope = float(np.mean((way_m - way_m.mean()) * (took_s - took_s.mean())) / spread) if spread > 0.0 else 0.0
    slope = max(slope, 0.0)
    fixed = float(took_s.mean() - slope * way_m.mean())
    if fixed < 0.0:
        return MeasurementCost(0.0, float(took_s.sum() / max(way_m.sum(), 1e-30)))
    return MeasurementCost(fixed, slope)


def snake(cells: Sequence[Cell]) -> list[Cell]:
    """Return lattice cells (column, row) row by row, every other row backwards."""
    order: list[Cell] = []
    for turn, row in enumerate(sorted({row for _, row in cells})):
        in_row = sorted(cell for cell in cells if cell[1] == row)
        order += in_row[::-1] if turn % 2 else in_row
    return order


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

    def around(self, cell: Cell, level: int) -> list[Cell]:
        """Return the neighbours of a cell in a finer level."""
        stride = self.stride(level)
        sides = [[at + side for side in (-stride, 0, stride)] for at in cell]
        return [
            (i, j) for j in sides[1] for i in sides[0]
            if (i, j) != cell and 0 <= i < self.counts[0] and 0 <= j < self.counts[1]
        ]  # fmt: skip

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
        self._done: dict[Cell, None] = {}  # measured and failed, in their order
        self._failed: list[Cell] = []
        self._asked: dict[str, Cell] = {}
        self._queue: list[Cell] = []
        self._rows: list[tuple[float, float, float, float]] = []  # x, y, value, time
        self._ways_m: list[float] = []
        self._seconds: list[float] = []
        self._model: GaussianProcess | None = None
        self._predictions: list[tuple[float, float]] = []  # squares of the errors, and their expected squares
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
                self._done[self._cell(point[ID])] = None
                self._asked.pop(str(point[ID]), None)
            if self._rows and "seconds" in point:
                self._ways_m.append(math.dist(row[:2], self._rows[-1][:2]))
                self._seconds.append(float(point["seconds"]))
            self._rows.append(row)
        self.cost = learnt_cost(self._ways_m, self._seconds)

    def register_failures(self, suggestions: Sequence[Point]) -> None:
        """Leave out suggested positions that can't be measured."""
        for point in suggestions:
            cell = self._cell(point[ID])
            self._done[cell] = None
            self._failed.append(cell)
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
        model = self._model
        known = 0 if model is None else len(model.positions_m)
        if model is not None and known == len(self._rows):
            return model
        x, y, values, times = self.measurements[known:].T
        if model is None:
            self._model = model = GaussianProcess(np.stack([x, y], axis=1), values, times, self.parameters)
        else:
            model.add(np.stack([x, y], axis=1), values, times)
        return model

    def fit(self) -> None:
        """Fit the process to all measurements, if their number has grown by a fifth since the last fit."""
        if len(self._rows) < _MORE * self._fitted:
            return
        self._judge_predictions()
        self._fitted = len(self._rows)
        x, y, values, times = self.measurements.T
        shortest = 0.3 * self._reached_m()
        self.parameters = fitted(
            np.stack([x, y], axis=1), values, times, self.parameters, shortest,
            drifts=self._follows_drift and len(values) > _DRIFT_FROM,
        )  # fmt: skip
        self._model = None

    def map(self, xy_m: Array) -> Array:
        """Return the expected values at positions (m, 2) of the sample as it lay at the first measurement."""
        return self.model.predict(xy_m)

    def expected_error(self) -> float:
        """Return the expected rms difference between the map and a value measured anywhere in the region.

        It contains the noise of the values, since noise looks like features between the measurements. It is enlarged
        where the values since were typically farther from their predictions than expected.
        """
        scale = 1.0
        if len(self._predictions) >= _LEAST_PREDICTED:
            square, expected = self._judged()
            scale = max(1.0, _typical(square / expected))
        return math.sqrt(scale * (float(self.model.variance(self._check).mean()) + self.model.noise_variance))

    # -- inside

    def _judge_predictions(self) -> None:
        # the measurements since the last fit, as the process of then predicts them
        if not self._fitted:
            return
        x, y, values, times = self.measurements.T
        at_m, known = np.stack([x, y], axis=1), slice(self._fitted)
        before = GaussianProcess(at_m[known], values[known], times[known], self.parameters)
        since = slice(self._fitted, None)
        now_m = before.on_sample(at_m[since], times[since])
        square = (values[since] - before.predict(now_m)) ** 2
        expected = before.variance(now_m) + before.noise_variance
        self._predictions += zip(square.tolist(), expected.tolist(), strict=True)

    def _judged(self) -> Array:
        return np.array(self._predictions[-_PREDICTED:]).T

    def _round(self) -> list[Cell]:
        raise NotImplementedError

    def _rest_of_lattice(self) -> list[Cell]:
        for level in range(self.lattice.levels + 1):
            cells = [cell for cell in self.lattice.new(level) if cell not in self._done]
            if cells:
                return snake(cells)
        return []

    def _reached_m(self) -> float:
        return self.lattice.spacing_m(max(map(self.lattice.level, self._done), default=0))

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


def _typical(squares: Array) -> float:
    # the variance of normal errors with this median square: a few large errors leave it as it is
    return SD_PER_MAD**2 * float(np.median(squares))


class NestedGrid(LatticeMap):
    """Complete nested lattices, one after the other, each back and forth row by row."""

    def _round(self) -> list[Cell]:
        if self._rows:
            self.fit()
        return self._rest_of_lattice()


class AdaptiveMap(LatticeMap):
    """Positions with the largest expected square error per second.

    The candidates are the positions of the third refinement, and of finer ones between positions that are measured.
    Where the latest values were typically predicted no better than by their mean, the rest of a lattice is measured.

    Attributes:
        is_grid: whether the positions are those of a lattice, since the values could not be predicted.
    """

    def __init__(self, region: Region, quantity: str, **settings: Any) -> None:
        super().__init__(region, quantity, **settings)
        self.is_grid = False
        self._coarse = min(_CANDIDATES, self.lattice.levels)
        self._cells = self.lattice.cells(self._coarse)  # candidates, with those measured since the last fit
        self._places: PredictedPlaces | None = None
        self._followed = 0  # measured cells whose neighbours are candidates

    def _round(self) -> list[Cell]:
        first = [cell for cell in self.lattice.cells(0) if cell not in self._done]
        if first:
            return snake(first)
        if not self._rows:  # no position of the first lattice has a value
            return self._rest_of_lattice()
        self.fit()
        self.is_grid = self._is_unpredictable()
        if self.is_grid:
            return self._rest_of_lattice()
        places = self._candidates()
        is_left = np.array([cell not in self._done for cell in self._cells])
        if not is_left.any():
            return []
        # on the sample, as the candidates: with drift the tip's own position is another
        ways_m = np.hypot(*(places.xy_m - self.model.positions_m[-1]).T)
        gains = places.variance() / np.maximum(self.cost.fixed_s + self.cost.per_m_s * ways_m, _LEAST_S)
        if self._failed:
            # the expected error stays large around a failure, where all other positions may fail, too
            failure_m = distances(places.xy_m, self.lattice.xy_m(self._failed)).min(axis=1)
            is_likely = is_left & (places.nearest_m.min(axis=1) < failure_m)
            is_left = is_likely if is_likely.any() else is_left
        gains[~is_left] = -1.0
        # symmetric positions differ by rounding alone, which may be another one after a restart
        tied = np.flatnonzero(gains >= gains.max() * (1.0 - _TIED))
        return [min((self._cells[place] for place in tied), key=self._order)]

    def _is_unpredictable(self) -> bool:
        if len(self._rows) < _JUDGED_FROM or len(self._predictions) < _LEAST_PREDICTED:
            return False
        return _typical(self._judged()[0]) > _UNEXPLAINED * float(np.var(self.measurements[:, 2]))

    def _candidates(self) -> PredictedPlaces:
        model = self.model
        opened = [cell for done in list(self._done)[self._followed :] for cell in self._opened_by(done)]
        self._followed = len(self._done)
        if self._places is None or self._places.model is not model:
            self._cells = [cell for cell in dict.fromkeys([*self._cells, *opened]) if cell not in self._done]
            self._places = PredictedPlaces(model, self.lattice.xy_m(self._cells))
        elif added := [cell for cell in dict.fromkeys(opened) if cell not in self._done]:
            self._cells += added
            self._places.add(self.lattice.xy_m(added))
        return self._places

    def _opened_by(self, done: Cell) -> Iterator[Cell]:
        # the finer cells around a measured one whose parents are all measured
        for level in range(max(self._coarse, self.lattice.level(done)) + 1, self.lattice.levels + 1):
            for cell in self.lattice.around(done, level):
                if all(parent in self._done for parent in self.lattice.parents(cell, level)):
                    yield cell

    def _order(self, cell: Cell) -> tuple[int, int, int]:
        return max(self._coarse, self.lattice.level(cell)), cell[1], cell[0]
