"""Controller's side of the TCP protocol: decoding of requests and encoding of replies.

Independent of the translator's code, so that each checks the other; both read the table `functions.txt`.
"""

from __future__ import annotations

import math
import random
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

HEADER_BYTES: Final = 40
_LARGEST_BODY: Final = 1 << 20
_LARGEST_SINGLE: Final = float(np.finfo(np.float32).max)
_NEVER: Final = 1 << 31
_FIELD: Final = re.compile(r"(?P<code>[^@?=-]+)(?P<mark>\?|-|=-?\d+)?(?:@(?P<since>\d+))?(?:@<(?P<until>\d+))?")
_SIZES: Final[Mapping[str, int]] = {code: struct.calcsize(f">{code}") for code in "BHIifd"}
ZEROS: Final[Mapping[str, object]] = {
    **dict.fromkeys("HIin", 0),
    **dict.fromkeys("fd", 0.0),
    "S": "",
    **dict.fromkeys(("A", "2S", *(f"[{code}]" for code in _SIZES), *(f"*{code}" for code in (*_SIZES, "S"))), ()),
    "2f": np.zeros((0, 0)),
}
_SENSELESS_NUMBERS: Final = (float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1e-38, 3e38, -3e38, 1e9)
_SENSELESS_INTEGERS: Final = (0, 1, 2, 3, 7, 127, 500, 65535, 2**31 - 1, -1, -(2**31))
_SENSELESS_TEXTS: Final = (
    "",
    "\0",
    "../..",
    "x" * 3000,
    "Z (m)",
    "Current (A)",
    "(",
    "ä€",
    "C:\\nowhere\\at all.sxm",
    "/nowhere/a.dat",
)


class MalformedRequest(Exception):
    """The error that the bytes of a request do not fit its function."""


@dataclass(frozen=True)
class WireField:
    """One field of a request or a reply.

    Attributes:
        code: type code, see `functions.txt`.
        since, until: first release with the field, first later release without the field.
        mark: relation between values in `…Set` and `…Get`, see `functions.txt`.
    """

    code: str
    since: int = 0
    until: int = _NEVER
    mark: str = ""

    @classmethod
    def of(cls, text: str) -> WireField:
        found = _FIELD.fullmatch(text)
        if found is None:
            raise ValueError(text)
        since, until = found["since"] or 0, found["until"] or _NEVER
        return cls(found["code"], int(since), int(until), found["mark"] or "")

    def is_in(self, release: int) -> bool:
        return self.since <= release < self.until


@dataclass(frozen=True)
class NanonisFunction:
    """A function: its fields, and the first release that has it."""

    arguments: tuple[WireField, ...]
    results: tuple[WireField, ...]
    since: int

    def argument_codes(self, release: int) -> list[str]:
        return [field.code for field in self.arguments if field.is_in(release)]

    def result_codes(self, release: int) -> list[str]:
        return [field.code for field in self.results if field.is_in(release)]


@cache
def functions() -> Mapping[str, NanonisFunction]:
    """Return the protocol's functions by name."""
    found = {}
    for line in Path(__file__).parents[1].joinpath("functions.txt").read_text(encoding="ascii").splitlines():
        if line and not line.startswith("#"):
            name, arguments, results, *since = re.split(" {2,}", line)
            results = results.partition(" | ")[0]
            found[name] = NanonisFunction(_fields(arguments), _fields(results), int(since[0]) if since else 0)
    return found


@cache
def _by_lower_case() -> Mapping[str, str]:
    return {name.lower(): name for name in functions()}


def known_as(name: str) -> str | None:
    """Return a function's name in the spelling of `functions.txt`, ignoring case; None if unknown."""
    return _by_lower_case().get(name.lower())


def _fields(column: str) -> tuple[WireField, ...]:
    return tuple(WireField.of(text) for text in column.split() if text != "-")


def split(received: bytearray) -> tuple[str, bool, bytes] | None:
    """Remove one request from the received bytes; return its name, True if an answer is wanted, and its body.

    Return None if the request is incomplete.

    Raises:
        MalformedRequest: the announced size is impossible.
    """
    if len(received) < HEADER_BYTES:
        return None
    (size,) = struct.unpack_from(">i", received, 32)
    if not 0 <= size <= _LARGEST_BODY:
        raise MalformedRequest(f"a request of {size} bytes")
    if len(received) < HEADER_BYTES + size:
        return None
    name = bytes(received[:32]).rstrip(b"\0").decode("ascii", "replace")
    (wants_answer,) = struct.unpack_from(">H", received, 36)
    body = bytes(received[HEADER_BYTES : HEADER_BYTES + size])
    del received[: HEADER_BYTES + size]
    return name, bool(wants_answer), body


def arguments(name: str, body: bytes, release: int, encoding: str = "utf-8") -> list[object]:
    """Decode the arguments in a request's body.

    Raises:
        MalformedRequest: too few or too many bytes.
    """
    at, found, count = 0, [], 0
    try:
        for code in functions()[name].argument_codes(release):
            value, at = _unpacked(code, body, at, count, encoding)
            count = value if code == "n" else count
            found.append(value)
    except struct.error as error:
        raise MalformedRequest(f"{len(body)} bytes of arguments are too few for {name}") from error
    if at != len(body):
        raise MalformedRequest(f"{len(body) - at} bytes of arguments too many for {name}")
    return found


def _unpacked(code: str, body: bytes, at: int, count: int, encoding: str) -> tuple[Any, int]:
    # `count` is the length of lists that share one length field.
    if code in _SIZES:
        return struct.unpack_from(f">{code}", body, at)[0], at + _SIZES[code]
    if code.startswith("*"):
        return _items(code[1], count, body, at, encoding)
    if code == "A":
        at += 4  # the size in bytes, which clients calculate differently: nanonis-spm and nanonisTCP disagree
    (number,) = struct.unpack_from(">i", body, at)
    at += 4
    if code == "n":
        return number, at
    if code == "S":
        end = at + max(number, 0)
        return struct.unpack_from(f">{max(number, 0)}s", body, at)[0].decode(encoding, "replace"), end
    if code == "A":
        return _items("S", number, body, at, encoding)
    if code == "2f":
        (columns,) = struct.unpack_from(">i", body, at)
        values, at = _items("f", max(number, 0) * max(columns, 0), body, at + 4, encoding)
        return np.reshape(values, (max(number, 0), max(columns, 0))), at
    return _items(code[1], number, body, at, encoding)


def _items(code: str, count: int, body: bytes, at: int, encoding: str) -> tuple[list[Any], int]:
    count = max(count, 0)
    if code in _SIZES:
        return list(struct.unpack_from(f">{count}{code}", body, at)), at + count * _SIZES[code]
    texts = []
    for _ in range(count):
        text, at = _unpacked("S", body, at, 0, encoding)
        texts.append(text)
    return texts, at


def reply(name: str, body: bytes) -> bytes:
    """Encode a reply from the name for its header and the body."""
    return name.encode("ascii", "replace")[:32].ljust(32, b"\0") + struct.pack(">i", len(body)) + bytes(4) + body


def body(name: str, results: Sequence[object], release: int, encoding: str = "utf-8") -> bytes:
    """Encode the body of a reply without an error."""
    values = zip(functions()[name].results, results, strict=True)
    packed = (_packed(field.code, value, encoding) for field, value in values if field.is_in(release))
    return b"".join(packed) + error_block("", 0)


def error_body(name: str, text: str, release: int, *, bare: bool) -> bytes:
    """Encode the body of a reply with an error, after results of zeros or (`bare`) without results."""
    # The specification does not define if results are present after an error: both can be emulated.
    codes = [] if bare or name not in functions() else functions()[name].result_codes(release)
    return b"".join(_packed(code, ZEROS[code], "utf-8") for code in codes) + error_block(text, 1)


def error_block(text: str, status: int) -> bytes:
    """Encode the error block at the end of every reply."""
    return struct.pack(">I", status) + _packed("S", text, "utf-8")


def _packed(code: str, value: Any, encoding: str) -> bytes:
    if code == "S":
        # The real software on Windows may send texts in Latin-1.
        raw = str(value).encode(encoding, "replace")
        return struct.pack(">i", len(raw)) + raw
    if code == "A":
        raw = b"".join(_packed("S", one, encoding) for one in value)
        return struct.pack(">ii", len(raw), len(value)) + raw
    if code == "2f":
        with np.errstate(over="ignore"):  # infinite, like a single value
            array = np.asarray(value, dtype=">f4")
        return struct.pack(">ii", *array.shape) + array.tobytes()
    if code == "2S":
        rows, columns = len(value), max(map(len, value), default=0)
        cells = (cell for row in value for cell in [*row, *[""] * (columns - len(row))])
        return struct.pack(">ii", rows, columns) + b"".join(_packed("S", cell, encoding) for cell in cells)
    if code.startswith("["):
        return struct.pack(">i", len(value)) + b"".join(_packed(code[1], one, encoding) for one in value)
    if code.startswith("*"):
        return b"".join(_packed(code[1], one, encoding) for one in value)
    if code == "f" and abs(value) > _LARGEST_SINGLE:
        return struct.pack(">f", math.copysign(math.inf, value))
    if code in "BHIin":  # a value set as a signed field may be returned as an unsigned field
        size = _SIZES[code.replace("n", "i")]
        return (int(value) % (1 << 8 * size)).to_bytes(size, "big")
    return struct.pack(f">{code}", value)


def senseless_value(code: str, chance: random.Random) -> object:
    """Return a random absurd value of a field's type."""
    if code in "fd":
        return chance.choice(_SENSELESS_NUMBERS)
    if code in "BHIin":
        return chance.choice(_SENSELESS_INTEGERS)
    if code == "S":
        return chance.choice(_SENSELESS_TEXTS)
    if code == "2f":
        shape = chance.randrange(4), chance.randrange(4)
        return np.reshape([chance.choice(_SENSELESS_NUMBERS) for _ in range(shape[0] * shape[1])], shape)
    if code == "2S":
        return [
            [chance.choice(_SENSELESS_TEXTS) for _ in range(chance.randrange(3))] for _ in range(chance.randrange(3))
        ]
    item = "S" if code == "A" else code[1]
    return [senseless_value(item, chance) for _ in range(chance.randrange(4))]
