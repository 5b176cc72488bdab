"""Timelines as HTML: rows of coloured intervals over a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import tzinfo
from html import escape
from typing import Protocol

from afspm.basics import time_of_day
from afspm.basics.clock import NS_PER_S
from afspm.basics.formatting import duration_text, quantity

COLUMNS = 720  # resolution of a row: intervals within one column are merged
MOST_PICTURES = 14
_STEPS_S = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, 86400)
_DAY_S = _STEPS_S[-1]
_EDGES = ((0.0, 3.0, 0), (97.0, 100.0, -100))
"""(from, to, shift) in percent: near the ends of a row the label of a tick is shifted inwards."""

CSS = """
.lanes{display:grid;gap:3px}
.lane,.lane-axis{display:grid;grid-template-columns:var(--names,130px) minmax(0,1fr);align-items:center;gap:8px}
.lane b,.lane-axis b{font-weight:500;font-size:12.5px;text-align:right}
.lane b{overflow:hidden;text-overflow:ellipsis;white-space:nowrap}
.lane>div{position:relative;height:17px;background:var(--lane);border-radius:2px;overflow:hidden}
.lane span{position:absolute;top:0;bottom:0;min-width:1px;background:var(--quiet);overflow:hidden}
.lane span.marked{min-width:6px;margin-left:-3px;border-radius:3px;background:currentColor}
.lane i{display:block;margin:0;height:auto;padding:0 4px;color:#fff;white-space:nowrap}
.lane i{font-style:normal;font-size:11px;line-height:17px}
.strip>div{height:auto;aspect-ratio:14/1;background:none}
.strip span{background:none;padding:1px}
.strip img.outside{outline:2px solid #d0342c;outline-offset:-2px}
.strip img{width:100%;height:100%;object-fit:cover;display:block;border-radius:2px;cursor:pointer}
.curve>div{height:70px}
.curve svg{position:absolute;left:0;right:0;top:17px;bottom:0;width:100%;height:53px}
.curve polyline,.curve line{fill:none;stroke:currentColor;stroke-width:1.3;vector-effect:non-scaling-stroke}
.curve polyline{stroke-linecap:round}.curve polyline.dot{stroke-width:4}
.curve line{stroke:#2f8f4e;stroke-dasharray:4 3}
.curve .allowed{fill:#2f8f4e;fill-opacity:.2}
.curve .outside{fill:#d0342c;fill-opacity:.3}
.curve em{display:block;padding:0 4px;font-size:11px;line-height:17px;font-style:normal;color:var(--quiet)}
.curve em{white-space:nowrap;overflow:hidden;text-overflow:ellipsis}
.curve em b{display:inline;font:inherit;font-weight:600;color:#d0342c}
.lane-axis>div{position:relative;height:18px}
.lane-axis span{position:absolute;top:1px;font-size:11.5px;color:var(--quiet);transform:translateX(-50%)}
.lanes{font-variant-numeric:tabular-nums}
@media (max-width:760px){.lane,.lane-axis{grid-template-columns:1fr;gap:0}.lane b,.lane-axis b{text-align:left}}
"""


class Interval(Protocol):
    """An interval of time; an end of None: the interval continues."""

    @property
    def label(self) -> str: ...
    @property
    def start_ns(self) -> int: ...
    @property
    def end_ns(self) -> int | None: ...
    @property
    def by(self) -> str: ...


@dataclass(frozen=True)
class TimelineRow:
    """A row of a timeline; `style` returns the CSS class of a label."""

    name: str
    spans: Iterable[Interval]
    style: Callable[[str], str]


@dataclass(frozen=True)
class DrawnBand:
    """The values that a condition allows; infinite: no bound."""

    condition: str
    low: float
    high: float


@dataclass(frozen=True)
class TimelineCurve:
    """A value over time, drawn below the rows; NaN where the value is unknown."""

    name: str
    unit: str
    times_ns: Sequence[int]
    values: Sequence[float]
    bands: Sequence[DrawnBand] = ()

    def outside(self) -> list[tuple[int, int]]:
        """Return the times in which the value is outside a band: (from, to) in ns, interpolated between values."""
        low = max((band.low for band in self.bands), default=-math.inf)
        high = min((band.high for band in self.bands), default=math.inf)
        parts: list[tuple[int, int]] = []
        points = list(zip(self.times_ns, self.values, strict=True))
        for (t0, v0), (t1, v1) in zip(points, [*points[1:], points[-1]] if points else [], strict=True):
            if not math.isfinite(v0):
                continue
            if not math.isfinite(v1):
                t1, v1 = t0, v0  # how the value went on is unknown
            for part in _outside(t0, v0, t1, v1, low, high):
                if parts and parts[-1][1] == part[0]:
                    parts[-1] = (parts[-1][0], part[1])
                else:
                    parts.append(part)
        return parts


@dataclass
class Stretch:
    """A drawn interval, or several that share columns: the label and duration of the longest, and their number."""

    begin: int
    end: int
    label: str
    by: str
    lasted_ns: int
    count: int = 1


def timeline_html(
    rows: Iterable[TimelineRow],
    begin_ns: int | None,
    end_ns: int,
    zone: tzinfo | None = None,
    *,
    local_too: bool = False,
    pictures: Iterable[tuple[int, str]] = (),
    curves: Iterable[TimelineCurve] = (),
) -> str:
    """Return the HTML of a timeline from `begin_ns` (None: the first interval) to `end_ns`, with a time axis.

    Args:
        zone: the time zone of the axis; None: this computer's zone.
        local_too: add a second axis in this computer's zone.
        pictures: (time, HTML) of each, shown above the rows; of overlapping pictures only the last is shown.
        curves: shown below the rows, on the same axis of time.
    """
    read = [(row, tuple(row.spans)) for row in rows]
    starts = [spans[0].start_ns for _, spans in read if spans]
    if not starts:
        return '<p class="nothing">No data yet.</p>'
    begin_ns = min(starts) if begin_ns is None else begin_ns
    end_ns = max(end_ns, begin_ns + NS_PER_S)
    body = "".join(_row(row, stretches(spans, begin_ns, end_ns), begin_ns, end_ns, zone) for row, spans in read)
    axes = _axis(begin_ns, end_ns, zone, "UTC" if local_too else "")
    axes += _axis(begin_ns, end_ns, None, "local") if local_too else ""
    strip = _pictures(pictures, begin_ns, end_ns)
    drawn = "".join(_curve(curve, begin_ns, end_ns) for curve in curves)
    longest = max(len(row.name) for row, _ in read)
    return f'<div class="lanes" style="--names:min(max(9ch, {longest}ch), 40%)">{strip}{body}{drawn}{axes}</div>'


def _axis(begin_ns: int, end_ns: int, zone: tzinfo | None, name: str) -> str:
    at_s = time_ticks(begin_ns / NS_PER_S, end_ns / NS_PER_S)
    seconds = any(s % 60 for s in at_s)
    ticks = []
    for s in at_s:
        percent = 100.0 * (s * NS_PER_S - begin_ns) / (end_ns - begin_ns)
        # the page ends where the row does: labels near the ends are shifted inwards
        within = next((f";transform:translateX({by}%)" for low, high, by in _EDGES if low <= percent <= high), "")
        text = time_of_day(round(s * NS_PER_S), zone, seconds=seconds)
        ticks.append(f'<span style="left:{percent:.2f}%{within}">{text}</span>')
    return f'<div class="lane-axis"><b>{name}</b><div>{"".join(ticks)}</div></div>'


def tint_class(name: str) -> str:
    """Return the CSS class of a name, the same in every row."""
    return f"tint-{sum(ord(letter) * (i + 7) for i, letter in enumerate(name)) % 8}"


def time_ticks(begin_s: float, end_s: float, about: int = 7) -> list[float]:
    """Return about `about` round times of day in [begin_s, end_s], in seconds since the epoch."""
    step = next((s for s in _STEPS_S if (end_s - begin_s) / s <= about), None)
    if step is None:  # a wrong time in the far future must not make millions of ticks
        step = _DAY_S * -(-int(end_s - begin_s) // (about * _DAY_S))
    first = -(-begin_s // step) * step
    return [first + i * step for i in range(int((end_s - first) // step) + 1)] if first <= end_s else []


def stretches(spans: Sequence[Interval], begin_ns: int, end_ns: int) -> list[Stretch]:
    """Return the drawn stretch of each interval; short intervals in one column are merged and counted."""
    width_ns = (end_ns - begin_ns) / COLUMNS
    stretches: list[Stretch] = []
    for span in spans:
        until_ns = end_ns if span.end_ns is None else min(span.end_ns, end_ns)
        begin = min(COLUMNS - 1, max(0, int((span.start_ns - begin_ns) / width_ns)))
        end = max(begin + 1, min(COLUMNS, round((until_ns - begin_ns) / width_ns)))
        _add(stretches, Stretch(begin, end, span.label, span.by, max(0, until_ns - span.start_ns)))
    return stretches


def _pictures(pictures: Iterable[tuple[int, str]], begin_ns: int, end_ns: int) -> str:
    width = 100.0 / MOST_PICTURES
    last = {}
    for time_ns, html in pictures:
        if begin_ns <= time_ns <= end_ns:
            at = (time_ns - begin_ns) / (end_ns - begin_ns)
            last[min(MOST_PICTURES - 1, int(at * MOST_PICTURES))] = html
    cells = "".join(f'<span style="left:{slot * width:.2f}%;width:{width:.2f}%">{html}</span>'
                    for slot, html in last.items())  # fmt: skip
    return f'<div class="lane strip"><b>scans</b><div>{cells}</div></div>' if cells else ""


def _add(stretches: list[Stretch], added: Stretch) -> None:
    if not stretches:
        stretches.append(added)
        return
    before = stretches[-1]
    if added.begin < before.end:
        if added.end <= before.end:
            _merge(before, added)
            return
        added.begin = before.end
    if before.end == added.begin and before.label == added.label and added.end - added.begin <= 1:
        before.end, before.lasted_ns, before.count = added.end, before.lasted_ns + added.lasted_ns, before.count + 1
        return
    stretches.append(added)


def _merge(into: Stretch, stretch: Stretch) -> None:
    if stretch.lasted_ns > into.lasted_ns and into.end - into.begin <= 1:
        into.label, into.by = stretch.label, stretch.by
    into.lasted_ns = max(into.lasted_ns, stretch.lasted_ns)
    into.count += 1


def _outside(t0: int, v0: float, t1: int, v1: float, low: float, high: float) -> list[tuple[int, int]]:
    # the parts of one straight piece of a curve outside [low, high]
    parts = []
    for bound, sign in ((low, -1.0), (high, 1.0)):
        begin, end = (sign * (v - bound) for v in (v0, v1))  # above zero: outside
        if not math.isfinite(bound) or (begin <= 0.0 and end <= 0.0):
            continue
        crossing = t0 if begin == end else t0 + round((t1 - t0) * begin / (begin - end))
        parts.append((t0 if begin > 0.0 else crossing, t1 if end > 0.0 else crossing))
    return sorted(parts)


def _curve(curve: TimelineCurve, begin_ns: int, end_ns: int) -> str:
    # the lowest value or limit is at the bottom, the highest on top; a gap where the value was unknown
    known = [v for v in curve.values if math.isfinite(v)]
    if not known:
        return f'<div class="lane"><b>{escape(curve.name)}</b><div></div></div>'
    limits = [v for band in curve.bands for v in (band.low, band.high) if math.isfinite(v)]
    low, high = min(*known, *limits, known[0]), max(*known, *limits, known[0])

    def up(value: float) -> float:
        if high == low:
            return 50.0
        return min(100.0, max(0.0, 96.0 - 92.0 * (value - low) / (high - low)))

    def across(time_ns: int) -> float:
        return COLUMNS * (time_ns - begin_ns) / (end_ns - begin_ns)

    lines, line = list[list[str]](), list[str]()
    for time_ns, value in zip(curve.times_ns, curve.values, strict=True):
        if not math.isfinite(value):
            lines, line = [*lines, line], []
        elif begin_ns <= time_ns <= end_ns:
            line.append(f"{across(time_ns):.1f},{up(value):.1f}")
    # a value between two gaps is a dot: a line from a point to itself with round ends
    drawn = "".join(
        f'<polyline points="{" ".join(points)}"/>'
        if len(points) > 1
        else f'<polyline class="dot" points="{" ".join(points * 2)}"/>'
        for points in (*lines, line)
        if points
    )
    bands = "".join(_drawn_band(up(band.low), up(band.high), band) for band in curve.bands)
    gone = [(max(a, begin_ns), min(b, end_ns)) for a, b in curve.outside() if a <= end_ns and b >= begin_ns]
    # at least three columns, so that a short excursion is seen
    marks = "".join(
        f'<rect class="outside" x="{across(a):.1f}" y="0" width="{max(3.0, across(b) - across(a)):.1f}" height="100"/>'
        for a, b in gone
    )
    text, alarm = _curve_texts(curve, min(known), max(known), sum(b - a for a, b in gone), len(gone))
    shown = escape(text) + (f" · <b>{escape(alarm)}</b>" if alarm else "")
    title = escape(f"{curve.name}: {text}{f'; {alarm}' if alarm else ''}")
    return (
        f'<div class="lane curve" title="{title}"><b>{escape(curve.name)}</b><div><em>{shown}</em>'
        f'<svg viewBox="0 0 {COLUMNS} 100" preserveAspectRatio="none">{bands}{marks}{drawn}</svg></div></div>'
    )


def _drawn_band(below: float, above: float, band: DrawnBand) -> str:
    # y grows downwards
    dashes = "".join(
        f'<line x1="0" x2="{COLUMNS}" y1="{y:.1f}" y2="{y:.1f}"/>'
        for y, bound in ((below, band.low), (above, band.high))
        if math.isfinite(bound)
    )
    height = max(0.0, below - above)
    return f'<rect class="allowed" x="0" y="{above:.1f}" width="{COLUMNS}" height="{height:.1f}"/>{dashes}'


def _curve_texts(curve: TimelineCurve, low: float, high: float, gone_ns: int, times: int) -> tuple[str, str]:
    unit = curve.unit
    now = quantity(curve.values[-1], unit) if math.isfinite(curve.values[-1]) else "unknown"
    parts = [f"{quantity(low, unit)} to {quantity(high, unit)}, now {now}"]
    for band in curve.bands:
        if math.isinf(band.high):
            allowed = f"at least {quantity(band.low, unit)}"
        elif math.isinf(band.low):
            allowed = f"at most {quantity(band.high, unit)}"
        else:
            allowed = f"{quantity(band.low, unit)} to {quantity(band.high, unit)}"
        parts.append(f"{band.condition} allows {allowed}")
    if not times:
        return "; ".join(parts), ""
    often = f", {times} times" if times > 1 else ""
    return "; ".join(parts), f"outside for {duration_text(gone_ns / NS_PER_S)}{often}"


def _row(row: TimelineRow, shown: Sequence[Stretch], begin_ns: int, end_ns: int, zone: tzinfo | None) -> str:
    cells = []
    for stretch in shown:
        label = stretch.label.replace("_", " ")
        start_ns = begin_ns + stretch.begin * (end_ns - begin_ns) // COLUMNS
        by = f", by {stretch.by}" if stretch.by else ""
        lasted = f" for {duration_text(stretch.lasted_ns / NS_PER_S)}" if stretch.lasted_ns else ""
        often = f", {stretch.count} times about here" if stretch.count > 1 else lasted
        title = f"{label}{by} {'from' if stretch.lasted_ns else 'at'} {time_of_day(start_ns, zone)}{often}"
        left, width = 100 * stretch.begin / COLUMNS, 100 * (stretch.end - stretch.begin) / COLUMNS
        word = f"<i>{escape(label)}</i>" if width > 7 else ""
        cells.append(
            f'<span class="{row.style(stretch.label)}" style="left:{left:.2f}%;width:{width:.2f}%" '
            f'title="{escape(title)}">{word}</span>'
        )
    return f'<div class="lane"><b>{escape(row.name)}</b><div>{"".join(cells)}</div></div>'
