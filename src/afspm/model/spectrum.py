"""A spectrum: curves measured at one position of the probe."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING

from afspm.basics import NoSuchItem, imports_of_extra, utc_time
from afspm.basics.entry_points import DISPLAYS, required
from afspm.basics.errors import InvalidValue
from afspm.basics.plain_data import Plain
from afspm.basics.units import convert, si_unit
from afspm.model.geometry import XY, Frame
from afspm.model.variables import FOUND_BY_NAME, HEIGHT, RETRACE, VariableRoles, turning_point

if TYPE_CHECKING:
    import numpy as np
    import xarray
    from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Several variables measured together, point by point.

    Attributes:
        position_m: (x, y) of the probe in m; None if unknown.
        kind: kind of spectroscopy, e.g. "IV" or "force".
        names: names of the variables; by convention the swept variable is first.
        units: units of the variables.
        values: shape (points, variables), float64.
        time_ns: time of measurement, ns since the Unix epoch; None if unknown.
        filename: the controller's own file; empty without a file.
        frame: coordinate system of the position.
        declared_roles: what the variables measure, as the driver says; None if it does not.

    Raises:
        InvalidValue: names, units and values do not fit together.
    """

    position_m: XY | None
    kind: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: NDArray[np.float64]
    time_ns: int | None = None
    filename: str = ""
    frame: Frame = Frame.TIP
    declared_roles: VariableRoles | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.values.shape[1] != len(self.names) or len(self.names) != len(self.units):
            raise InvalidValue(
                f"a spectrum of {len(self.names)} names, {len(self.units)} units and values of shape "
                f"{self.values.shape} does not fit together",
                hint="values have the shape (points, variables)",
            )

    @property
    def time(self) -> datetime | None:
        """Return the time of measurement, UTC; None if unknown."""
        return None if self.time_ns is None else utc_time(self.time_ns)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return the values of a variable, shape (points,).

        Raises:
            NoSuchItem: there is no such variable.
        """
        if name not in self.names:
            raise NoSuchItem(f"no variable {name!r}; there are {', '.join(self.names)}")
        return self.values[:, self.names.index(name)]

    @property
    def roles(self) -> VariableRoles:
        """Return what the variables measure: as declared, or else found by the names that makers are known to use."""
        return self.declared_roles or FOUND_BY_NAME

    def of(self, role: str) -> NDArray[np.float64]:
        """Return the values of what a variable measures, in SI, shape (points of this way,).

        Args:
            role: one of `VARIABLES`, for the way there; with ", retrace" for the way back. A height is positive away
                from the sample; the swept variable of the way back has the order of the way back's points.

        Raises:
            NoSuchItem: the curve has no such variable, or no way back.
        """
        quantity = role.removesuffix(RETRACE)
        is_back = role != quantity
        there, back = (self.roles.column(one, self.names) for one in (quantity, quantity + RETRACE))
        turn = turning_point(self.values[:, 0]) if back is None else None
        # the swept variable has one column: the points of the way back, measured at the same time, have its values
        is_swept = there is not None and there == self.names[0]
        name = (back or (there if is_swept or turn is not None else None)) if is_back else there
        if name is None or (is_back and is_swept and turn is None and not self._has_way_back):
            known = [one for one in self.roles.roles_of(self.names) if one]
            ways = [one + RETRACE for one in known if turn is not None]
            raise NoSuchItem(
                f"the curve has no {role!r}", hint=f"it has {', '.join([*known, *ways])} ({', '.join(self.names)})"
            )
        values = self[name]
        if turn is not None:
            values = values[turn:] if is_back else values[:turn]
        unit = self.units[self.names.index(name)]
        values = convert(values, unit, si_unit(unit))
        return -values if quantity == HEIGHT and name in self.roles.towards else values

    def si_unit_of(self, role: str) -> str:
        """Return the SI unit of a variable by its role, for the way there or back; empty if the curve has none."""
        quantity = role.removesuffix(RETRACE)
        found = (self.roles.column(one, self.names) for one in (role, quantity))
        name = next((one for one in found if one is not None), None)
        return "" if name is None else si_unit(self.units[self.names.index(name)])

    def has(self, role: str) -> bool:
        """Return whether the curve has a variable that measures this."""
        try:
            self.of(role)
        except NoSuchItem:
            return False
        return True

    @property
    def _has_way_back(self) -> bool:
        return any(one.endswith(RETRACE) for one in self.roles.roles_of(self.names))

    def to_xarray(self) -> xarray.Dataset:
        """Return an xarray Dataset over the first variable (needs the extra `xarray`)."""
        with imports_of_extra("xarray", "to_xarray"):
            import xarray

        swept, *rest = self.names
        columns: Plain = {
            name: (swept, self[name], {"units": unit}) for name, unit in zip(rest, self.units[1:], strict=True)
        }
        attributes: dict[str, object] = {
            "kind": self.kind,
            "frame": self.frame.value,
            "time": str(self.time),
            "file": self.filename,
        }
        if self.position_m is not None:  # NetCDF has no None
            attributes["position_m"] = self.position_m
        return xarray.Dataset(columns, {swept: (swept, self[swept], {"units": self.units[0]})}, attributes)

    def _repr_html_(self) -> str:
        return str(required(DISPLAYS, "spectrum_html")(self))
