"""Removal of the drift during a scan from its values."""

from __future__ import annotations

import math

import numpy as np

from afspm.basics.errors import InvalidValue
from afspm.model.arrays import Array
from afspm.model.geometry import XY, Region


def undistorted(
    values: Array, region: Region, velocity_m_s: XY, duration_s: float, *, upwards: bool | None = True
) -> Array:
    """Return a scan's values without drift, on the same grid, as at the middle of the scan.

    Rows are scanned one after the other. A sample point at the offset S from the region's centre at half time was
    recorded at the offset q, with S = (1 - v a') q. Here v is the velocity, and a is the vector along the slow axis of
    length duration / height, negative when scanning down. Values between pixels are from cubic splines; NaN where
    nothing was measured. Arguments and errors as for `Scan.undistorted`.
    """
    ny, nx = values.shape
    along_m, across_m = _per_scan_m(region, velocity_m_s, duration_s, upwards=upwards)
    width_m, height_m = region.size_m
    # In pixels from the centre: S_y = (1 - along) q_y and S_x = q_x - across q_y.
    along = along_m / height_m
    across = across_m / width_m * (nx - 1) / max(ny - 1, 1)
    if along >= 1.0:
        raise InvalidValue(f"the sample moved by {along:.2g} of the scan's height while it was taken")
    y = (np.arange(ny) - (ny - 1) / 2)[:, None] / (1.0 - along)
    x = (np.arange(nx) - (nx - 1) / 2)[None, :] + across * y
    return _interpolated(values, np.broadcast_to(y + (ny - 1) / 2, values.shape), x + (nx - 1) / 2)


def _per_scan_m(region: Region, velocity_m_s: XY, duration_s: float, *, upwards: bool | None) -> XY:
    # motion of the sample during a scan along the slow and the fast axis, counted from small y to large y
    x, y = (float(v) for v in velocity_m_s)
    if not (all(map(math.isfinite, (x, y, duration_s))) and duration_s >= 0.0):
        raise InvalidValue(f"a velocity of ({x}, {y}) m/s during {duration_s} s", hint="finite, and no time below zero")
    if upwards is None:  # as a file without it is read; a wrong direction would double the distortion
        raise InvalidValue(
            "the direction of the slow axis is unknown", hint="upwards=True if small y was scanned first, else False"
        )
    cos, sin = math.cos(region.angle_rad), math.sin(region.angle_rad)
    signed_s = duration_s if upwards else -duration_s
    return (-sin * x + cos * y) * signed_s, (cos * x + sin * y) * signed_s


def _interpolated(values: Array, row: Array, column: Array) -> Array:
    # NaN outside, and wherever a neighbour is NaN; with a tolerance, so that rounding makes no border pixel NaN
    from scipy.ndimage import distance_transform_edt, map_coordinates

    ny, nx = values.shape
    known = np.isfinite(values)
    inside = (row >= -1e-6) & (row <= ny - 1 + 1e-6) & (column >= -1e-6) & (column <= nx - 1 + 1e-6)
    if not known.any():
        return np.full(values.shape, np.nan)
    if not known.all():  # splines need a number everywhere: take the nearest measured one
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        values = values[tuple(nearest)]
        inside &= map_coordinates((~known).astype(np.float64), (row, column), order=1, mode="nearest") < 1e-6
    resampled = map_coordinates(values, (row, column), order=3, mode="mirror")
    return np.where(inside, resampled, np.nan)
