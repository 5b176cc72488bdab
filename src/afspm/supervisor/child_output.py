"""The output of one child: its lines, and a limit to how much of it is kept."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from afspm.basics.clock import ExperimentClock

AT_ONCE = 500_000
BYTES_PER_S = 5_000
"""For as long as it likes: 0.2 GB in a night of ten hours."""
PAUSE_S = 10.0
"""So long lines are left out at a time."""
LAST_BYTES = 10_000
"""Of what was held back the last goes on after all: what matters most, a traceback, comes at the end."""
STAMP_BYTES = 100
"""What a line costs besides its text: stamp and name in the file, and its place in memory."""

Stream = Literal["stdout", "stderr"]


@dataclass(frozen=True, slots=True)
class OutputLine:
    """A child wrote a line."""

    name: str
    pid: int
    stream: Stream
    line: str


@dataclass(frozen=True, slots=True)
class OutputDropped:
    """A child writes more than can be kept: so many lines of it are left out here."""

    name: str
    lines: int


class OutputLimit:
    """Which lines of a stream go on, and which are left out.

    A stream has AT_ONCE to its credit, and gets BYTES_PER_S. Once that is used up it pauses: from then on its lines are
    left out until `go_on` is called, PAUSE_S later or at the end of the stream.
    """

    def __init__(self, now_s: float) -> None:
        self._credit, self._credited_s = float(AT_ONCE), now_s
        self._left_out = self._last_bytes = 0
        self._last: deque[bytes] = deque()
        self.pausing = False

    def passes(self, line: bytes, now_s: float) -> bool:
        """Return whether a line is to go on now. If not it is held back, as one that may be the last.

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
        """End the pause: how many lines were left out for good, and those after them, which are to go on now."""
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
    """Tells what a stream of a child says, as far as that can be kept.

    The child never has to wait for us: a driver that says much must not become slow.
    """

    def __init__(self, name: str, pid: int, stream: Stream, tell: Callable[[OutputLine | OutputDropped], None]) -> None:
        self._name, self._pid, self._stream, self._tell = name, pid, stream, tell
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
        """Nothing more comes."""
        if self._pause is not None:
            self._pause.cancel()
        self._go_on()

    def _go_on(self) -> None:
        with self._lock:
            left_out, last = self._thinning.go_on()
            if left_out:
                self._tell(OutputDropped(self._name, left_out))
            for line in last:
                self._tell_line(line)

    def _tell_line(self, line: bytes) -> None:
        text = line.decode("utf-8", errors="replace").rstrip("\r\n")
        self._tell(OutputLine(self._name, self._pid, self._stream, text))
