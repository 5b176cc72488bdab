"""A scan or spectrum as a small picture for a notebook, without a plotting library."""

from __future__ import annotations

import base64
import html
import struct
import zlib
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from afspm.model.scan import Scan
    from afspm.model.spectrum import Spectrum

_LARGEST_PX = 256
# gold on dark, as height maps are usually shown: (position, red, green, blue)
_COLOURS = np.array(
    [(0.0, 18, 6, 4), (0.25, 92, 36, 8), (0.5, 172, 92, 22), (0.75, 232, 172, 72), (1.0, 255, 250, 224)]
)


def scan_html(scan: Scan) -> str:
    """Return the scan as an image with y upwards, and a line that says what it is."""
    width, height = scan.region.size_m
    x, y = scan.region.center_m
    ny, nx = scan.shape
    caption = (
        f"<b>{html.escape(scan.channel)}</b> [{html.escape(scan.unit)}] {nx} x {ny} px, "
        f"{width * 1e9:g} x {height * 1e9:g} nm at ({x * 1e9:g}, {y * 1e9:g}) nm, "
        f"{np.degrees(scan.region.angle_rad):g}°, {scan.time or 'time unknown'}"
    )
    if scan.values.size == 0:
        return f"<figure><figcaption>{caption}, no values</figcaption></figure>"
    image = base64.b64encode(png(scan.values[::-1])).decode()
    shown = max(1, round(_LARGEST_PX * min(1.0, width / height)))
    return (
        f'<figure style="display:inline-block"><img width="{shown}" style="image-rendering:pixelated" '
        f'src="data:image/png;base64,{image}"/><figcaption>{caption}</figcaption></figure>'
    )


def spectrum_html(spectrum: Spectrum) -> str:
    """Return every variable against the first one, as small SVG curves."""
    swept = spectrum.values[:, 0]
    curves = []
    for column, (name, unit) in enumerate(zip(spectrum.names[1:], spectrum.units[1:], strict=True), start=1):
        x, y = _to_unit(swept), _to_unit(spectrum.values[:, column])
        points = " ".join(f"{5 + 190 * a:.1f},{115 - 110 * b:.1f}" for a, b in zip(x, y, strict=True))
        curves.append(
            f'<figure style="display:inline-block"><svg width="200" height="120" style="background:#fff">'
            f'<polyline fill="none" stroke="#a0522d" points="{points}"/></svg>'
            f"<figcaption>{html.escape(name)} [{html.escape(unit)}] against {html.escape(spectrum.names[0])} "
            f"[{html.escape(spectrum.units[0])}]</figcaption></figure>"
        )
    return f"<div><b>{html.escape(spectrum.kind)}</b> at {spectrum.position_m} m<br/>{''.join(curves)}</div>"


def png(values: NDArray[np.float64]) -> bytes:
    """Return an array [row, column], first row on top, as a PNG: the 1st to the 99th percentile, NaN grey."""
    step = max(1, -(-max(values.shape) // _LARGEST_PX))
    values = values[::step, ::step]
    finite = np.isfinite(values)
    low, high = np.percentile(values[finite], (1, 99)) if finite.any() else (0.0, 1.0)
    scaled = np.clip((values - low) / (high - low if high > low else 1.0), 0.0, 1.0)
    levels = np.where(finite, scaled, 0.0)
    rgb = np.stack([np.interp(levels, _COLOURS[:, 0], _COLOURS[:, i]) for i in (1, 2, 3)], axis=-1).astype(np.uint8)
    rgb[~finite] = 128
    ny, nx = values.shape
    rows = np.concatenate([np.zeros((ny, 1), np.uint8), rgb.reshape(ny, nx * 3)], axis=1)
    return b"".join(
        [
            b"\x89PNG\r\n\x1a\n",
            _chunk(b"IHDR", struct.pack(">IIBBBBB", nx, ny, 8, 2, 0, 0, 0)),
            _chunk(b"IDAT", zlib.compress(rows.tobytes(), 6)),
            _chunk(b"IEND", b""),
        ]
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _to_unit(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scaled to 0 … 1; what is not finite goes to the middle."""
    finite = np.isfinite(values)
    if not finite.any():
        return np.full(values.shape, 0.5)
    low, high = values[finite].min(), values[finite].max()
    return np.where(finite, (values - low) / (high - low if high > low else 1.0), 0.5)
