"""Preparation of scans for registration: rows flattened, on a common pixel grid; useless scans refused."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.components import SD_PER_MAD, Array, robust_spread
from afspm.plugins.drift.pairs.drift_scan import DriftScan

Mask = NDArray[np.bool_]

LEAST_ROWS = 0.08  # least share of measured rows in a scan: a stopped scan with a tenth of its rows has features
LEAST_OF_ROW = 0.3  # least share of measured pixels in such a row
LEAST_TOPOGRAPHY = 0.1  # correlation of neighbouring rows; noise and streaks have none
MOST_SATURATED = 0.6  # largest share of pixels at exactly the lowest or the highest value


class Unusable(Exception):
    """Error: a scan, or the overlap of two scans, can't be registered, for the reason in its text."""


@dataclass(frozen=True, eq=False)
class Image:
    """An image prepared for registration.

    Attributes:
        values: [y, x], finite everywhere: unmeasured pixels are filled from the nearest measured pixel.
        known: [y, x], true for measured pixels of rows with at least `LEAST_OF_ROW` of them, and for a single missing
            row between measured rows.
        made_up: [y, x], true for values interpolated from neighbouring rows, which carry no information about a
            displacement; None: nowhere.
    """

    values: Array
    known: Mask
    made_up: Mask | None = None


def prepare(values: Array) -> Image:
    """Return an image with flattened rows, clipped outliers, mended scars, and a standard deviation of 1.

    Raises:
        Unusable: fewer than `LEAST_ROWS` are measured, or the values are constant, saturated, only an offset and a
            tilt in each row, or without topography (a crashed tip).
    """
    known = np.isfinite(values)
    known &= ~_unfinished(np.where(known, values, 0.0))[:, None]
    rows = known.mean(axis=1) >= LEAST_OF_ROW
    known &= rows[:, None]
    if rows.mean() < LEAST_ROWS:
        raise Unusable(f"only {rows.sum()} of {rows.size} rows hold values")
    measured = values[known]
    lowest, highest = measured.min(), measured.max()
    if highest - lowest <= 1e-12 * max(abs(lowest), abs(highest)):
        raise Unusable("all values of the scan are equal")
    if max(np.mean(measured == lowest), np.mean(measured == highest)) > MOST_SATURATED:
        raise Unusable("most pixels have the same value (saturated): check whether the tip crashed")
    scaled = (_filled(values, known) - lowest) / (highest - lowest)
    flat, known = _without_gaps(flatten_rows(scaled, known), known)
    low, high = np.percentile(flat[known], (0.1, 99.9))
    flat = without_scars(np.clip(flat, low - 0.25 * (high - low), high + 0.25 * (high - low)))
    spread = flat[known].std()
    if spread < 1e-9:
        raise Unusable("the rows hold nothing but an offset and a tilt")
    flat /= spread
    if _topography(flat, rows) < LEAST_TOPOGRAPHY:
        raise Unusable("no row resembles its neighbours (only noise or streaks): check whether the tip crashed")
    return Image(flat, known)


def flatten_rows(values: Array, known: Mask) -> Array:
    """Subtract a straight line from each row, fitted by two rounds of weighted least squares that suppress outliers."""
    flat = _less_lines(values, known.astype(np.float64))
    for _ in range(2):
        scale = SD_PER_MAD * np.median(np.abs(flat[known]), overwrite_input=True)
        flat = _less_lines(values, known / (1.0 + (flat / max(2.0 * scale, 1e-12)) ** 2))
    return flat


def _less_lines(values: Array, weight: Array) -> Array:
    x = np.linspace(-1.0, 1.0, values.shape[1])
    powers = np.stack([np.ones_like(x), x, x * x], axis=1)
    w, wx, wxx = (weight @ powers).T
    b, bx = ((weight * values) @ powers[:, :2]).T
    determinant = w * wxx - wx * wx
    determinant = np.where(determinant > 1e-12, determinant, np.inf)
    offset, slope = (wxx * b - wx * bx) / determinant, (w * bx - wx * b) / determinant
    flat: Array = values - (offset[:, None] + slope[:, None] * x)
    return flat


SCAR_PX = 15
SCAR_ROWS = 2
SCAR_SD = 2.5  # least height or depth relative to both neighbouring rows, in standard deviations of a pixel


def without_scars(values: Array) -> Array:
    """Replace scars by interpolation between the rows above and below.

    A scar is up to `SCAR_ROWS` rows thick. In each of its rows, most of `SCAR_PX` pixels are above both neighbouring
    rows, or below both. No feature of a surface is as thin and as long.
    """
    level = levelled(values)
    scar = np.zeros(values.shape, dtype=bool)
    for thick in range(1, min(SCAR_ROWS, len(values) - 2) + 1):
        up, down, apart = standing_out(level, thick)
        least = SCAR_SD * spread_of(apart)
        scar |= scarred(up > least, down > least, thick)
    return mended_rows(values, level, scar)


def levelled(values: Array) -> Array:
    """Subtract the offsets of the rows, which are estimated from the median steps between rows."""
    steps = np.median(np.diff(values, axis=0), axis=1)
    level: Array = values - np.concatenate([[0.0], np.cumsum(steps)])[:, None]
    return level


def standing_out(level: Array, thick: int) -> tuple[Array, Array, Array]:
    """Return the height of `thick` rows above their neighbouring rows, their depth below, and the mean difference.

    The first is the least height above both neighbouring rows, the second the least depth below both, the third the
    middle row minus the mean of both neighbours. Each is an image without the first row and the last `thick` rows.
    """
    count = len(level) - thick - 1
    above, below = level[:count], level[thick + 1 :]
    inside = [level[1 + k : 1 + k + count] for k in range(thick)]
    up = np.minimum.reduce(inside) - np.maximum(above, below)
    down = np.minimum(above, below) - np.maximum.reduce(inside)
    return up, down, inside[thick // 2] - (above + below) / 2


def spread_of(values: Array) -> float:
    """Return a robust standard deviation, from the median absolute deviation of at most twice `COUNTED` values."""
    values = values.ravel()[:: max(1, values.size // COUNTED)]
    return robust_spread(values)


COUNTED = 1 << 16
"""Medians of more values take a tenth of a registration of 1024 x 1024 pixels; this many give the spread within 1 %."""


def scarred(up: Mask, down: Mask, thick: int) -> Mask:
    """Return the mask of scars `thick` rows thick, from the pixels that stand out up or down."""
    there: Mask = np.zeros_like(up)
    for which in (up, down):
        some = rows_with_scars(which)
        there[some] |= _mostly(which[some])
    scar = np.zeros((there.shape[0] + thick + 1, there.shape[1]), dtype=bool)
    for k in range(thick):
        scar[1 + k : 1 + k + len(there)] |= there
    return scar


def rows_with_scars(which: Mask) -> Mask:
    """Return the rows with enough of these pixels for a scar; most rows of most scans have too few."""
    return np.asarray(which.sum(axis=1) > SCAR_PX / 2)


def mended_rows(values: Array, level: Array, scar: Mask) -> Array:
    """Replace scars by linear interpolation between the neighbouring rows.

    Args:
        level: the image without the offsets of its rows.
    """
    from scipy.ndimage import binary_dilation

    if not scar.any():
        return values
    scar = binary_dilation(scar, np.ones((1, 9), dtype=bool))
    rows, columns = np.arange(len(values))[:, None], np.arange(values.shape[1])
    before = np.maximum.accumulate(np.where(scar, 0, rows), axis=0)
    after = np.minimum.accumulate(np.where(scar, len(values) - 1, rows)[::-1], axis=0)[::-1]
    above, below = before[:-2], after[2:]
    share = (rows[1:-1] - above) / (below - above)
    beside = values.copy()
    beside[1:-1] = (1.0 - share) * level[above, columns] + share * level[below, columns]
    for row in np.flatnonzero(scar.any(axis=1) & ~scar.all(axis=1)):
        beside[row] += np.median((values[row] - beside[row])[~scar[row]])
    return np.where(scar, beside, values)


def _mostly(which: Mask) -> Mask:
    from scipy.ndimage import uniform_filter1d

    share: Array = uniform_filter1d(which.astype(np.float64), SCAR_PX, axis=1, mode="constant")
    return share > 0.5


def _unfinished(values: Array) -> Mask:
    # rows at the start or the end with one value throughout: the scan was stopped before them
    same = (values == values[:, :1]).all(axis=1)
    first = np.logical_and.accumulate(same & (values[:, 0] == values[0, 0]))
    last = np.logical_and.accumulate((same & (values[:, 0] == values[-1, 0]))[::-1])[::-1]
    unfinished: Mask = first | last
    return unfinished


def _filled(values: Array, known: Mask) -> Array:
    if known.all():
        return np.array(values, dtype=np.float64)
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(~known, sampling=(1.0, 2.0), return_distances=False, return_indices=True)
    filled: Array = values[tuple(nearest)]
    return filled


def _without_gaps(values: Array, known: Mask) -> tuple[Array, Mask]:
    # a single missing row becomes the mean of its neighbours: otherwise filters and splines, which reach across, lose
    # the rows beside it as well
    missing: Mask = ~np.any(known, axis=1)
    alone = 1 + np.flatnonzero(missing[1:-1] & ~missing[:-2] & ~missing[2:])
    if not alone.size:
        return values, known
    values, known = values.copy(), known.copy()
    values[alone] = (values[alone - 1] + values[alone + 1]) / 2
    known[alone] = known[alone - 1] & known[alone + 1]
    return values, known


def _topography(values: Array, rows: Mask) -> float:
    # largest correlation of rows up to four apart
    measured = values[rows] - values[rows].mean(axis=1, keepdims=True)
    power = float(np.mean(measured**2))
    return max(abs(float(np.mean(measured[lag:] * measured[:-lag]))) / power for lag in (1, 2, 3, 4))


@dataclass(frozen=True, eq=False)
class CommonGrid:
    """Pixel grid common to two scans, with its conversions.

    Pixel coordinates (x, y) start at the centre of each scan and follow the axes of the reference.

    Attributes:
        to_m: (2, 2) matrix from pixels to metres in tip coordinates.
        to_own: (2, 2) matrix from pixels of the grid to pixels of the scan, along the scan's own axes.
        reference_m, scan_m: (2,) the centres in tip coordinates.
    """

    to_m: Array
    to_own: Array
    reference_m: Array
    scan_m: Array

    def shift_px(self, displacement_m: Array) -> Array:
        """Convert a displacement in tip coordinates to a shift between pixel coordinates."""
        shift: Array = np.linalg.inv(self.to_m) @ (displacement_m - (self.scan_m - self.reference_m))
        return shift

    def displacement_m(self, shift_px: Array) -> Array:
        """Convert a shift between pixel coordinates to a displacement in tip coordinates."""
        displacement: Array = self.to_m @ shift_px + (self.scan_m - self.reference_m)
        return displacement

    def position_m(self, position_px: Array) -> Array:
        """Convert a pixel of the reference to tip coordinates."""
        position: Array = self.to_m @ position_px + self.reference_m
        return position

    def halved(self, reference_px: Array, scan_px: Array) -> CommonGrid:
        """Return the grid with pixels twice as large, and the centres moved back by these pixels."""
        moved = (self.reference_m - self.to_m @ reference_px, self.scan_m - self.to_m @ scan_px)
        return CommonGrid(2.0 * self.to_m, 2.0 * self.to_own, *moved)

    def linear_m(self, linear_px: Array) -> Array:
        """Convert a linear map of pixel coordinates to tip coordinates."""
        linear: Array = self.to_m @ linear_px @ np.linalg.inv(self.to_m)
        return linear


def onto_common_grid(
    reference: DriftScan, image1: Image, scan: DriftScan, image2: Image
) -> tuple[CommonGrid, Image, Image]:
    """Resample both images onto the axes of the reference and the coarser pixel of the two.

    An image already on this grid is not resampled: interpolation costs accuracy.
    """
    angle = reference.region.angle_rad
    turn = scan.region.angle_rad - angle
    cos, sin = math.cos(turn), math.sin(turn)
    own = np.array(reference.pixel_m)
    turned = np.array([[cos, -sin], [sin, cos]]) * scan.pixel_m  # the steps of the scan's columns and rows
    pixel: Array = np.maximum(own, np.hypot(*turned.T))
    image1 = _resampled(image1, np.diag(pixel / own))
    to_own = np.linalg.inv(turned) * pixel
    image2 = _resampled(image2, to_own)
    c, s = math.cos(angle), math.sin(angle)
    to_m = np.array([[c, -s], [s, c]]) @ np.diag(pixel)
    return CommonGrid(to_m, to_own, np.array(reference.region.center_m), np.array(scan.region.center_m)), image1, image2


def _resampled(image: Image, step: Array) -> Image:
    # On the grid whose pixel (x, y) is `step` @ (x, y) old pixels, both counted from the centre. Details finer than the
    # new pixel are smoothed away first, to the width that a pixel of the new size would have had (a Gaussian of half a
    # pixel).
    if np.abs(step - np.eye(2)).max() < 1e-6:
        return image
    from scipy.ndimage import gaussian_filter, map_coordinates

    ny, nx = image.values.shape
    sigma = 0.5 * np.sqrt(np.maximum(np.linalg.norm(step, axis=1) ** 2 - 1.0, 0.0))
    smooth = gaussian_filter(image.values, sigma[::-1], mode="nearest")
    half = np.abs(np.linalg.inv(step)) @ np.array([nx - 1, ny - 1]) / 2
    width, height = np.floor(2.0 * half + 1e-6).astype(int) + 1
    y, x = np.mgrid[:height, :width].astype(np.float64)
    u, v = np.tensordot(step, np.stack([x - (width - 1) / 2, y - (height - 1) / 2]), 1)
    known = (np.abs(u) <= (nx - 1) / 2 + 1e-6) & (np.abs(v) <= (ny - 1) / 2 + 1e-6)
    at = np.stack([v + (ny - 1) / 2, u + (nx - 1) / 2])
    if not image.known.all():
        known &= map_coordinates(image.known.astype(np.float64), at, order=1, mode="nearest") > 0.999
    return Image(map_coordinates(smooth, at, order=3, mode="nearest"), known)
