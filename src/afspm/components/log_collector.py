"""`LogCollector`: the log lines of all processes, of several computers, in one file."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import ClassVar, Literal

from afspm.basics.clock import iso_utc
from afspm.client.component import Component
from afspm.components.line_file import LineFile
from afspm.model import LogLine, LogLines

_WRITTEN_NS = "written_ns"


class LogCollector(Component):
    """Writes what every process of the experiment logs to one file, wherever it runs.

    On one computer `log.txt` in the run folder is that already. On several, each has a `log.txt` of its own processes;
    their supervisors also have the scheduler publish the lines, from INFO on, and this component writes these.

    Args:
        file: its name in the run folder.
        level: the least that is written.
    """

    listens: ClassVar = ("LogLines",)

    def __init__(self, file: str = "log-all.txt", level: Literal["INFO", "WARNING", "ERROR"] = "INFO") -> None:
        self.file = file
        self.level = logging.getLevelNamesMapping()[level]

    def on_start(self) -> None:
        self._lines = LineFile(Path(self.run_dir) / self.file)

    def on_message(self, envelope: str, message: object) -> None:
        time_ns = (self.packet and self.packet.time_ns) or 0
        # after a restart the scheduler sends what it has cached again
        if isinstance(message, LogLines) and time_ns > self.memory.get(_WRITTEN_NS, -1):
            self._lines.append(formatted(line) for line in message.lines if self._is_wanted(line))
            self.memory[_WRITTEN_NS] = time_ns

    def _is_wanted(self, line: LogLine) -> bool:
        return logging.getLevelNamesMapping().get(line.level, logging.INFO) >= self.level


def formatted(line: LogLine) -> str:
    """Return a line as it is written: time in the experiment, level, process, text."""
    text = line.text.replace("\n", "\n    ")
    return f"{iso_utc(line.time_ns)} {line.level:8} {line.name:16} {text}"
