"""Arrays as images: the shown range of values, indices into a colour map, PNG.

One convention for report, night, survey and page, since two scans side by side once had colours that meant different
heights. Lines are levelled by `model.line_levelling`; the colour map ends at the 1st and 99th percentile. Compared
images share one range. Scans of one size and unit share the range of all their values together (`pooled_range`), which
one bad scan does not widen. Scans of another size are not compared: a flat zoom beside a steep overview keeps its
contrast. The price: a scan that is nothing but a slope becomes a uniform image.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from afspm.drawing.palette import LEVELS, PALETTES, UNMEASURED, colour_map
from afspm.model.arrays import Array

if TYPE_CHECKING:
    from PIL import Image

_SAMPLED = 65_536  # percentiles of larger images are estimated from an even sample
_OUTLIERS_PERCENT = 1.0
_FAST = 1  # zlib's fastest level: dozens of images are made, each is viewed once
_QUALITY = 80


class Contrast(Enum):
    """The values at the ends of the colour map: the 1st and 99th percentile, or the extremes."""

    ROBUST = "robust"
    FULL = "full"


@dataclass(frozen=True, slots=True)
class ValueRange:
    """The values at the ends of the colour map."""

    low: float
    high: float


def value_range(values: Array, contrast: Contrast = Contrast.ROBUST) -> ValueRange:
    """Return the shown range of the finite values; 0 to 1 without values, a range around a single value."""
    stride = max(1, values.size // _SAMPLED)
    # the stride shares no divisor with the width; otherwise it would sample a few columns only
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


def shared_range(pictures: Iterable[Array], contrast: Contrast = Contrast.ROBUST) -> ValueRange:
    """Return one range for compared images, which contains the range of each image."""
    spans = [value_range(values, contrast) for values in pictures]
    return ValueRange(min(span.low for span in spans), max(span.high for span in spans))


def pooled_range(pictures: Iterable[Array]) -> ValueRange:
    """Return the robust range of all values of a series of images: a few odd images do not widen the range."""
    return value_range(np.concatenate([values.ravel() for values in pictures])[None, :])


def indices(values: Array, span: ValueRange) -> NDArray[np.uint8]:
    """Return the index of each value in the colour map; UNMEASURED for values that are not finite."""
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
    written = io.BytesIO()
    opacity = b"\xff" * LEVELS + b"\0"
    _image(levels, palette).save(written, "PNG", compress_level=_FAST, transparency=opacity)
    return written.getvalue()


def webp(levels: NDArray[np.uint8], palette: str = PALETTES[0]) -> bytes:
    """Return the image in a third of the bytes of `png`, with inexact colours."""
    written = io.BytesIO()
    image = _image(levels, palette)
    image.info["transparency"] = UNMEASURED
    image.convert("RGBA").save(written, "WEBP", quality=_QUALITY)
    return written.getvalue()


def reduced(values: Array, largest_px: int, *, each_side: bool = False) -> Array:
    """Return an image reduced to at most `largest_px` a side, by means over blocks of pixels; NaN is ignored.

    Incomplete blocks at the end of a side are dropped.

    Args:
        each_side: reduce each side separately, for images drawn in the proportions of their region; otherwise blocks
            are squares of pixels.
    """
    steps = [max(1, -(-count // largest_px)) for count in values.shape]
    if max(steps) == 1:
        return values
    # a block is not larger than the image: a scan of a few long lines keeps at least one row
    across, along = steps if each_side else (min(max(steps), count) for count in values.shape)
    rows, columns = values.shape[0] // across, values.shape[1] // along
    blocks = values[: rows * across, : columns * along].reshape(rows, across, columns, along)
    measured = np.isfinite(blocks)
    count = measured.sum(axis=(1, 3))
    total = np.where(measured, blocks, 0.0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _image(levels: NDArray[np.uint8], palette: str) -> Image.Image:
    from PIL import Image

    picture = Image.fromarray(np.ascontiguousarray(levels[::-1]), "L")
    picture.putpalette(_table(palette))
    return picture


@lru_cache(16)
def _table(palette: str) -> bytes:
    return colour_map(palette).tobytes() + b"\0\0\0"
