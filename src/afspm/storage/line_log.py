"""A log of JSON lines. Each line goes to the operating system at once, so that a kill loses no line."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from afspm.basics import PlainList
from afspm.basics.errors import FileError
from afspm.basics.plain_data import from_json
from afspm.storage.disk import DEADLINE_S, DiskBacklogFull, DiskThread, DiskTimeout

REQUESTS_FOLDER = "requests"
"""Folder of a run with the logs that `[record] requests = true` keeps."""


class LineLog:
    """A writer that appends lines to a file.

    A write waits for the disk for at most `DEADLINE_S` (`afspm.storage.disk`): a hanging disk gets the lines once it
    answers. A write error must not end the experiment: it is logged once, and the log ends there until a restart.
    """

    def __init__(self, path: Path, logger: logging.Logger) -> None:
        self._path = path
        self._logger = logger
        self._disk = DiskThread()
        self._file: int | None = None
        self._failure: OSError | None = None
        self._is_closed = self._is_late = False
        self._do(self._open)

    def add(self, line: PlainList) -> None:
        """Append a line of JSON's types."""
        if not self._is_closed:
            text = json.dumps(line, separators=(",", ":")).encode() + b"\n"
            self._do(lambda: self._write(text), len(text))

    def close(self) -> None:
        """Close the file. Safe to repeat."""
        if self._is_closed:
            return
        self._is_closed = True
        if self._disk.close(DEADLINE_S) and self._file is not None:
            os.close(self._file)
            self._file = None

    def _do(self, work: Callable[[], None], size: int = 0) -> None:
        try:
            self._disk.run(work, size)
        except DiskBacklogFull as error:
            self._give_up(error)
        except DiskTimeout as error:
            if not self._is_late:
                self._logger.warning("requests are recorded late: %s", error)
            self._is_late = True
        except OSError as error:
            self._give_up(error)
        else:
            self._is_late = False

    def _open(self) -> None:
        with self._failing():
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            os.write(self._file, b"\n")  # a kill or a full disk may have left half a line

    def _write(self, line: bytes) -> None:
        if self._failure is not None or self._file is None:  # of a late line: the log has no gaps
            raise self._failure or OSError("the file is not open")
        with self._failing():
            text = memoryview(line)
            while text:
                text = text[os.write(self._file, text) :]

    @contextmanager
    def _failing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._failure = error
            raise

    def _give_up(self, error: OSError) -> None:
        self._logger.error("requests are no longer recorded, what-if can replay up to here only: %s", error)
        self.close()


def read_lines(path: Path) -> Iterator[PlainList]:
    """Yield the lines of a log; an incomplete line, left by a kill, is skipped.

    Raises:
        FileError: the file can't be read.
    """
    try:
        with path.open("rb") as file:
            for text in file:
                try:
                    line = from_json(text)
                except ValueError:
                    continue
                if isinstance(line, list) and line:
                    yield line
    except OSError as error:
        raise FileError(f"can't be read: {error}", where=str(path)) from error
