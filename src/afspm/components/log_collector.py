"""`LogCollector`: the log lines of all processes, also on other computers, in one file."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import ClassVar, Literal

from afspm.basics.clock import iso_utc
from afspm.client.component import Component
from afspm.components.line_file import LineFile
from afspm.model import LogLine
from afspm.model.events import LogLines

_WRITTEN_NS = "written_ns"


class LogCollector(Component):
    """One log file of all processes of an experiment, on all its computers.

    On one computer `log.txt` in the run folder has all lines already. On several, each computer has a `log.txt` of its
    own processes; the scheduler also publishes the lines, from INFO on, and this component writes them.

    Args:
        file: name of the file in the run folder.
        level: lowest level that is written.
    """

    listens: ClassVar = ("LogLines",)
    file_suffix: ClassVar[str] = ""

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
    """Return a line in the file's format: experiment time, level, process, text."""
    text = line.text.replace("\n", "\n    ")
    return f"{iso_utc(line.time_ns)} {line.level:8} {line.name:16} {text}"
