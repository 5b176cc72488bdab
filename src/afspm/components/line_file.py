"""Files that grow line by line; after a kill a line is in the file completely or not at all."""

from __future__ import annotations

import csv
import io
import logging
import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from afspm.basics.errors import FileError
from afspm.storage.atomic import OutageLog

_log = logging.getLogger("afspm.records")


class LineFile:
    """A text file that grows by lines. An incomplete last line, left by a kill, is removed before the next is written.

    Args:
        path: created with the first line.
        header: first line of a new file.
    """

    def __init__(self, path: Path, header: str = "") -> None:
        self.path = path
        self._header = header
        self._is_open = False
        self._waiting = ""
        self._told = OutageLog("lines wait to be written", _log)

    def lines(self) -> list[str]:
        """Return the complete lines, without the header.

        Raises:
            FileError: the file can't be read.
        """
        try:
            text = self.path.read_bytes().decode("utf-8", errors="replace")
        except FileNotFoundError:
            return []
        except OSError as error:
            raise FileError(f"can't be read: {error}", where=str(self.path)) from error
        whole = text.split("\n")[:-1]  # splitlines would also split at other line ends, which file names may hold
        return whole[1:] if self._header else whole

    def append(self, lines: Iterable[str]) -> None:
        """Append lines, after the header if the file is new.

        If the file can't be written (the disk is full, or a program such as a spreadsheet locks the file), this is
        logged, and the lines wait for the next call.
        """
        self._waiting += "".join(f"{line}\n" for line in lines)
        with self._told.trying():
            self._write()

    def _write(self) -> None:
        try:
            if not self._is_open:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                header = self._repair()
                _append(self.path, header)
                self._is_open = True
            _append(self.path, self._waiting)
        except OSError as error:
            raise FileError(f"can't be written: {error}", where=str(self.path)) from error
        self._waiting = ""

    def _repair(self) -> str:
        # a kill leaves half a line at the end, which is cut off; an empty file gets its header
        if not self.path.exists():
            return f"{self._header}\n" if self._header else ""
        data = self.path.read_bytes()
        whole = data.rfind(b"\n") + 1
        if whole < len(data):
            with self.path.open("r+b") as file:
                file.truncate(whole)
        return f"{self._header}\n" if self._header and whole == 0 else ""


def csv_line(row: Iterable[str]) -> str:
    """Return a row as a line of CSV, with its line end."""
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(row)
    return line.getvalue().replace("\n", " ")


def _append(path: Path, text: str) -> None:
    size = path.stat().st_size if path.exists() else 0
    try:
        with path.open("ab") as file:
            file.write(text.encode())
    except OSError:
        with suppress(OSError):
            os.truncate(path, size)
        raise
