"""One drawing kit for notebooks, the report, figures and the dashboard.

The kit knows arrays, times and text, but no scan. Pillow writes PNG with one byte per pixel and a colour map;
unmeasured pixels are transparent. matplotlib takes a second to load and draws no page, so it draws only figures.
Charts of the dashboard are SVG from ECharts, whose colours are variables of the style sheet (light and dark). Scans are
not drawn by ECharts: they need the published values under the pointer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.drawing.plotting import draw_scale_bar, save_figure
    from afspm.drawing.raster import Contrast, ValueRange, indices, png, shared_range, value_range

if TYPE_CHECKING:  # figures of plug-ins look like those of the report
    from afspm.drawing.image_html import round_length_m
    from afspm.drawing.palette import CATEGORICAL, PROBLEM
    from afspm.drawing.plotting import gold
    from afspm.drawing.raster import reduced

if TYPE_CHECKING:  # the page draws with the kit of the report
    from afspm.drawing.chart import Axis, Curve
    from afspm.drawing.curves import profile, thinned
    from afspm.drawing.image_html import shown as shown_image
    from afspm.drawing.palette import DIVERGING, LEVELS, PALETTES
    from afspm.drawing.timeline import CSS as TIMELINE_CSS
    from afspm.drawing.timeline import TimelineRow, timeline_html, tint_class

__all__ = [
    "CATEGORICAL",
    "DIVERGING",
    "LEVELS",
    "PALETTES",
    "PROBLEM",
    "TIMELINE_CSS",
    "Axis",
    "Contrast",
    "Curve",
    "TimelineRow",
    "ValueRange",
    "draw_scale_bar",
    "gold",
    "indices",
    "png",
    "profile",
    "reduced",
    "round_length_m",
    "save_figure",
    "shared_range",
    "shown_image",
    "thinned",
    "timeline_html",
    "tint_class",
    "value_range",
]

if not TYPE_CHECKING:
    __getattr__ = lazily(
        __name__,
        {
            "afspm.drawing.chart": "Axis Curve",
            "afspm.drawing.curves": "profile thinned",
            "afspm.drawing.image_html": "round_length_m",
            "afspm.drawing.palette": "CATEGORICAL PROBLEM DIVERGING LEVELS PALETTES",
            "afspm.drawing.plotting": "draw_scale_bar save_figure gold",
            "afspm.drawing.raster": "Contrast ValueRange indices png shared_range value_range reduced",
            "afspm.drawing.timeline": "TimelineRow timeline_html tint_class",
        },
        TIMELINE_CSS="afspm.drawing.timeline.CSS",
        shown_image="afspm.drawing.image_html.shown",
    )
