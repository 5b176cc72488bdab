"""Arrays as pictures: the range of values that is shown, indices into a colour map, PNG."""

from __future__ import annotations

import io
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from afspm.drawing.palette import LEVELS, PALETTES, UNMEASURED, colour_map

Array = NDArray[np.float64]
_SAMPLED = 65_536  # values that the range is found from, of a larger picture evenly chosen ones
_OUTLIERS_PERCENT = 0.5
_FAST = 1  # of zlib: pictures are made by the dozen, and looked at once


class Contrast(Enum):
    """The values that the ends of the colour map stand for: all but the outer half percents, or all."""

    ROBUST = "robust"
    FULL = "full"


@dataclass(frozen=True, slots=True)
class ValueRange:
    """The values at the ends of the colour map."""

    low: float
    high: float


def value_range(values: Array, contrast: Contrast = Contrast.ROBUST) -> ValueRange:
    """Return the range of the finite values: 0 to 1 if there are none, a range around a single one."""
    stride = max(1, values.size // _SAMPLED)
    # a stride that shares no divisor with the width, or it would look at a few columns only
    while stride > 1 and np.gcd(stride, max(values.shape[-1], 1)) != 1:
        stride += 1
    some = values.ravel()[::stride] if contrast is Contrast.ROBUST else values.ravel()
    finite = some[np.isfinite(some)]
    if not finite.size:
        finite = values[np.isfinite(values)]
    if not finite.size:
        return ValueRange(0.0, 1.0)
    if contrast is Contrast.FULL:
        low, high = float(finite.min()), float(finite.max())
    else:
        low, high = (float(v) for v in np.percentile(finite, (_OUTLIERS_PERCENT, 100.0 - _OUTLIERS_PERCENT)))
    if not high > low:
        around = abs(low) * 1e-3 or 0.5
        low, high = low - around, high + around
    return ValueRange(low, high)


def indices(values: Array, span: ValueRange) -> NDArray[np.uint8]:
    """Return the index of each value in the colour map; UNMEASURED where it is not finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = (values - span.low) * ((LEVELS - 1) / (span.high - span.low))
        np.clip(scaled, 0.0, LEVELS - 1, out=scaled)
        scaled += 0.5
        measured = np.isfinite(values)
        if not measured.all():
            scaled[~measured] = UNMEASURED
        return scaled.astype(np.uint8)


def png(levels: NDArray[np.uint8], palette: str = PALETTES[0]) -> bytes:
    """Return indices [y, x], y ascending, as a PNG with the highest y on top; UNMEASURED is transparent."""
    from PIL import Image

    picture = Image.fromarray(np.ascontiguousarray(levels[::-1]), "L")
    picture.putpalette(_table(palette))
    written = io.BytesIO()
    opacity = b"\xff" * LEVELS + b"\0"
    picture.save(written, "PNG", compress_level=_FAST, transparency=opacity)
    return written.getvalue()


def picture(values: Array, largest_px: int = 256) -> bytes:
    """Return values [y, x], y ascending, as a PNG of at most `largest_px` a side: every second, third … is shown."""
    step = max(1, -(-max(values.shape) // largest_px))
    some = values[::step, ::step]
    return png(indices(some, value_range(some)))


@lru_cache(16)
def _table(palette: str) -> bytes:
    return colour_map(palette).tobytes() + b"\0\0\0"
