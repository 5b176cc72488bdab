"""Successive spans of time."""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass, field, replace

MOST_SPANS = 20_000


@dataclass(frozen=True, slots=True)
class Span:
    """A span of time.

    Attributes:
        label: the state during the span.
        start_ns, end_ns: experiment time; an end of None: the span continues.
        by: the component or person that caused the state; empty if unknown.
    """

    label: str
    start_ns: int
    end_ns: int | None = None
    by: str = ""

    def lasted_ns(self, now_ns: int) -> int:
        end_ns = now_ns if self.end_ns is None else min(self.end_ns, now_ns)
        return max(0, end_ns - self.start_ns)


class Timeline:
    """Successive spans, with gaps. Beyond the limit, the oldest spans are dropped."""

    def __init__(self, most: int = MOST_SPANS) -> None:
        self.spans: deque[Span] = deque(maxlen=most)
        self.changed_ns: int | None = None
        """The time of the last change, to a span or to a gap."""

    @property
    def now(self) -> Span | None:
        """The current span, or None."""
        return self.spans[-1] if self.spans and self.spans[-1].end_ns is None else None

    def change(self, label: str | None, time_ns: int, by: str = "") -> None:
        """Start a span of this label at `time_ns`; None: a gap. Older changes and equal labels are ignored."""
        if self.changed_ns is not None and time_ns < self.changed_ns:
            return
        now = self.now
        if self.changed_ns is not None and label == (now.label if now else None):
            return
        self.changed_ns = time_ns
        if now is not None:
            self.spans[-1] = replace(now, end_ns=time_ns)
        if label is not None:
            self.spans.append(Span(label, time_ns, by=by))

    def name_last(self, by: str) -> None:
        """Set the author of the last span, unless the author is known."""
        if self.spans and not self.spans[-1].by:
            self.spans[-1] = replace(self.spans[-1], by=by)

    def at(self, time_ns: int) -> Span | None:
        """Return the span that contains a time; None in a gap."""
        for span in reversed(self.spans):
            if span.start_ns <= time_ns:
                return span if span.end_ns is None or time_ns < span.end_ns else None
        return None

    def lasted_ns(self, now_ns: int) -> dict[str, int]:
        """Return the total duration of each label, in the order of first occurrence."""
        total: dict[str, int] = {}
        for span in self.spans:
            total[span.label] = total.get(span.label, 0) + span.lasted_ns(now_ns)
        return total


@dataclass(slots=True)
class Timelines:
    """The timelines of control and microscope.

    Attributes:
        control: the holders.
        mode, scope_state: labels in lower case.
        problems: the timeline of each problem, by number.
    """

    control: Timeline = field(default_factory=Timeline)
    mode: Timeline = field(default_factory=Timeline)
    scope_state: Timeline = field(default_factory=Timeline)
    problems: defaultdict[int, Timeline] = field(default_factory=lambda: defaultdict(Timeline))
