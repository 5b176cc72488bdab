"""Small pictures of finished scans, for the map and the time line."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import lru_cache

from afspm.drawing.image_html import shown
from afspm.drawing.levelling import flattened
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
        """Return the picture of a scan, flattened; None if its values are not kept."""
        with self._lock:
            try:
                return self._kept(time_ns, channel)
            except LookupError:
                return None

    def _draw(self, time_ns: int, channel: str) -> bytes:
        frame = self._frame(time_ns, channel)
        if frame is None:
            raise LookupError(time_ns)
        return shown(flattened(frame.values), SIDE_PX).image
