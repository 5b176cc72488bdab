"""The spectra of a grid as arrays over position, repeat, direction and swept variable, and maps of them."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from afspm.basics import imports_of_extra
from afspm.basics.errors import InvalidValue
from afspm.basics.units import convert
from afspm.model.arrays import Array
from afspm.model.caption import SettingInForce
from afspm.model.geometry import Frame, Region
from afspm.model.scan import Scan
from afspm.model.spectrum import Spectrum
from afspm.model.variables import RETRACE, VARIABLES, VariableRoles
from afspm.night.netcdf_encoding import fit_classic_netcdf
from afspm.record.spectrum_grid import DIRECTIONS, PointGrid, alike, at, columns_of, common_sweep, grid, repeats, ways

if TYPE_CHECKING:
    import xarray

DIMENSIONS: Final = ("y", "x", "repeat", "direction", "z")
Quantity = str | Callable[[Spectrum], float]
"""The name of a variable, or a function of one spectrum."""


@dataclass(frozen=True)
class SpectrumStack:
    """The spectra of one grid.

    Attributes:
        points: the grid.
        swept: the values of the swept variable, shape (z,), with its name and unit.
        directions: "forward", and "backward" if the sweep went both ways.
        curves: the curves by variable, shape (y, x, repeat, direction, z); NaN where nothing was measured.
        units: the units by variable.
        names: the measured columns of each spectrum, without the swept column.
        columns: columns of each variable, as from `columns_of`.
        times: times of measurement, shape (y, x, repeat); NaT if unknown.
        roles: of the swept variable and the columns.
        in_force: the settings that were the same for all curves.
    """

    kind: str
    frame: Frame
    points: PointGrid
    swept: Array
    swept_name: str
    swept_unit: str
    directions: tuple[str, ...]
    curves: Mapping[str, Array]
    units: Mapping[str, str]
    names: tuple[str, ...]
    columns: Sequence[Mapping[str, str]]
    times: NDArray[np.datetime64]
    roles: VariableRoles
    in_force: tuple[SettingInForce, ...] = ()

    def role_of(self, column: str) -> str:
        """Return the role of the swept variable or a column; empty without a role."""
        (role,) = self.roles.roles_of([column])
        return role

    def to_xarray(self) -> xarray.Dataset:
        """Return the arrays with their coordinates (needs the extra `xarray`).

        `x` and `y` are those of the unrotated grid; if it is turned, `x_m` and `y_m` are the positions of the points.
        """
        with imports_of_extra("xarray", "stacking spectra"):
            import xarray

        points, role = self.points, self.role_of(self.swept_name)
        stack = xarray.Dataset(
            {
                name: (DIMENSIONS, values, {"units": self.units[name], "role": self.role_of(self.columns[0][name])})
                for name, values in self.curves.items()
            },
            {
                "y": ("y", points.y_m, {"units": "m"}),
                "x": ("x", points.x_m, {"units": "m"}),
                "repeat": range(self.times.shape[2]),
                "direction": list(self.directions),
                "z": (
                    "z",
                    self.swept,
                    {"long_name": self.swept_name, "units": self.swept_unit, "role": role},
                ),
                "time": (DIMENSIONS[:3], self.times),
            },
            {
                "kind": self.kind,
                "frame": self.frame.value,
                "angle_rad": points.angle_rad,
                "center_m": points.center_m,
                **{one.name: one.text for one in self.in_force if one.text},
            },
        )
        if points.angle_rad:
            places = [points.position_m(row, column) for row, column in np.ndindex(self.times.shape[:2])]
            x_m, y_m = np.reshape(places, (*self.times.shape[:2], 2)).transpose(2, 0, 1)
            stack = stack.assign_coords(x_m=(("y", "x"), x_m, {"units": "m"}), y_m=(("y", "x"), y_m, {"units": "m"}))
        return fit_classic_netcdf(stack)


def stacked(spectra: Sequence[Spectrum], *, interpolate: bool = False) -> SpectrumStack:
    """Return the curves of a grid as arrays; see `SpectrumTable.stack`.

    Raises:
        InvalidValue: the spectra do not form a grid, or were not measured in the same way.
    """
    first = alike(spectra, swept_alike=not interpolate)
    points, repeat_of = _grid_of(spectra)
    curves = [ways(spectrum) for spectrum in spectra]
    swept = common_sweep([own for own, _ in curves]) if interpolate else curves[0][0]
    directions = DIRECTIONS[: max(len(own_ways) for _, own_ways in curves)]
    shape = (len(points.y_m), len(points.x_m), max(repeat_of) + 1, len(directions), len(swept))
    arrays = {name: np.full(shape, np.nan) for name in curves[0][1][0]}
    times = np.full(shape[:3], "NaT", "datetime64[ns]")
    for spectrum, (own, own_ways), cell, repeat in zip(spectra, curves, points.cells, repeat_of, strict=True):
        for direction, names in enumerate(own_ways):
            for name, curve in names.items():
                arrays[name][(*cell, repeat, direction)] = at(swept, own, curve) if interpolate else curve
        if spectrum.time_ns is not None:
            times[(*cell, repeat)] = np.datetime64(spectrum.time_ns, "ns")
    columns = columns_of(first)
    return SpectrumStack(
        first.kind,
        first.frame,
        points,
        swept,
        first.names[0],
        first.units[0],
        directions,
        arrays,
        {name: _unit(first, column) for name, column in columns[0].items()},
        first.names[1:],
        columns,
        times,
        first.roles,
        tuple(one for one in first.in_force if all(one in other.in_force for other in spectra)),
    )


def map_of(
    spectra: Sequence[Spectrum], quantity: Quantity, swept: float | None, unit: str, direction: str, name: str = ""
) -> Scan:
    """Return a quantity over the grid as a scan of one channel; see `SpectrumTable.map`."""
    first = alike(spectra, swept_alike=False)
    points, repeat_of = _grid_of(spectra)
    if isinstance(quantity, str):
        if swept is None:
            raise InvalidValue(f"a map of {quantity} is one at a value of {first.names[0]}", hint="give at=…")
        own_name = f"{quantity} at {swept:g} {first.units[0]}"
        number_of: Callable[[Spectrum], float] = partial(_value_at, quantity, swept, direction)
        if quantity.removesuffix(RETRACE) in VARIABLES:
            if direction not in DIRECTIONS:
                raise InvalidValue(f"nothing was measured {direction!r}", hint=f"there is {', '.join(DIRECTIONS)}")
            role = quantity if direction == DIRECTIONS[0] or quantity.endswith(RETRACE) else quantity + RETRACE
            if not first.has(role):
                known = ", ".join(filter(None, first.roles.roles_of(first.names)))
                raise InvalidValue(f"no {role!r} was measured", hint=f"there are {known} ({', '.join(first.names)})")
            own_unit = first.si_unit_of(role)
            factor = convert(1.0, own_unit, unit) if unit else 1.0
            number_of, unit = partial(_value_of_role, role, swept, factor), unit or own_unit
            own_name = f"{quantity} at {swept:g} {first.si_unit_of(first.swept_role)}"
        unit = unit or _unit(first, quantity)
    else:
        own_name, number_of = getattr(quantity, "__name__", "map").replace("<lambda>", "map"), quantity
    values = np.full((len(points.y_m), len(points.x_m), max(repeat_of) + 1), np.nan)
    for spectrum, cell, repeat in zip(spectra, points.cells, repeat_of, strict=True):
        found = np.asarray(number_of(spectrum), dtype=object)
        if found.shape != () or not isinstance(found.item(), int | float | np.number):
            raise InvalidValue(f"{own_name} returned {reprlib.repr(found.tolist())} for a spectrum, not a number")
        values[(*cell, repeat)] = found.item()
    return Scan(
        _region(points, first.frame), name or own_name, unit, mean_over_repeats(values), spectra[-1].time_ns, ""
    )


def _unit(spectrum: Spectrum, variable: str) -> str:
    return dict(zip(spectrum.names, spectrum.units, strict=True)).get(variable, "")


def _value_at(variable: str, value: float, direction: str, spectrum: Spectrum) -> float:
    # linear between the points of the sweep
    swept, curves = ways(spectrum)
    name, unit = spectrum.names[0], spectrum.units[0]
    by_direction = dict(zip(DIRECTIONS, curves, strict=False))
    if direction not in by_direction:
        raise InvalidValue(f"nothing was measured {direction!r}", hint=f"there is {', '.join(by_direction)}")
    if variable not in by_direction[direction]:
        hint = f"there are {', '.join(by_direction[direction])}"
        raise InvalidValue(f"no variable {variable!r} was measured {direction}", hint=hint)
    return _interpolated(value, swept, by_direction[direction][variable], f"{name} was swept", unit)


def _value_of_role(role: str, value: float, factor: float, spectrum: Spectrum) -> float:
    swept_role = spectrum.swept_role
    if not swept_role:
        raise InvalidValue(f"{spectrum.names[0]!r} has no known role", hint="give a function of the spectrum")
    swept, values = spectrum.of(swept_role + (RETRACE if role.endswith(RETRACE) else "")), spectrum.of(role)
    measured = np.isfinite(swept) & np.isfinite(values)
    if not measured.any():
        return float("nan")
    unit = spectrum.si_unit_of(swept_role)
    return factor * _interpolated(value, swept[measured], values[measured], f"the {swept_role} was swept", unit)


def _interpolated(value: float, swept: Array, values: Array, what: str, unit: str) -> float:
    low, high = float(swept.min()), float(swept.max())
    if not low <= value <= high:
        raise InvalidValue(f"{what} from {low:g} to {high:g} {unit}, not to {value:g} {unit}")
    return float(at(np.array([value]), swept, values)[0])


def _grid_of(spectra: Sequence[Spectrum]) -> tuple[PointGrid, list[int]]:
    points = grid([spectrum.position_m for spectrum in spectra if spectrum.position_m is not None])
    return points, repeats(points.cells)


def mean_over_repeats(values: Array) -> Array:
    """Return the mean over the third axis; NaN where nothing was measured."""
    known = np.isfinite(values)
    count = known.sum(axis=2)
    total = np.where(known, values, 0.0).sum(axis=2)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _region(points: PointGrid, frame: Frame) -> Region:
    sizes = [float(np.ptp(axis_m)) for axis_m in (points.x_m, points.y_m)]
    if min(sizes) == 0.0:
        raise InvalidValue("a map has at least two columns and two rows", hint="stack() gives the curves of a line")
    return Region(points.center_m, (sizes[0], sizes[1]), points.angle_rad, frame)
