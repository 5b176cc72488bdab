"""Frames as pictures for the browser, each made once however many look at it."""

from __future__ import annotations

import json
import math
import threading
from collections import OrderedDict
from dataclasses import dataclass

from afspm.dashboard.frames import Frame
from afspm.dashboard.levelling import Array, Levelling, levelled
from afspm.dashboard.palettes import PALETTES
from afspm.dashboard.pictures import Contrast, Span, indices, png, span_of

KEPT = 8


@dataclass(frozen=True, slots=True)
class Look:
    """How a viewer wants to see a scan."""

    levelling: Levelling = Levelling.PLANE
    contrast: Contrast = Contrast.ROBUST
    palette: str = PALETTES[0]


@dataclass(frozen=True, slots=True)
class Drawn:
    """A frame as it is seen.

    Attributes:
        values: levelled, [y, x].
        png: the picture, highest y on top.
    """

    frame: Frame
    look: Look
    values: Array
    span: Span
    png: bytes

    def head(self) -> str:
        """What has to be known to draw it with axes, as ASCII JSON. Lengths in m."""
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
                "levelling": self.look.levelling.value,
                "palette": self.look.palette,
            }
        )


class Drawer:
    """Draws, from any thread; keeps the newest few pictures."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._drawn: OrderedDict[tuple[int, Look], Drawn] = OrderedDict()

    def draw(self, frame: Frame, look: Look) -> Drawn:
        """The picture of a frame."""
        key = (frame.number, look)
        with self._lock:  # two that want the same wait for one; two that want others share a core anyway
            drawn = self._drawn.get(key)
            if drawn is None:
                drawn = self._drawn[key] = _draw(frame, look)
                while len(self._drawn) > KEPT:
                    self._drawn.popitem(last=False)
            else:
                self._drawn.move_to_end(key)
            return drawn


def _draw(frame: Frame, look: Look) -> Drawn:
    values = levelled(frame.values, look.levelling)
    span = span_of(values, look.contrast)
    return Drawn(frame, look, values, span, png(indices(values, span), look.palette))


def number_or_none(value: float) -> float | None:
    """As JSON has it, which knows no NaN."""
    return value if math.isfinite(value) else None
