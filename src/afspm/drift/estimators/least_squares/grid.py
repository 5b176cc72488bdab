"""A common pixel grid for two scans of different resolution, size and rotation, and the way back to metres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.drift.estimators.least_squares.prepare import Image
from afspm.drift.registration import DriftScan

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Grid:
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


def onto_common_grid(reference: DriftScan, image1: Image, scan: DriftScan, image2: Image) -> tuple[Grid, Image, Image]:
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
    return Grid(to_m, np.array(reference.region.center_m), np.array(scan.region.center_m)), image1, image2


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
