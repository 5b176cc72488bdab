"""The one geometry of afspm: a region is centre, size and angle in SI units, in a named frame.

x grows to the right, y upwards; angles are counter-clockwise in radians. Arrays are [y, x], both ascending, and the
first and last pixel of a row or column lie on the border of the region (wire format, "Geometry").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING

from afspm.basics.errors import InvalidValue, UnitError
from afspm.basics.formatting import area_text
from afspm.basics.units import si_or_text

if TYPE_CHECKING:
    from afspm.model.arrays import Array

XY = tuple[float, float]


class Frame(Enum):
    """The coordinate system of a position."""

    TIP = "tip"
    SAMPLE = "sample"


@dataclass(frozen=True)
class RegionDifference:
    """How another region differs from one.

    Attributes:
        along, across: offset of its centre along the width and the height of the one, as shares of these.
        size: largest relative difference of width and height.
        turned_rad: its angle less the angle of the one, from -pi to pi.
    """

    along: float
    across: float
    size: float
    turned_rad: float

    @property
    def apart(self) -> float:
        """The larger offset: below 1 the regions overlap, if they are equal and not turned."""
        return max(abs(self.along), abs(self.across))


@dataclass(frozen=True)
class Region:
    """A rectangle turned about its centre.

    Attributes:
        center_m: (x, y) in m.
        size_m: (width, height) in m before the rotation; both above zero.
        angle_rad: counter-clockwise.
        frame: tip or sample coordinates.

    Each value may be given as text with a unit: `Region(("1 um", 0), ("500 nm", "500 nm"), "30 deg")`.

    Raises:
        InvalidValue: a value is not finite, or a size not above zero.
        UnitError: text without a length or angle, or without a unit.
    """

    center_m: XY
    size_m: XY
    angle_rad: float = 0.0
    frame: Frame = Frame.TIP

    def __post_init__(self) -> None:
        try:
            x, y = self.center_m
            width, height = self.size_m
            lengths_m = (si_or_text(value, "m") for value in (x, y, width, height))
            values = (*lengths_m, si_or_text(self.angle_rad, "rad"))
        except UnitError:
            raise
        except (TypeError, ValueError, OverflowError) as error:
            raise InvalidValue(
                f"a region needs (x, y) and (width, height), not centre {self.center_m!r} and size {self.size_m!r}",
                hint='numbers in metres or text, e.g. Region((0, 0), (1e-6, 1e-6)) or Region((0, 0), ("1 um", "1 um"))',
            ) from error
        if not all(map(math.isfinite, values)):
            raise InvalidValue(
                f"a region is finite, not of centre {self.center_m}, size {self.size_m} and angle {self.angle_rad}",
                hint="in metres and radians, or as text with units",
            )
        if values[2] <= 0.0 or values[3] <= 0.0:
            raise InvalidValue(f"a region of {area_text(values[2:4])} is empty", hint="both sizes are above zero")
        if not isinstance(self.frame, Frame):
            raise InvalidValue(
                f"the frame of a region is a Frame, not {self.frame!r}", hint="Frame.TIP or Frame.SAMPLE"
            )
        # the class is frozen; text was converted to numbers above
        object.__setattr__(self, "center_m", values[:2])
        object.__setattr__(self, "size_m", values[2:4])
        object.__setattr__(self, "angle_rad", values[4])

    @classmethod
    def from_top_left(cls, top_left_m: XY, size_m: XY, angle_rad: float = 0.0, frame: Frame = Frame.TIP) -> Region:
        """Return a region from the corner of smallest x and y before the rotation, called "top left" on the wire."""
        center_m = (top_left_m[0] + size_m[0] / 2, top_left_m[1] + size_m[1] / 2)
        return cls(center_m, size_m, angle_rad, frame)

    @property
    def top_left_m(self) -> XY:
        """Return (x, y) in m of the corner of smallest x and y before the rotation."""
        return (self.center_m[0] - self.size_m[0] / 2, self.center_m[1] - self.size_m[1] / 2)

    def corners_m(self) -> Array:
        """Return the four rotated corners in m, shape (4, 2), counter-clockwise.

        The first is the corner of smallest x and y before the rotation.
        """
        # imported late, as in all of model: processes without values start in half the time without numpy
        import numpy as np

        half = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * np.asarray(self.size_m)
        return np.stack(self._in_space(half[:, 0], half[:, 1]), axis=-1)

    def contains(self, xy_m: XY) -> bool:
        """Return whether a point, in the same frame, lies inside the region or on its border."""
        x, y = xy_m[0] - self.center_m[0], xy_m[1] - self.center_m[1]
        cos, sin = math.cos(self.angle_rad), math.sin(self.angle_rad)
        return bool(abs(cos * x + sin * y) <= self.size_m[0] / 2 and abs(cos * y - sin * x) <= self.size_m[1] / 2)

    def pixels_m(self, shape: tuple[int, int]) -> tuple[Array, Array]:
        """Return the arrays of x and y, in m, of every pixel of an array of `shape` (ny, nx)."""
        import numpy as np

        ny, nx = shape
        u = np.linspace(-0.5, 0.5, nx) if nx > 1 else np.zeros(1)
        v = np.linspace(-0.5, 0.5, ny) if ny > 1 else np.zeros(1)
        u_m, v_m = np.meshgrid(u * self.size_m[0], v * self.size_m[1])
        return self._in_space(u_m, v_m)

    def pixel_at(self, x_m: Array, y_m: Array, shape: tuple[int, int]) -> tuple[Array, Array]:
        """Return the fractional (row, column) of positions in an array of `shape`: the inverse of `pixels_m`."""
        x, y = x_m - self.center_m[0], y_m - self.center_m[1]
        cos, sin = math.cos(self.angle_rad), math.sin(self.angle_rad)
        along, across = (cos * x + sin * y) / self.size_m[0], (cos * y - sin * x) / self.size_m[1]
        return (across + 0.5) * (shape[0] - 1), (along + 0.5) * (shape[1] - 1)

    def compared(self, other: Region) -> RegionDifference:
        """Return how `other` differs; the frames of both are not compared."""
        x, y = other.center_m[0] - self.center_m[0], other.center_m[1] - self.center_m[1]
        cos, sin = math.cos(self.angle_rad), math.sin(self.angle_rad)
        along, across = (cos * x + sin * y) / self.size_m[0], (cos * y - sin * x) / self.size_m[1]
        size = max(abs(b / a - 1.0) for a, b in zip(self.size_m, other.size_m, strict=True))
        return RegionDifference(along, across, size, math.remainder(other.angle_rad - self.angle_rad, math.tau))

    def has_size_of(self, other: Region, tolerance: float) -> bool:
        """Return whether width and height agree with `other` within a relative tolerance."""
        return all(math.isclose(a, b, rel_tol=tolerance) for a, b in zip(self.size_m, other.size_m, strict=True))

    def moved_to(self, center_m: XY) -> Region:
        """Return a region of the same size and angle around another centre."""
        return replace(self, center_m=center_m)

    def _in_space(self, u_m: Array, v_m: Array) -> tuple[Array, Array]:
        # from offsets along the rotated sides to x and y
        cos, sin = math.cos(self.angle_rad), math.sin(self.angle_rad)
        return cos * u_m - sin * v_m + self.center_m[0], sin * u_m + cos * v_m + self.center_m[1]


@dataclass(frozen=True)
class RegionChange:
    """A request to change some fields of a region; None stays unchanged.

    Corner and size are in m and before the rotation, the angle is in rad.
    """

    left_m: float | None = None
    low_m: float | None = None
    width_m: float | None = None
    height_m: float | None = None
    angle_rad: float | None = None

    def onto(self, region: Region) -> Region:
        """Return `region` with the given fields changed.

        Raises:
            InvalidValue: the result is not a valid region.
        """
        (left, low), (width, height) = region.top_left_m, region.size_m
        return Region.from_top_left(
            (left if self.left_m is None else self.left_m, low if self.low_m is None else self.low_m),
            (width if self.width_m is None else self.width_m, height if self.height_m is None else self.height_m),
            region.angle_rad if self.angle_rad is None else self.angle_rad,
            region.frame,
        )
