"""Picture of a survey: the wide scan with its numbered targets, their zooms, and the curves under each zoom."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke

from afspm.basics import typeset_area, typeset_length
from afspm.basics.formatting import counted, scale
from afspm.components.surveying.record import Outcome, SurveyRecord, Visit
from afspm.components.surveying.targets import flattened
from afspm.drawing import CATEGORICAL, PROBLEM, gold, round_length_m
from afspm.drawing.palette import NEUTRAL
from afspm.drawing.plotting import draw_scale_bar
from afspm.drawing.raster import shared_range
from afspm.model import Scan, Spectrum
from afspm.model.arrays import Array
from afspm.model.geometry import XY

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_ZOOMS: Final = 15
DPI: Final = 200
_COLUMNS: Final = 5
_SURVEY_IN, _ZOOM_IN, _CURVE_IN = 4.6, 1.28, 0.8
_LEFT_IN, _TOP_IN, _BOTTOM_IN, _RIGHT_IN = 0.15, 0.42, 0.55, 0.15
_BAR_IN, _GAP_IN, _ROW_IN = 0.1, 0.08, 0.22
_TEXT: Final = 9.0  # readable where the whole picture is shown 800 px wide
_MARK: Final = CATEGORICAL[3]
_CURVES: Final = (CATEGORICAL[0], CATEGORICAL[2], CATEGORICAL[1], CATEGORICAL[4])
_OUTLINE: Final = [withStroke(linewidth=2.0, foreground="black")]
_SAYS: Final = {Outcome.REFUSED: "refused", Outcome.NOT_REACHED: "not reached", Outcome.INCOMPLETE: "incomplete"}


def draw_survey(record: SurveyRecord, path: str | Path, *, title: str = "", simulated: bool = False) -> None:
    """Draw a survey with its numbered targets, the zooms of the first fifteen and their curves.

    Args:
        path: the path of the picture; its suffix gives the format.
        simulated: whether to mark the picture, so that it is not taken for a measurement.
    """
    survey_figure(record, title=title, simulated=simulated).savefig(path, dpi=DPI)


def survey_figure(record: SurveyRecord, *, title: str = "", simulated: bool = False) -> Figure:
    """Return the figure that `draw_survey` writes."""
    return _Picture(record).drawn(title, simulated=simulated)


class _Picture:
    # parts are placed in inches from the upper left corner

    def __init__(self, record: SurveyRecord) -> None:
        self._record = record
        self._shown = record.visits[:MOST_ZOOMS]
        columns = min(_COLUMNS, max(1, math.ceil(len(self._shown) / 2)))
        self._rows = math.ceil(len(self._shown) / columns)
        self._columns = columns if self._shown else 0
        self._row_in = _ZOOM_IN + (_GAP_IN + _CURVE_IN if record.curves else 0.0) + _ROW_IN
        body_in = max(_SURVEY_IN, self._rows * self._row_in - _ROW_IN)
        self._zooms_in = _LEFT_IN + _SURVEY_IN + 1.25  # beside the colour bar of the survey
        zooms_in = self._columns * (_ZOOM_IN + _GAP_IN)
        self._width_in = self._zooms_in + (zooms_in + _RIGHT_IN if zooms_in else -0.1)
        self._height_in = _TOP_IN + body_in + _BOTTOM_IN
        self._figure = Figure(figsize=(self._width_in, self._height_in), facecolor="white")
        FigureCanvasAgg(self._figure)
        self._map = gold()

    def drawn(self, title: str, *, simulated: bool) -> Figure:
        self._head(title, simulated=simulated)
        # one range for the survey and its zooms: the targets are the highest of the survey, and compared with it
        zooms = [flattened(visit.zoom, 1) for visit in self._shown if visit.zoom]
        colours = self._survey(zooms)
        if zooms:
            self._zooms(*colours)
        return self._figure

    def _axes(self, left_in: float, top_in: float, width_in: float, height_in: float) -> Axes:
        low_in = self._height_in - _TOP_IN - top_in - height_in
        box = (left_in / self._width_in, low_in / self._height_in,
               width_in / self._width_in, height_in / self._height_in)  # fmt: skip
        axes = self._figure.add_axes(box)
        axes.tick_params(labelsize=_TEXT, direction="in", width=0.6, length=2.5)
        return axes

    def _head(self, title: str, *, simulated: bool) -> None:
        record, y = self._record, 1 - 0.2 / self._height_in
        scan, measured = record.survey, sum(record.outcome(v) is Outcome.MEASURED for v in record.visits)
        when = f"{scan.time:%Y-%m-%d %H:%M} UTC" if scan.time else ""
        targets = (
            f"{measured} of {counted(len(record.visits), 'target')} measured" if record.visits else "no target found"
        )
        title_text = ", ".join(filter(None, (title, scan.channel, typeset_area(scan.region.size_m), when, targets)))
        self._figure.text(_LEFT_IN / self._width_in, y, title_text, size=9, va="center")
        if simulated:
            right = 1 - _LEFT_IN / self._width_in
            self._figure.text(right, y, "SIMULATED", size=10, weight="bold", color=PROBLEM, ha="right", va="center")

    def _survey(self, zooms: Sequence[Array]) -> tuple[float, Normalize]:
        scan = self._record.survey
        values = flattened(scan, 2)
        factor, colours = self._colour_bar([values, *zooms], scan, _LEFT_IN + _SURVEY_IN + _GAP_IN, _SURVEY_IN)
        axes = self._image(scan, values * factor, colours, (_LEFT_IN, 0.0, _SURVEY_IN))
        self._bar_below(scan, axes)
        for visit in self._record.visits:
            self._mark(axes, visit)
        return factor, colours

    def _bar_below(self, scan: Scan, axes: Axes) -> None:
        # under the survey, where it hides no target
        width, height = _shown_size(scan)
        bar_m = round_length_m(scan.region.size_m[0] / 4.0)
        low = -0.14 / _SURVEY_IN * max(width, height)
        axes.plot([0.0, 1e9 * bar_m], [low, low], color="black", linewidth=3.0, solid_capstyle="butt", clip_on=False)
        axes.text(1e9 * bar_m + 0.02 * width, low, typeset_length(bar_m), size=9, va="center")

    def _mark(self, axes: Axes, visit: Visit) -> None:
        scan = self._record.survey
        if visit.zoom is None:
            x, y = _within(scan, [visit.center_m])[0]
            axes.plot(x, y, "+", color=_MARK, markersize=7, path_effects=_OUTLINE)
        else:
            corners = _within(scan, visit.zoom.region.corners_m())
            axes.add_patch(Polygon(corners, fill=False, edgecolor=_MARK, linewidth=1.0, path_effects=_OUTLINE))
            x, y = corners[:, 0].min(), corners[:, 1].max()
        width, height = _shown_size(scan)
        inside = min(max(x, 0.0), 0.97 * width), min(max(y, 0.0), 0.97 * height)
        axes.annotate(str(visit.number), inside, (0, 1), textcoords="offset points", size=9, weight="bold",
                      color="white", path_effects=_OUTLINE)  # fmt: skip

    def _zooms(self, factor: float, colours: Normalize) -> None:
        spectra = [curve for visit in self._shown for curve in visit.curves.values()]
        for index, visit in enumerate(self._shown):
            row, column = divmod(index, self._columns)
            left_in, top_in = self._zooms_in + column * (_ZOOM_IN + _GAP_IN), row * self._row_in
            place = (left_in, top_in, _ZOOM_IN)
            if visit.zoom is None:
                axes = self._axes(left_in, top_in, _ZOOM_IN, _ZOOM_IN)
                axes.set(facecolor="#F4F4F4", xticks=[], yticks=[])
            else:
                values = flattened(visit.zoom, 1) * factor
                axes = self._image(visit.zoom, values, colours, place)
                draw_scale_bar(axes, visit.zoom.region.size_m, (0.0, 0.0), 1e9, font=_TEXT, named=index == 0)
                self._mark_curves(axes, visit)
            self._label(axes, visit)
            if spectra:
                below = self._axes(left_in, top_in + _ZOOM_IN + _GAP_IN, _ZOOM_IN, _CURVE_IN)
                is_last = index + self._columns >= len(self._shown)
                self._curves(below, visit, spectra, left=column == 0, low=is_last)
        if spectra:
            self._legend()

    def _label(self, axes: Axes, visit: Visit) -> None:
        label = _SAYS.get(self._record.outcome(visit), "")
        axes.text(0.04, 0.95, f"{visit.number}", transform=axes.transAxes, size=9, weight="bold", va="top",
                  color="white", path_effects=_OUTLINE)  # fmt: skip
        if visit.registration is not None and not visit.registration.is_registered:
            sd = "" if visit.position_sd_m is None else f"\n± {typeset_length(float(f'{visit.position_sd_m:.2g}'))}"
            # in lines beside the number: one line is wider than a zoom
            axes.text(0.96, 0.96, f"dead\nreckoning{sd}", transform=axes.transAxes, size=0.8 * _TEXT, ha="right",
                      va="top", linespacing=1.0, color="white", path_effects=_OUTLINE)  # fmt: skip
        if label:
            axes.text(0.5, 0.5, label, transform=axes.transAxes, size=_TEXT, ha="center", va="center",
                      bbox={"facecolor": "white", "alpha": 0.8, "pad": 2.0, "edgecolor": "none"})  # fmt: skip

    def _mark_curves(self, axes: Axes, visit: Visit) -> None:
        for name, colour in zip(self._record.curves, self._colours(), strict=False):
            curve = visit.curves.get(name)
            if curve is not None and curve.position_m is not None and visit.zoom is not None:
                x, y = _within(visit.zoom, [curve.position_m])[0]
                axes.plot(x, y, "o", color=colour, markersize=4, markeredgecolor="white", markeredgewidth=0.7)

    def _curves(self, axes: Axes, visit: Visit, spectra: Sequence[Spectrum], *, left: bool, low: bool) -> None:
        # all curves have one scale
        x_scale, y_scale = (_scale_of([column(curve) for curve in spectra]) for column in (_swept, _shown_of))
        for name, colour in zip(self._record.curves, self._colours(), strict=False):
            if (curve := visit.curves.get(name)) is not None:
                axes.plot(_swept(curve)[2] * x_scale[0], _shown_of(curve)[2] * y_scale[0], color=colour, linewidth=0.8)
        for limit, column, (factor, _) in ((axes.set_xlim, _swept, x_scale), (axes.set_ylim, _shown_of, y_scale)):
            low_end, high_end = _range([column(curve)[2] * factor for curve in spectra])
            limit(low_end, high_end)
        axes.locator_params(nbins=3)
        for side in axes.spines.values():
            side.set_linewidth(0.6)
        axes.tick_params(labelleft=left, labelbottom=low)
        if left:
            axes.set_ylabel(f"{_shown_of(spectra[0])[0]} / {y_scale[1]}", size=_TEXT, labelpad=1)
        if low:
            axes.set_xlabel(f"{_swept(spectra[0])[0]} / {x_scale[1]}", size=_TEXT, labelpad=1)

    def _legend(self) -> None:
        x = self._zooms_in
        for name, colour in zip(self._record.curves, self._colours(), strict=False):
            self._figure.text(x / self._width_in, 0.1 / self._height_in, f"● {name}", color=colour, size=_TEXT)
            x += 0.3 + 0.1 * len(name)

    def _colours(self) -> list[str]:
        return [_CURVES[index % len(_CURVES)] for index in range(len(self._record.curves))]

    def _image(self, scan: Scan, values: Array, colours: Normalize, place: tuple[float, float, float]) -> Axes:
        left_in, top_in, side_in = place
        axes = self._axes(left_in, top_in, side_in, side_in)
        axes.set(facecolor=NEUTRAL, xticks=[], yticks=[])
        width, height = _shown_size(scan)
        axes.imshow(values, origin="lower", extent=(0.0, width, 0.0, height), cmap=self._map, norm=colours,
                    interpolation="nearest")  # fmt: skip
        axes.set(xlim=(0.0, width), ylim=(0.0, height))
        axes.set_anchor("NW")
        return axes

    def _colour_bar(
        self, images: Sequence[Array], scan: Scan, left_in: float, side_in: float
    ) -> tuple[float, Normalize]:
        span = shared_range(images)
        low, high = span.low, span.high
        factor, shown = scale(max(abs(low), abs(high)), scan.unit)
        colours = Normalize(low * factor, high * factor)
        width, height = scan.region.size_m
        axes = self._axes(left_in, 0.0, _BAR_IN, side_in * min(1.0, height / width))
        gradient = np.linspace(low * factor, high * factor, 256)[:, None]
        axes.imshow(gradient, aspect="auto", origin="lower", cmap=self._map, norm=colours,
                    extent=(0.0, 1.0, low * factor, high * factor))  # fmt: skip
        axes.set_xticks([])
        axes.yaxis.tick_right()
        axes.yaxis.set_label_position("right")
        axes.set_ylabel(
            f"height / {shown}" if scan.unit == "m" else f"{scan.channel} / {shown}", size=_TEXT, labelpad=1
        )
        return factor, colours


def _shown_size(scan: Scan) -> tuple[float, float]:
    width, height = scan.region.size_m
    return 1e9 * width, 1e9 * height


def _within(scan: Scan, places_m: Sequence[XY] | Array) -> Array:
    # places in nm from the lower left corner of a scan, along its sides
    region = scan.region
    x, y = (np.asarray(places_m, dtype=np.float64) - region.center_m).T
    cos, sin = math.cos(region.angle_rad), math.sin(region.angle_rad)
    return 1e9 * (np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1) + np.asarray(region.size_m) / 2)


Variable = tuple[str, str, Array]
"""Name, unit and values of one variable of a curve."""


def _swept(curve: Spectrum) -> Variable:
    return curve.names[0], curve.units[0], curve.values[:, 0]


def _shown_of(curve: Spectrum) -> Variable:
    # the variable named like the kind of the curve, else the first that is not swept
    index = next((i for i, name in enumerate(curve.names) if name.lower() == curve.kind.lower()), 1)
    index = min(index, len(curve.names) - 1)
    return curve.names[index], curve.units[index], curve.values[:, index]


def _scale_of(variables: Sequence[Variable]) -> tuple[float, str]:
    largest = max(float(np.nanmax(np.abs(values), initial=0.0)) for _, _, values in variables)
    return scale(largest, variables[0][1])


def _range(curves: Sequence[Array]) -> tuple[float, float]:
    known = np.concatenate([curve[np.isfinite(curve)] for curve in curves])
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    margin = 0.04 * (high - low) or 1.0
    return low - margin, high + margin
