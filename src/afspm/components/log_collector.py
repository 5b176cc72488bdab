"""`LogCollector`: the log lines of all processes, of several computers, in one file."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from afspm.addresses import ListeningAddress
from afspm.client.component import Component
from afspm.clock import iso_utc
from afspm.components.line_file import LineFile

if TYPE_CHECKING:
    from afspm.process.context import ProcessContext
    from afspm.transport.log_link import LogLine


REST_S = 0.8  # real: what is waited for others' last words


class LogCollector(Component):
    """Writes what every process of the experiment logs to one file, wherever it runs.

    On one computer `log.txt` in the run folder is that already. On several, each has a `log.txt` of its own processes;
    with this component in the experiment file they all send their lines to its address as well. What is said while it
    is not running is in those files only.

    Args:
        address: where it listens, e.g. "tcp://192.168.1.5:9010"; for other computers it needs keys, see `afspm keys`.
        file: its name in the run folder.
        level: the least that is written.
    """

    collects_logs: ClassVar[bool] = True
    listens: ClassVar = ()
    period_s = 0.25
    period_time: Literal["experiment", "real"] = "real"

    def __init__(
        self,
        address: ListeningAddress,
        file: str = "log-all.txt",
        level: Literal["DEBUG", "INFO", "WARNING", "ERROR"] = "INFO",
    ) -> None:
        self.address, self.file = address, file
        self.level = logging.getLevelName(level)

    def run_process(self, context: ProcessContext) -> int:
        from afspm.transport.log_link import LogReceiver
        from afspm.transport.network import Network

        self.receiver = LogReceiver(Network.from_launch(context.name, context.launch.keys), self.address)
        try:
            return super().run_process(context)
        finally:
            self.receiver.close()

    def on_start(self) -> None:
        self._lines = LineFile(Path(self.run_dir) / self.file)
        self.log.info("collecting log lines at %s", self.receiver.address)

    def on_tick(self) -> None:
        self._write(self.receiver.take())

    def _write(self, found: list[LogLine]) -> None:
        lines = [told(line) for line in found if line.level >= self.level]
        if lines:
            self._lines.append(lines)

    def on_end(self) -> None:
        # everybody ends now, and has more to say than what has come; we ourselves stay connected
        self._write(self.receiver.take_rest(REST_S, self.clock, staying=1))


def told(line: LogLine) -> str:
    """As it is written: time in the experiment, level, who, what."""
    text = line.text.replace("\n", "\n    ")
    return f"{iso_utc(line.time_ns)} {logging.getLevelName(line.level):8} {line.name:16} {text}"
