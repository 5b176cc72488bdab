"""What was so from when to when, as rows of coloured stretches over the whole run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from afspm.clock import NS_PER_S
from afspm.dashboard.words import colour_class, escape
from afspm.formatting import duration_text, time_of_day
from afspm.record.overview import Overview, Span, Timeline

NOT_HEARD_OF = "not heard of"
COLUMNS = 720  # stretches narrower than this part of the run are put together
_STEPS_S = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, 86400)


@dataclass(frozen=True)
class Row:
    """One row of the time line."""

    name: str
    spans: Iterable[Span]
    style: Callable[[str], str]


def rows_of(overview: Overview, unheard: Mapping[str, int]) -> list[Row]:
    """Control, mode, scope state, each problem, each process."""
    rows = [
        Row("control", overview.controls.spans, colour_class),
        Row("mode", overview.modes.spans, lambda label: f"mode-{label}"),
        Row("microscope", overview.states.spans, lambda label: f"state-{label.replace('_', '-')}"),
    ]
    for number, lane in sorted(overview.problem_timelines.items()):
        if lane.spans:
            rows.append(Row(overview.problems.name(number), lane.spans, lambda label: "problem"))
    for name, lane in overview.process_timelines.items():
        spans = _as_last_told(lane, overview.processes_told_ns[name]) if name in unheard else lane.spans
        rows.append(Row(name, spans, lambda label: f"process-{label.replace(' ', '-')}"))
    return rows


def _as_last_told(lane: Timeline, told_ns: int) -> Iterator[Span]:
    """What was so until it was told of last; since then nobody knows."""
    for span in lane.spans:
        yield replace(span, end_ns=max(told_ns, span.start_ns)) if span.end_ns is None else span
    if lane.now is not None:
        yield Span(NOT_HEARD_OF, told_ns)


def time_line_html(overview: Overview, now_ns: int, unheard: Mapping[str, int] = MappingProxyType({})) -> str:
    """The rows over the whole run until `now_ns`, experiment time; `unheard` of processes as in `Content`."""
    rows = [(row, tuple(row.spans)) for row in rows_of(overview, unheard)]
    starts = [spans[0].start_ns for _, spans in rows if spans]
    if not starts:
        return '<p class="nothing">Nothing has been heard yet.</p>'
    begin_ns = min(starts)
    now_ns = max(now_ns, begin_ns + NS_PER_S)
    body = "".join(_row(row, spans, begin_ns, now_ns) for row, spans in rows)
    ticks = "".join(
        f'<span class="tick-x" style="left:{_percent(s * NS_PER_S, begin_ns, now_ns):.2f}%">'
        f"{time_of_day(round(s * NS_PER_S), seconds=False)}</span>"
        for s in time_ticks(begin_ns / NS_PER_S, now_ns / NS_PER_S)
    )
    return f'<div class="lanes">{body}<div class="lane-axis"><b></b><div>{ticks}</div></div></div>'


def time_ticks(begin_s: float, end_s: float, about: int = 7) -> list[float]:
    """Round times of day between two, seconds since the epoch."""
    step = next((s for s in _STEPS_S if (end_s - begin_s) / s <= about), _STEPS_S[-1])
    first = -(-begin_s // step) * step
    return [first + i * step for i in range(int((end_s - first) // step) + 1)] if first <= end_s else []


@dataclass
class _Stretch:
    begin: int
    end: int
    label: str
    by: str
    lasted_ns: int
    count: int = 1


def stretches(spans: Sequence[Span], begin_ns: int, now_ns: int) -> list[_Stretch]:
    """Spans in columns of the picture. Of several that fall into one column the longest is shown, and says so."""
    width_ns = (now_ns - begin_ns) / COLUMNS
    found: list[_Stretch] = []
    for span in spans:
        end_ns = now_ns if span.end_ns is None else min(span.end_ns, now_ns)
        begin = min(COLUMNS - 1, max(0, int((span.start_ns - begin_ns) / width_ns)))
        end = max(begin + 1, min(COLUMNS, round((end_ns - begin_ns) / width_ns)))
        one = _Stretch(begin, end, span.label, span.by, max(0, end_ns - span.start_ns))
        if found and one.begin < found[-1].end:
            before = found[-1]
            if one.end <= before.end:
                _merge(before, one)
                continue
            one.begin = before.end
        if found and found[-1].end == one.begin and found[-1].label == one.label and one.end - one.begin <= 1:
            found[-1].end, found[-1].lasted_ns = one.end, found[-1].lasted_ns + one.lasted_ns
            found[-1].count += 1
            continue
        found.append(one)
    return found


def _merge(into: _Stretch, one: _Stretch) -> None:
    if one.lasted_ns > into.lasted_ns and into.end - into.begin <= 1:
        into.label, into.by = one.label, one.by
    into.lasted_ns = max(into.lasted_ns, one.lasted_ns)
    into.count += 1


def _row(row: Row, spans: Sequence[Span], begin_ns: int, now_ns: int) -> str:
    cells = "".join(_cell(row, one, begin_ns, now_ns) for one in stretches(spans, begin_ns, now_ns))
    return f'<div class="lane"><b>{escape(row.name)}</b><div>{cells}</div></div>'


def _cell(row: Row, one: _Stretch, begin_ns: int, now_ns: int) -> str:
    start_ns = begin_ns + one.begin * (now_ns - begin_ns) // COLUMNS
    by = f", by {one.by}" if one.by else ""
    often = f", {one.count} times about here" if one.count > 1 else f" for {duration_text(one.lasted_ns / NS_PER_S)}"
    title = f"{one.label.replace('_', ' ')}{by} from {time_of_day(start_ns)}{often}"
    left, width = 100 * one.begin / COLUMNS, 100 * (one.end - one.begin) / COLUMNS
    word = f"<i>{escape(one.label.replace('_', ' '))}</i>" if width > 7 else ""
    return (
        f'<span class="{row.style(one.label)}" style="left:{left:.2f}%;width:{width:.2f}%" title="{escape(title)}">'
        f"{word}</span>"
    )


def _percent(time_ns: float, begin_ns: int, now_ns: int) -> float:
    return 100.0 * (time_ns - begin_ns) / (now_ns - begin_ns)
