"""Two finished scans compared: their difference, after the second was laid over the first."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from afspm.drawing.levelling import Array, Levelling, levelled
from afspm.drift.estimators import estimator
from afspm.drift.registration import DriftScan
from afspm.errors import InvalidValue
from afspm.formatting import typeset_position
from afspm.model import Region
from afspm.web.frames import ChannelFrame

_ALIKE = 1e-3


def difference(first: ChannelFrame, second: ChannelFrame, how: Levelling) -> tuple[ChannelFrame, str]:
    """Return second minus first as a frame at the place of the first, and in words how they were laid over each other.

    What both have in common is found by registration, where their sizes match; it has NaN where only one was measured.

    Raises:
        InvalidValue: they have not the same pixels, or other units.
    """
    if first.values.shape != second.values.shape:
        (rows, columns), (others, along) = first.values.shape, second.values.shape
        raise InvalidValue(f"{columns} × {rows} and {along} × {others} pixels can't be subtracted")
    if first.unit != second.unit:
        raise InvalidValue(f"values in {first.unit or '1'} and {second.unit or '1'} can't be subtracted")
    before, after = levelled(first.values, how), levelled(second.values, how)
    moved_m, words = _displacement(first.region, second.region, before, after)
    change = _moved(after, first.region, moved_m) - before
    if np.isfinite(change).any():
        change -= np.nanmedian(change)
    return replace(first, number=first.number ^ second.number, values=change), words


def _displacement(first: Region, second: Region, before: Array, after: Array) -> tuple[tuple[float, float], str]:
    """Return by how much the second picture lies elsewhere than the first, within the frame; and that in words."""
    unmoved = (0.0, 0.0)
    if not all(math.isclose(a, b, rel_tol=_ALIKE) for a, b in zip(first.size_m, second.size_m, strict=True)):
        return unmoved, "not registered, because the sizes differ: compared pixel by pixel"
    frame = Region((0.0, 0.0), first.size_m)
    found = estimator("correlation").register(DriftScan(before, frame, 0.0, 1.0), DriftScan(after, frame, 2.0, 3.0))
    if not found.accepted:
        return unmoved, f"not registered ({found.reason}): compared pixel by pixel"
    x, y = map(float, found.displacement_m)
    return (x, y), f"registered: the second scan was moved by {typeset_position((-x, -y))}"


def _moved(values: Array, region: Region, displacement_m: tuple[float, float]) -> Array:
    """Return values with a displacement taken back; NaN where nothing is known."""
    from scipy import ndimage

    if displacement_m == (0.0, 0.0):
        return values
    pixels_m = (side / max(n - 1, 1) for side, n in zip(region.size_m[::-1], values.shape, strict=True))
    shift = [-d / pixel for d, pixel in zip(displacement_m[::-1], pixels_m, strict=True)]
    return np.asarray(ndimage.shift(values, shift, order=1, cval=np.nan))
