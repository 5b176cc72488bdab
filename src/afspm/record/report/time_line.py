"""The time line of a run as SVG, in colours of the page around it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC
from html import escape

from afspm.formatting import day_and_time, time_of_day
from afspm.record.report.story import RunStory, in_trouble, states_in_words
from afspm.record.timeline import Span

WIDTH, LABELS, LANE, BAR = 1000, 170, 22, 14
LEAST = 1.2  # what is too short to be seen is drawn so wide that it is
HOUR_NS = 3600 * 1_000_000_000
STEPS_H = (1 / 60, 2 / 60, 5 / 60, 10 / 60, 0.25, 0.5, 1, 2, 4, 6, 12, 24, 48, 96, 168)
MOST_TICKS = 12
COLOURS = 5  # of those in control, in turn: the classes c0 to c4 of the page


@dataclass(frozen=True)
class TimelineRow:
    """A lane as it is drawn; `style` is a class of the page."""

    label: str
    style: str
    spans: Sequence[Span]


def draw(story: RunStory) -> str:
    """An `<svg>` with a row for each in control, mode, problem, state, and process that was not well."""
    rows = list(_rows(story))
    height = LANE * len(rows) + 30
    parts = [
        f'<svg viewBox="0 0 {WIDTH} {height}" class="timeline" role="img" aria-label="time line of the run">',
        *_axis(story, LANE * len(rows)),
    ]
    for number, row in enumerate(rows):
        y = LANE * number
        parts.append(f'<text x="{LABELS - 8}" y="{y + 15}" text-anchor="end">{escape(row.label)}</text>')
        parts.append(f'<line x1="{LABELS}" x2="{WIDTH}" y1="{y + LANE}" y2="{y + LANE}" class="rule"/>')
        parts += _bars(story, row, y + (LANE - BAR) / 2)
    return "".join([*parts, "</svg>"])


def colours(story: RunStory) -> dict[str, str]:
    """The class of each who was in control."""
    holders = dict.fromkeys(span.label for span in story.overview.controls.spans)
    return {holder: f"c{number % COLOURS}" for number, holder in enumerate(holders)}


def _rows(story: RunStory) -> Iterator[TimelineRow]:
    seen = story.overview
    for holder, style in colours(story).items():
        yield TimelineRow(holder, style, [span for span in seen.controls.spans if span.label == holder])
    manual = [span for span in seen.modes.spans if span.label == "manual"]
    if manual:
        yield TimelineRow("MANUAL", "manual", manual)
    for lane in seen.problem_timelines.values():
        if lane.spans:
            yield TimelineRow(lane.spans[0].label, "problem", lane.spans)
    for label in dict.fromkeys(span.label for span in seen.states.spans):
        if label not in ("free", "undefined"):
            style = "problem" if label == "interrupted" else "state"
            yield TimelineRow(
                states_in_words(label), style, [span for span in seen.states.spans if span.label == label]
            )
    for name, lane in seen.process_timelines.items():
        if trouble := in_trouble(lane):
            yield TimelineRow(f"{name} not well", "problem", trouble)
    again = [Span(f"{one.name} started again: {one.last_exit}", one.time_ns, one.time_ns) for one in story.restarts]
    if again:
        yield TimelineRow("restarts", "problem", again)


def _bars(story: RunStory, row: TimelineRow, y: float) -> Iterator[str]:
    for span in _merged(row.spans, story):
        x0, x1 = (_x(story, time_ns) for time_ns in (span.start_ns, _end(span, story)))
        until = f"{day_and_time(span.start_ns, UTC)} to {day_and_time(_end(span, story), UTC)}"
        title = f"{span.label}{f', by {span.by}' if span.by else ''}: {until}"
        yield (
            f'<rect x="{x0:.2f}" y="{y:.1f}" width="{max(x1 - x0, LEAST):.2f}" height="{BAR}" class="{row.style}">'
            f"<title>{escape(title)}</title></rect>"
        )


def _merged(spans: Iterable[Span], story: RunStory) -> Iterator[Span]:
    """What can't be told apart at this width as one: a week of short scans must not be a page of megabytes."""
    near_ns = story.lasted_ns / (WIDTH - LABELS) * 0.4
    last: Span | None = None
    for span in spans:
        if last is not None and last.by == span.by and span.start_ns - _end(last, story) < near_ns:
            last = Span(last.label, last.start_ns, _end(span, story), last.by)
            continue
        if last is not None:
            yield last
        last = span
    if last is not None:
        yield last


def _axis(story: RunStory, bottom: float) -> Iterator[str]:
    span_h = story.lasted_ns / HOUR_NS
    step_h = next((step for step in STEPS_H if span_h / step <= MOST_TICKS), STEPS_H[-1])
    for number in range(math.floor(span_h / step_h) + 1):
        at_ns = story.start_ns + round(number * step_h * HOUR_NS)
        x = _x(story, at_ns)
        yield f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{bottom}" class="tick"/>'
        told = time_of_day(at_ns, UTC, seconds=False)
        anchor = "end" if x > WIDTH - 20 else "start" if number == 0 else "middle"
        yield f'<text x="{x:.1f}" y="{bottom + 18}" text-anchor="{anchor}">{told}</text>'


def _x(story: RunStory, time_ns: int) -> float:
    part = (time_ns - story.start_ns) / max(1, story.lasted_ns)
    return LABELS + (WIDTH - LABELS) * min(1.0, max(0.0, part))


def _end(span: Span, story: RunStory) -> int:
    return story.end_ns if span.end_ns is None else span.end_ns
