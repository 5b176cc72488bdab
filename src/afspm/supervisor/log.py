"""One log of a run: lines of all processes, in log.txt and, with names in colour, in the terminal."""

from __future__ import annotations

import contextlib
import logging
import re
import sys
import threading
import zlib
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TextIO

from afspm.basics import time_of_day
from afspm.basics.clock import NS_PER_S, Clock, ExperimentClock
from afspm.basics.formatting import day_and_time
from afspm.model.events import LOGGED_AS
from afspm.storage.atomic import SLOW_S
from afspm.storage.disk import SYNCER

if TYPE_CHECKING:
    from rich.console import Console

CLOCK = ExperimentClock.real()
# lines that wait for a blocked terminal or disk; beyond it the oldest are dropped
MOST_UNSHOWN = 10_000
_HANGS = "the disk has not answered for {:.0f} s: log.txt is written once it does, and the run goes on"
COLOURS = ("cyan", "green", "magenta", "blue", "bright_cyan", "bright_green", "bright_magenta", "bright_blue")
LEVEL_STYLES = {logging.WARNING: "yellow", logging.ERROR: "bold red", logging.CRITICAL: "bold red"}
_LEVELS = {name: getattr(logging, name) for name in ("DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL")}
_LEVELLED = re.compile(rf"(?P<level>{'|'.join(_LEVELS)})\b:?\s*(?P<text>.*)", re.DOTALL)


class LineReader:
    """A parser of the log levels in one process's output lines.

    On stderr a line may begin with its level ("WARNING the tip is blunt"), as afspm's lines do. Lines without a level
    belong to the line before: a traceback below an ERROR. Lines before the first level are warnings, since a program
    that writes to stderr before its log is set up reports a problem. Lines on stdout are information.
    """

    def __init__(self) -> None:
        self._level: int = logging.WARNING
        self.last_error = ""
        """First line of the last error."""
        self.last_warning = ""

    def read(self, stream: Literal["stdout", "stderr"], line: str) -> tuple[int, str]:
        """Return the level (as in `logging`) and the text of a line."""
        if stream == "stdout":
            return logging.INFO, line
        match = _LEVELLED.match(line)
        if match is None:
            return self._level, line
        self._level = _LEVELS[match["level"]]
        if self._level >= logging.ERROR:
            self.last_error = match["text"]
        elif self._level >= logging.WARNING:
            self.last_warning = match["text"]
        return self._level, match["text"]


class RunLog:
    """The log of a run: all lines in `file`, lines from `level` up in the terminal. `names` are padded to one width.

    Neither a terminal that has gone or blocks (text marked in it, Ctrl-S) nor a disk that is full or hangs may stop a
    measurement, so each has a thread of its own. A line from `level` up that one of them loses is still in the other.
    """

    def __init__(
        self,
        file: Path,
        clock: Clock,
        *,
        terminal: TextIO | None = None,
        level: int = logging.INFO,
        names: Iterable[str] = (),
        shown_within_s: float = 2.0,
        slow_s: float = SLOW_S,
    ) -> None:
        self._slow_s = slow_s
        # the time at the end for the lines that wait for a blocked terminal
        self._file = _Shown(*_writer_to(file), within_s=shown_within_s)
        self._clock = clock
        self._wall = ExperimentClock.real()
        self._level = level
        terminal = terminal or sys.stdout
        self.listener: Callable[[str, int, str], None] = lambda name, level, text: None
        """Function that is called with the arguments of each `write`."""
        self._hangs = False
        self._shown = _Shown(_coloured(terminal) if terminal.isatty() else _plain(terminal), within_s=shown_within_s)
        self._widest = max(map(len, (LOGGED_AS, *names)))

    def write(self, name: str, level: int, text: str) -> None:
        """Write one line of the process `name`; `level` is a number of `logging`."""
        wall_ns = self._wall.now_ns()
        stamp = f"{day_and_time(wall_ns)}.{wall_ns // 1_000_000 % 1000:03d}{self._experiment_time()}"
        self._file.add(stamp, f"{name:{self._widest}}", level, text)
        self._tell(name, level, text, wall_ns)
        hung, self._hangs = self._hangs, self._file.hangs(self._slow_s)
        if self._hangs and not hung:
            self._tell(LOGGED_AS, logging.WARNING, _HANGS.format(self._slow_s), wall_ns)

    def _tell(self, name: str, level: int, text: str, wall_ns: int) -> None:
        self.listener(name, level, text)
        if level >= self._level:
            self._shown.add(time_of_day(wall_ns), f"{name:{self._widest}}", level, text)

    def _experiment_time(self) -> str:
        # empty where the experiment's time is the wall clock's
        now_ns = self._clock.now_ns()
        if abs(now_ns - self._wall.now_ns()) < NS_PER_S:
            return ""
        return f" [{day_and_time(now_ns)}]"

    def close(self) -> None:
        """Write and show the waiting lines, as far as file and terminal accept them in time."""
        self._shown.close()
        self._file.close()


def colour_of(name: str) -> str:
    """Return the colour of a process name: the same in every run and on every computer."""
    return COLOURS[zlib.crc32(name.encode()) % len(COLOURS)]


Show = Callable[[str, str, int, str], None]


class _Shown:
    """A writer of lines in a thread of its own, which may wait for the terminal or the disk."""

    def __init__(self, show: Show, finish: Callable[[], None] = lambda: None, *, within_s: float) -> None:
        self._show, self._within_s = show, within_s
        self._finish = finish
        self._lines: deque[tuple[str, str, int, str]] = deque(maxlen=MOST_UNSHOWN)
        self._changed = threading.Condition()
        self._closing = False
        self._busy_since_s: float | None = None
        self._thread = threading.Thread(target=self._run, name="terminal", daemon=True)
        self._thread.start()

    def add(self, time: str, name: str, level: int, text: str) -> None:
        """Append a line; if the queue is full, the oldest line is dropped."""
        with self._changed:
            self._lines.append((time, name, level, text))
            self._changed.notify()

    def close(self) -> None:
        """Write the waiting lines, for `within_s` at most."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(self._within_s)

    def _run(self) -> None:
        while (line := self._next()) is not None:
            with contextlib.suppress(OSError, ValueError):
                self._show(*line)
            self._busy_since_s = None
        with contextlib.suppress(OSError):  # lines that wait for room on a full disk are lost at exit
            self._finish()

    def hangs(self, longer_than_s: float) -> bool:
        """Return whether writing one line has taken longer than `longer_than_s`."""
        since_s = self._busy_since_s
        return since_s is not None and CLOCK.monotonic_s() - since_s > longer_than_s

    def _next(self) -> tuple[str, str, int, str] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._lines or self._closing)
            self._busy_since_s = CLOCK.monotonic_s() if self._lines else None
            return self._lines.popleft() if self._lines else None


def _writer_to(path: Path) -> tuple[Show, Callable[[], None]]:
    file = path.open("a", encoding="utf-8", errors="replace")
    SYNCER.folder_soon(path.parent)

    def show(stamp: str, name: str, level: int, text: str) -> None:
        file.write(f"{stamp} {logging.getLevelName(level):8} {name} {text}\n")
        file.flush()
        SYNCER.soon(file.fileno())  # after a power cut only the last moment is missing

    return show, file.close


def _plain(terminal: TextIO) -> Show:
    def show(time: str, name: str, level: int, text: str) -> None:
        mark = "" if level < logging.WARNING else f"{logging.getLevelName(level)} "
        terminal.write(f"{time} {name} {mark}{text}\n")
        terminal.flush()

    return show


def _coloured(terminal: TextIO) -> Show:
    from rich.console import Console
    from rich.text import Text

    console: Console = Console(file=terminal, highlight=False, soft_wrap=True)

    def show(time: str, name: str, level: int, text: str) -> None:
        line = Text.assemble((time, "dim"), " ", (name, colour_of(name.strip())), " ")
        line.append(text, style=LEVEL_STYLES.get(level, ""))
        console.print(line)

    return show
