"""A `NightRecord` as a figure: contact sheet, bands over the night, and close-ups of the first repairs."""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from afspm.basics import time_of_day, typeset_length
from afspm.basics.clock import NS_PER_S
from afspm.basics.formatting import counted, period_text, scale
from afspm.drawing import CATEGORICAL, PROBLEM, round_length_m
from afspm.drawing.palette import NEUTRAL, UNMEASURED, colour_map
from afspm.drawing.raster import ValueRange, indices, pooled_range
from afspm.drawing.timeline import time_ticks
from afspm.model import names
from afspm.night import Span
from afspm.night.bad_scans import BAD
from afspm.night.night_record import NightMark, NightRecord, Shot, Thumbnail

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN = 7.2  # the width of two columns in a journal
LANE_IN = 0.22
THUMB_PX = 64
GAP_PX = 6
SCALES_IN = 0.3
MOST_SCALES = 3
BAR_PX = 6
COLUMNS = 14
MOST_SHOTS = 98
MOST_LOOKS = 3
AROUND_NS = 8 * 60 * 1_000_000_000
PAPER = (255, 255, 255)
SMALL_PT, TEXT_PT = 6.0, 7.0
_SCALE_IN = 2.3


def prepare() -> None:
    """Load slow modules, fonts and colours in advance."""
    figure = _figure(1.0)
    figure.add_axes((0.0, 0.0, 1.0, 1.0)).text(0.5, 0.5, "a", weight="bold")
    figure.savefig(io.BytesIO(), dpi=50)


def draw(
    record: NightRecord, path: Path, problems: Mapping[int, str], *, title: str = "", simulated: bool = False
) -> None:
    """Write the figure as an image file; the arguments are those of `figure_of`."""
    figure_of(record, problems, title=title, simulated=simulated).savefig(path, dpi=200)


def figure_of(record: NightRecord, problems: Mapping[int, str], *, title: str = "", simulated: bool = False) -> Figure:
    """Return the figure.

    Args:
        problems: the names of problems, by number.
        simulated: mark the figure as SIMULATED, so that it can't pass as a measurement.
    """
    shots = _chosen(record)
    repairs = _episodes(record)[:MOST_LOOKS]
    rows = max(1, math.ceil(len(shots) / COLUMNS))
    lanes = len(record.holders) + len(record.problems)
    sheet_in = rows * WIDTH_IN / COLUMNS * (THUMB_PX + GAP_PX + BAR_PX) / (THUMB_PX + GAP_PX)
    bands_in = LANE_IN * lanes + 0.05
    looks_in = bands_in if repairs else 0.0
    height_in = 0.32 + sheet_in + SCALES_IN + 0.42 + bands_in + (0.62 + looks_in if repairs else 0.0) + 0.42
    figure = _figure(height_in)
    colours = {holder: CATEGORICAL[i % len(CATEGORICAL)] for i, holder in enumerate(record.holders)}

    def axes(left_in: float, top_in: float, width_in: float, tall_in: float) -> Axes:
        box = (left_in / WIDTH_IN, 1 - (top_in + tall_in) / height_in, width_in / WIDTH_IN, tall_in / height_in)
        return figure.add_axes(box)

    _head(figure, record, title, height_in, simulated=simulated)
    top = 0.32
    spans = _spans(shots)
    _sheet(axes(0.0, top, WIDTH_IN, sheet_in), record, shots, colours, rows, spans)
    top += sheet_in
    for number, kind in enumerate(list(spans)[:MOST_SCALES]):
        left = WIDTH_IN - 0.1 - _SCALE_IN * (number + 1)
        _height_scale(axes(left + 1.15, top + 0.1, 0.7, 0.1), kind, spans[kind])
    top += SCALES_IN + 0.42
    label_in = 1.35
    night = axes(label_in, top, WIDTH_IN - label_in - 0.12, bands_in)
    _bands(night, record, problems, colours, (record.start_ns, record.end_ns), names_too=True)
    _hours(night, record)
    _letter(figure, "b", 0.0, 1 - (top - 0.06) / height_in)
    if repairs:
        top += bands_in + 0.62
        width = (WIDTH_IN - label_in - 0.12 - 0.25 * (len(repairs) - 1)) / len(repairs)
        for i, span in enumerate(repairs):
            look = axes(label_in + i * (width + 0.25), top, width, looks_in)
            _bands(look, record, problems, colours, _around(span, record), names_too=i == 0)
            _times(look, *(round(edge) for edge in look.get_xlim()), about=4)
        _letter(figure, "c", 0.0, 1 - (top - 0.06) / height_in)
    return figure


def _figure(height_in: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, height_in), facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _head(figure: Figure, record: NightRecord, title: str, height_in: float, *, simulated: bool) -> None:
    what = f"{title}   " if title else ""
    y = 1 - 0.17 / height_in
    about = f"{what}{period_text(record.start_ns, record.end_ns, UTC)}, {counted(record.scans, 'scan')}"
    figure.text(0.03, y, about, size=TEXT_PT, va="center")
    legend = "lower bar: in control, as in b" + ("; framed: bad or interrupted" if record.bad_ns() else "")
    figure.text(0.86, y, legend, size=SMALL_PT, va="center", ha="right")
    _letter(figure, "a", 0.0, y)
    if simulated:
        figure.text(0.995, y, "SIMULATED", size=9, weight="bold", color=PROBLEM, ha="right", va="center")


def _letter(figure: Figure, letter: str, x: float, y: float) -> None:
    figure.text(x + 0.008, y, letter, size=9, weight="bold", va="center")


def _spans(shots: Sequence[Shot]) -> dict[tuple[str, float], ValueRange]:
    # scans of one size are compared: their colours mean the same heights; the most frequent size first
    kinds = Counter(shot.picture.kind for shot in shots)
    return {
        kind: pooled_range(shot.picture.values for shot in shots if shot.picture.kind == kind)
        for kind, _ in kinds.most_common()
    }


def _height_scale(ax: Axes, kind: tuple[str, float], span: ValueRange) -> None:
    unit, width_m = kind
    factor, shown = scale(max(abs(span.low), abs(span.high)), unit)
    ax.imshow(colour_map("gold")[None], aspect="auto", extent=(0.0, 1.0, 0.0, 1.0))
    ax.set_axis_off()
    low, high = (f"{value * factor:.3g}".replace("-", "−") for value in (span.low, span.high))
    ax.text(-0.06, 0.45, f"{typeset_length(width_m)} wide:  {low}", size=SMALL_PT, ha="right", va="center")
    ax.text(1.06, 0.45, f"{high} {shown}", size=SMALL_PT, va="center")


def _sheet(
    ax: Axes,
    record: NightRecord,
    shots: Sequence[Shot],
    colours: Mapping[str, str],
    rows: int,
    spans: Mapping[tuple[str, float], ValueRange],
) -> None:
    # one image for all pictures: drawing an image for each takes much longer
    pitch, tall = THUMB_PX + GAP_PX, THUMB_PX + GAP_PX + BAR_PX
    canvas = np.full((rows * tall, COLUMNS * pitch, 3), PAPER, np.uint8)
    bad_ns = record.bad_ns()
    palette = np.vstack([colour_map("gold"), [_rgb(NEUTRAL)]])  # the last colour marks unmeasured pixels
    for i, shot in enumerate(shots):
        y, x = i // COLUMNS * tall, i % COLUMNS * pitch + GAP_PX // 2
        levels = indices(shot.picture.values, spans[shot.picture.kind])
        picture = palette[_fitted(levels, (shot.picture.width_m, shot.picture.height_m))[::-1]]  # drawn with y upwards
        canvas[y : y + THUMB_PX, x : x + THUMB_PX] = picture
        bar_px = _scale_bar_px(shot.picture)[1]
        canvas[y + THUMB_PX - 8 : y + THUMB_PX - 3, x + 3 : x + 5 + bar_px] = 0
        canvas[y + THUMB_PX - 7 : y + THUMB_PX - 4, x + 4 : x + 4 + bar_px] = 255
        bar = _rgb(colours.get(record.holder_of(shot) or "", NEUTRAL))
        canvas[y + THUMB_PX + 1 : y + THUMB_PX + BAR_PX, x : x + THUMB_PX] = bar
        if shot.time_ns in bad_ns:
            _frame(canvas[y : y + THUMB_PX, x : x + THUMB_PX], _rgb(PROBLEM))
    ax.imshow(canvas, interpolation="nearest", aspect="auto")
    ax.set_axis_off()
    for i, shot in enumerate(shots):
        y, x = i // COLUMNS * tall, i % COLUMNS * pitch + GAP_PX // 2
        label = time_of_day(shot.time_ns, UTC, seconds=False)
        ax.text(x + 2, y + 2, label, size=SMALL_PT, color="white", va="top", bbox=_LABEL)
        if i == 0 or shot.picture.width_m != shots[i - 1].picture.width_m:  # the length holds until the next label
            length = typeset_length(_scale_bar_px(shot.picture)[0])
            ax.text(x + 4, y + THUMB_PX - 10, length, size=SMALL_PT, color="white", va="bottom", bbox=_LABEL)


def _scale_bar_px(picture: Thumbnail) -> tuple[float, int]:
    # length in m, and in pixels of the sheet
    length_m = round_length_m(picture.width_m / 2.5)
    return length_m, max(1, round(length_m / max(picture.width_m, picture.height_m) * THUMB_PX))


_LABEL: dict[str, object] = {"boxstyle": "square,pad=0.12", "facecolor": "black", "alpha": 0.55, "linewidth": 0}


def _bands(
    ax: Axes,
    record: NightRecord,
    problems: Mapping[int, str],
    colours: Mapping[str, str],
    limits: tuple[int, int],
    *,
    names_too: bool,
) -> None:
    labels: list[str] = []
    for lane, holder in enumerate(record.holders):
        _lane(ax, lane, record.control_spans(holder), limits, facecolor=colours[holder])
        labels.append(holder)
    first = len(labels)
    for lane, problem in enumerate(record.problems, start=first):
        spans = record.problem_spans(problem)
        _lane(ax, lane, spans, limits, facecolor=PROBLEM, hatch="////", edgecolor="white")
        by = " or ".join(dict.fromkeys(filter(None, (flagged_by(record, span) for span in spans))))
        labels.append(problems.get(problem, f"problem {problem}") + (f"\nflagged by {by}" if by else ""))
    for span in record.manual_spans():
        ax.axvspan(*_clipped(span, limits), color=NEUTRAL, alpha=0.5, linewidth=0)
    _actions(ax, record, {holder: lane for lane, holder in enumerate(record.holders)}, limits)
    ax.axhline(first - 0.5, color="black", linewidth=0.5)
    ax.set_xlim(*limits)
    ax.set_ylim(max(len(labels), 1) - 0.5, -0.5)
    ax.set_yticks(range(len(labels)), labels if names_too else [""] * len(labels), size=SMALL_PT, linespacing=0.95)
    ax.tick_params(axis="y", length=0)
    ax.set_facecolor("#F4F4F4")
    for side in ("top", "right", "left"):
        ax.spines[side].set_visible(False)


def _lane(ax: Axes, lane: int, spans: Sequence[Span], limits: tuple[int, int], **style: Any) -> None:
    least = (limits[1] - limits[0]) / 600  # shorter spans would be invisible
    bars = []
    for span in spans:
        start, end = _clipped(span, limits)
        if end >= start:  # otherwise it is outside the limits
            bars.append((start, max(end - start, least)))
    ax.broken_barh(bars, (lane - 0.36, 0.72), linewidth=0, **style)


def flagged_by(record: NightRecord, span: Span) -> str:
    """Return the author of the bad verdict nearest to a flag; empty without a bad verdict within `AROUND_NS` / 4."""
    near = [m for m in record.marks if m.score == BAD and abs(m.time_ns - span.start_ns) < AROUND_NS / 4]
    return min(near, key=lambda m: abs(m.time_ns - span.start_ns)).by if near else ""


def _actions(ax: Axes, record: NightRecord, lanes: Mapping[str, int], limits: tuple[int, int]) -> None:
    for action, marker in ((names.PULSE, "v"), (names.CRASH, "X")):
        done: list[NightMark] = [m for m in record.marks if m.what == action and limits[0] <= m.time_ns <= limits[1]]
        if done:
            at = [lanes.get(m.by, 0) for m in done]
            label = action.removeprefix("x-")
            ax.scatter(
                [m.time_ns for m in done], at, s=16, marker=marker, color="black", linewidths=0.4, edgecolors="white",
                label=label, zorder=3,
            )  # fmt: skip


def _hours(ax: Axes, record: NightRecord) -> None:
    _times(ax, record.start_ns, record.end_ns, about=10)
    ax.set_xlabel("time of day, UTC", size=TEXT_PT, labelpad=1)
    _legend(ax)


def _times(ax: Axes, begin_ns: int, end_ns: int, *, about: int) -> None:
    ticks_ns = [round(tick_s * NS_PER_S) for tick_s in time_ticks(begin_ns / NS_PER_S, end_ns / NS_PER_S, about)]
    seconds = any(tick_ns % (60 * NS_PER_S) for tick_ns in ticks_ns)
    ax.set_xticks(ticks_ns, [time_of_day(tick_ns, UTC, seconds=seconds) for tick_ns in ticks_ns], size=TEXT_PT)


def _legend(ax: Axes) -> None:
    if ax.get_legend_handles_labels()[1]:
        ax.legend(
            loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=SMALL_PT, frameon=False, handletextpad=0.1,
            borderpad=0.1,
        )  # fmt: skip


def _episodes(record: NightRecord) -> list[Span]:
    spans = sorted((s for p in record.problems for s in record.problem_spans(p)), key=lambda s: s.start_ns)
    merged: list[Span] = []
    for span in spans:
        if merged and (merged[-1].end_ns is None or span.start_ns <= merged[-1].end_ns):
            last = merged[-1]
            end = None if span.end_ns is None or last.end_ns is None else max(last.end_ns, span.end_ns)
            merged[-1] = Span(last.label, last.start_ns, end)
        else:
            merged.append(span)
    return merged


def _around(span: Span, record: NightRecord) -> tuple[int, int]:
    end_ns = record.end_ns if span.end_ns is None else span.end_ns
    margin = max(AROUND_NS // 4, (end_ns - span.start_ns) // 3)
    return span.start_ns - margin, end_ns + margin


def _chosen(record: NightRecord) -> list[Shot]:
    shots = sorted(record.shots, key=lambda shot: shot.time_ns)
    if len(shots) <= MOST_SHOTS:
        return shots
    series = record.holders[0] if record.holders else None
    bad_ns = record.bad_ns()
    odd = {i for i, shot in enumerate(shots) if record.holder_of(shot) != series or shot.time_ns in bad_ns}
    odd = set(sorted(odd)[: MOST_SHOTS // 2])
    rest = [i for i in range(len(shots)) if i not in odd]
    even = np.linspace(0, len(rest) - 1, MOST_SHOTS - len(odd)).round().astype(int)
    return [shots[i] for i in sorted(odd | {rest[k] for k in even})]


def _clipped(span: Span, limits: tuple[int, int]) -> tuple[float, float]:
    end = limits[1] if span.end_ns is None else span.end_ns
    return float(max(span.start_ns, limits[0])), float(min(end, limits[1]))


def _fitted(picture: NDArray[np.uint8], size_m: tuple[float, float]) -> NDArray[np.uint8]:
    # the sides follow the region, not the pixels: few lines over a tall region are a tall image
    width_px, height_px = (max(1, round(THUMB_PX * side_m / max(size_m))) for side_m in size_m)
    ny, nx = picture.shape
    small = picture[np.ix_(np.arange(height_px) * ny // height_px, np.arange(width_px) * nx // width_px)]
    canvas = np.full((THUMB_PX, THUMB_PX), UNMEASURED, np.uint8)
    y, x = (THUMB_PX - small.shape[0]) // 2, (THUMB_PX - small.shape[1]) // 2
    canvas[y : y + small.shape[0], x : x + small.shape[1]] = small
    return canvas


def _frame(picture: NDArray[np.uint8], colour: tuple[int, int, int]) -> None:
    for edge in (picture[:3], picture[-3:], picture[:, :3], picture[:, -3:]):
        edge[...] = colour


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
