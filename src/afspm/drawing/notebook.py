"""Scans and spectra as HTML for a notebook, without a plotting library."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from afspm.basics import typeset_area
from afspm.basics.formatting import day_and_time, typeset_position
from afspm.drawing import image_html
from afspm.drawing.chart import Axis, Curve, chart

if TYPE_CHECKING:
    from afspm.model.scan import Scan
    from afspm.model.spectrum import Spectrum

_LARGEST_PX = 256


def scan_html(scan: Scan) -> str:
    """Return the scan as an image with y upwards, scale bar, colour bar and a caption."""
    region, (rows, columns) = scan.region, scan.shape
    angle = f", turned by {np.degrees(region.angle_rad):.4g}°" if region.angle_rad else ""
    caption = (
        f"<b>{escape(scan.channel)}</b> [{escape(scan.unit)}] {columns} × {rows} px, {typeset_area(region.size_m)} "
        f"at {typeset_position(region.center_m)}{angle}<br/>{_time_text(scan.time_ns)}"
    )
    if scan.values.size == 0:
        return f"<figure>{_caption(f'{caption}, no values')}</figure>"
    shown = image_html.shown(scan.values, _LARGEST_PX)
    width = max(40, round(_LARGEST_PX * min(1.0, region.size_m[0] / region.size_m[1])))
    image = image_html.image_html(shown, region.size_m, scan.unit, f"{width}px")
    return f'<figure style="display:inline-block;margin:4px">{image}{_caption(caption)}</figure>'


def scans_html(scans: Iterable[Scan]) -> str:
    """Return channels side by side; the row wraps."""
    return f'<div style="display:flex;flex-wrap:wrap;gap:12px">{"".join(map(scan_html, scans))}</div>'


def _caption(text: str) -> str:
    return f'<figcaption style="max-width:320px">{text}</figcaption>'


def _time_text(time_ns: int | None) -> str:
    return "time unknown" if time_ns is None else day_and_time(time_ns, UTC)


def spectrum_html(spectrum: Spectrum) -> str:
    """Return small charts of every variable over the first, side by side."""
    swept = spectrum.values[:, 0]
    x = Axis.over(spectrum.names[0], spectrum.units[0], swept)
    drawn = "".join(
        chart(x, Axis.over(name, unit, values), [Curve(swept, values)])
        for name, unit, values in zip(spectrum.names[1:], spectrum.units[1:], spectrum.values.T[1:], strict=True)
    )
    place = "" if spectrum.position_m is None else f" at {typeset_position(spectrum.position_m)}"
    head = f"<b>{escape(spectrum.kind)}</b>{place}, {_time_text(spectrum.time_ns)}"
    return f'<div>{head}<div style="display:flex;flex-wrap:wrap">{drawn}</div></div>'
