"""The controller's side of the TCP protocol: requests from bytes, replies to bytes.

Written apart from the translator's, which it is to be tested against.
"""

from __future__ import annotations

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
ZEROS: Final[Mapping[str, Any]] = {
    **dict.fromkeys("HIi", 0),
    **dict.fromkeys("fd", 0.0),
    "S": "",
    "A": [],
    "[i]": [],
    "[f]": [],
    "2f": np.zeros((0, 0)),
    "2S": [],
}


class Unreadable(Exception):
    """The bytes of a client are not what belongs to the function."""


@dataclass(frozen=True)
class Function:
    """One function: the codes of its fields, each with the first release that has it, and its own."""

    arguments: tuple[tuple[str, int], ...]
    results: tuple[tuple[str, int], ...]
    since: int

    def argument_codes(self, release: int) -> list[str]:
        return [code for code, since in self.arguments if since <= release]

    def result_codes(self, release: int) -> list[str]:
        return [code for code, since in self.results if since <= release]


@cache
def functions() -> Mapping[str, Function]:
    """All that there are, by name."""
    found = {}
    for line in Path(__file__).with_name("functions.txt").read_text(encoding="ascii").splitlines():
        if line and not line.startswith("#"):
            name, arguments, results, *since = re.split(" {2,}", line)
            found[name] = Function(_codes(arguments), _codes(results), int(since[0]) if since else 0)
    return found


def _codes(column: str) -> tuple[tuple[str, int], ...]:
    codes = []
    for field in column.split():
        if field != "-":
            code, _, since = field.partition("@")
            codes.append((code, int(since or 0)))
    return tuple(codes)


def split(received: bytearray) -> tuple[str, bool, bytes] | None:
    """Takes one request off: its function, whether an answer is wanted, its body; None if it is not there yet.

    Raises:
        Unreadable: these are no requests.
    """
    if len(received) < HEADER_BYTES:
        return None
    (size,) = struct.unpack_from(">i", received, 32)
    if not 0 <= size <= _LARGEST_BODY:
        raise Unreadable(f"a request of {size} bytes")
    if len(received) < HEADER_BYTES + size:
        return None
    name = bytes(received[:32]).rstrip(b"\0").decode("ascii", "replace")
    (wants_answer,) = struct.unpack_from(">H", received, 36)
    body = bytes(received[HEADER_BYTES : HEADER_BYTES + size])
    del received[: HEADER_BYTES + size]
    return name, bool(wants_answer), body


def arguments(name: str, body: bytes, release: int) -> list[Any]:
    """The arguments in the body of a request.

    Raises:
        Unreadable: too few or too many bytes.
    """
    at, found = 0, []
    try:
        for code in functions()[name].argument_codes(release):
            value, at = _unpacked(code, body, at)
            found.append(value)
    except struct.error as error:
        raise Unreadable(f"{len(body)} bytes of arguments are too few for {name}") from error
    if at != len(body):
        raise Unreadable(f"{len(body) - at} bytes of arguments too many for {name}")
    return found


def _unpacked(code: str, body: bytes, at: int) -> tuple[Any, int]:
    if len(code) == 1 and code in "HIifd":
        return struct.unpack_from(f">{code}", body, at)[0], at + struct.calcsize(f">{code}")
    if code == "A":
        at += 4  # the size in bytes, which clients reckon in different ways
    (count,) = struct.unpack_from(">i", body, at)
    at += 4
    if code == "S":
        return struct.unpack_from(f">{max(count, 0)}s", body, at)[0].decode("utf-8", "replace"), at + max(count, 0)
    if code == "A":
        texts = []
        for _ in range(count):
            text, at = _unpacked("S", body, at)
            texts.append(text)
        return texts, at
    return list(struct.unpack_from(f">{max(count, 0)}{code[1]}", body, at)), at + 4 * max(count, 0)


def reply(name: str, body: bytes) -> bytes:
    """With its header."""
    return name.encode("ascii", "replace")[:32].ljust(32, b"\0") + struct.pack(">i", len(body)) + bytes(4) + body


def body(name: str, results: Sequence[Any], release: int, encoding: str = "utf-8") -> bytes:
    """Of a reply without an error."""
    values = zip(functions()[name].results, results, strict=True)
    packed = (_packed(code, value, encoding) for (code, since), value in values if since <= release)
    return b"".join(packed) + error_block("", 0)


def error_body(name: str, text: str, release: int, *, bare: bool) -> bytes:
    """Of a reply with an error: after the results, all zero, or without any."""
    codes = [] if bare or name not in functions() else functions()[name].result_codes(release)
    return b"".join(_packed(code, ZEROS[code], "utf-8") for code in codes) + error_block(text, 1)


def error_block(text: str, status: int) -> bytes:
    """What every reply ends with."""
    return struct.pack(">I", status) + _packed("S", text, "utf-8")


def _packed(code: str, value: Any, encoding: str) -> bytes:
    if code == "S":
        raw = str(value).encode(encoding, "replace")
        return struct.pack(">i", len(raw)) + raw
    if code == "A":
        raw = b"".join(_packed("S", one, encoding) for one in value)
        return struct.pack(">ii", len(raw), len(value)) + raw
    if code == "2f":
        array = np.asarray(value, dtype=">f4")
        return struct.pack(">ii", *array.shape) + array.tobytes()
    if code == "2S":
        rows, columns = len(value), max(map(len, value), default=0)
        cells = (cell for row in value for cell in [*row, *[""] * (columns - len(row))])
        return struct.pack(">ii", rows, columns) + b"".join(_packed("S", cell, encoding) for cell in cells)
    if code in ("[i]", "[f]"):
        return struct.pack(f">i{len(value)}{code[1]}", len(value), *value)
    return struct.pack(f">{code}", value)
