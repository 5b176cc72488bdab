"""Overlap of regions and ratio of resolutions, the criteria for comparing scans and for rescans.

Both after the paper, "Overarching workflow": intersection_ratio, sr_norm, f'.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from afspm.basics import InvalidValue
from afspm.components import Array
from afspm.model import XY, Frame, Region


def intersection_m(first: Region, second: Region) -> Array:
    """Return the intersection polygon of two rotated rectangles.

    One rectangle is clipped at each side of the other (Sutherland and Hodgman 1974), which is exact for convex
    polygons.

    Returns:
        Corners (n, 2), counter-clockwise; empty if at most a border is shared.

    Raises:
        InvalidValue: the regions are in different frames.
    """
    if first.frame is not second.frame:
        raise InvalidValue(f"a region in {first.frame.value} and one in {second.frame.value} coordinates can't overlap")
    # About one centre, in units of one size: far from the origin the corners would lose digits.
    origin, unit = np.array(first.center_m), max(*first.size_m, *second.size_m)
    corners: list[XY] = ((first.corners_m() - origin) / unit).tolist()
    sides: list[XY] = ((second.corners_m() - origin) / unit).tolist()
    for start, end in zip(sides, sides[1:] + sides[:1], strict=True):
        corners = _clipped(corners, start, end)
    polygon = np.array(corners)
    return polygon * unit + origin if _area(polygon) > 0.0 else np.empty((0, 2))


def intersection_area_m2(first: Region, second: Region) -> float:
    """Return the area of the intersection of two regions in m². Raises InvalidValue as `intersection_m` does."""
    polygon = intersection_m(first, second)
    return _area(polygon - polygon[0]) if len(polygon) else 0.0


def intersection_ratio(first: Region, second: Region) -> float:
    """Return the intersection area over the smaller region's area. Raises InvalidValue as `intersection_m` does."""
    smaller_m2 = min(region.size_m[0] * region.size_m[1] for region in (first, second))
    return min(intersection_area_m2(first, second) / smaller_m2, 1.0)


def intersection_center_m(first: Region, second: Region) -> Array | None:
    """Return the centroid (2,) of the intersection; None if empty. Raises InvalidValue as `intersection_m` does."""
    polygon = intersection_m(first, second)
    if not len(polygon):
        return None
    corners = polygon - polygon[0]
    after = _after(corners)
    twice = corners[:, 0] * after[:, 1] - after[:, 0] * corners[:, 1]
    center: Array = ((corners + after) * twice[:, None]).sum(axis=0) / (3.0 * twice.sum()) + polygon[0]
    return center


def overlap_center_m(reference: Region, scan: Region, displacement_m: ArrayLike) -> Array | None:
    """Return the centroid (2,) of the area of the sample in both scans, in coordinates of the reference.

    Features are displaced by `displacement_m` from the reference to the scan. None without an overlap. Raises
    InvalidValue as `intersection_m` does.
    """
    x_m, y_m = np.asarray(displacement_m, dtype=np.float64)
    center = intersection_center_m(_moved(reference, x_m, y_m), scan)
    return None if center is None else center - (x_m, y_m)


def overlap_ratio(reference: Region, scan: Region, displacement_m: ArrayLike) -> float:
    """Return the area of the sample in both scans over the area of the smaller region, 0 to 1.

    Features are displaced by `displacement_m` from the reference to the scan. Raises InvalidValue as `intersection_m`
    does.
    """
    x_m, y_m = np.asarray(displacement_m, dtype=np.float64)
    return intersection_ratio(_moved(reference, x_m, y_m), scan)


def sr_norm(first: Region, first_shape: tuple[int, int], second: Region, second_shape: tuple[int, int]) -> float:
    """Return the ratio of two spatial resolutions (pixels per length, min/max) along the axis of largest difference.

    A pair can be compared if this ratio is at least sr_norm,min (the paper's "<=" is reversed).

    Args:
        first_shape, second_shape: pixels (ny, nx).

    Returns:
        A ratio above 0; 1 for equal resolutions.
    """
    per_m = [
        np.array([nx / region.size_m[0], ny / region.size_m[1]])
        for region, (ny, nx) in ((first, first_shape), (second, second_shape))
    ]
    return float((np.minimum(*per_m) / np.maximum(*per_m)).min())


def _moved(region: Region, x_m: float, y_m: float) -> Region:
    return region.moved_to((region.center_m[0] + x_m, region.center_m[1] + y_m))


def _clipped(polygon: list[XY], start: XY, end: XY) -> list[XY]:
    # the part of a polygon left of the line from `start` to `end`
    along_x, along_y = end[0] - start[0], end[1] - start[1]
    left = [along_x * (y - start[1]) - along_y * (x - start[0]) for x, y in polygon]
    kept = []
    for k, (x, y) in enumerate(polygon):
        side, side_before, (x_before, y_before) = left[k], left[k - 1], polygon[k - 1]
        if side * side_before < 0.0:
            share = side_before / (side_before - side)
            kept.append((x_before + (x - x_before) * share, y_before + (y - y_before) * share))
        if side >= 0.0:
            kept.append((x, y))
    return kept


def _area(polygon: Array) -> float:
    if len(polygon) < 3:
        return 0.0
    (x, y), (x_after, y_after) = polygon.T, _after(polygon).T
    return max(float(x @ y_after - y @ x_after) / 2, 0.0)


def _after(corners: Array) -> Array:
    return np.concatenate([corners[1:], corners[:1]])


F_RESCAN = 0.75


def too_little_shared(asked: Region, scanned: Region, f_rescan: float = F_RESCAN) -> str:
    """Return the reason for a rescan by the paper's rule, f' = intersection_ratio(r', r) below f_rescan; else "".

    Raises:
        InvalidValue: a region is not in sample coordinates.
    """
    _in_sample(asked, scanned)
    shared = intersection_ratio(asked, scanned)
    if shared >= f_rescan:
        return ""
    return f"it shows {shared:.0%} of the requested region, less than {f_rescan:.0%}"


def too_far_off(asked: Region, scanned: Region, sd_m: float, tolerance_m: float) -> str:
    """Return the reason for a rescan if a corner may be off by more than the tolerance; else "".

    The paper's rule tolerates an offset of a quarter of the side along one axis (f_rescan = 0.75). Here the user sets
    the tolerance, and the uncertainty counts: |residual| + 2 sd > tolerance.

    Args:
        sd_m: standard deviation of the estimated position, `update.after.sd_m`.

    Raises:
        InvalidValue: a region is not in sample coordinates, or the tolerance is not above zero.
    """
    _in_sample(asked, scanned)
    if not tolerance_m > 0.0:
        raise InvalidValue(f"the tolerance must be above zero, and is {tolerance_m * 1e9:g} nm")
    off_m = float(np.linalg.norm(asked.corners_m() - scanned.corners_m(), axis=1).max())
    worst_m = off_m + 2.0 * sd_m
    if worst_m <= tolerance_m:
        return ""
    parts = f"{off_m * 1e9:.3g} nm, and twice the standard deviation of {sd_m * 1e9:.2g} nm"
    return f"it may be {worst_m * 1e9:.3g} nm off ({parts}), {tolerance_m * 1e9:.3g} nm is tolerated"


def _in_sample(*regions: Region) -> None:
    for region in regions:
        if region.frame is not Frame.SAMPLE:
            raise InvalidValue(
                f"a region in {region.frame.value} coordinates can't be compared",
                hint="map it to sample coordinates first",
            )
