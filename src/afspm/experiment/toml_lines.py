"""Line numbers of the keys in a TOML text: the standard parser returns values without lines."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from itertools import count
from typing import TypeAlias

from afspm.basics.plain_data import Plain, PlainMapping

Path: TypeAlias = tuple[str | int, ...]
"""Path in the parsed document: keys, and indices of arrays."""
Table: TypeAlias = PlainMapping
"""A table of a TOML file, read-only."""
Settings: TypeAlias = Plain
"""Settings of a component made from a table, in types of TOML or JSON."""

_TOKEN = re.compile(
    r'''"""(?:\\.|[^\\])*?"{3,5}'''
    r"""|'''.*?'{3,5}"""
    r'''|"(?:\\.|[^"\\])*"'''
    r"""|'[^']*'"""
    r"""|[\[\]{}=,.\n]"""
    r"""|\#[^\n]*|[ \t\r]+"""
    r"""|[^\s\[\]{}=,.\#"']+""",
    re.DOTALL,
)
_BLANK = re.compile(r"[ \t\r#]")


def locate(text: str) -> dict[Path, int]:
    """Return the line (from 1) on which each key, table and array element of a valid TOML text begins."""
    scanner = _Scanner(text.replace("\r\n", "\n"))
    scanner.document()
    return scanner.lines


class _Scanner:
    """A scanner without error checks, for a text that `tomllib` has accepted."""

    def __init__(self, text: str) -> None:
        self.lines: dict[Path, int] = {}
        self._tokens = [*_tokens(text), ("", text.count("\n") + 1)]
        self._at = 0
        self._array_lengths: dict[Path, int] = {}

    def document(self) -> None:
        table: Path = ()
        while self._peek(over_lines=True):
            table = self._header() if self._peek() == "[" else self._key_value(table)

    def _header(self) -> Path:
        line = self._line()
        is_array = self._next() == self._peek() == "["
        if is_array:
            self._next()
        *tables, last = self._dotted_key()
        for _ in range(1 + is_array):
            self._next()
        path: Path = ()
        for key in tables if is_array else [*tables, last]:
            path = (*path, key)
            if path in self._array_lengths:  # a header through an array of tables refers to its last element
                path = (*path, self._array_lengths[path] - 1)
        if is_array:
            array = (*path, last)
            index = self._array_lengths.get(array, 0)
            self._array_lengths[array] = index + 1
            path = (*array, index)
        self._note(path, line)
        return path

    def _key_value(self, table: Path) -> Path:
        line = self._line()
        path = (*table, *self._dotted_key())
        self._note(path, line)
        self._next()  # the equals sign
        self._value(path)
        return table

    def _value(self, path: Path) -> None:
        first = self._next()
        if first == "[":
            for index in count():
                if self._peek(over_lines=True, also=",") == "]":
                    break
                self._note((*path, index), self._line())
                self._value((*path, index))
            self._next()
        elif first == "{":
            while self._peek(over_lines=True, also=",") != "}":
                self._key_value(path)
            self._next()
        else:
            while self._peek() not in ("", ",", "]", "}", "\n"):  # numbers and dates consist of several tokens
                self._next()

    def _note(self, path: Path, line: int) -> None:
        for depth in range(1, len(path) + 1):  # a dotted key also opens the tables above it
            self.lines.setdefault(path[:depth], line)

    def _dotted_key(self) -> tuple[str, ...]:
        keys = [_unquoted(self._next())]
        while self._peek() == ".":
            self._next()
            keys.append(_unquoted(self._next()))
        return tuple(keys)

    def _peek(self, *, over_lines: bool = False, also: str = "\n") -> str:
        while over_lines and self._tokens[self._at][0] in ("\n", also):
            self._at += 1
        return self._tokens[self._at][0]

    def _line(self) -> int:
        return self._tokens[self._at][1]

    def _next(self) -> str:
        self._at += 1
        return self._tokens[self._at - 1][0]


def _tokens(text: str) -> Iterator[tuple[str, int]]:
    line = 1
    for match in _TOKEN.finditer(text):
        if not _BLANK.match(match[0]):
            yield match[0], line
        line += match[0].count("\n")


def _unquoted(key: str) -> str:
    return str(tomllib.loads(f"key = {key}")["key"]) if key[:1] in ('"', "'") else key
