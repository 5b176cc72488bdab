"""Order of positions along a short way, and the cost of a measurement in seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from afspm import Array
from afspm.plugins.adaptive.gaussian_process import distances

Cell = tuple[int, int]
_PASSES: Final = 6  # largest number of passes that improve a tour
_REMEMBERED: Final = 60  # latest measurements, from which the costs are learnt


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


def short_tour(xy_m: Array, start_m: Array) -> list[int]:
    """Return an order of positions (n, 2) with a short way from `start_m`: nearest neighbours, then 2-opt."""
    n = len(xy_m)
    apart = distances(xy_m, xy_m)
    left = np.ones(n, dtype=bool)
    at = int(np.argmin(np.hypot(*(xy_m - start_m).T)))
    order = [at]
    left[at] = False
    for _ in range(n - 1):
        at = int(np.argmin(np.where(left, apart[at], np.inf)))
        left[at] = False
        order.append(at)
    return _untangled(order, apart, np.hypot(*(xy_m - start_m).T))


def way_m(xy_m: Array, start_m: Array) -> float:
    """Return the length in m of the way from `start_m` through positions in their order."""
    return float(np.hypot(*np.diff(np.vstack([start_m, xy_m]), axis=0).T).sum())


def _untangled(order: list[int], apart: Array, from_start: Array) -> list[int]:
    # reverse a part of the way wherever that shortens it; the end is free
    path = np.array(order)
    n = len(path)
    for _ in range(_PASSES):
        improved = False
        for i in range(n - 1):
            before = from_start[path] if i == 0 else apart[path[i - 1], path]
            after = np.append(apart[path[i], path[i + 2 :]], 0.0)  # the point after the reversed part
            joint = np.append(apart[path[i + 1 : n - 1], path[i + 2 :]], 0.0)
            gain = before[i] + joint - before[i + 1 :] - after
            best = int(np.argmax(gain))
            if gain[best] > 1e-12:
                end = i + 1 + best
                path[i : end + 1] = path[i : end + 1][::-1]
                improved = True
        if not improved:
            break
    return [int(place) for place in path]
