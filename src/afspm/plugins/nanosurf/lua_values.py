"""Lua values in Studio's scripts and replies: tables, texts, numbers, booleans and nil."""

from __future__ import annotations

import math
import re
from typing import Any, Final

from afspm.basics import AfspmError

_TOKEN: Final = re.compile(
    r"""\s*(?:(?P<text>"(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*')
    |(?P<nan>-?\(?-?(?:0/0|nan(?:\([^)]*\))?|math\.huge|1e9999|inf)\)?)
    |(?P<number>[+-]?(?:0[xX][0-9a-fA-F.]+(?:[pP][+-]?\d+)?|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?))
    |(?P<name>[A-Za-z_]\w*)
    |(?P<mark>[{}\[\]=,;()]))""",
    re.VERBOSE | re.DOTALL,
)
_ESCAPE: Final = re.compile(r"\\(\d{1,3}|x[0-9a-fA-F]{2}|.)", re.DOTALL)
_ESCAPED: Final = {"n": "\n", "t": "\t", "r": "\r", "a": "\a", "b": "\b", "f": "\f", "v": "\v"}
_WORDS: Final = {"nil": None, "true": True, "false": False}
_DEEPEST: Final = 50


class BadLua(AfspmError):
    """The error that a text is not a Lua value."""

    code = "bad-reply"


def parse(text: str) -> object:
    """Parse a value; a table becomes a dictionary, with items without a key numbered from 1. Raises BadLua."""
    reader = _Reader(text)
    value = reader.value(0)
    if reader.token() != ("", ""):
        raise BadLua(f"{text[:60]!r} does not end where it should")
    return value


class _Reader:
    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0

    def token(self, *, peek: bool = False) -> tuple[str, str]:
        """Return kind and text of the next token; two empty texts at the end."""
        found = _TOKEN.match(self._text, self._at)
        if found is None:
            if self._text[self._at :].strip():
                raise BadLua(f"{self._text[self._at : self._at + 40]!r} is no value")
            return "", ""
        if not peek:
            self._at = found.end()
        kind = found.lastgroup or ""
        return kind, found[kind]

    def value(self, depth: int) -> Any:
        kind, text = self.token()
        if kind == "text":
            return _ESCAPE.sub(_unescaped, text[1:-1])
        if kind == "nan":
            return _special(text)
        if kind == "number":
            return _number(text)
        if kind == "name" and text in _WORDS:
            return _WORDS[text]
        if (kind, text) == ("mark", "{") and depth < _DEEPEST:
            return self._table(depth + 1)
        raise BadLua(f"{text!r} is no value")

    def _table(self, depth: int) -> dict[object, object]:
        found: dict[object, object] = {}
        position = 0
        while True:
            kind, text = self.token(peek=True)
            if (kind, text) == ("mark", "}"):
                self.token()
                return found
            key = self._key(depth)
            if key is None:
                position += 1
                key = position
            found[key] = self.value(depth)
            kind, text = self.token()
            if (kind, text) == ("mark", "}"):
                return found
            if text not in {",", ";"}:
                raise BadLua(f"{text!r} within a table")

    def _key(self, depth: int) -> object:
        before = self._at
        kind, text = self.token()
        if (kind, text) == ("mark", "["):
            text = self.value(depth)
            self.token()
            kind = "name"
        if kind == "name" and self.token() == ("mark", "="):
            return text
        self._at = before
        return None


def _unescaped(found: re.Match[str]) -> str:
    code = found[1]
    if code.isdigit():
        return chr(int(code))
    return chr(int(code[1:], 16)) if len(code) == 3 else _ESCAPED.get(code, code)


def _special(text: str) -> float:
    # The text of NaN and infinity depends on Lua's C library.
    if "huge" in text or "inf" in text or "1e9999" in text:
        return -math.inf if text.lstrip("(").startswith("-") else math.inf
    return math.nan


def _number(text: str) -> int | float:
    if "x" in text.lower():
        return float.fromhex(text) if "p" in text.lower() or "." in text else int(text, 16)
    return float(text) if any(mark in text for mark in ".eE") else int(text)


def written(value: bool | float | str) -> str:
    """Return a value in Lua's syntax."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n").replace("\r", "\\r")
        return f'"{escaped}"'
    return repr(value)
