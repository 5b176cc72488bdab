"""A scan drawn with matplotlib: as an image, as contour lines or as a surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, BinaryIO, Final, cast
from weakref import WeakKeyDictionary

import numpy as np

from afspm.basics import typeset_length
from afspm.basics.errors import InvalidValue
from afspm.basics.formatting import scale
from afspm.drawing.image_html import round_length_m
from afspm.drawing.palette import PALETTES, PROBLEM, colour_map
from afspm.drawing.raster import ValueRange, value_range

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    from afspm.model.scan import Scan

KINDS: Final = ("image", "contour", "surface")
_LEVELS: Final = 12


WITH_ASPECT: Final = "compressed"
"""Layout of a figure with a picture of fixed aspect: with "constrained" a first drawing cuts the labels beside it."""
_LAYOUTS: Final = 2
"""The first layout of a picture with fixed aspect may still cut labels."""
_EMBEDDED: Final = 42
"""Type of fonts in a PDF whose texts stay texts; some journals refuse matplotlib's usual type 3."""


@dataclass(frozen=True)
class _Colours:
    # the range of the first scan in some axes, and the factor of its unit
    span: ValueRange
    factor: float
    unit: str


_COLOURS: Final[WeakKeyDictionary[Axes, _Colours]] = WeakKeyDictionary()


def draw(
    scan: Scan,
    kind: str = "image",
    axes: Axes | None = None,
    *,
    colorbar: bool = True,
    vmin: float | None = None,
    vmax: float | None = None,
) -> Axes:
    """Draw a scan; see `Scan.plot`."""
    if kind not in KINDS:
        raise InvalidValue(f"a scan can't be drawn as {kind!r}", hint=f"one of {', '.join(KINDS)}")
    if not scan.values.size or not np.isfinite(scan.values).any():
        raise InvalidValue(f"the scan {scan.channel!r} has no values to draw")
    drawn_before = _COLOURS.get(axes) if axes is not None else None
    if drawn_before is not None and drawn_before.unit == scan.unit:
        span, factor = drawn_before.span, drawn_before.factor  # the colour bar of the first scan holds for all
    else:
        span, factor = value_range(scan.values), None
    low, high = span.low if vmin is None else vmin, span.high if vmax is None else vmax
    if not low <= high:
        raise InvalidValue(f"colours from {low:g} to {high:g} {scan.unit}", hint="vmin is below vmax")
    import matplotlib.pyplot as plt

    given: Any = axes
    if given is None:
        layout, projection = ("constrained", "3d") if kind == "surface" else (WITH_ASPECT, None)
        given = plt.figure(layout=layout).add_subplot(projection=projection)
        given.set_title(_title(scan), fontsize=9)
    is_first = not given.has_data()
    own, unit = scale(max(abs(low), abs(high)), scan.unit)
    factor = own if factor is None else factor
    drawn = _fill(scan, kind, given, factor, (low, high))
    if is_first:
        _COLOURS[given] = _Colours(ValueRange(low, high), factor, scan.unit)
        _explain(scan, drawn, given, f"{scan.channel} / {unit}" if unit else scan.channel, colorbar=colorbar)
    return cast("Axes", given)


def _fill(scan: Scan, kind: str, axes: Any, factor: float, ends: tuple[float, float]) -> object:
    x, y = scan.region.pixels_m(scan.shape)
    values = np.ma.masked_invalid(scan.values * factor)
    look = {"cmap": gold(), "vmin": ends[0] * factor, "vmax": ends[1] * factor}
    match kind:
        case "surface":
            return axes.plot_surface(x, y, values, **look)
        case "contour":
            return axes.contour(x, y, values, _LEVELS, **look)
        case _:
            return axes.pcolormesh(x, y, values, shading="nearest", **look)


def _explain(scan: Scan, drawn: object, axes: Any, label: str, *, colorbar: bool) -> None:
    # only for the first scan in these axes: later scans are drawn over it in the same units and frame
    factor, length_unit = scale(max(scan.region.size_m), "m")
    for axis, name in ((axes.xaxis, "x"), (axes.yaxis, "y")):
        axis.set_major_formatter(lambda place_m, _: f"{place_m * factor:.6g}".replace("-", "−"))
        axis.set_label_text(f"{name} / {length_unit}")
    if scan.simulated:
        box = {"facecolor": "white", "alpha": 0.8, "pad": 1.5, "edgecolor": "none"}
        look: Any = {"color": PROBLEM, "weight": "bold", "fontsize": 8, "ha": "right", "va": "top", "bbox": box}
        axes.annotate("SIMULATED", (0.99, 0.99), xycoords="axes fraction", **look)
    if hasattr(axes, "set_zlabel"):
        axes.set_zlabel(label)
        return
    axes.set_facecolor("0.6")  # seen at unmeasured pixels, and behind contour lines
    axes.set_aspect("equal")
    if colorbar:  # inset axes: as high as the image, which is rarely as high as its slot in the figure
        axes.figure.colorbar(drawn, cax=axes.inset_axes((1.03, 0.0, 0.05, 1.0)), label=label)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    draw_scale_bar(axes, (right - left, high - low), (left, low), 1.0)


def save_figure(figure: Figure, file: Path | BinaryIO, dpi: float, suffix: str | None = None) -> None:
    """Write a figure in the format of `suffix`, by default of the file's; `dpi`: of parts with pixels."""
    import matplotlib

    with matplotlib.rc_context({"pdf.fonttype": _EMBEDDED, "ps.fonttype": _EMBEDDED}):
        if (layout := figure.get_layout_engine()) is not None:
            for _ in range(_LAYOUTS):
                layout.execute(figure)
            figure.set_layout_engine("none")  # it is settled: savefig would lay it out once more
        figure.savefig(file, dpi=dpi, format=suffix)


def draw_scale_bar(
    axes: Axes, size_m: tuple[float, float], corner: tuple[float, float], length: float, *,
    font: float | None = None, named: bool = True,
) -> None:  # fmt: skip
    """Draw a bar of round length into the lower left corner of a picture.

    Args:
        corner: the lower left corner of the picture, in coordinates of the axes.
        length: a metre in coordinates of the axes.
        font: size of the label; None: matplotlib's.
        named: label the bar with its length.
    """
    bar_m = round_length_m(size_m[0] / 4.0)
    left, low = corner[0] + 0.05 * size_m[0] * length, corner[1] + 0.05 * size_m[1] * length
    for color, line in (("black", 6.0), ("white", 3.0)):
        axes.plot([left, left + bar_m * length], [low, low], color=color, linewidth=line, solid_capstyle="butt")
    if named:
        axes.text(
            left, low + 0.025 * size_m[1] * length, typeset_length(bar_m), color="white", va="bottom", fontsize=font,
            bbox={"facecolor": "black", "alpha": 0.5, "pad": 1.5, "edgecolor": "none"},
        )  # fmt: skip


def gold() -> ListedColormap:
    """Return the colour map of heights as a matplotlib colour map."""
    from matplotlib.colors import ListedColormap

    return ListedColormap(colour_map(PALETTES[0]) / 255.0)


def _title(scan: Scan) -> str:
    title = f"{scan.channel}, {scan.time:%Y-%m-%d %H:%M:%S} UTC" if scan.time else scan.channel
    return "\n".join(filter(None, (title, scan.caption())))
