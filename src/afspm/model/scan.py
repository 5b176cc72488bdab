"""Scans: their parameters, one measured channel, and all channels together."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING, Final

from afspm.basics import NoSuchItem, imports_of_extra, utc_time
from afspm.basics.entry_points import DISPLAYS, required
from afspm.basics.errors import InvalidValue
from afspm.model.caption import SettingInForce, caption, picture_settings
from afspm.model.geometry import XY, Region, RegionChange

if TYPE_CHECKING:
    import numpy as np
    import sidpy
    import xarray
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

_SHAPE: Final = "two whole numbers, e.g. shape=(128, 128)"
_MOST: Final = 2**32 - 1
"""The largest number of rows or columns on the wire."""


@dataclass(frozen=True)
class ShapeChange:
    """Rows, columns or both in a request to change a shape; None stays unchanged."""

    rows: int | None = None
    columns: int | None = None

    def onto(self, shape: tuple[int, int]) -> tuple[int, int]:
        return (
            shape[0] if self.rows is None else self.rows,
            shape[1] if self.columns is None else self.columns,
        )


@dataclass(frozen=True)
class ScanParameters:
    """Region and pixels of a scan. In a request, None stays unchanged.

    Attributes:
        region: the scanned rectangle; in a request perhaps only some of its fields.
        shape: pixels as (rows, columns), the order of numpy; in a request perhaps only one of them.
        unit: unit of the scan's values; None for the microscope's own.
    """

    region: Region | RegionChange | None = None
    shape: tuple[int, int] | ShapeChange | None = None
    unit: str | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.region, Region | RegionChange | None):
            raise InvalidValue(
                f"the region of a scan is a Region, not {self.region!r}",
                hint="e.g. Region(center_m=(0, 0), size_m=(1e-6, 1e-6))",
            )
        if self.shape is None:
            return
        if isinstance(self.shape, ShapeChange):
            ScanParameters(shape=self.shape.onto((1, 1)))
            return
        try:
            rows, columns = map(operator.index, self.shape)
        except (TypeError, ValueError) as error:
            raise InvalidValue(
                f"the shape of a scan is (rows, columns), not {self.shape!r}",
                hint=_SHAPE,
            ) from error
        if min(rows, columns) < 1:
            raise InvalidValue(f"a scan of {rows} rows and {columns} columns has no pixels", hint=_SHAPE)
        if max(rows, columns) > _MOST:
            raise InvalidValue(f"a scan of {rows} rows and {columns} columns is too large", hint=_SHAPE)
        object.__setattr__(self, "shape", (rows, columns))

    def onto(self, current: ScanParameters) -> ScanParameters:
        """Return the parameters in force after this request, if `current` were in force before.

        Raises:
            InvalidValue: a part of a region without a region before, or an invalid result.
        """
        region = current.region if self.region is None else self.region
        if isinstance(region, RegionChange):
            if not isinstance(current.region, Region):
                raise InvalidValue("a part of a region was given, and there is none to change", hint="give it whole")
            region = region.onto(current.region)
        shape = current.shape if self.shape is None else self.shape
        if isinstance(shape, ShapeChange):
            if not isinstance(current.shape, tuple):
                raise InvalidValue("pixels were given along one axis, and there are none to change", hint="give both")
            shape = shape.onto(current.shape)
        return ScanParameters(region, shape, self.unit or current.unit)


@dataclass(frozen=True, eq=False)
class Scan:
    """One channel of a scan.

    Attributes:
        region: the scanned region.
        channel: e.g. "Height Retrace".
        unit: unit of the values.
        values: [y, x], both ascending, float64; empty if only the parameters arrived.
        time_ns: end of the scan, ns since the Unix epoch; None if unknown.
        filename: the controller's own file; empty without a file.
        pixels: (rows, columns) of a scan without values; None if unknown.
        roles: what the channel measures, as the microscope's driver declares: "height", "height, retrace", "current" …
        in_force: bias, setpoint, speed … at begin and end, as far as they are known.
        simulated: whether the microscope was simulated, as the record of a run knows.
    """

    region: Region
    channel: str
    unit: str
    values: NDArray[np.float64]
    time_ns: int | None = None
    filename: str = ""
    pixels: tuple[int, int] | None = None
    roles: tuple[str, ...] = ()
    in_force: tuple[SettingInForce, ...] = ()
    simulated: bool = False

    def __post_init__(self) -> None:
        if self.values.ndim != 2:
            raise InvalidValue(f"a scan needs values as [y, x], not of shape {self.values.shape}")
        if self.pixels is None:
            return
        # raises InvalidValue for pixels that no scan can have
        ScanParameters(shape=self.pixels)
        if self.values.size and self.values.shape != self.pixels:
            raise InvalidValue(f"a scan of {self.pixels} pixels with values of shape {self.values.shape}")

    @property
    def shape(self) -> tuple[int, int]:
        """Return (rows, columns) of the values, else of `pixels`; with a zero if both are missing."""
        rows, columns = self.values.shape
        return (rows, columns) if self.values.size or self.pixels is None else self.pixels

    @property
    def parameters(self) -> ScanParameters:
        """Return the parameters of the scan, without a shape if it is unknown."""
        return ScanParameters(self.region, self.shape if all(self.shape) else None, self.unit)

    @property
    def time(self) -> datetime | None:
        """Return the end of the scan, UTC; None if unknown."""
        return None if self.time_ns is None else utc_time(self.time_ns)

    def caption(self) -> str:
        """Return the settings that were in force, "V = 100 mV, I = 20 pA, 5 nm/s"; empty if none is known."""
        return caption(self.in_force)

    @property
    def picture_settings(self) -> dict[str, float]:
        """The settings on which a picture of one place depends: bias, setpoint, speed, and gains of the run."""
        return picture_settings(self.in_force)

    def is_of(self, channel: str) -> bool:
        """Return whether a channel, given by its name or role, is this one."""
        return channel == self.channel or channel in self.roles

    @property
    def lines_missing(self) -> int:
        """Return the number of lines without any value, as in an interrupted scan; all lines without values."""
        if not self.values.size:
            return self.shape[0]
        import numpy as np

        return int(np.isnan(self.values).all(axis=1).sum())

    @property
    def is_blank(self) -> bool:
        """Return whether all values are NaN, so that nothing was measured; False without values."""
        return bool(self.values.size) and self.lines_missing == self.shape[0]

    def undistorted(self, velocity_m_s: XY, duration_s: float, *, upwards: bool | None = True) -> Scan:
        """Return the scan without the drift during its acquisition, as at the middle of that time.

        Args:
            velocity_m_s: (x, y) of the sample under the tip, e.g. from an up frame followed by a down frame
                (`afspm.plugins.drift.track.shear`); constant during the scan.
            duration_s: from the first to the last row.
            upwards: whether small y was scanned first; None, from a file without the direction, is an error.

        Returns:
            The same region and pixels; NaN where nothing was measured.

        Raises:
            InvalidValue: an argument is not finite, the direction is unknown, the duration is below zero, or the sample
                moves along the slow axis as fast as the scan.
        """
        from afspm.model.drift_removal import undistorted

        values = undistorted(self.values, self.region, velocity_m_s, duration_s, upwards=upwards)
        return replace(self, values=values)

    def levelled(
        self, order: int = 1, fit: str = "least-squares", quantile: float = 0.5, rows: str | None = None
    ) -> Scan:
        """Return the scan without the polynomial surface that fits it best.

        Args:
            order: 0 for a height, 1 for a plane, 2 and 3 for curved surfaces.
            fit: "least-squares", or a fit that is robust against particles and steps: "huber", "theil-sen", "ransac" or
                "quantile".
            quantile: for the fit "quantile": the part of the pixels below the surface.
            rows: levelling of each row before the fit: by its "median", by the median "difference" from the row below,
                robust against long features, or by a straight "line"; None: not at all.

        Raises:
            InvalidValue: there is no such fit, order, quantile or levelling of rows, or too few pixels were measured.
        """
        from afspm.model.levelling import levelled

        return replace(self, values=levelled(self.values, order, fit, quantile, rows))

    def plot(
        self,
        kind: str = "image",
        axes: Axes | None = None,
        *,
        colorbar: bool = True,
        vmin: float | None = None,
        vmax: float | None = None,
    ) -> Axes:
        """Draw the scan with matplotlib; an image or contours get a scale bar, and a colour bar with units.

        Only the first scan drawn into the axes gets these bars. A new figure has the caption below its title, and a
        scan of a simulated microscope is marked SIMULATED.

        Args:
            kind: "image", "contour" or "surface" (in three dimensions).
            axes: axes to draw into; for a surface they need `projection="3d"`. None: a new figure.
            colorbar: whether to draw the colour bar, as high as the picture. Beside other axes it needs the space that
                `plt.subplots(…, layout="constrained")` makes.
            vmin, vmax: values at the ends of the colours, in the unit of the values; None: those of the first scan in
                these axes, else the robust range of this scan, 1 to 99 %. Give both to compare scans in several axes.

        Returns:
            The axes. Their coordinates are in m, with ticks in a suitable unit: another scan, or
            `axes.plot(*spectrum.position_m, "o")`, appears at its measured position.

        Raises:
            InvalidValue: there is no such kind, nothing was measured, or `vmin` is above `vmax`.
        """
        drawn: Axes = required(DISPLAYS, "plot")(self, kind, axes, colorbar=colorbar, vmin=vmin, vmax=vmax)
        return drawn

    def to_sidpy(self) -> sidpy.Dataset:
        """Return the scan as a `sidpy.Dataset`, for programs of the pycroscopy ecosystem (needs sidpy).

        Its axes are x and y of the unrotated rectangle, in m; angle, frame, time and file are in
        `original_metadata["afspm"]`.
        """
        return required(DISPLAYS, "to_sidpy")(self)

    @staticmethod
    def from_sidpy(dataset: sidpy.Dataset) -> Scan:
        """Return a two-dimensional `sidpy.Dataset` as a scan; axes in any unit of length.

        Raises:
            InvalidValue: the data are not an image, or an axis has only one value.
            UnitError: an axis is not a length.
        """
        scan: Scan = required(DISPLAYS, "from_sidpy")(dataset)
        return scan

    def to_xarray(self) -> xarray.DataArray:
        """Return an xarray DataArray with coordinates in m (needs the extra `xarray`).

        `x` and `y` are those of the unrotated rectangle. If it is turned (`angle_rad` in the attributes), `x_m` and
        `y_m` over (y, x) are where each pixel was measured: `array.plot(x="x_m", y="y_m")`. NaN without values.
        """
        import numpy as np

        with imports_of_extra("xarray", "to_xarray"):
            import xarray

        (left, low), (width, height) = self.region.top_left_m, self.region.size_m
        ny, nx = self.shape
        array = xarray.DataArray(
            self.values if self.values.size else np.full(self.shape, np.nan),
            {
                "y": ("y", np.linspace(low, low + height, ny), {"units": "m"}),
                "x": ("x", np.linspace(left, left + width, nx), {"units": "m"}),
            },
            ("y", "x"),
            self.channel,
            {
                "units": self.unit,
                "angle_rad": self.region.angle_rad,
                "frame": self.region.frame.value,
                "time": str(self.time),
                "file": self.filename,
                "roles": ", ".join(self.roles),
                **{one.name: one.text for one in self.in_force if one.text},
            },
        )
        if not self.region.angle_rad or not array.size:
            return array
        x_m, y_m = self.region.pixels_m((ny, nx))
        return array.assign_coords(x_m=(("y", "x"), x_m, {"units": "m"}), y_m=(("y", "x"), y_m, {"units": "m"}))

    def _repr_html_(self) -> str:
        return str(required(DISPLAYS, "scan_html")(self))


class ScanSet(Mapping[str, Scan]):
    """All channels of one scan: `scans["height"]`, by role or by the maker's name, or `.first`, published first.

    Attributes:
        interruptions: time and reason of each interruption before the scan succeeded, as text, oldest first.
    """

    def __init__(self, scans: Iterable[Scan], interruptions: Iterable[str] = ()) -> None:
        self._scans = {scan.channel: scan for scan in scans}
        if not self._scans:
            raise InvalidValue("a set of scans needs one channel at least")
        self.interruptions = tuple(interruptions)

    @property
    def first(self) -> Scan:
        """Return the channel that was published first."""
        return next(iter(self._scans.values()))

    @property
    def region(self) -> Region:
        """Return the scanned region."""
        return self.first.region

    @property
    def time(self) -> datetime | None:
        """Return the end of the scan, UTC; None if unknown."""
        return self.first.time

    @property
    def time_ns(self) -> int | None:
        """Return the end of the scan, ns since the Unix epoch; None if unknown."""
        return self.first.time_ns

    def __getitem__(self, channel: str) -> Scan:
        of_role = (scan for scan in self._scans.values() if channel in scan.roles)
        if (found := self._scans.get(channel) or next(of_role, None)) is None:
            there = (
                f"{scan.channel} ({' and '.join(scan.roles)})" if scan.roles else name for name, scan in self.items()
            )
            raise NoSuchItem(f"no channel {channel!r}; there are {', '.join(there)}")
        return found

    def __iter__(self) -> Iterator[str]:
        return iter(self._scans)

    def __len__(self) -> int:
        return len(self._scans)

    def __repr__(self) -> str:
        ny, nx = self.first.shape
        width, height = (size * 1e9 for size in self.region.size_m)
        return f"<ScanSet {', '.join(self)}: {nx} x {ny} px, {width:g} x {height:g} nm, {self.time}>"

    def to_xarray(self) -> xarray.Dataset:
        """Return all channels as an xarray Dataset (needs the extra `xarray`)."""
        with imports_of_extra("xarray", "to_xarray"):
            import xarray

        return xarray.Dataset({channel: scan.to_xarray() for channel, scan in self.items()})

    def _repr_html_(self) -> str:
        return str(required(DISPLAYS, "scans_html")(self.values()))


@dataclass(frozen=True, eq=False)
class ScanLines:
    """Neighbouring rows of one channel, published while the scan is running.

    Attributes:
        region: the region of the whole scan.
        shape: (rows, columns) of the whole scan.
        channel, unit: channel and unit of the values.
        first_row: index in the whole scan of the first of these rows.
        values: [rows, columns], y and x ascending, independent of the scan direction.
        began_ns: start of the scan, ns since the Unix epoch; the same for all its lines.
        roles: as of a `Scan`.
    """

    region: Region
    shape: tuple[int, int]
    channel: str
    unit: str
    first_row: int
    values: NDArray[np.float64]
    began_ns: int | None = None
    roles: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        rows, columns = self.shape
        fits = self.values.ndim == 2 and self.values.shape[1] == columns
        if not fits or not 0 <= self.first_row <= rows - self.values.shape[0]:
            raise InvalidValue(
                f"lines of shape {self.values.shape} from row {self.first_row} on are none of a scan of {self.shape}"
            )

    def is_of(self, channel: str) -> bool:
        """Return whether a channel, given by its name or role, is this one."""
        return channel == self.channel or channel in self.roles

    def into(self, picture: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Return a picture of the whole scan with these lines in it; rows not yet scanned are NaN.

        Args:
            picture: [y, x] with the earlier lines, changed in place; None for the first lines.
        """
        import numpy as np

        picture = np.full(self.shape, np.nan) if picture is None else picture
        picture[self.first_row : self.first_row + len(self.values)] = self.values
        return picture
