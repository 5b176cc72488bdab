"""Style of the figures: sizes, colours safe for colour-blind readers, and units on the axes."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Literal

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import FuncFormatter

from afspm.basics import Plain, scale
from afspm.components import Array, flattened
from afspm.drawing import ValueRange, draw_scale_bar, save_figure, shared_range
from afspm.plugins.drift.registration import DriftScan

WIDTH_IN = 7.2  # two columns of a journal
ORANGE, BLUE, GREEN, MAGENTA, GREY = "#EE7733", "#0077BB", "#009988", "#EE3377", "#999999"  # P. Tol's vibrant scheme
TIME_COLOURS = "viridis"  # of even lightness: distinct in grey, too
DPI = 200
LAYOUT: Literal["constrained"] | None = "constrained"
HOUR_S = 3600.0
SIMULATED = "SIMULATED"
_UNITS = ((1e-9, "pm", 1e12), (1e-6, "nm", 1e9), (np.inf, "µm", 1e6))
_STYLE: Plain = {
    "font.size": 7,
    "axes.titlesize": 7,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "legend.fontsize": 6.5,
    "legend.frameon": False,
    "lines.linewidth": 1.0,
}


def styled() -> AbstractContextManager[None]:
    """Return a context for afspm's figure style, independent of the user's."""
    return matplotlib.style.context(["default", _STYLE])


def figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure that can be drawn without a screen."""
    made = Figure(figsize=(width_in, height_in), facecolor="white", layout=LAYOUT)
    FigureCanvasAgg(made)
    return made


def save(made: Figure, path: Path) -> None:
    """Write a figure in the format of the file's suffix."""
    save_figure(made, path, DPI)


def unit_of(*lengths_m: Array | float) -> tuple[str, float]:
    """Return the most readable unit for lengths, and the factor from metres to this unit."""
    finite = [np.abs(np.asarray(a, dtype=np.float64)[np.isfinite(a)]) for a in lengths_m]
    largest = max((float(a.max()) for a in finite if a.size), default=0.0)
    return next((unit, factor) for below, unit, factor in _UNITS if largest < 2 * below)


def time_axis(ax: Axes, *, label: bool = True) -> None:
    ax.set_xlabel("time / h" if label else "")
    ax.margins(x=0.02)


def shared_span(scans: Sequence[DriftScan]) -> ValueRange:
    """Return a common range of heights for scans that are compared."""
    return shared_range(flattened(scan.values) for scan in scans)


def show_scan(ax: Axes, scan: DriftScan, span: ValueRange) -> AxesImage:
    """Show a scan in grey, levelled line by line, with a scale bar; axes in µm of its own frame (before rotation)."""
    left, low = (1e6 * edge for edge in scan.region.top_left_m)
    width, height = (1e6 * size for size in scan.region.size_m)
    level = flattened(scan.values)
    # the first and last pixels lie on the border of the region: half of each reaches over it
    half_x, half_y = (
        size / (count - 1) / 2 for size, count in zip((width, height), scan.values.shape[::-1], strict=True)
    )
    extent = (left - half_x, left + width + half_x, low - half_y, low + height + half_y)
    image = ax.imshow(
        level, cmap="gray", vmin=span.low, vmax=span.high, extent=extent, origin="lower", interpolation="nearest"
    )
    ax.set_aspect("equal")
    draw_scale_bar(ax, scan.region.size_m, (left, low), 1e6, font=6.5)
    return image


def colour_bar(ax: Axes, image: AxesImage, unit: str) -> None:
    """Draw a colour bar with quantity and unit, as high as the image; draw nothing without a unit."""
    if not unit:
        return
    factor, shown = scale(max(abs(end) for end in image.get_clim()), unit)
    label = f"height / {shown}" if unit == "m" else shown
    bar = ax.figure.colorbar(image, cax=ax.inset_axes((1.04, 0.0, 0.05, 1.0)), label=label)
    bar.formatter = FuncFormatter(lambda value, _: f"{value * factor:.6g}".replace("-", "−"))
    bar.update_ticks()


def three_digits(value: float) -> str:
    """Return a number with three significant digits, without an exponent.

    >>> [three_digits(value) for value in (-1112.3, 74.52, 0.12345)]
    ['−1110', '74.5', '0.123']
    """
    return f"{float(f'{value:.3g}'):.12g}".replace("-", "−")


def letter(ax: Axes, text: str) -> None:
    ax.set_title(text, loc="left", weight="bold", size=9)
