"""A picture of values as HTML: the image with a scale bar in it, and a colour bar beside it."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from html import escape

import numpy as np

from afspm.drawing.palette import PALETTES, colour_map
from afspm.drawing.raster import Array, ValueRange, indices, png, value_range
from afspm.formatting import quantity, scale, typeset_length

_LABEL = "font:11px/1.2 system-ui,sans-serif;white-space:nowrap"
_SHADOW = "text-shadow:0 0 2px #000,0 0 2px #000"


@dataclass(frozen=True)
class Shown:
    """Values as a picture.

    Attributes:
        png: the picture, y upwards.
        span: the values at the ends of the colours.
        shape: (rows, columns) of the picture.
    """

    png: bytes
    span: ValueRange
    shape: tuple[int, int]


def shown(values: Array, largest_px: int, palette: str = PALETTES[0]) -> Shown:
    """Return values [y, x], y ascending, as a picture of at most `largest_px` a side: every second, third … pixel."""
    step = max(1, -(-max(values.shape) // largest_px))
    some = values[::step, ::step]
    span = value_range(some)
    return Shown(png(indices(some, span), palette), span, (some.shape[0], some.shape[1]))


def data_url(image: bytes) -> str:
    """Return a PNG as an address that needs no file."""
    return f"data:image/png;base64,{base64.b64encode(image).decode()}"


def image_html(image: Shown, size_m: tuple[float, float], unit: str, width: str, palette: str = PALETTES[0]) -> str:
    """Return a picture with scale bar and colour bar; `width` of the image as CSS has it, e.g. "256px"."""
    return (
        f'<div style="display:flex;gap:6px"><div style="position:relative;width:{width}">'
        f'<img alt="" style="display:block;width:100%;image-rendering:pixelated;'
        f'aspect-ratio:{size_m[0] / size_m[1]:.5g}" src="{data_url(image.png)}"/>{scale_bar(size_m)}</div>'
        f"{_colour_bar(image.span, unit, palette)}</div>"
    )


def round_length_m(length_m: float) -> float:
    """Return 1, 2 or 5 times a power of ten, at most `length_m`."""
    power = 10.0 ** math.floor(math.log10(length_m))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length_m * (1 + 1e-9))


def scale_bar(size_m: tuple[float, float]) -> str:
    """Return a bar of a round length, to lie over the lower left corner of a picture of this size."""
    length_m = round_length_m(size_m[0] / 3.0)
    return (
        f'<div style="position:absolute;left:4%;bottom:4%;width:{100.0 * length_m / size_m[0]:.3g}%">'
        f'<span style="{_LABEL};color:#fff;{_SHADOW}">{escape(typeset_length(length_m))}</span>'
        f'<div style="height:3px;background:#fff;outline:1px solid #000"></div></div>'
    )


def _colour_bar(span: ValueRange, unit: str, palette: str) -> str:
    colours = colour_map(palette)[np.linspace(0, 254, 9).round().astype(int)]
    stops = ",".join(f"rgb({red},{green},{blue})" for red, green, blue in colours.tolist())
    factor, prefixed = scale(max(abs(span.low), abs(span.high)), unit)
    low, high = (quantity(value * factor, "", 3) for value in (span.low, span.high))
    return (
        f'<div style="display:flex;gap:4px;{_LABEL}">'
        f'<div style="width:10px;background:linear-gradient(to top,{stops})"></div>'
        f'<div style="display:flex;flex-direction:column;justify-content:space-between"><span>{high} '
        f"{escape(prefixed)}</span><span>{low} {escape(prefixed)}</span></div></div>"
    )
