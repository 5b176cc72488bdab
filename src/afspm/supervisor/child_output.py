"""Output lines of one child process, and a limit on their rate."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from afspm.basics.clock import ExperimentClock

# bytes: a start with many warnings, or a few tracebacks, pass in full
AT_ONCE = 500_000
BYTES_PER_S = 5_000
"""Sustained rate: 0.2 GB in a night of ten hours."""
PAUSE_S = 10.0
"""Real time for which lines are dropped once the limit is exceeded."""
LAST_BYTES = 10_000
"""Size of the last lines that are kept after a pause: a traceback, the most important part, comes last."""
STAMP_BYTES = 100
"""Size of a line besides its text: time and name in the file, overhead in memory."""

Stream = Literal["stdout", "stderr"]


@dataclass(frozen=True, slots=True)
class OutputLine:
    """An output line of a child."""

    name: str
    pid: int
    stream: Stream
    line: str


@dataclass(frozen=True, slots=True)
class OutputDropped:
    """The number of a child's lines dropped in one pause, because its output exceeded the limit."""

    name: str
    lines: int


class OutputLimit:
    """Rate limit on the lines of one stream.

    A stream may write AT_ONCE bytes in a burst, and then BYTES_PER_S. Above that a pause begins: all its lines are
    dropped except the last LAST_BYTES. `go_on` ends the pause, after PAUSE_S or at the end of the stream.
    """

    def __init__(self, now_s: float) -> None:
        self._credit, self._credited_s = float(AT_ONCE), now_s
        self._left_out = self._last_bytes = 0
        self._last: deque[bytes] = deque()
        self.pausing = False

    def passes(self, line: bytes, now_s: float) -> bool:
        """Return whether a line passes now; otherwise hold the line back, as it may be among the last lines.

        Args:
            now_s: real monotonic time.
        """
        if not self.pausing:
            credit = self._credit + (now_s - self._credited_s) * BYTES_PER_S
            self._credit, self._credited_s = min(credit, AT_ONCE) - len(line) - STAMP_BYTES, now_s
            self.pausing = self._credit < 0.0
        if self.pausing:
            self._hold(line)
        return not self.pausing

    def go_on(self) -> tuple[int, list[bytes]]:
        """End the pause; return the number of dropped lines, and the last lines, which pass now."""
        left_out, last = self._left_out, list(self._last)
        self._left_out = self._last_bytes = 0
        self._last.clear()
        self.pausing = False
        return left_out, last

    def _hold(self, line: bytes) -> None:
        self._last.append(line)
        self._last_bytes += len(line) + STAMP_BYTES
        while self._last_bytes > LAST_BYTES and len(self._last) > 1:
            self._last_bytes -= len(self._last.popleft()) + STAMP_BYTES
            self._left_out += 1


class ChildOutput:
    """A reporter of a child's output lines, within the limit.

    The child never waits for the supervisor: a driver that logs much must not slow down.
    """

    def __init__(self, name: str, pid: int, stream: Stream, tell: Callable[[OutputLine | OutputDropped], None]) -> None:
        self._name, self._pid, self._stream, self._report = name, pid, stream, tell
        self._clock = ExperimentClock.real()
        self._thinning = OutputLimit(self._clock.monotonic_s())
        self._lock = threading.Lock()
        self._pause: threading.Timer | None = None

    def take(self, line: bytes) -> None:
        with self._lock:
            was_pausing = self._thinning.pausing
            if self._thinning.passes(line, self._clock.monotonic_s()):
                self._tell_line(line)
            elif not was_pausing:
                # a timer, and not the next line: after a flood there may be silence
                self._pause = threading.Timer(PAUSE_S, self._go_on)
                self._pause.daemon = True
                self._pause.start()

    def end(self) -> None:
        """Report the withheld lines, at the end of the stream."""
        if self._pause is not None:
            self._pause.cancel()
        self._go_on()

    def _go_on(self) -> None:
        with self._lock:
            left_out, last = self._thinning.go_on()
            if left_out:
                self._report(OutputDropped(self._name, left_out))
            for line in last:
                self._tell_line(line)

    def _tell_line(self, line: bytes) -> None:
        text = line.decode("utf-8", errors="replace").rstrip("\r\n")
        self._report(OutputLine(self._name, self._pid, self._stream, text))
