"""The ground truth for later evaluation: `truth.jsonl` in the run folder, never published."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from afspm.basics.plain_data import Plain
from afspm.storage.atomic import OutageLog
from afspm.storage.disk import DEADLINE_S, DiskThread


class Truth:
    """A file of JSON objects, one per line, with `n`, `time_s` (experiment), `event` and its facts.

    While the disk hangs, lines are queued: the microscope does not wait for the disk. A full disk loses lines, which is
    logged, and refuses no measurement.

    Args:
        kept: storage for the number of the last line, which then survives a kill. After a kill the last event may be
            written again, under the same `n`.
    """

    def __init__(self, path: Path, kept: Plain | None = None) -> None:
        self._path = path
        self._kept: Plain = {} if kept is None else kept
        self._disk = DiskThread()
        self._outage = OutageLog("the ground truth lacks events", logging.getLogger("afspm.truth"))

    def note(self, time_s: float, event: str, facts: Mapping[str, object]) -> None:
        """Append an event."""
        self._kept["truth_lines"] = number = int(self._kept.get("truth_lines", 0)) + 1
        line = json.dumps({"n": number, "time_s": time_s, "event": event, **facts}, default=_plain)
        with self._outage.trying():
            self._disk.run(lambda: self._append(line), len(line))

    def close(self) -> None:
        """End the thread that writes; a later event starts another."""
        self._disk.close(DEADLINE_S)

    def _append(self, line: str) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a+b") as file:
            if size := file.tell():
                file.seek(size - 1)
                if file.read(1) != b"\n":  # a kill or a full disk has left a part of a line: keep it apart
                    line = f"\n{line}"
            file.write(f"{line}\n".encode())


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} can't be written as JSON")
