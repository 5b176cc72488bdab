"""Picture of a map: the values with the measured positions, and beside them the expected error."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap
from matplotlib.figure import Figure

from afspm.basics import counted, scale
from afspm.components import Array
from afspm.drawing import CATEGORICAL, PROBLEM, Contrast, draw_scale_bar, gold, value_range
from afspm.model import Region
from afspm.plugins.adaptive.mapping import MapProgress

DPI: Final = 160
_LONGER: Final = 120  # pixels along the longer side
_WIDTH_IN, _TEXT = 9.6, 9.0


def draw_map(found: MapProgress, region: Region, *, title: str = "", simulated: bool = False) -> Figure:
    """Return a figure of a map and its expected error, with the measured positions.

    Args:
        region: region that was mapped.
        simulated: whether to mark the picture as SIMULATED.
    """
    values, errors = _pictures(found, region)
    aspect = region.size_m[1] / region.size_m[0]
    height_in = 0.6 + 3.9 * aspect
    figure = Figure(figsize=(_WIDTH_IN, height_in), facecolor="white")
    FigureCanvasAgg(figure)
    unit = found.evaluation.unit
    of = found.evaluation.name.replace("_", " ")
    left = figure.add_axes((0.015, 0.04, 0.40, 1.0 - 0.55 / height_in - 0.04))
    right = figure.add_axes((0.515, 0.04, 0.40, 1.0 - 0.55 / height_in - 0.04))
    size_um = tuple(1e6 * size for size in region.size_m)
    _panel(left, values, size_um, of, unit, gold())
    _panel(right, errors, size_um, "expected error", unit, "viridis", low=0.0)
    x, y = _in_region(found.map.model.positions_m, region).T
    for axes, colour in ((left, CATEGORICAL[0]), (right, "white")):
        # whole at the border, too
        axes.plot(1e6 * x, 1e6 * y, ".", color=colour, markersize=4.0, markeredgewidth=0.0, clip_on=False)
    draw_scale_bar(left, region.size_m, (-size_um[0] / 2, -size_um[1] / 2), 1e6, font=_TEXT)
    head = ", ".join(filter(None, (title, of, counted(len(found.measured), "spectrum", "spectra"))))
    figure.text(0.015, 1.0 - 0.2 / height_in, head, size=10, va="center")
    if simulated:
        figure.text(0.985, 1.0 - 0.2 / height_in, "SIMULATED", size=10, weight="bold", color=PROBLEM, ha="right",
                    va="center")  # fmt: skip
    return figure


def _panel(
    axes: Axes,
    values: Array,
    size_um: tuple[float, ...],
    name: str,
    unit: str,
    colours: str | Colormap,
    low: float | None = None,
) -> None:
    factor, shown_unit = scale(float(np.abs(values).max()), unit)
    # all of a map: it is computed, and has no outliers to leave out
    span = value_range(values * factor, Contrast.FULL)
    width, height = size_um
    drawn = axes.imshow(
        values * factor, origin="lower", cmap=colours, vmin=span.low if low is None else low, vmax=span.high,
        extent=(-width / 2, width / 2, -height / 2, height / 2), interpolation="nearest",
    )  # fmt: skip
    axes.set_axis_off()
    bar = axes.figure.colorbar(drawn, ax=axes, fraction=0.045, pad=0.02)
    bar.set_label(f"{name} / {shown_unit}" if shown_unit else name, size=_TEXT)
    bar.ax.tick_params(labelsize=_TEXT)


def _pictures(found: MapProgress, region: Region) -> tuple[Array, Array]:
    # [y, x] over the region, along its own axes
    longer = max(region.size_m)
    columns, rows = (max(2, round(_LONGER * size / longer)) for size in region.size_m)
    x_m, y_m = region.pixels_m((rows, columns))
    places = np.stack([x_m.ravel(), y_m.ravel()], axis=1)
    model = found.map.model
    return model.predict(places).reshape(rows, columns), np.sqrt(model.variance(places)).reshape(rows, columns)


def _in_region(xy_m: Array, region: Region) -> Array:
    # positions along the axes of the region, from its middle
    cos, sin = np.cos(region.angle_rad), np.sin(region.angle_rad)
    return np.asarray((xy_m - np.asarray(region.center_m)) @ np.array([[cos, -sin], [sin, cos]]))
