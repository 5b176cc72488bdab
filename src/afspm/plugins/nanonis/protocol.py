"""Nanonis' TCP protocol: encoding of requests and decoding of results. No sockets here.

A message has a header of 40 bytes (name, size of the body) and a body; every reply ends with an error block.
`functions.txt` lists the functions; some fields exist only from a release of the software on.
"""

from __future__ import annotations

import difflib
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

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
_NUMBERS: Final = {code: struct.Struct(">" + code) for code in "BHIifd"}
_FIELD: Final = re.compile(r"([^@?=-]+)(\?|-|=-?\d+)?(?:@(\d+))?(?:@<(\d+))?")
_TYPES: Final = {
    "B": "uint8",
    "H": "uint16",
    "I": "uint32",
    "i": "int32",
    "f": "float32",
    "d": "float64",
    "S": "text",
    "A": "[text,...]",
    "n": "int32 (length of the lists)",
    "2f": "table of float32",
    "2S": "table of text",
}


class BadReply(ControllerLost):
    """The error that received bytes can't be the reply, so that later bytes can't be trusted either."""

    code = "nanonis-reply"


class UnreadableReply(BadReply):
    """The error that a whole reply to the right function has other results than expected: later replies count."""


class NanonisError(AfspmError):
    """An error reported by Nanonis, with its own text."""

    code = "nanonis"


class FieldType(NamedTuple):
    """The type of one field of a request or a reply.

    Attributes:
        code, mark: type code, and relation between `…Set` and `…Get`, see `functions.txt`.
        since, until: first release with the field, first later release without it.
    """

    code: str
    mark: str = ""
    since: int = 0
    until: int = NEWEST + 1

    @property
    def text(self) -> str:
        """The type as text for people."""
        return f"[{_TYPES[self.code[1]]},...]" if self.code[0] in "[*" else _TYPES[self.code]


Fields = tuple[FieldType, ...]


@dataclass(frozen=True)
class Function:
    """One function of the protocol.

    Attributes:
        arguments: fields in order.
        layouts: the possible results, each as fields in order; more than one where sources differ.
    """

    name: str
    arguments: Fields
    layouts: tuple[Fields, ...]

    def result_codes(self, release: int) -> list[tuple[str, ...]]:
        """Return the type codes of the fields in a reply of a release, for each layout."""
        return [tuple(one.code for one in fields if one.since <= release < one.until) for fields in self.layouts]


def _fields(text: str) -> Fields:
    matches = (_FIELD.fullmatch(field) for field in text.split() if field != "-")
    return tuple(
        FieldType(found[1], found[2] or "", int(found[3] or 0), int(found[4] or NEWEST + 1))
        for found in matches
        if found is not None
    )


@cache
def _rows() -> Mapping[str, str]:
    # a line is parsed when its function is used: all of them would delay the start of a translator by 15 ms
    lines = Path(__file__).with_name("functions.txt").read_text(encoding="ascii").splitlines()
    return {line.partition(" ")[0]: line for line in lines if line and line[0] != "#"}


def function_names() -> frozenset[str]:
    """Return the names of the known functions."""
    return frozenset(_rows())


@cache
def function(name: str) -> Function:
    """Return a function by name. Raises InvalidValue: `functions.txt` has no such function."""
    if name not in _rows():
        near = " or ".join(difflib.get_close_matches(name[:50], _rows(), n=3))
        raise InvalidValue(
            f"afspm's table of Nanonis functions has no {name[:50]!r}", hint=f"perhaps {near}" if near else ""
        )
    _, arguments, results, *_ = re.split(" {2,}", _rows()[name])
    return Function(name, _fields(arguments), tuple(map(_fields, results.split(" | "))))


def types_text(fields: Fields) -> str:
    """Return the types of fields as text for people, "int32 uint32"."""
    return " ".join(field.text for field in fields) or "none"


def request(name: str, arguments: Sequence[object], release: int = NEWEST) -> bytes:
    """Encode a request; arguments that the release lacks are left out.

    Raises:
        InvalidValue: the function is unknown, or the arguments do not fit.
    """
    fields = function(name).arguments
    if len(arguments) != len(fields):
        raise InvalidValue(f"{name} takes {len(fields)} arguments ({types_text(fields)}), got {len(arguments)}")
    body, shared = b"", 0
    for field, value in zip(fields, arguments, strict=True):
        if field.since <= release < field.until:
            try:
                body += _encoded(field.code, value, shared)
            except (struct.error, OverflowError, TypeError, ValueError) as error:
                raise InvalidValue(f"{name}: {value!r} can't be sent as {field.text}: {error}") from error
            shared = cast(int, value) if field.code == "n" else shared
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
    return any(one.since or one.until <= NEWEST for fields in function(name).layouts for one in fields)


def _parsed(body: bytes | bytearray, codes: Sequence[str], code_page: str) -> tuple[tuple[object, ...], int, str]:
    reader = _Reader(memoryview(body), code_page)
    found = tuple(reader.field(code) for code in codes)
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
        self._shared = 0

    def field(self, code: str) -> object:
        """Return the value of a field by its type code."""
        if code in _NUMBERS:
            return self.number(code)
        if code in _READERS:
            return _READERS[code](self)
        if code == "n":
            self._shared = self.count(1)
            return self._shared
        item = code[1]
        count = self._shared if code[0] == "*" else self.count(_NUMBERS[item].size)
        return [self.text() for _ in range(count)] if item == "S" else self.numbers(item, count)

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

    def numbers(self, code: str, count: int) -> list[object]:
        found = struct.unpack(f">{count}{code}", self.take(count * _NUMBERS[code].size))
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


_READERS: Final[Mapping[str, Callable[[_Reader], object]]] = {
    "S": _Reader.text,
    "A": _Reader.texts,
    "2f": _Reader.array,
    "2S": _Reader.text_array,
}


def _encoded(code: str, value: Any, shared: int) -> bytes:
    # `shared` is the length of lists that follow one length field
    if code in _NUMBERS or code == "n":
        return _NUMBERS[code.replace("n", "i")].pack(value)
    if code == "S":
        return _text(value)
    if code == "A":
        return _texts(value)
    if code == "2f":
        return struct.pack(">ii", *np.shape(value)) + np.asarray(value, ">f4").tobytes()
    if code[0] == "*" and len(value) != shared:
        raise ValueError(f"it has {len(value)} items, not {shared}")
    items = b"".join(map(_text, value)) if code[1] == "S" else struct.pack(f">{len(value)}{code[1]}", *value)
    return items if code[0] == "*" else struct.pack(">i", len(value)) + items


def _text(value: str) -> bytes:
    raw = value.raw if isinstance(value, ReceivedText) else value.encode()
    return struct.pack(">i", len(raw)) + raw


def _texts(values: Sequence[str]) -> bytes:
    raw = b"".join(map(_text, values))
    return struct.pack(">ii", len(raw), len(values)) + raw
