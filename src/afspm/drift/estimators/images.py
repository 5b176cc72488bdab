"""Images to register: scans with flattened rows on a common pixel grid; scans that hold nothing are refused."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.drift.registration import DriftScan

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_ROWS = 0.5  # of a scan, measured
LEAST_TOPOGRAPHY = 0.1  # correlation of neighbouring rows; noise and streaks have none
MOST_SATURATED = 0.6  # of the pixels at exactly the lowest or the highest value


class Unusable(Exception):
    """The scan can't be registered with any other; the text says why."""


@dataclass(frozen=True, eq=False)
class Image:
    """A prepared image.

    Attributes:
        values: [y, x], finite everywhere: what was not measured is filled from the nearest row.
        known: [y, x], where something was measured, or a single row is missing between two that were.
    """

    values: Array
    known: Mask


def prepare(values: Array) -> Image:
    """Flatten the rows, cut off what sticks out, mend scars, scale to a standard deviation of 1.

    Raises:
        Unusable: less than half of the rows measured, constant, saturated, or without topography (a crashed tip).
    """
    known = np.isfinite(values)
    known &= ~_unfinished(np.where(known, values, 0.0))[:, None]
    rows = known.mean(axis=1) > 0.5
    known &= rows[:, None]
    if rows.mean() < LEAST_ROWS:
        raise Unusable(f"only {rows.sum()} of {rows.size} rows hold values")
    measured = values[known]
    lowest, highest = measured.min(), measured.max()
    if highest - lowest <= 1e-12 * max(abs(lowest), abs(highest)):
        raise Unusable("all values are equal")
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
    """Minus a straight line in each row, by two rounds of weighted least squares that trust outliers less."""
    flat = _less_lines(values, known.astype(np.float64))
    for _ in range(2):
        scale = 1.4826 * np.median(np.abs(flat[known]), overwrite_input=True)
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
SCAR_SD = 2.5  # beyond the rows on both sides of it, in standard deviations of a pixel from their mean


def without_scars(values: Array) -> Array:
    """Return an image with the mean of the rows beside them in place of scars.

    A scar is where most of `SCAR_PX` pixels of a row are above both of its neighbours, or below both. Nothing on a
    surface is as thin as a row and much longer.
    """
    from scipy.ndimage import binary_dilation

    step = np.diff(values, axis=0)
    step -= np.median(step, axis=1, keepdims=True)
    up, down = step[:-1], -step[1:]
    beyond = np.where(up * down > 0.0, np.copysign(np.minimum(abs(up), abs(down)), up), 0.0)
    apart = (up + down) / 2
    least = SCAR_SD * 1.4826 * float(np.median(abs(apart - np.median(apart))))
    scar = np.zeros(values.shape, dtype=bool)
    scar[1:-1] = _mostly(beyond > least) | _mostly(beyond < -least)
    if not scar.any():
        return values
    scar = binary_dilation(scar, np.ones((1, 9), dtype=bool))
    rows, columns = np.arange(len(values))[:, None], np.arange(values.shape[1])
    before = np.maximum.accumulate(np.where(scar, 0, rows), axis=0)
    after = np.minimum.accumulate(np.where(scar, len(values) - 1, rows)[::-1], axis=0)[::-1]
    beside = values.copy()
    beside[1:-1] = (values[before[:-2], columns] + values[after[2:], columns]) / 2
    for row in np.flatnonzero(scar.any(axis=1) & ~scar.all(axis=1)):
        beside[row] += np.median((values[row] - beside[row])[~scar[row]])
    return np.where(scar, beside, values)


def _mostly(which: Mask) -> Mask:
    """Where most of the pixels of a row about this one are."""
    from scipy.ndimage import uniform_filter1d

    share: Array = uniform_filter1d(which.astype(np.float64), SCAR_PX, axis=1, mode="constant")
    return share > 0.5


def _unfinished(values: Array) -> Mask:
    """Rows at the start or the end of a scan that hold one and the same value: it was stopped before them."""
    same = (values == values[:, :1]).all(axis=1)
    first = np.logical_and.accumulate(same & (values[:, 0] == values[0, 0]))
    last = np.logical_and.accumulate((same & (values[:, 0] == values[-1, 0]))[::-1])[::-1]
    unfinished: Mask = first | last
    return unfinished


def _filled(values: Array, known: Mask) -> Array:
    """With the nearest measured value of the column in place of what is missing."""
    if known.all():
        return np.array(values, dtype=np.float64)
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(~known, sampling=(1.0, 2.0), return_distances=False, return_indices=True)
    filled: Array = values[tuple(nearest)]
    return filled


def _without_gaps(values: Array, known: Mask) -> tuple[Array, Mask]:
    """With the mean of the rows beside it in place of a row that is missing alone, and known there: where nothing is,
    the rows beside it are lost as well, since filters and splines reach across."""
    missing: Mask = ~np.any(known, axis=1)
    alone = 1 + np.flatnonzero(missing[1:-1] & ~missing[:-2] & ~missing[2:])
    if not alone.size:
        return values, known
    values, known = values.copy(), known.copy()
    values[alone] = (values[alone - 1] + values[alone + 1]) / 2
    known[alone] = known[alone - 1] & known[alone + 1]
    return values, known


def _topography(values: Array, rows: Mask) -> float:
    """Greatest correlation of rows up to four apart."""
    measured = values[rows] - values[rows].mean(axis=1, keepdims=True)
    power = float(np.mean(measured**2))
    return max(abs(float(np.mean(measured[lag:] * measured[:-lag]))) / power for lag in (1, 2, 3, 4))


@dataclass(frozen=True, eq=False)
class CommonGrid:
    """Pixel coordinates (x, y) count from the centre of each scan, along the axes of the reference.

    Attributes:
        to_m: (2, 2) from pixels to metres in tip coordinates.
        reference_m, scan_m: (2,) the centres in tip coordinates.
    """

    to_m: Array
    reference_m: Array
    scan_m: Array

    def shift_px(self, displacement_m: Array) -> Array:
        """The shift between pixel coordinates that a displacement in tip coordinates makes."""
        shift: Array = np.linalg.inv(self.to_m) @ (displacement_m - (self.scan_m - self.reference_m))
        return shift

    def displacement_m(self, shift_px: Array) -> Array:
        """The inverse of `shift_px`."""
        displacement: Array = self.to_m @ shift_px + (self.scan_m - self.reference_m)
        return displacement

    def position_m(self, position_px: Array) -> Array:
        """Tip coordinates of a pixel of the reference."""
        position: Array = self.to_m @ position_px + self.reference_m
        return position

    def linear_m(self, linear_px: Array) -> Array:
        """A linear map of pixel coordinates as one of tip coordinates."""
        linear: Array = self.to_m @ linear_px @ np.linalg.inv(self.to_m)
        return linear


def onto_common_grid(
    reference: DriftScan, image1: Image, scan: DriftScan, image2: Image
) -> tuple[CommonGrid, Image, Image]:
    """Both images with the axes of the reference and the coarser pixel of the two.

    An image that has them already is left as it is: interpolation costs accuracy.
    """
    angle = reference.region.angle_rad
    turn = scan.region.angle_rad - angle
    cos, sin = math.cos(turn), math.sin(turn)
    own = np.array(reference.pixel_m)
    turned = np.array([[cos, -sin], [sin, cos]]) * scan.pixel_m  # the steps of the scan's columns and rows
    pixel: Array = np.maximum(own, np.hypot(*turned.T))
    image1 = _resampled(image1, np.diag(pixel / own))
    image2 = _resampled(image2, np.linalg.inv(turned) * pixel)
    c, s = math.cos(angle), math.sin(angle)
    to_m = np.array([[c, -s], [s, c]]) @ np.diag(pixel)
    return CommonGrid(to_m, np.array(reference.region.center_m), np.array(scan.region.center_m)), image1, image2


def _resampled(image: Image, step: Array) -> Image:
    """On the grid whose pixel (x, y) is `step` @ (x, y) pixels of the old, both counted from the centre.

    What is finer than the new pixel is smoothed away first, to the width that a pixel of the new size would have had
    (a Gaussian of half a pixel); outside of the old image nothing is known.
    """
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
