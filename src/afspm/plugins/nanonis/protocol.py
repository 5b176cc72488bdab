"""Nanonis' TCP protocol: encoding of requests and decoding of results. No sockets here.

A message has a header of 40 bytes (name, size of the body) and a body; every reply ends with an error block.
`functions.txt` lists the functions; some fields exist only from a release of the software on.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from afspm.basics import AfspmError, InvalidValue, shortest_single
from afspm.driver import ControllerLost, text_of

HEADER_BYTES: Final = 40
NEWEST: Final = 1 << 31
"""A release with all fields."""
LARGEST_BODY: Final = 1 << 29
"""Longest body in bytes that is accepted as a reply; a larger announced size counts as garbage."""

# Big-endian: name padded with zeros, size of the body, 1 to request a reply, zero.
_HEADER: Final = struct.Struct(">32sihh")
_NUMBERS: Final = {code: struct.Struct(">" + code) for code in "HIifd"}


class BadReply(ControllerLost):
    """The error that received bytes can't be the reply, so that later bytes can't be trusted either."""

    code = "nanonis-reply"


class UnreadableReply(BadReply):
    """The error that a whole reply to the right function has other results than expected: later replies count."""


class NanonisError(AfspmError):
    """An error reported by Nanonis, with its own text."""

    code = "nanonis"


@dataclass(frozen=True)
class Function:
    """One function of the protocol.

    Attributes:
        arguments: fields in order, each as (type code, first release that has the field).
        layouts: the possible results, each as fields in order; more than one where sources differ.
    """

    name: str
    arguments: tuple[tuple[str, int], ...]
    layouts: tuple[tuple[tuple[str, int], ...], ...]

    def argument_codes(self, release: int) -> tuple[str, ...]:
        """Return the type codes of the fields in a request to a release."""
        return tuple(code for code, since in self.arguments if since <= release)

    def result_codes(self, release: int) -> list[tuple[str, ...]]:
        """Return the type codes of the fields in a reply of a release, for each layout."""
        return [tuple(code for code, since in fields if since <= release) for fields in self.layouts]


def _fields(text: str) -> tuple[tuple[str, int], ...]:
    parts = (field.partition("@") for field in text.split() if field != "-")
    return tuple((code, int(since or 0)) for code, _, since in parts)


@cache
def functions() -> Mapping[str, Function]:
    """Return the known functions by name."""
    rows = {}
    for line in Path(__file__).with_name("functions.txt").read_text(encoding="ascii").splitlines():
        if line and not line.startswith("#"):
            name, arguments, results = re.split(" {2,}", line)
            rows[name] = Function(name, _fields(arguments), tuple(map(_fields, results.split(" | "))))
    return rows


def function(name: str) -> Function:
    """Return a function by name. Raises InvalidValue: `functions.txt` has no such function."""
    if name not in functions():
        raise InvalidValue(f"Nanonis has no function {name[:50]!r}")
    return functions()[name]


def request(name: str, arguments: Sequence[object], release: int = NEWEST) -> bytes:
    """Encode a request; arguments that the release lacks are left out.

    Raises:
        InvalidValue: the function is unknown, or the arguments do not fit.
    """
    fields = function(name).arguments
    if len(arguments) != len(fields):
        raise InvalidValue(f"{name} takes {len(fields)} arguments, got {len(arguments)}")
    body = b""
    for (code, since), value in zip(fields, arguments, strict=True):
        if since <= release:
            try:
                body += _WRITERS[code](value)
            except (struct.error, OverflowError, TypeError, ValueError) as error:
                raise InvalidValue(f"{name}: {value!r} can't be sent as {code}: {error}") from error
    # A reply is always requested: without one, a refusal would go unnoticed.
    return _HEADER.pack(name.encode("ascii"), len(body), 1, 0) + body


def body_bytes(header: bytes, asked: str) -> int:
    """Return the number of bytes after the header of a reply to `asked`.

    Raises:
        BadReply: the size is impossible, or the reply belongs to another function.
    """
    raw_name, size, _, _ = _HEADER.unpack(header)
    name = text_of(raw_name.split(b"\0", 1)[0])
    if name != asked:
        raise BadReply(f"Nanonis replied to {name!r} instead of {asked}")
    if not 0 <= size <= LARGEST_BODY:
        raise BadReply(f"Nanonis announced {size} bytes in reply to {asked}")
    return int(size)


class ReceivedText(str):
    """A text with the bytes that Nanonis sent: sent back, it is the same text in any code page.

    Attributes:
        raw: these bytes.
    """

    __slots__ = ("raw",)
    raw: bytes

    @classmethod
    def of(cls, raw: bytes, code_page: str) -> ReceivedText:
        """Decode as UTF-8, otherwise by the code page of Nanonis' computer, otherwise as `text_of`."""
        text = text_of(raw)
        for encoding in (code_page, "utf-8") if code_page else ():  # the last one that fits
            with suppress(UnicodeDecodeError):
                text = raw.decode(encoding)
        found = cls(text)
        found.raw = raw
        return found


def results(name: str, body: bytes | bytearray, release: int = NEWEST, code_page: str = "") -> tuple[object, ...]:
    """Decode the results in a reply's body.

    Args:
        code_page: see `ReceivedText.of`.

    The specification does not define whether an error follows results or replaces them: both forms are accepted.

    Raises:
        NanonisError: Nanonis reports an error.
        UnreadableReply: the body does not fit the function.
    """
    whole = None
    # The fields depend on the release: a wrong release leaves bytes over, or needs more bytes than received.
    for codes in (*function(name).result_codes(release), ()):
        try:
            found, status, text = _parsed(body, codes, code_page)
        except BadReply as error:
            whole = whole or error
            continue
        if status:
            raise NanonisError(f"Nanonis: {text or 'no reason given'} (error {status})", where=name)
        if whole is None or codes:
            return found
    hint = f"it was read as release {release} sends it" if _depends_on_release(name) else ""
    raise UnreadableReply(f"the reply to {name} is malformed: {whole.what if whole else ''}", hint=hint)


def _depends_on_release(name: str) -> bool:
    return any(since for fields in function(name).layouts for _, since in fields)


def _parsed(body: bytes | bytearray, codes: Sequence[str], code_page: str) -> tuple[tuple[object, ...], int, str]:
    reader = _Reader(memoryview(body), code_page)
    found = tuple(_READERS[code](reader) for code in codes)
    # The error block at the end of every reply: a status, and a text.
    status, text = reader.number("I"), reader.text()
    if reader.left:
        raise BadReply(f"it has {reader.left} bytes too many")
    return found, int(status), text


class _Reader:
    """A reader of consecutive fields of a body, never beyond its end."""

    def __init__(self, body: memoryview, code_page: str) -> None:
        self._body = body
        self._code_page = code_page
        self._at = 0

    @property
    def left(self) -> int:
        return len(self._body) - self._at

    def take(self, size: int) -> memoryview:
        if not 0 <= size <= self.left:
            raise BadReply(f"a field of {size} bytes where {self.left} are left")
        self._at += size
        return self._body[self._at - size : self._at]

    def number(self, code: str) -> Any:
        number = _NUMBERS[code]
        found = number.unpack(self.take(number.size))[0]
        # a bias of 0.1 V is read as 0.1: otherwise pages and files have 0.10000000149011612
        return shortest_single(found) if code == "f" else found

    def text(self) -> str:
        return ReceivedText.of(bytes(self.take(self.number("i"))), self._code_page)

    def texts(self) -> list[str]:
        self.number("i")  # the size in bytes, which peers calculate differently
        return [self.text() for _ in range(self.count(4))]

    def count(self, at_least_bytes: int) -> int:
        """Return the number of elements. Raises BadReply: more than the body can contain."""
        count = int(self.number("i"))
        if not 0 <= count <= self.left // at_least_bytes:
            raise BadReply(f"{count} elements in {self.left} bytes")
        return count

    def numbers(self, code: str) -> list[object]:
        raw = self.take(4 * self.count(4))
        found = struct.unpack(f">{len(raw) // 4}{code}", raw)
        return [shortest_single(one) if code == "f" else one for one in found]

    def shape(self) -> tuple[int, int]:
        rows, columns = self.number("i"), self.number("i")
        if min(rows, columns) < 0 or rows * columns * 4 > self.left:
            raise BadReply(f"{rows} x {columns} values in {self.left} bytes")
        return rows, columns

    def array(self) -> np.ndarray:
        rows, columns = self.shape()
        return np.frombuffer(self.take(4 * rows * columns), ">f4").reshape(rows, columns)

    def text_array(self) -> list[list[str]]:
        rows, columns = self.shape()
        if rows > self.left:
            raise BadReply(f"{rows} rows in {self.left} bytes")
        return [[self.text() for _ in range(columns)] for _ in range(rows)]


def _reader_of(code: str) -> Callable[[_Reader], object]:
    return lambda reader: reader.number(code)


_READERS: Final[Mapping[str, Callable[[_Reader], object]]] = {
    **{code: _reader_of(code) for code in _NUMBERS},
    "S": _Reader.text,
    "A": _Reader.texts,
    "[i]": lambda reader: reader.numbers("i"),
    "[f]": lambda reader: reader.numbers("f"),
    "2f": _Reader.array,
    "2S": _Reader.text_array,
}


def _counted(code: str, values: Sequence[object]) -> bytes:
    return struct.pack(f">i{len(values)}{code}", len(values), *values)


def _text(value: str) -> bytes:
    raw = value.raw if isinstance(value, ReceivedText) else value.encode()
    return struct.pack(">i", len(raw)) + raw


def _texts(values: Sequence[str]) -> bytes:
    raw = b"".join(map(_text, values))
    return struct.pack(">ii", len(raw), len(values)) + raw


_WRITERS: Final[Mapping[str, Callable[[Any], bytes]]] = {
    **{code: number.pack for code, number in _NUMBERS.items()},
    "S": _text,
    "A": _texts,
    "[i]": lambda values: _counted("i", values),
    "[f]": lambda values: _counted("f", values),
}
