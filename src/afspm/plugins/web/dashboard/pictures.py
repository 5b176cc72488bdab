"""Frames as pictures for the browser, each rendered once for all viewers; thumbnails for map and time line."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from afspm.components import Array, Levelling, flattened, levelled
from afspm.drawing import PALETTES, Contrast, ValueRange, indices, png, shared_range, shown_image
from afspm.plugins.web.dashboard.scan_facts import Facts
from afspm.plugins.web.frames import ChannelFrame

KEPT, THUMBNAILS_KEPT = 8, 600
SIDE_PX = 128


@dataclass(frozen=True, slots=True)
class Look:
    """Levelling, contrast and colours of a viewer's picture."""

    levelling: Levelling = Levelling.PLANE
    contrast: Contrast = Contrast.ROBUST
    palette: str = PALETTES[0]

    @classmethod
    def named(cls, levelling: str, contrast: str, palette: str) -> Look:
        """Return the look with these names; unknown names mean the default."""
        usual = cls()
        return cls(
            Levelling(levelling) if levelling in Levelling._value2member_map_ else usual.levelling,
            Contrast(contrast) if contrast in Contrast._value2member_map_ else usual.contrast,
            palette if palette in PALETTES else usual.palette,
        )


@dataclass(frozen=True, slots=True)
class RenderedFrame:
    """A frame with a viewer's levelling, contrast and colours.

    Attributes:
        values: levelled, [y, x].
        png: highest y on top.
    """

    frame: ChannelFrame
    look: Look
    values: Array
    span: ValueRange
    png: bytes

    def head(self, facts: Facts) -> str:
        """Return the data for drawing the frame with axes, and facts about the frame, as ASCII JSON in SI units."""
        frame, region = self.frame, self.frame.region
        return json.dumps(
            {
                "number": frame.number,
                "channel": frame.channel,
                "unit": frame.unit,
                "center": region.center_m,
                "size": region.size_m,
                "angle": region.angle_rad,
                "shape": frame.values.shape,
                "low": self.span.low,
                "high": self.span.high,
                "time_ns": None if frame.time_ns is None else str(frame.time_ns),
                "rows": frame.rows,
                "newest_row": frame.newest_row,
                "changed_row": frame.changed_row,
                "levelling": self.look.levelling.value,
                "palette": self.look.palette,
                "facts": facts,
            }
        )


class PictureCache:
    """A thread-safe cache of the `KEPT` last used pictures. A frame is identified by its number."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._drawn = lru_cache(KEPT)(_draw)

    def draw(self, frame: ChannelFrame, look: Look, beside: ChannelFrame | None = None) -> RenderedFrame:
        """Return the picture of a frame; with `beside` of the same unit, both frames share one range of values."""
        with self._lock:  # requests for the same picture wait for one drawing; others would share a core anyway
            return self._drawn(frame, look, beside)


def _draw(frame: ChannelFrame, look: Look, beside: ChannelFrame | None) -> RenderedFrame:
    values = levelled(frame.values, look.levelling)
    compared = [] if beside is None or beside.unit != frame.unit else [levelled(beside.values, look.levelling)]
    span = shared_range([values, *compared], look.contrast)
    return RenderedFrame(frame, look, values, span, png(indices(values, span), look.palette))


class Thumbnails:
    """A thread-safe cache of the `THUMBNAILS_KEPT` last used small pictures of finished scans, which never change.

    Args:
        frame: returns a finished channel by time and name; None if its values are not kept.
    """

    def __init__(self, frame: Callable[[int, str], ChannelFrame | None]) -> None:
        self._frame = frame
        self._lock = threading.Lock()
        self._kept = lru_cache(THUMBNAILS_KEPT)(self._draw)

    def png(self, time_ns: int, channel: str) -> bytes | None:
        """Return a small, flattened picture of a scan as PNG; None if its values are not stored."""
        with self._lock:
            try:
                return self._kept(time_ns, channel)
            except LookupError:
                return None

    def _draw(self, time_ns: int, channel: str) -> bytes:
        frame = self._frame(time_ns, channel)
        if frame is None:
            # raised, so that the cache does not keep a missing picture
            raise LookupError(time_ns)
        return shown_image(flattened(frame.values), SIDE_PX).image
