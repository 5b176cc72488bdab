"""The rows of a run's time line."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import UTC

from afspm.drawing.timeline import TimelineRow, timeline_html
from afspm.record.report.story import RunStory, in_trouble, states_in_words
from afspm.record.timeline import Span

COLOURS = 5  # of those in control, in turn: the classes c0 to c4 of the page


def draw(story: RunStory) -> str:
    """Return a row for each in control, mode, problem, state, and process that was not well."""
    return timeline_html(_rows(story), story.start_ns, story.end_ns, UTC)


def colours(story: RunStory) -> dict[str, str]:
    """Return the class of each component that was in control."""
    holders = dict.fromkeys(span.label for span in story.overview.controls.spans)
    return {holder: f"c{number % COLOURS}" for number, holder in enumerate(holders)}


def _rows(story: RunStory) -> Iterator[TimelineRow]:
    seen = story.overview
    for holder, style in colours(story).items():
        yield _row(holder, style, (span for span in seen.controls.spans if span.label == holder))
    manual = [span for span in seen.modes.spans if span.label == "manual"]
    if manual:
        yield _row("MANUAL", "manual", manual)
    for lane in seen.problem_timelines.values():
        if lane.spans:
            yield _row(lane.spans[0].label, "problem", lane.spans)
    for label in dict.fromkeys(span.label for span in seen.states.spans):
        if label not in ("free", "undefined"):
            style = "problem" if label == "interrupted" else "state"
            yield _row(states_in_words(label), style, (span for span in seen.states.spans if span.label == label))
    for name, lane in seen.process_timelines.items():
        if trouble := in_trouble(lane):
            yield _row(f"{name} not well", "problem", trouble)
    again = [Span(f"{one.name} started again: {one.last_exit}", one.time_ns, one.time_ns) for one in story.restarts]
    if again:
        yield _row("restarts", "problem", again)


def _row(name: str, style: str, spans: Iterable[Span]) -> TimelineRow:
    return TimelineRow(name, spans, lambda _: style)
