"""Where in a TOML text each key stands: the standard parser gives values, but no lines."""

from __future__ import annotations

import bisect
import tomllib
from typing import Any, TypeAlias

Path: TypeAlias = tuple[str | int, ...]
"""A way into the parsed document: keys, and indices into arrays."""

_BARE_END = set(" \t\r\n=.[]{},#\"'")


def locate(text: str) -> dict[Path, int]:
    """The line (from 1) on which each key, table and array element of a valid TOML text begins."""
    scanner = _Scanner(text)
    scanner.document()
    return scanner.lines


class _Scanner:
    """Walks a text that `tomllib` has already accepted, so it need not look for errors."""

    def __init__(self, text: str) -> None:
        self.text = text.replace("\r\n", "\n")
        self.at = 0
        self.lines: dict[Path, int] = {}
        self._line_ends = [i for i, c in enumerate(self.text) if c == "\n"]
        self._array_lengths: dict[Path, int] = {}

    def document(self) -> None:
        table: Path = ()
        while self._skip_blank():
            if self.text.startswith("[[", self.at):
                table = self._header(2)
            elif self._peek() == "[":
                table = self._header(1)
            else:
                self._key_value(table)

    def _header(self, brackets: int) -> Path:
        line = self._line()
        self.at += brackets
        keys = self._dotted_key()
        self._skip_blank()
        self.at += brackets
        path = self._through_arrays(keys[:-1])
        if brackets == 1:
            path = self._through_arrays((keys[-1],), path)
        else:
            array = (*path, keys[-1])
            index = self._array_lengths.get(array, 0)
            self._array_lengths[array] = index + 1
            self.lines.setdefault(array, line)
            path = (*array, index)
        self._note(path, line)
        return path

    def _through_arrays(self, keys: tuple[str, ...], path: Path = ()) -> Path:
        """A header that leads through an array of tables means its newest element."""
        for key in keys:
            path = (*path, key)
            if path in self._array_lengths:
                path = (*path, self._array_lengths[path] - 1)
        return path

    def _key_value(self, table: Path) -> None:
        line = self._line()
        path = (*table, *self._dotted_key())
        self._note(path, line)
        self._skip_blank()
        self.at += 1  # the equals sign
        self._value(path)

    def _value(self, path: Path) -> None:
        self._skip_blank()
        first = self._peek()
        if first in "\"'":
            self._string()
        elif first == "[":
            self.at += 1
            index = 0
            while self._skip_blank(also=",") and self._peek() != "]":
                self._note((*path, index), self._line())
                self._value((*path, index))
                index += 1
            self.at += 1
        elif first == "{":
            self.at += 1
            while self._skip_blank(also=",") and self._peek() != "}":
                self._key_value(path)
            self.at += 1
        else:
            while self.at < len(self.text) and self._peek() not in ",]}#\n":
                self.at += 1

    def _note(self, path: Path, line: int) -> None:
        for depth in range(1, len(path) + 1):  # a dotted key opens the tables above it as well
            self.lines.setdefault(path[:depth], line)

    def _dotted_key(self) -> tuple[str, ...]:
        keys = []
        while True:
            self._skip_blank()
            if self._peek() in "\"'":
                start = self.at
                self._string()
                keys.append(_unquote(self.text[start : self.at]))
            else:
                start = self.at
                while self.at < len(self.text) and self._peek() not in _BARE_END:
                    self.at += 1
                keys.append(self.text[start : self.at])
            self._skip_blank()
            if self._peek() != ".":
                return tuple(keys)
            self.at += 1

    def _string(self) -> None:
        quote = self._peek()
        if self.text.startswith(quote * 3, self.at):
            self.at += 3
            while not self.text.startswith(quote * 3, self.at):
                self.at += 2 if quote == '"' and self._peek() == "\\" else 1
            self.at += 3
            while self._peek() == quote:  # up to two quotes may stand just before the closing ones
                self.at += 1
            return
        self.at += 1
        while self._peek() != quote:
            self.at += 2 if quote == '"' and self._peek() == "\\" else 1
        self.at += 1

    def _skip_blank(self, also: str = "") -> bool:
        """Go to the next thing that is no space, line end or comment; false at the end of the text."""
        while self.at < len(self.text):
            char = self.text[self.at]
            if char == "#":
                end = self.text.find("\n", self.at)
                self.at = len(self.text) if end < 0 else end
            elif char in " \t\r\n" or char in also:
                self.at += 1
            else:
                return True
        return False

    def _peek(self) -> str:
        return self.text[self.at] if self.at < len(self.text) else "\0"

    def _line(self) -> int:
        return bisect.bisect_left(self._line_ends, self.at) + 1


def _unquote(key: str) -> str:
    parsed: dict[str, Any] = tomllib.loads(f"key = {key}")
    return str(parsed["key"])
