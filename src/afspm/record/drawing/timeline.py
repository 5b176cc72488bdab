"""Timelines as HTML: rows of coloured intervals over a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import tzinfo
from html import escape
from typing import Protocol

from afspm.basics.clock import NS_PER_S
from afspm.basics.formatting import duration_text, quantity, time_of_day

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
.strip img{width:100%;height:100%;object-fit:cover;display:block;border-radius:2px;cursor:pointer}
.curve>div{height:46px}
.curve svg{position:absolute;inset:0;width:100%;height:100%}
.curve polyline{fill:none;stroke:currentColor;stroke-width:1.2;vector-effect:non-scaling-stroke}
.curve em{position:absolute;left:4px;top:1px;font-size:11px;font-style:normal;color:var(--quiet)}
.lane-axis>div{position:relative;height:18px}
.lane-axis span{position:absolute;top:1px;font-size:11.5px;color:var(--quiet);transform:translateX(-50%)}
.lanes{font-variant-numeric:tabular-nums}
@media (max-width:760px){.lane,.lane-axis{grid-template-columns:1fr;gap:0}.lane b,.lane-axis b{text-align:left}}
"""


class Interval(Protocol):
    """An interval of time; an end of None means it continues."""

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
    """One row of a timeline; `style` gives the CSS class of a label."""

    name: str
    spans: Iterable[Interval]
    style: Callable[[str], str]


@dataclass(frozen=True)
class TimelineCurve:
    """A value over time under the rows; NaN where it is unknown."""

    name: str
    unit: str
    times_ns: Sequence[int]
    values: Sequence[float]


@dataclass
class Stretch:
    """Intervals that share columns of the image: the longest, and their number."""

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
    """Return rows from `begin_ns` (None: from the first interval on) to `end_ns`, with an axis of times of day.

    Args:
        zone: of the axis; None: this computer's.
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
    drawn = "".join(_curve(one, begin_ns, end_ns) for one in curves)
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
    """Return intervals in columns of the image; of several in one column the longest is shown, with their number."""
    width_ns = (end_ns - begin_ns) / COLUMNS
    found: list[Stretch] = []
    for span in spans:
        until_ns = end_ns if span.end_ns is None else min(span.end_ns, end_ns)
        begin = min(COLUMNS - 1, max(0, int((span.start_ns - begin_ns) / width_ns)))
        end = max(begin + 1, min(COLUMNS, round((until_ns - begin_ns) / width_ns)))
        _add(found, Stretch(begin, end, span.label, span.by, max(0, until_ns - span.start_ns)))
    return found


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


def _add(found: list[Stretch], one: Stretch) -> None:
    if not found:
        found.append(one)
        return
    before = found[-1]
    if one.begin < before.end:
        if one.end <= before.end:
            _merge(before, one)
            return
        one.begin = before.end
    if before.end == one.begin and before.label == one.label and one.end - one.begin <= 1:
        before.end, before.lasted_ns, before.count = one.end, before.lasted_ns + one.lasted_ns, before.count + 1
        return
    found.append(one)


def _merge(into: Stretch, one: Stretch) -> None:
    if one.lasted_ns > into.lasted_ns and into.end - into.begin <= 1:
        into.label, into.by = one.label, one.by
    into.lasted_ns = max(into.lasted_ns, one.lasted_ns)
    into.count += 1


def _curve(curve: TimelineCurve, begin_ns: int, end_ns: int) -> str:
    # from the lowest value, at the bottom, to the highest; a gap where the value was unknown
    known = [(t, v) for t, v in zip(curve.times_ns, curve.values, strict=True) if math.isfinite(v)]
    if not known:
        return f'<div class="lane"><b>{escape(curve.name)}</b><div></div></div>'
    low, high = min(v for _, v in known), max(v for _, v in known)
    lines, line = list[str](), list[str]()
    for time_ns, value in zip(curve.times_ns, curve.values, strict=True):
        if not math.isfinite(value):
            lines, line = [*lines, " ".join(line)], []
        elif begin_ns <= time_ns <= end_ns:
            x = COLUMNS * (time_ns - begin_ns) / (end_ns - begin_ns)
            y = 50.0 if high == low else 96.0 - 92.0 * (value - low) / (high - low)
            line.append(f"{x:.1f},{y:.1f}")
    drawn = "".join(f'<polyline points="{points}"/>' for points in (*lines, " ".join(line)) if points)
    now = quantity(curve.values[-1], curve.unit) if math.isfinite(curve.values[-1]) else "unknown"
    text = f"{quantity(low, curve.unit)} to {quantity(high, curve.unit)}, now {now}"
    return (
        f'<div class="lane curve" title="{escape(f"{curve.name}: {text}")}"><b>{escape(curve.name)}</b><div>'
        f'<svg viewBox="0 0 {COLUMNS} 100" preserveAspectRatio="none">{drawn}</svg><em>{escape(text)}</em></div></div>'
    )


def _row(row: TimelineRow, shown: Sequence[Stretch], begin_ns: int, end_ns: int, zone: tzinfo | None) -> str:
    cells = []
    for one in shown:
        label = one.label.replace("_", " ")
        start_ns = begin_ns + one.begin * (end_ns - begin_ns) // COLUMNS
        by = f", by {one.by}" if one.by else ""
        lasted = f" for {duration_text(one.lasted_ns / NS_PER_S)}" if one.lasted_ns else ""
        often = f", {one.count} times about here" if one.count > 1 else lasted
        title = f"{label}{by} {'from' if one.lasted_ns else 'at'} {time_of_day(start_ns, zone)}{often}"
        left, width = 100 * one.begin / COLUMNS, 100 * (one.end - one.begin) / COLUMNS
        word = f"<i>{escape(label)}</i>" if width > 7 else ""
        cells.append(
            f'<span class="{row.style(one.label)}" style="left:{left:.2f}%;width:{width:.2f}%" '
            f'title="{escape(title)}">{word}</span>'
        )
    return f'<div class="lane"><b>{escape(row.name)}</b><div>{"".join(cells)}</div></div>'
