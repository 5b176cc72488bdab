"""A spectrum: curves measured at one position of the probe."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING

from afspm.basics import NoSuchItem, imports_of_extra, utc_time
from afspm.basics.entry_points import DISPLAYS, required
from afspm.basics.errors import InvalidValue
from afspm.basics.plain_data import Plain
from afspm.model.geometry import XY, Frame

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
