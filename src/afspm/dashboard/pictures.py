"""From values to what a browser draws: PNGs of one byte a pixel, with the colour map in them."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from afspm.dashboard.levelling import Array
from afspm.dashboard.palettes import LEVELS, UNMEASURED, colours

_SAMPLED = 65_536  # values that the contrast is found from, of a larger picture evenly chosen ones
_OUTLIERS_PERCENT = 0.5
_FAST = 1  # of zlib: pictures are made by the dozen, and looked at once


class Contrast(Enum):
    """Which values the ends of the colour map stand for."""

    ROBUST = "robust"
    """All but the lowest and the highest half percent."""
    FULL = "full"
    """The lowest and the highest."""


@dataclass(frozen=True, slots=True)
class Span:
    """The values at the ends of the colour map."""

    low: float
    high: float


def span_of(values: Array, contrast: Contrast) -> Span:
    """Of the finite values; 0 to 1 where there are none, something around the value where there is only one."""
    stride = max(1, values.size // _SAMPLED)
    # a stride that shares no divisor with the width, or it would look at a few columns only
    while stride > 1 and np.gcd(stride, max(values.shape[-1], 1)) != 1:
        stride += 1
    some = values.ravel()[::stride] if contrast is Contrast.ROBUST else values.ravel()
    finite = some[np.isfinite(some)]
    if not finite.size:
        finite = values[np.isfinite(values)]
    if not finite.size:
        return Span(0.0, 1.0)
    if contrast is Contrast.FULL:
        low, high = float(finite.min()), float(finite.max())
    else:
        low, high = (float(v) for v in np.percentile(finite, (_OUTLIERS_PERCENT, 100.0 - _OUTLIERS_PERCENT)))
    if not high > low:
        around = abs(low) * 1e-3 or 0.5
        low, high = low - around, high + around
    return Span(low, high)


def indices(values: Array, span: Span) -> NDArray[np.uint8]:
    """Each value as an index into the colour map; beyond the span its ends, UNMEASURED where it is not finite."""
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = (values - span.low) * ((LEVELS - 1) / (span.high - span.low))
        np.clip(scaled, 0.0, LEVELS - 1, out=scaled)
        scaled += 0.5
        measured = np.isfinite(values)
        if not measured.all():
            scaled[~measured] = UNMEASURED
        return scaled.astype(np.uint8)


def png(levels: NDArray[np.uint8], palette: str) -> bytes:
    """Indices [y, x], y ascending, as a PNG whose first row is the highest y; UNMEASURED is transparent."""
    ny, nx = levels.shape
    rows = np.zeros((ny, nx + 1), np.uint8)  # each row begins with its filter: none
    rows[:, 1:] = levels[::-1]
    return b"".join(
        (
            b"\x89PNG\r\n\x1a\n",
            _chunk(b"IHDR", struct.pack(">IIBBBBB", nx, ny, 8, 3, 0, 0, 0)),
            *_palette_chunks(palette),
            _chunk(b"IDAT", zlib.compress(rows.data, _FAST)),
            _chunk(b"IEND", b""),
        )
    )


@lru_cache(16)
def _palette_chunks(palette: str) -> tuple[bytes, bytes]:
    table = colours(palette).tobytes() + b"\0\0\0"
    opacity = b"\xff" * LEVELS + b"\0"
    return _chunk(b"PLTE", table), _chunk(b"tRNS", opacity)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
