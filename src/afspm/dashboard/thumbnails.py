"""Small pictures of finished scans, for the map and the time line."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from afspm.drawing.levelling import Array, Levelling, levelled
from afspm.drawing.palette import PALETTES
from afspm.drawing.raster import indices, png, value_range
from afspm.web.frames import ChannelFrame

KEPT = 600
SIDE_PX = 128


class Thumbnails:
    """Draws, from any thread, and keeps the newest few hundred; a finished scan never changes.

    Args:
        frame: returns a finished channel by time and name; None if its values are not kept.
    """

    def __init__(self, frame: Callable[[int, str], ChannelFrame | None]) -> None:
        self._frame = frame
        self._lock = threading.Lock()
        self._kept = lru_cache(KEPT)(self._draw)

    def png(self, time_ns: int, channel: str) -> bytes | None:
        """Return the picture of a scan, levelled by a plane; None if its values are not kept."""
        with self._lock:
            try:
                return self._kept(time_ns, channel)
            except LookupError:
                return None

    def _draw(self, time_ns: int, channel: str) -> bytes:
        frame = self._frame(time_ns, channel)
        if frame is None:
            raise LookupError(time_ns)
        values = _reduced(levelled(frame.values, Levelling.PLANE))
        return png(indices(values, value_range(values)), PALETTES[0])


def _reduced(values: Array) -> Array:
    """Return [y, x] averaged to at most SIDE_PX along each side."""
    from PIL import Image

    rows, columns = (min(n, SIDE_PX) for n in values.shape)
    if (rows, columns) == values.shape:
        return values
    # PIL's floats are single: values near 1e-9 are kept, of values about a large offset the plane is gone already
    small = Image.fromarray(values.astype(np.float32), "F").resize((columns, rows), Image.Resampling.BOX)
    return np.asarray(small, dtype=np.float64)
