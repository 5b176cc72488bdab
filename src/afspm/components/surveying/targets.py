"""Targets in a scan: particles found with scikit-image, highest first, and places beside them. Pure.

A scan is levelled first: a curved surface, fitted so that particles have little weight, the offset of each line, scars.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from afspm.basics.requirements import require_installed
from afspm.model import Scan
from afspm.model.arrays import Array, robust_spread
from afspm.model.geometry import XY
from afspm.model.levelling import levelled

_SIGMAS: Final = 6.0
"""Default least height in units of the noise: no height in 128 x 128 pixels of noise is that large."""
_WIDEST: Final = 0.2
"""Default width above which features count as ground, as a share of the scan's shorter side."""
# least standard deviation of the blur
_LEAST_BLUR_PX: Final = 0.6
# shortest rise along a line that counts as a scar
_SCAR_PX: Final = 4
# every 5 degrees
_DIRECTIONS: Final = 72


@dataclass(frozen=True)
class Target:
    """A place for a zoom.

    Attributes:
        position_m: (x, y) in the coordinate frame of the scan.
        height: the height above the ground around the target, in the unit of the scan; None: unknown.
    """

    position_m: XY
    height: float | None = None


def find_particles(
    scan: Scan,
    count: int | None = None,
    *,
    min_height: float | None = None,
    separation_m: float = 0.0,
    widest_m: float | None = None,
) -> list[Target]:
    """Return the particles of a scan, highest first (needs the extra `features`).

    Particles whose top lies on the border are left out, and so are scars: disturbed stretches of single lines.

    Args:
        count: largest number of particles; None: all.
        min_height: the least height above the ground, in the unit of the scan; None: six times the noise.
        separation_m: the least distance of two particles; of a nearer pair only the higher counts.
        widest_m: wider features count as ground; None: a fifth of the scan's shorter side.

    Raises:
        ConfigError: scikit-image is not installed.
        InvalidValue: too few pixels were measured to level the scan.
    """
    pixel_m = _pixel_m(scan)
    widest_m = _WIDEST * min(scan.region.size_m) if widest_m is None else widest_m
    # a particle as wide as the scan looks like curved ground
    order = 2 if widest_m < min(scan.region.size_m) else 1
    heights = _smooth(flattened(scan, order), _blur_px(separation_m, pixel_m))
    above = _above_ground(heights, [widest_m / size for size in pixel_m])
    least = _SIGMAS * _scatter(above) if min_height is None else min_height
    found = _tops(above, scan, least)
    kept: list[Target] = []
    for target in sorted(found, key=lambda target: -(target.height or 0.0)):
        if len(kept) == count:
            break
        if all(math.dist(target.position_m, other.position_m) >= separation_m for other in kept):
            kept.append(target)
    return kept


def nearest(targets: Iterable[Target], to_m: XY, within_m: float) -> Target | None:
    """Return the target nearest to a place; None if none lies within the distance."""
    near = [target for target in targets if math.dist(target.position_m, to_m) <= within_m]
    return min(near, key=lambda target: math.dist(target.position_m, to_m), default=None)


def lowest_beside(scan: Scan, center_m: XY, distance_m: float) -> XY:
    """Return the lowest place at a distance from a centre, e.g. the bare ground beside a particle.

    Directions that leave the scan don't count; if all do, the place is in the direction of larger x.
    """
    angles = np.linspace(0.0, math.tau, _DIRECTIONS, endpoint=False)
    x_m = center_m[0] + distance_m * np.cos(angles)
    y_m = center_m[1] + distance_m * np.sin(angles)
    pixel_m = _pixel_m(scan)
    heights = _at(_smooth(flattened(scan, 1), _blur_px(distance_m, pixel_m)), scan, x_m, y_m)
    lowest = int(np.nanargmin(heights)) if np.isfinite(heights).any() else 0
    return float(x_m[lowest]), float(y_m[lowest])


def flattened(scan: Scan, order: int) -> Array:
    """Return the values less a robust polynomial surface of this order, and less the offset of each line.

    The ground is at 0; NaN where not measured.
    """
    flat = levelled(scan.values, order, "huber")
    for _ in range(3):
        flat = flat - _line_offsets(flat)[:, None]
    return np.asarray(flat - np.nanmedian(flat))


def _pixel_m(scan: Scan) -> tuple[float, float]:
    (width, height), (ny, nx) = scan.region.size_m, scan.shape
    return height / max(ny - 1, 1), width / max(nx - 1, 1)


def _blur_px(detail_m: float, pixel_m: Sequence[float]) -> list[float]:
    # leaves details of this size, and takes away the grain of a particle's top
    return [max(_LEAST_BLUR_PX, detail_m / 20.0 / size) for size in pixel_m]


def _smooth(flat: Array, blur_px: Sequence[float]) -> Array:
    # scars removed, blurred; missing values are ground
    from scipy import ndimage

    return np.asarray(ndimage.gaussian_filter(_without_scars(np.nan_to_num(flat)), blur_px))


def _above_ground(heights: Array, widest_px: Sequence[float]) -> Array:
    # the rest after everything narrow is cut off
    from scipy import ndimage

    rows, columns = (min(2 * n - 1, max(3, round(px))) for px, n in zip(widest_px, heights.shape, strict=True))
    window = (rows, columns)
    above = heights - ndimage.uniform_filter(ndimage.grey_opening(heights, window), window)
    return np.asarray(above - np.median(above))


def _scatter(values: Array) -> float:
    return robust_spread(values[~np.isnan(values)])


def _line_offsets(flat: Array) -> Array:
    # the median of each line's ground; 0 for a line without ground
    is_ground = np.abs(flat - np.nanmedian(flat)) < 2.5 * _scatter(flat)
    offsets = np.zeros(len(flat))
    for row, ground in enumerate(is_ground):  # what was not measured is never ground
        offsets[row] = np.median(flat[row, ground]) if ground.any() else 0.0
    return offsets


def _without_scars(flat: Array) -> Array:
    # long stretches that rise above the ground of both neighbours become their mean
    from scipy import ndimage

    padded = np.pad(flat, ((1, 1), (0, 0)), mode="reflect")
    below, over = padded[:-2], padded[2:]
    beside, least = np.maximum(below, over), 3.0 * _scatter(over - below)
    rises = (flat - beside > least) & (beside < 0.25 * flat)
    is_scar = ndimage.binary_opening(rises, np.ones((1, _SCAR_PX), dtype=np.bool_))
    return np.where(is_scar, (below + over) / 2.0, flat)


def _tops(above: Array, scan: Scan, least: float) -> list[Target]:
    # height, and centre of the part above half of it, up to the saddles around
    require_installed("finding particles", "afspm[features]")
    import skimage

    feature: Any = skimage.feature
    segmentation: Any = skimage.segmentation
    peaks = feature.peak_local_max(above, min_distance=1, threshold_abs=max(least, 1e-30), exclude_border=1)
    markers = np.zeros(above.shape, dtype=np.int32)
    markers[tuple(peaks.T)] = np.arange(1, len(peaks) + 1)
    numbers = segmentation.watershed(-above, markers, mask=above > 0.3 * least).ravel()
    heights = above[tuple(peaks.T)]
    weights = np.maximum(above.ravel() - 0.5 * np.concatenate([[np.inf], heights])[numbers], 0.0)
    total, x_m, y_m = (
        np.bincount(numbers, weights * axis, len(peaks) + 1)[1:]
        for axis in (np.ones(weights.shape), *(axis.ravel() for axis in scan.region.pixels_m(scan.shape)))
    )
    return [
        Target((float(x / weight), float(y / weight)), float(height))
        for x, y, weight, height in zip(x_m, y_m, total, heights, strict=True)
    ]


def _at(values: Array, scan: Scan, x_m: Array, y_m: Array) -> Array:
    # linear between pixels; NaN outside
    from scipy import ndimage

    places = scan.region.pixel_at(x_m, y_m, scan.shape)
    return np.asarray(ndimage.map_coordinates(values, places, order=1, cval=np.nan))
