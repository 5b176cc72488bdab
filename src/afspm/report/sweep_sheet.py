"""The contact sheet of a sweep: its scans beside each other, labelled by the swept parameters, for the report."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from afspm.basics import typeset
from afspm.basics.errors import FileError
from afspm.basics.formatting import scale
from afspm.drawing import reduced
from afspm.drawing.raster import ValueRange, shared_range
from afspm.model import Scan
from afspm.model.arrays import Array
from afspm.model.line_levelling import flattened
from afspm.night.run import Run
from afspm.night.tables import ScanRow, SweptSetting
from afspm.report.pictures import topography

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST: Final = 600
_LARGEST_PX: Final = 160
_PANEL_IN, _GAP_IN, _TEXT = 1.15, 0.06, 7.5
_LEAST_CONTRAST: Final = 4.0
"""Largest ratio of the shared range to the range of a row.

A gain at which the feedback oscillates gives heights ten times those of a good scan, which is one colour then."""
_TOP_IN, _BOTTOM_IN, _RIGHT_IN, _CHARACTER_IN = 0.85, 0.12, 0.85, 0.068
_log = logging.getLogger("afspm.report")
Setting = tuple[SweptSetting, ...]


class Panel(NamedTuple):
    """The place of a scan on the sheet: its settings, and the number of earlier points with the same settings."""

    settings: Setting
    again: int = 0

    @property
    def row(self) -> Setting:
        return self.settings[:-1]

    @property
    def column(self) -> Panel:
        return Panel(self.settings[-1:], self.again)


def figures(run: Run, title: str, again: bool = False) -> Iterator[tuple[str, Figure]]:
    """Yield the contact sheet of each sweep of a run, named "sweep", "sweep_2" …

    Interrupted scans, and sweeps of more than `MOST` scans, are left out.
    """
    swept: dict[tuple[str, ...], list[ScanRow]] = {}
    for row in run.scans:
        if row.settings and row.file and not row.interrupted:
            swept.setdefault(tuple(setting.column for setting in row.settings), []).append(row)
    for number, rows in enumerate((one for found in swept.values() for one in _panels(found)), 1):
        if len(rows) > MOST:
            _log.warning("a sweep of %d scans has no contact sheet: at most %d fit", len(rows), MOST)
            continue
        scans = [(panel, scan) for panel, row in rows.items() if (scan := _scan(run, row)) is not None]
        if scans:
            yield f"sweep_{number}" if number > 1 else "sweep", sheet(scans, title)


def _panels(rows: Sequence[ScanRow]) -> list[dict[Panel, ScanRow]]:
    # a dictionary for each scan of a point; of a point that was measured again, the later scan
    sheets: list[dict[Panel, ScanRow]] = []
    in_point: Counter[int | None] = Counter()
    points: dict[Setting, list[int]] = {}
    for row in {row.key or row.number: row for row in rows}.values():
        place, again = 0, 0
        if row.point is not None:
            place, of_values = in_point[row.point], points.setdefault(row.settings, [])
            in_point[row.point] += 1
            of_values += [row.point] if row.point not in of_values else []
            again = of_values.index(row.point)
        sheets += [{}] if place == len(sheets) else []
        sheets[place][Panel(row.settings, again)] = row
    return sheets


def _scan(run: Run, row: ScanRow) -> Scan | None:
    try:
        scans = run.scan(row)
    except FileError as error:
        _log.warning("scan %d is missing on the contact sheet of its sweep: %s", row.number, error)
        return None
    return scans[topography(scans)]


def sheet(scans: Sequence[tuple[Panel, Scan]], title: str) -> Figure:
    """Return a figure of scans, in the order of measurement, in rows and columns by their settings.

    The last parameter changes along a row, all others from row to row. Where points have equal values, as in a loop,
    each has a column, in the order of measurement if that is the same in all rows. All scans share one range of
    colours, unless that would leave a row without contrast: then each row has a range and a colour bar of its own.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    from afspm.drawing import gold
    from afspm.drawing.plotting import draw_scale_bar

    panels = [panel for panel, _ in scans]
    across, down = _columns(panels), _sorted(panel.row for panel in panels)
    last, others = panels[0].settings[-1], panels[0].row
    left_in = 0.2 + _CHARACTER_IN * max([0, *map(len, "\n".join((*map(_label, down), _names(others))).split("\n"))])
    pitch_in = _PANEL_IN + _GAP_IN
    width_in = left_in + max(len(across) * pitch_in, 2.4) + _RIGHT_IN
    height_in = _TOP_IN + len(down) * pitch_in + _BOTTOM_IN
    figure = Figure(figsize=(width_in, height_in), facecolor="white")
    FigureCanvasAgg(figure)

    def text(x_in: float, y_in: float, words: str, **how: Any) -> None:
        figure.text(x_in / width_in, 1 - y_in / height_in, words, fontsize=_TEXT, **how)

    text(0.1, 0.2, title, va="center", weight="bold")
    text(left_in, 0.46, last.name, va="center", style="italic")
    text(left_in - 0.1, 0.46, _names(others), va="center", ha="right", style="italic")
    for number, column in enumerate(across):
        text(left_in + number * pitch_in + _PANEL_IN / 2, 0.72, _label(column.settings), va="center", ha="center")
    for row, settings in enumerate(down):
        y_in = _TOP_IN + row * pitch_in + _PANEL_IN / 2
        text(left_in - 0.1, y_in, _label(settings), va="center", ha="right")
    pictures = {panel: (scan, _picture(scan)) for panel, scan in scans}
    spans = _spans({panel: picture for panel, (_, picture) in pictures.items()})
    for panel, (scan, picture) in pictures.items():
        place = (across.index(panel.column), down.index(panel.row))
        x_in, y_in = left_in + place[0] * pitch_in, _TOP_IN + place[1] * pitch_in
        axes = figure.add_axes(
            (x_in / width_in, 1 - (y_in + _PANEL_IN) / height_in, _PANEL_IN / width_in, _PANEL_IN / height_in)
        )
        axes.set_facecolor("0.6")  # not measured
        span = spans[panel.row]
        width_m, height_m = scan.region.size_m
        axes.imshow(
            np.ma.masked_invalid(picture), cmap=gold(), vmin=span.low, vmax=span.high, origin="lower",
            extent=(0.0, width_m, 0.0, height_m), interpolation="nearest",
        )  # fmt: skip
        axes.set_xlim(0.0, width_m)
        axes.set_ylim(0.0, height_m)
        axes.set_xticks([])
        axes.set_yticks([])
        is_first = place == (0, len(down) - 1)
        draw_scale_bar(axes, scan.region.size_m, (0.0, 0.0), 1.0, font=_TEXT, named=is_first)
    scan, bars_in = scans[0][1], left_in + len(across) * pitch_in + 0.05
    is_shared = len(set(spans.values())) == 1
    if not is_shared:
        text(bars_in, 0.72, "row’s scale", va="center", style="italic")
    tall_in = (min(2, len(down)) if is_shared else 1) * pitch_in - _GAP_IN
    for row, settings in enumerate(down[:1] if is_shared else down):
        span = spans[settings]
        factor, unit = scale(max(abs(span.low), abs(span.high)), scan.unit)
        low_in = _TOP_IN + row * pitch_in + tall_in
        bar = figure.add_axes((bars_in / width_in, 1 - low_in / height_in, 0.1 / width_in, tall_in / height_in))
        colours = ScalarMappable(Normalize(span.low * factor, span.high * factor), gold())
        drawn = figure.colorbar(colours, cax=bar)
        drawn.ax.yaxis.set_major_formatter(lambda value, _: f"{value:.3g}".replace("-", "−"))
        drawn.ax.tick_params(labelsize=_TEXT)
        drawn.set_label(f"{scan.channel} / {unit}" if unit else scan.channel, fontsize=_TEXT)
    return figure


def _spans(pictures: Mapping[Panel, Array]) -> dict[Setting, ValueRange]:
    # the range of colours of each row; a picture of one value, or of none, has no range
    rows: dict[Setting, list[Array]] = {}
    for panel, picture in pictures.items():
        rows.setdefault(panel.row, []).append(picture)
    varied = {row: [one for one in found if np.nanmax(one, initial=-np.inf) > np.nanmin(one, initial=np.inf)]
              for row, found in rows.items()}  # fmt: skip
    spans = {row: shared_range(found) for row, found in varied.items() if found}
    together = shared_range([one for found in varied.values() for one in found] or pictures.values())
    is_flat = any(together.high - together.low > _LEAST_CONTRAST * (span.high - span.low) for span in spans.values())
    return {row: spans.get(row, together) if is_flat else together for row in rows}


def _picture(scan: Scan) -> Array:
    return reduced(flattened(scan.values), _LARGEST_PX)


def _columns(panels: Sequence[Panel]) -> list[Panel]:
    rows: dict[Setting, list[Panel]] = {}
    for panel in panels:
        rows.setdefault(panel.row, []).append(panel.column)
    orders = list(rows.values())
    if any(panel.again for panel in panels) and all(order == orders[0] for order in orders):
        return orders[0]
    found = {panel.column for panel in panels}
    values = _sorted(panel.column.settings for panel in panels)
    return sorted(found, key=lambda column: (values.index(column.settings), column.again))


def _sorted(settings: Iterable[Setting]) -> list[Setting]:
    # numbers ascending, other values in the order of occurrence
    found = list(dict.fromkeys(settings))
    seen: list[object] = [setting.value for each in found for setting in each]

    def rank(setting: SweptSetting) -> float:
        return float(setting.value) if isinstance(setting.value, int | float) else float(seen.index(setting.value))

    return sorted(found, key=lambda each: tuple(map(rank, each)))


def _names(settings: Setting) -> str:
    return "\n".join(setting.name for setting in settings)


def _label(settings: Setting) -> str:
    return "\n".join(typeset(setting.text) for setting in settings)
