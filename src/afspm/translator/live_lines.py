"""Lines of a running scan, for those who want to watch: published while it goes on, and kept nowhere."""

from __future__ import annotations

from dataclasses import replace

from afspm.clock import NS_PER_S
from afspm.translator.driver import Driver
from afspm.wire import encode


class LiveLines:
    """Knows which lines of the running scan have been published. Times are of the experiment.

    Args:
        microscope: its `live_lines_s` says how often it is asked for lines; None: never.
    """

    def __init__(self, microscope: Driver) -> None:
        self._microscope = microscope
        self._every_s = microscope.live_lines_s
        self._began_ns = 0
        self._lines = 0
        self.due_s: float | None = None
        """When to `look` next; None: not before another scan begins."""

    def begin(self, now_ns: int) -> None:
        """A scan began."""
        if self._every_s is not None:
            self._began_ns, self._lines = now_ns, 0
            self.due_s = now_ns / NS_PER_S + self._every_s

    def end(self) -> None:
        """It is over: the whole of it comes, or nothing more."""
        self.due_s = None

    def look(self, now_s: float) -> list[tuple[str, bytes]]:
        """If it is time: the messages with the lines that are new."""
        if self._every_s is None or self.due_s is None or now_s < self.due_s:
            return []
        self.due_s = now_s + self._every_s
        new = self._microscope.lines(self._lines)
        self._lines += max((len(lines.values) for lines in new), default=0)
        return [encode(replace(lines, began_ns=self._began_ns)) for lines in new if len(lines.values)]
