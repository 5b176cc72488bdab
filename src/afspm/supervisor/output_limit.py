"""How much one process may say: a component that prints in a loop must fill neither memory nor disk. Decisions only."""

from __future__ import annotations

from collections import deque

AT_ONCE = 500_000
BYTES_PER_S = 5_000
"""For as long as it likes: 0.2 GB in a night of ten hours."""
PAUSE_S = 10.0
"""So long lines are left out at a time."""
LAST_BYTES = 10_000
"""Of what was held back the last goes on after all: what matters most, a traceback, comes at the end."""
STAMP_BYTES = 100
"""What a line costs besides its text: stamp and name in the file, and its place in memory."""


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
        """Whether a line is to go on now. If not it is held back, as one that may be the last.

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
