"""NetCDF, classic format (64-bit offsets): arrays with named dimensions, units and attributes in one file.

xarray, MATLAB, Gwyddion's users' scripts, `ncdump` … read it. Of the format only what scans need is here:
numbers and texts, no records; what is written are float64. The format: Unidata, "The NetCDF Classic Format
Specification".
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from afspm.errors import FileError

_MAGIC = b"CDF\x02"
_DIMENSIONS, _VARIABLES, _ATTRIBUTES = 10, 11, 12
_CHAR, _DOUBLE = 2, 6
_KINDS = {1: ">i1", _CHAR: "S1", 3: ">i2", 4: ">i4", 5: ">f4", _DOUBLE: ">f8"}
_OFFSETS = {b"CDF\x01": ">i", _MAGIC: ">q"}  # of where arrays begin

Attributes = Mapping[str, str | float]


@dataclass(frozen=True)
class Variable:
    """One array: the names of its dimensions, float64 values, attributes such as its units."""

    dimensions: tuple[str, ...]
    values: NDArray[np.float64]
    attributes: Attributes = field(default_factory=dict)


@dataclass(frozen=True)
class File:
    """What is in a file: arrays of numbers, those of characters as texts, and what is said of the whole."""

    variables: Mapping[str, Variable]
    texts: Mapping[str, str]
    attributes: Attributes


def encoded(variables: Mapping[str, Variable], attributes: Attributes) -> bytes:
    """The bytes of a file."""
    sizes = {
        name: size
        for variable in variables.values()
        for name, size in zip(variable.dimensions, variable.values.shape, strict=True)
    }
    ids = {name: number for number, name in enumerate(sizes)}
    dimensions = b"".join(_text(name) + struct.pack(">i", size) for name, size in sizes.items())
    head = _MAGIC + struct.pack(">i", 0) + _list(_DIMENSIONS, len(sizes), dimensions) + _attributes(attributes)

    def described(begins: list[int]) -> bytes:
        entries = b""
        for (name, variable), begin in zip(variables.items(), begins, strict=True):
            axes = [ids[dimension] for dimension in variable.dimensions]
            entries += _text(name) + struct.pack(f">i{len(axes)}i", len(axes), *axes)
            # the size field of an array beyond 4 GiB is not used
            size = min(variable.values.size * 8, 2**32 - 4)
            entries += _attributes(variable.attributes) + struct.pack(">iIq", _DOUBLE, size, begin)
        return _list(_VARIABLES, len(variables), entries)

    begin = len(head) + len(described([0] * len(variables)))
    begins = []
    for variable in variables.values():
        begins.append(begin)
        begin += variable.values.size * 8
    data = [variable.values.astype(">f8").tobytes() for variable in variables.values()]
    return b"".join([head, described(begins), *data])


def read(path: Path) -> File:
    """The variables and the global attributes of a file of the classic format.

    Raises:
        FileError: missing, not whole, or something else.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileError(f"can't be read: {error}", where=str(path)) from error
    if content[:4] not in _OFFSETS:
        raise FileError("is no NetCDF file of the classic format", where=str(path))
    try:
        return _Reader(content).file()
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise FileError(f"is not whole: {error}", where=str(path)) from error


class _Reader:
    def __init__(self, content: bytes) -> None:
        self._content = content
        self._offset = _OFFSETS[content[:4]]
        self._at = 8

    def file(self) -> File:
        if self._content[4:8] != bytes(4):
            raise ValueError("it has records, which is not read")
        dimensions = [(self._text(), self._take(">i")) for _ in range(self._count(_DIMENSIONS))]
        attributes = self._attributes()
        variables: dict[str, Variable] = {}
        texts: dict[str, str] = {}
        for _ in range(self._count(_VARIABLES)):
            name = self._text()
            axes = [dimensions[self._index(len(dimensions))] for _ in range(self._size())]
            own = self._attributes()
            kind = self._take(">i")
            self._take(">I")  # the size, which the shape says too
            values = self._values(kind, tuple(size for _, size in axes), self._take(self._offset))
            if kind == _CHAR:
                texts[name] = _decoded(values.tobytes())
            else:
                variables[name] = Variable(tuple(axis for axis, _ in axes), values.astype(np.float64), own)
        return File(variables, texts, attributes)

    def _values(self, kind: int, shape: tuple[int, ...], begin: int) -> NDArray[Any]:
        count = math.prod(shape)
        if min(shape, default=1) < 1 or begin < 0 or kind not in _KINDS:
            raise ValueError(f"an array of type {kind} and shape {shape} at byte {begin}")
        return np.frombuffer(self._content, _KINDS[kind], count, begin).reshape(shape)

    def _take(self, kind: str) -> int:
        (value,) = struct.unpack_from(kind, self._content, self._at)
        self._at += struct.calcsize(kind)
        return int(value)

    def _count(self, tag: int) -> int:
        found, count = self._take(">i"), self._size()
        if found != tag and (found, count) != (0, 0):
            raise ValueError(f"a list of kind {found} where one of {tag} was to be")
        return count

    def _size(self) -> int:
        """How many of something follow: no more than there are bytes."""
        size = self._take(">i")
        if not 0 <= size <= len(self._content) - self._at:
            raise ValueError(f"{size} of something in {len(self._content)} bytes")
        return size

    def _index(self, count: int) -> int:
        index = self._take(">i")
        if not 0 <= index < count:
            raise ValueError(f"number {index} of {count}")
        return index

    def _raw(self, length: int) -> bytes:
        raw = self._content[self._at : self._at + length]
        self._at += length + -length % 4
        return raw

    def _text(self) -> str:
        return self._raw(self._size()).decode()

    def _attributes(self) -> dict[str, str | float]:
        """Text as it is, of numbers the first."""
        found: dict[str, str | float] = {}
        for _ in range(self._count(_ATTRIBUTES)):
            name, kind, count = self._text(), self._take(">i"), self._size()
            if kind not in _KINDS:
                raise ValueError(f"an attribute of type {kind}")
            raw = self._raw(count * np.dtype(_KINDS[kind]).itemsize)
            found[name] = _decoded(raw) if kind == _CHAR else float(np.frombuffer(raw, _KINDS[kind], 1)[0])
        return found


def _decoded(raw: bytes) -> str:
    return raw.split(b"\0", 1)[0].decode("utf-8", "replace")


def _list(tag: int, count: int, entries: bytes) -> bytes:
    return struct.pack(">ii", tag if count else 0, count) + entries


def _text(text: str) -> bytes:
    raw = text.encode()
    return struct.pack(">i", len(raw)) + raw + b"\0" * (-len(raw) % 4)


def _attributes(attributes: Attributes) -> bytes:
    entries = b""
    for name, value in attributes.items():
        entries += _text(name)
        if isinstance(value, str):
            entries += struct.pack(">i", _CHAR) + _text(value)
        else:
            entries += struct.pack(">iid", _DOUBLE, 1, value)
    return _list(_ATTRIBUTES, len(attributes), entries)
