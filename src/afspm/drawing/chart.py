"""Curves over one variable as SVG, with ticks and units; colours follow the text of the page, light or dark.

Axes are labelled "name / unit" in SVG and on the page, and times of day have ticks at round times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from afspm.basics.formatting import scale
from afspm.drawing.curves import round_ticks, thinned
from afspm.model.arrays import Array

_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 8.0, 8.0, 34.0
_MOST_POINTS = 200
Size = tuple[int, int]
FORWARD, BACKWARD = "#c2571a", "#3f7fc4"
"""Colours of forward and backward curves, distinct on white and on black."""


@dataclass(frozen=True)
class Axis:
    """A variable with its name, unit and range.

    Attributes:
        largest: the value that sets the unit's prefix where two axes share a prefix; 0: the axis's own range.
    """

    name: str
    unit: str
    low: float
    high: float
    largest: float = 0.0

    @classmethod
    def over(cls, name: str, unit: str, values: Array) -> Axis:
        finite = values[np.isfinite(values)]
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
        if not high > low:
            around = abs(low) * 0.1 or 0.5
            low, high = low - around, high + around
        return cls(name, unit, low, high)

    @property
    def scaled(self) -> tuple[float, str]:
        """Return (factor, label with unit) that give readable numbers."""
        factor, unit = scale(self.largest or max(abs(self.low), abs(self.high)), self.unit)
        return factor, f"{self.name} / {unit}" if unit else self.name

    def ticks(self, about: int = 5) -> list[tuple[float, str]]:
        """Return about `about` round ticks: (place from 0 at the low end to 1, label)."""
        factor, _ = self.scaled
        return [
            (float(self.at(np.array(tick / factor), 0.0, 1.0)), f"{tick:g}".replace("-", "−"))
            for tick in round_ticks(self.low * factor, self.high * factor, about)
        ]

    def at(self, values: Array, begin: float, end: float) -> Array:
        """Map values linearly to [begin, end]."""
        return begin + (end - begin) * (values - self.low) / (self.high - self.low)


@dataclass(frozen=True)
class Curve:
    """A curve. An `opacity` below 1 makes the line thin; an empty colour means the text colour."""

    x: Array
    y: Array
    colour: str = FORWARD
    opacity: float = 1.0


@dataclass(frozen=True)
class Band:
    """An area between two curves, drawn behind all curves."""

    x: Array
    low: Array
    high: Array


def chart(x: Axis, y: Axis, curves: Sequence[Curve], band: Band | None = None, size: Size = (320, 210)) -> str:
    """Return an SVG of curves in a frame."""
    width, height = size
    drawn = [] if band is None else [_band(x, y, band, size)]
    drawn += [_line(x, y, curve, size) for curve in curves]
    return (
        f'<svg class="chart" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        f'style="max-width:100%;height:auto;color:inherit;font:10.5px system-ui,sans-serif">'
        f"{_frame(x, y, size)}{''.join(drawn)}</svg>"
    )


def _line(x: Axis, y: Axis, curve: Curve, size: Size) -> str:
    is_thin = curve.opacity < 1.0
    look = f' stroke-width="0.7" opacity="{curve.opacity:.2g}"' if is_thin else ' stroke-width="1.6"'
    points = _places(x, y, *thinned(curve.x, curve.y, _MOST_POINTS // 2 if is_thin else _MOST_POINTS), size)
    look += ' vector-effect="non-scaling-stroke"'
    return f'<polyline fill="none" stroke="{curve.colour or "currentColor"}"{look} points="{points}"/>'


def _band(x: Axis, y: Axis, band: Band, size: Size) -> str:
    step = max(1, len(band.x) // _MOST_POINTS)
    across, low, high = (values[::step] for values in (band.x, band.low, band.high))
    there, back = _places(x, y, across, low, size), _places(x, y, across[::-1], high[::-1], size)
    return f'<polygon fill="{FORWARD}" fill-opacity="0.22" points="{there} {back}"/>'


def _places(x: Axis, y: Axis, across: Array, up: Array, size: Size) -> str:
    known = np.isfinite(across) & np.isfinite(up)
    left = x.at(across[known], _LEFT, size[0] - _RIGHT)
    top = y.at(up[known], size[1] - _BOTTOM, _TOP)
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(left, top, strict=True))


def _frame(x: Axis, y: Axis, size: Size) -> str:
    right, bottom = size[0] - _RIGHT, size[1] - _BOTTOM
    (_, x_label), (_, y_label) = x.scaled, y.scaled
    made = [
        f'<path d="M{_LEFT},{_TOP}V{bottom}H{right}" fill="none" stroke="currentColor" opacity="0.6"/>',
        f'<text x="{(_LEFT + right) / 2:.0f}" y="{size[1] - 4}" text-anchor="middle" fill="currentColor">'
        f"{escape(x_label)}</text>",
        f'<text transform="translate(10,{(_TOP + bottom) / 2:.0f}) rotate(-90)" text-anchor="middle" '
        f'fill="currentColor">{escape(y_label)}</text>',
    ]
    for place, label in x.ticks():
        at = _LEFT + place * (right - _LEFT)
        made.append(f'<path d="M{at:.1f},{bottom}v3" stroke="currentColor" opacity="0.6"/>')
        made.append(f'<text x="{at:.1f}" y="{bottom + 14}" text-anchor="middle" fill="currentColor">{label}</text>')
    for place, label in y.ticks(4):
        at = bottom + place * (_TOP - bottom)
        made.append(f'<path d="M{_LEFT},{at:.1f}h-3" stroke="currentColor" opacity="0.6"/>')
        made.append(f'<text x="{_LEFT - 5}" y="{at + 3.5:.1f}" text-anchor="end" fill="currentColor">{label}</text>')
    return "".join(made)
