"""An image of values as HTML, with a scale bar and a colour bar."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from html import escape

import numpy as np

from afspm.basics import typeset_length
from afspm.basics.formatting import quantity, scale
from afspm.drawing.palette import PALETTES, colour_map
from afspm.drawing.raster import ValueRange, indices, png, reduced, value_range, webp
from afspm.model.arrays import Array

_LABEL = "font:11px/1.2 system-ui,sans-serif;white-space:nowrap"
_PILL = "background:rgba(0,0,0,.55);padding:0 3px;border-radius:2px"


@dataclass(frozen=True)
class Shown:
    """An image of values, with their range.

    Attributes:
        image: a PNG or WebP, y upwards.
        span: the values at the ends of the colour map.
    """

    image: bytes
    span: ValueRange


def shown(
    values: Array, largest_px: int, palette: str = PALETTES[0], *, small: bool = False, span: ValueRange | None = None
) -> Shown:
    """Return values [y, x], y ascending, as an image of at most `largest_px` a side.

    Args:
        small: prefer a small file to exact colours.
        span: the values at the ends of the colour map; None: the robust range of this image.
    """
    some = reduced(values, largest_px, each_side=True)
    span = value_range(some) if span is None else span
    return Shown((webp if small else png)(indices(some, span), palette), span)


def data_url(image: bytes) -> str:
    """Return a PNG or WebP as a data URL."""
    kind = "webp" if image.startswith(b"RIFF") else "png"
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"


def image_html(image: Shown, size_m: tuple[float, float], unit: str, width: str, palette: str = PALETTES[0]) -> str:
    """Return an image with scale bar and colour bar; `width` is a CSS length, e.g. "256px"."""
    return (
        f'<div style="display:flex;gap:6px"><div style="position:relative;width:{width}">'
        f'<img alt="" style="display:block;width:100%;image-rendering:pixelated;'
        f'aspect-ratio:{size_m[0] / size_m[1]:.5g}" src="{data_url(image.image)}"/>{scale_bar(size_m)}</div>'
        f"{_colour_bar(image.span, unit, palette)}</div>"
    )


def round_length_m(length_m: float) -> float:
    """Return 1, 2 or 5 times a power of ten, at most `length_m`."""
    power = 10.0 ** math.floor(math.log10(length_m))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= length_m * (1 + 1e-9))


def scale_bar(size_m: tuple[float, float]) -> str:
    """Return a scale bar of round length as HTML, for the lower left corner of an image of this size."""
    length_m = round_length_m(size_m[0] / 3.0)
    return (
        f'<div style="position:absolute;left:4%;bottom:4%;width:{100.0 * length_m / size_m[0]:.3g}%">'
        f'<span style="{_LABEL};color:#fff;{_PILL}">{escape(typeset_length(length_m))}</span>'
        f'<div style="height:3px;margin-top:2px;background:#fff;outline:1px solid #000"></div></div>'
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
