"""Scans and spectra as HTML for a notebook, without a plotting library."""

from __future__ import annotations

import base64
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from afspm.drawing import curves, raster

if TYPE_CHECKING:
    from afspm.model.scan import Scan
    from afspm.model.spectrum import Spectrum

_LARGEST_PX = 256


def scan_html(scan: Scan) -> str:
    """Return the scan as an image with y upwards, and a line that says what it is."""
    width, height = scan.region.size_m
    x, y = scan.region.center_m
    ny, nx = scan.shape
    caption = (
        f"<b>{escape(scan.channel)}</b> [{escape(scan.unit)}] {nx} x {ny} px, "
        f"{width * 1e9:g} x {height * 1e9:g} nm at ({x * 1e9:g}, {y * 1e9:g}) nm, "
        f"{np.degrees(scan.region.angle_rad):g}°, {scan.time or 'time unknown'}"
    )
    if scan.values.size == 0:
        return f"<figure><figcaption>{caption}, no values</figcaption></figure>"
    image = base64.b64encode(raster.picture(scan.values, _LARGEST_PX)).decode()
    shown = max(1, round(_LARGEST_PX * min(1.0, width / height)))
    return (
        f'<figure style="display:inline-block"><img width="{shown}" style="image-rendering:pixelated" '
        f'src="data:image/png;base64,{image}"/><figcaption>{caption}</figcaption></figure>'
    )


def spectrum_html(spectrum: Spectrum) -> str:
    """Return every variable against the first one, as small SVG curves."""
    others = zip(spectrum.names[1:], spectrum.units[1:], spectrum.values.T[1:], strict=True)
    drawn = "".join(
        f'<figure style="display:inline-block">{curves.sparkline(spectrum.values[:, 0], values)}'
        f"<figcaption>{escape(name)} [{escape(unit)}] against {escape(spectrum.names[0])} "
        f"[{escape(spectrum.units[0])}]</figcaption></figure>"
        for name, unit, values in others
    )
    return f"<div><b>{escape(spectrum.kind)}</b> at {spectrum.position_m} m<br/>{drawn}</div>"
