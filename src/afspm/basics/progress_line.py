"""A line on the terminal that shows how far slow work is."""

from __future__ import annotations

import shutil
import sys
import threading
from contextlib import suppress
from types import TracebackType
from typing import Self, TextIO

from afspm.basics.clock import ExperimentClock
from afspm.basics.formatting import duration_text


class ProgressLine:
    """A line of text and elapsed time below the output, from two seconds after the begin of the work to its end.

    A thread draws the line, since one step of the work may take long. Where the stream is not a terminal, nothing is
    drawn.

    Args:
        text: description of the work, such as "writing the report".
        quiet: whether to draw nothing in any case.
        stream: where to draw; None: sys.stderr, so that output to a pipe stays clean.
        after_s: duration of quick work, which shows no line.
        every_s: time between two drawings: the seconds in the line go on, so that slow work is not taken for a hang.
    """

    def __init__(
        self,
        text: str,
        *,
        quiet: bool = False,
        stream: TextIO | None = None,
        after_s: float = 2.0,
        every_s: float = 0.5,
    ) -> None:
        self._text, self._step = text, ""
        self._stream = sys.stderr if stream is None else stream
        self._is_drawn = not quiet and self._stream.isatty()
        self._after_s, self._every_s = after_s, every_s
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._width = 0
        self._clock = ExperimentClock.real()
        self._began_s = self._clock.monotonic_s()
        self._thread = threading.Thread(target=self._draw_on, name="progress", daemon=True)

    def step(self, text: str) -> None:
        """Set the text of the step under way, such as "scan 3 of 26"."""
        self._step = text

    def say(self, text: str) -> None:
        """Write a whole line above the line of the progress, also where that is not drawn."""
        with self._lock:
            self._erase()
            self._stream.write(f"{text}\n")
            self._stream.flush()

    def __enter__(self) -> Self:
        if self._is_drawn:
            self._thread.start()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._over.set()
        if self._is_drawn:
            self._thread.join()

    def _draw_on(self) -> None:
        wait_s = self._after_s
        with suppress(OSError, ValueError):  # the terminal has gone: the work goes on
            while not self._over.wait(wait_s):
                self._draw()
                wait_s = self._every_s
            with self._lock:
                self._erase()

    def _draw(self) -> None:
        took = duration_text(self._clock.monotonic_s() - self._began_s)
        line = " · ".join(part for part in (self._text, self._step, took) if part)
        with self._lock:
            self._erase()
            # one column less than the terminal has: a full line would wrap, and could not be erased
            line = line[: max(0, shutil.get_terminal_size().columns - 1)]
            self._stream.write(line)
            self._stream.flush()
            self._width = len(line)

    def _erase(self) -> None:
        if self._width:
            self._stream.write(f"\r{' ' * self._width}\r")
            self._stream.flush()
            self._width = 0
