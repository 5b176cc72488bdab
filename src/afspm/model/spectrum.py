"""A spectrum: curves measured at one position of the probe."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from typing import TYPE_CHECKING

from afspm.basics import NoSuchItem, imports_of_extra, utc_time
from afspm.basics.entry_points import DISPLAYS, required
from afspm.basics.errors import InvalidValue
from afspm.basics.plain_data import Plain
from afspm.basics.units import in_si
from afspm.model.caption import SENSITIVITY, SPRING_CONSTANT, SettingInForce, bias_of, caption
from afspm.model.geometry import XY, Frame
from afspm.model.variables import (
    BIAS,
    DEFLECTION,
    FORCE,
    FOUND_BY_NAME,
    HEIGHT,
    RETRACE,
    VariableRoles,
    turning_point,
)

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
        in_force: bias, setpoint, lock-in, calibrations … at begin and end, as far as they are known.

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
    in_force: tuple[SettingInForce, ...] = field(default=(), repr=False)

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

    def caption(self) -> str:
        """Return the settings that were in force, "V = 100 mV, I = 20 pA"; empty if none is known."""
        return caption(self.in_force)

    @property
    def roles(self) -> VariableRoles:
        """Return what the variables measure: as declared, or else found by the names that makers are known to use."""
        return self.declared_roles or FOUND_BY_NAME

    def label(self, name: str) -> str:
        """Return a variable's name for a person, with its role where that differs: "Defl (deflection)"."""
        (role,) = self.roles.roles_of([name])
        if role.removesuffix(RETRACE) == BIAS and (of := bias_of(self.in_force)):
            role = f"{of} {role}"
        return f"{name} ({role})" if role and role.casefold() != name.casefold() else name

    def of(self, role: str) -> NDArray[np.float64]:
        """Return the values of what a variable measures, in SI, shape (points of this way,).

        Args:
            role: one of `VARIABLES`, for the way there; with ", retrace" for the way back. A height is positive away
                from the sample; the swept variable of the way back has the order of the way back's points. A force that
                was not recorded is the deflection times the spring constant, where the measurement knows both.

        Raises:
            NoSuchItem: the curve has no such variable, no way back, or its ways are not clear.
        """
        quantity = role.removesuffix(RETRACE)
        is_back = role != quantity
        if quantity == FORCE and not self._has_column(FORCE):
            return self._force(role.replace(FORCE, DEFLECTION))
        there, back = (self.roles.column(one, self.names) for one in (quantity, quantity + RETRACE))
        known = [one for one in self.roles.roles_of(self.names) if one]
        lacking = NoSuchItem(f"the curve has no {role!r}", hint=f"it has {', '.join(known)} ({', '.join(self.names)})")
        if there is None and back is None:
            raise lacking
        has_own_way_back = any(one.endswith(RETRACE) for one in known)
        swept, turn = self._sweep
        if has_own_way_back and turn is not None:
            what = "the sweep turns, and columns of a way back stand beside it"
            raise NoSuchItem(what, hint="take the columns by their names")
        # the swept variable has one column: the points of the way back, measured at the same time, have its values
        shares = turn is not None or (has_own_way_back and there == swept)
        name = (back or (there if shares else None)) if is_back else there
        if name is None:
            raise lacking
        values = in_si(self[name], self.units[self.names.index(name)])[0]
        if turn is not None:
            values = values[turn:] if is_back else values[:turn]
        return -values if quantity == HEIGHT and name in self.roles.towards else values

    @property
    def swept_role(self) -> str:
        """Return the role of the swept variable; empty if it has none.

        Raises:
            NoSuchItem: no variable goes one way, or there and back.
        """
        name, _ = self._sweep
        return self.roles.roles_of(self.names)[self.names.index(name)]

    @cached_property
    def _sweep(self) -> tuple[str, int | None]:
        # the swept variable, and where it turns: some makers have other columns before it
        known = [name for role in (BIAS, HEIGHT) if (name := self.roles.column(role, self.names)) is not None]
        found: dict[str, int | None] = {}
        why = "nothing is measured"
        for name in sorted(known, key=self.names.index) or self.names[:1]:
            try:
                found[name] = turning_point(self[name])
            except NoSuchItem as error:
                why = error.what
        if len({*found.values()}) != 1:
            several = f"{' and '.join(found)} turn at different points" if found else why
            raise NoSuchItem(f"the ways of the curve are not clear: {several}", hint="take the columns by their names")
        return next(iter(found.items()))

    def si_unit_of(self, role: str) -> str:
        """Return the unit in which `of` gives a variable; empty if the curve has none."""
        if role.removesuffix(RETRACE) == FORCE and not self._has_column(FORCE):
            return "N" if self.has(role) else ""
        found = (self.roles.column(one, self.names) for one in (role, role.removesuffix(RETRACE)))
        name = next((one for one in found if one is not None), None)
        return "" if name is None else in_si(1.0, self.units[self.names.index(name)])[1]

    def _has_column(self, quantity: str) -> bool:
        return any(self.roles.column(one, self.names) for one in (quantity, quantity + RETRACE))

    def _force(self, deflection: str) -> NDArray[np.float64]:
        # some makers record the deflection alone
        lacking = f"the curve has no {deflection.replace(DEFLECTION, FORCE)!r}"
        if not self._has_column(DEFLECTION):
            raise NoSuchItem(f"{lacking}, and no deflection", hint=f"it has {', '.join(self.names)}")
        unit = self.si_unit_of(deflection)
        constants = {SPRING_CONSTANT: "N/m"} | ({} if unit == "m" else {SENSITIVITY: "m/V"})
        if unit not in ("m", "V"):
            raise NoSuchItem(f"{lacking}, and its deflection is in {unit or 'no unit'}")
        factor = 1.0
        for name, its_unit in constants.items():
            known = next((one.constant for one in self.in_force if one.name == name and one.unit == its_unit), None)
            if known is None:
                what = f"{lacking}, and its {name} in {its_unit} is not known"
                raise NoSuchItem(what, hint="calibrate the cantilever at the controller")
            factor *= known
        return factor * self.of(deflection)

    def has(self, role: str) -> bool:
        """Return whether the curve has a variable that measures this."""
        try:
            self.of(role)
        except NoSuchItem:
            return False
        return True

    def to_xarray(self) -> xarray.Dataset:
        """Return an xarray Dataset over the first variable (needs the extra `xarray`)."""
        with imports_of_extra("xarray", "to_xarray"):
            import xarray

        swept, *rest = self.names
        role, *roles = self.roles.roles_of(self.names)
        columns: Plain = {
            name: (swept, self[name], {"units": unit, "role": its})
            for name, unit, its in zip(rest, self.units[1:], roles, strict=True)
        }
        attributes: dict[str, object] = {
            "kind": self.kind,
            "frame": self.frame.value,
            "time": str(self.time),
            "file": self.filename,
            **{one.name: one.text for one in self.in_force if one.text},
        }
        if self.position_m is not None:  # NetCDF has no None
            attributes["position_m"] = self.position_m
        return xarray.Dataset(
            columns, {swept: (swept, self[swept], {"units": self.units[0], "role": role})}, attributes
        )

    def _repr_html_(self) -> str:
        return str(required(DISPLAYS, "spectrum_html")(self))
