"""Alignment of two scans of one region, for their difference."""

from __future__ import annotations

import numpy as np

from afspm.basics import typeset_position
from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.estimators import estimator
from afspm.plugins.drift.registration import DriftScan

_ALIKE = 1e-3
_DIGITS = 12  # decimals of a displacement in m: less than a picometre comes from rounding


def onto_first(first: Array, region: Region, second: Array, second_region: Region) -> tuple[Array, str]:
    """Return the second scan shifted onto the features of the first, and a text about the alignment.

    Scans of equal size are registered relative to their frames, regardless of the positions and angles of the
    frames. The result is NaN where only the first scan was measured. Scans that can't be registered are not shifted.
    """
    moved_m, words = _displacement(first, region, second, second_region)
    return _moved(second, region, moved_m), words


def _displacement(first: Array, region: Region, second: Array, other: Region) -> tuple[tuple[float, float], str]:
    # within the frame of the first, with a text that explains it
    unmoved = (0.0, 0.0)
    if not region.has_size_of(other, _ALIKE):
        return unmoved, "not registered, because the sizes differ: compared pixel by pixel"
    frame = Region((0.0, 0.0), region.size_m)
    found = estimator("correlation").register(DriftScan(first, frame, 0.0, 1.0), DriftScan(second, frame, 2.0, 3.0))
    if not found.accepted:
        return unmoved, f"not registered ({found.reason}): compared pixel by pixel"
    x, y = map(float, found.displacement_m)
    moved_m = (round(-x, _DIGITS) + 0.0, round(-y, _DIGITS) + 0.0)  # adding zero removes the sign of -0
    return (x, y), f"registered: the second scan was moved by {typeset_position(moved_m)}"


def _moved(values: Array, region: Region, displacement_m: tuple[float, float]) -> Array:
    # undoes the displacement; NaN where the second scan has no values
    from scipy import ndimage

    if displacement_m == (0.0, 0.0):
        return values
    pixels_m = (side / max(n - 1, 1) for side, n in zip(region.size_m[::-1], values.shape, strict=True))
    shift = [-d / pixel for d, pixel in zip(displacement_m[::-1], pixels_m, strict=True)]
    return np.asarray(ndimage.shift(values, shift, order=1, cval=np.nan))
