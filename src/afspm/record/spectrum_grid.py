"""Positions of spectra in a grid, and the forward and backward curves of each variable."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from afspm.basics.errors import InvalidValue
from afspm.model.arrays import Array
from afspm.model.geometry import XY
from afspm.model.spectrum import Spectrum

DIRECTIONS: Final = ("forward", "backward")
_BACKWARD = re.compile(r"\s*(?:\[bwd\]|\bretrace\b|\bbackward\b|\bbwd\b)", re.IGNORECASE)
_FORWARD = re.compile(r"\s*(?:\[fwd\]|\btrace\b|\bforward\b|\bfwd\b)", re.IGNORECASE)
_TOLERANCE: Final = 0.1
"""Largest distance of a position from its grid point, as a fraction of the spacing."""
_LEAST_FILLED: Final = 0.5
"""Largest share of measured grid points at which positions still count as a list of places, not as a grid."""


@dataclass(frozen=True)
class PointGrid:
    """A rectangular grid, and the grid cell of each position.

    Attributes:
        x_m, y_m: coordinates of columns and rows, before the rotation about `center_m`.
        cells: (row, column) of each position.
    """

    x_m: Array
    y_m: Array
    center_m: XY
    angle_rad: float
    cells: tuple[tuple[int, int], ...] = ()

    def position_m(self, row: int, column: int) -> XY:
        """Return the position of a grid point."""
        x, y = self.center_m
        along, across = float(self.x_m[column]) - x, float(self.y_m[row]) - y
        cos, sin = math.cos(self.angle_rad), math.sin(self.angle_rad)
        return x + cos * along - sin * across, y + sin * along + cos * across


def grid(positions_m: Sequence[XY]) -> PointGrid:
    """Return the rectangular grid of some positions; the grid may be rotated, and points may be missing.

    Raises:
        InvalidValue: the positions do not lie on a grid, or on too few points of a grid.
    """
    given = np.array(positions_m, dtype=np.float64).reshape(-1, 2)
    center = (given.min(axis=0) + given.max(axis=0)) / 2.0
    spacing_m, angle_rad = _nearest(given - center)
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    along = (given - center) @ np.array([[cos, -sin], [sin, cos]])
    (x_m, columns), (y_m, rows) = (_axis(along[:, axis], spacing_m) for axis in (0, 1))
    cells = tuple(zip(rows.tolist(), columns.tolist(), strict=True))
    if len(set(cells)) <= _LEAST_FILLED * len(x_m) * len(y_m) and len(set(cells)) > 1:
        raise InvalidValue(
            f"{len(set(cells))} positions are no grid: {len(x_m)} columns and {len(y_m)} rows would be needed",
            hint="read them one by one with run.spectrum(row)",
        )
    x, y = (float(value) for value in center)
    return PointGrid(x + x_m, y + y_m, (x, y), angle_rad, cells)


def _nearest(places: Array) -> tuple[float, float]:
    # spacing of neighbours, and the angle of the grid, -45° to 45°
    from scipy.spatial import cKDTree

    extent = float(np.ptp(places, axis=0).max())
    # positions within a thousandth of the extent are repeats at one point
    same = 1e-3 * extent
    distinct = places[np.unique(np.round(places / same), axis=0, return_index=True)[1]] if extent else places[:1]
    if len(distinct) < 2:
        return 0.0, 0.0
    found = cKDTree(distinct).query(distinct, k=min(5, len(distinct)))
    distances, others = np.asarray(found[0]), np.asarray(found[1])
    spacing_m = float(np.median(distances[:, 1]))
    # without diagonal neighbours, which are 1.41 spacings away
    one, rank = np.nonzero((distances > 0.0) & (distances < 1.3 * spacing_m))
    between = distinct[others[one, rank]] - distinct[one]
    angles = np.arctan2(between[:, 1], between[:, 0])
    # four times the angle: a grid turned by a quarter is the same grid
    return spacing_m, float(np.angle(np.exp(4j * angles).mean()) / 4.0)


def _axis(along_m: Array, spacing_m: float) -> tuple[Array, NDArray[np.int64]]:
    # the coordinates of evenly spaced lines, and the line of each position
    order = np.sort(along_m)
    gaps = np.diff(order)
    steps = gaps[gaps > _TOLERANCE * spacing_m]
    if not steps.size:
        return np.array([float(order.mean())]), np.zeros(len(along_m), np.int64)
    step = float(steps.min())
    # the mean step over the whole extent: a single step has the error of two positions
    count = round(float(order[-1] - order[0]) / step)
    step = float(order[-1] - order[0]) / count
    lines = np.round((along_m - order[0]) / step).astype(np.int64)
    if np.abs(along_m - order[0] - lines * step).max() > _TOLERANCE * step:
        raise InvalidValue(
            "the positions are no grid: they are not evenly spaced", hint="read them one by one with run.spectrum(row)"
        )
    return order[0] + step * np.arange(count + 1), lines


def repeats(cells: Sequence[tuple[int, int]]) -> list[int]:
    """Return the number of earlier occurrences of each cell."""
    seen: dict[tuple[int, int], int] = {}
    found = []
    for cell in cells:
        found.append(seen.get(cell, 0))
        seen[cell] = found[-1] + 1
    return found


def alike(spectra: Sequence[Spectrum], *, swept_alike: bool) -> Spectrum:
    """Return the first spectrum after a check that all spectra were measured alike.

    Raises:
        InvalidValue: there are no spectra, a position is unknown, or two differ in kind, variables, frame or, with
            `swept_alike`, in their sweep.
    """
    if not spectra:
        raise InvalidValue("there are no spectra to stack")
    first = spectra[0]
    for number, other in enumerate(spectra, 1):
        if other.position_m is None:
            raise InvalidValue(f"the position of spectrum {number} of {len(spectra)} is not known")
        if (other.kind, other.names, other.frame) != (first.kind, first.names, first.frame):
            raise InvalidValue(
                f"spectra of different kinds do not form one array: {_kind(first)} and {_kind(other)}",
                hint='choose with run.spectra.where(lambda row: row.kind == "IV")',
            )
        if swept_alike and not _same_sweep(first.values[:, 0], other.values[:, 0]):
            raise InvalidValue(
                f"spectrum {number} was swept differently: {_sweep(other)} instead of {_sweep(first)}",
                hint="choose with run.spectra.where(…), or stack(interpolate=True)",
            )
    return first


def ways(spectrum: Spectrum) -> tuple[Array, list[dict[str, Array]]]:
    """Return the swept values, and the curves by variable: a mapping for forward, then for backward if measured.

    Backward curves are in the order of the returned swept values.
    """
    swept, columns = spectrum.values[:, 0], columns_of(spectrum)
    curves = [{name: spectrum[column] for name, column in one.items()} for one in columns]
    if (half := _turning_point(swept)) is None:
        return swept, curves
    there = {name: values[:half] for name, values in curves[0].items()}
    return swept[:half], [there, {name: values[half:][::-1] for name, values in curves[0].items()}]


def columns_of(spectrum: Spectrum) -> list[dict[str, str]]:
    """Return the column of each variable: a mapping for forward, then for backward if measured in own columns.

    A single sweep that goes forth and back has one mapping, since its columns contain both directions.
    """
    names = spectrum.names[1:]
    plain = {_FORWARD.sub("", name) or name: name for name in names if not _BACKWARD.search(name)}
    back = {_BACKWARD.sub("", name): name for name in names if _BACKWARD.search(name)}
    if _turning_point(spectrum.values[:, 0]) is not None or not back.keys() <= plain.keys():
        return [{name: name for name in names}]  # a backward curve without a forward one keeps its full name
    return [plain, back] if back else [plain]


def common_sweep(sweeps: Sequence[Array]) -> Array:
    """Return evenly spaced values, ascending, within all sweeps.

    Raises:
        InvalidValue: the sweeps do not overlap.
    """
    low, high = max(float(one.min()) for one in sweeps), min(float(one.max()) for one in sweeps)
    if not low < high:
        raise InvalidValue("the sweeps have no values in common")
    return np.linspace(low, high, max(map(len, sweeps)))


def at(common: Array, swept: Array, values: Array) -> Array:
    """Return a curve at other values of the swept variable, linear between its points."""
    order = np.argsort(swept)
    return np.interp(common, swept[order], values[order])


def _turning_point(swept: Array) -> int | None:
    # half of a sweep that goes forth and back over the same values; None for a one-way sweep
    half, odd = divmod(len(swept), 2)
    if not np.isfinite(swept).all():
        return None
    extent = float(np.ptp(swept)) if half else 0.0
    if odd or half < 2 or not np.allclose(swept[:half], swept[half:][::-1], rtol=0.0, atol=1e-3 * extent):
        return None
    # the forward half must cover most of the range: a one-way sweep of equal values has no turning point
    return half if abs(swept[half] - swept[0]) > 0.5 * extent else None


def _same_sweep(one: Array, other: Array) -> bool:
    finite = one[np.isfinite(one)]  # a stopped sweep has NaN
    atol = 1e-6 * float(np.ptp(finite)) + 1e-30 if finite.size else 0.0
    return one.shape == other.shape and np.allclose(one, other, rtol=0.0, atol=atol, equal_nan=True)


def _kind(spectrum: Spectrum) -> str:
    return f"{spectrum.kind} ({', '.join(spectrum.names)})"


def _sweep(spectrum: Spectrum) -> str:
    swept = spectrum.values[:, 0]
    low, high = (f"{value:g}" for value in (swept.min(), swept.max())) if swept.size else ("?", "?")
    return f"{len(swept)} points of {spectrum.names[0]} from {low} to {high} {spectrum.units[0]}"
