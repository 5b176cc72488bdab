"""A log of JSON lines. Each line goes to the operating system at once, so that a kill loses no line."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from afspm.basics.errors import FileError
from afspm.basics.plain_data import PlainList

REQUESTS_FOLDER = "requests"
"""Folder of a run with the logs that `[record] requests = true` keeps."""


class LineLog:
    """A writer that appends lines to a file.

    A write error must not end the experiment: it is logged once, and the log ends there until a restart.
    """

    def __init__(self, path: Path, logger: logging.Logger) -> None:
        self._path = path
        self._logger = logger
        self._file: int | None = None
        self._open()

    def _open(self) -> None:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            os.write(self._file, b"\n")  # a kill or a full disk may have left half a line
        except OSError as error:
            self._give_up(error)

    def add(self, line: PlainList) -> None:
        """Append a line of JSON's types."""
        if self._file is None:
            return
        try:
            text = memoryview(json.dumps(line, separators=(",", ":")).encode() + b"\n")
            while text:
                text = text[os.write(self._file, text) :]
        except OSError as error:
            self._give_up(error)

    def close(self) -> None:
        """Close the file. Safe to repeat."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

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
                    line = json.loads(text)
                except ValueError:
                    continue
                if isinstance(line, list) and line:
                    yield line
    except OSError as error:
        raise FileError(f"can't be read: {error}", where=str(path)) from error
