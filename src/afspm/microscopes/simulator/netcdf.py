"""NetCDF, classic format (64-bit offsets): arrays with named dimensions, units and attributes in one file.

xarray, MATLAB, Gwyddion's users' scripts, `ncdump` … read it. Of the format only what a scan needs is here:
arrays of float64 and attributes that are text or float64. The format: Unidata, "The NetCDF Classic Format
Specification".
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from afspm.errors import FileError
from afspm.runtime.memory import write_whole

_MAGIC = b"CDF\x02"
_DIMENSIONS, _VARIABLES, _ATTRIBUTES = 10, 11, 12
_CHAR, _DOUBLE = 2, 6

Attributes = Mapping[str, str | float]


@dataclass(frozen=True)
class Variable:
    """One array: the names of its dimensions, float64 values, attributes such as its units."""

    dimensions: tuple[str, ...]
    values: NDArray[np.float64]
    attributes: Attributes = field(default_factory=dict)


def write(path: Path, variables: Mapping[str, Variable], attributes: Attributes) -> None:
    """Write a file, whole or not at all.

    Raises:
        FileError: it can't be written.
    """
    write_whole(path, [encoded(variables, attributes)])


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


def read(path: Path) -> tuple[dict[str, Variable], dict[str, str | float]]:
    """The variables and the global attributes of a file that `write` wrote.

    Raises:
        FileError: missing, not whole, or something else.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FileError(f"can't be read: {error}", where=str(path)) from error
    if content[:4] != _MAGIC:
        raise FileError("is not a NetCDF file of ours", where=str(path))
    try:
        return _Reader(content).file()
    except (struct.error, ValueError, IndexError) as error:
        raise FileError(f"is not whole: {error}", where=str(path)) from error


class _Reader:
    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 8

    def file(self) -> tuple[dict[str, Variable], dict[str, str | float]]:
        dimensions = [(self._text(), self._take(">i")) for _ in range(self._count())]
        attributes = self._attributes()
        variables = {}
        for _ in range(self._count()):
            name = self._text()
            axes = [dimensions[self._take(">i")] for _ in range(self._take(">i"))]
            own = self._attributes()
            self._take(">i")  # the type: always double
            self._take(">I")  # the size, which the shape says too
            shape = tuple(size for _, size in axes)
            values = np.frombuffer(self._content, ">f8", int(np.prod(shape)), self._take(">q"))
            variables[name] = Variable(tuple(axis for axis, _ in axes), values.astype(np.float64).reshape(shape), own)
        return variables, attributes

    def _take(self, kind: str) -> int:
        (value,) = struct.unpack_from(kind, self._content, self._at)
        self._at += struct.calcsize(kind)
        return int(value)

    def _count(self) -> int:
        self._take(">i")  # which list it is, or 0 for none
        return self._take(">i")

    def _text(self) -> str:
        length = self._take(">i")
        text = self._content[self._at : self._at + length].decode()
        self._at += length + -length % 4
        return text

    def _attributes(self) -> dict[str, str | float]:
        found: dict[str, str | float] = {}
        for _ in range(self._count()):
            name = self._text()
            if self._take(">i") == _CHAR:
                found[name] = self._text()
            else:
                self._take(">i")
                (found[name],) = struct.unpack_from(">d", self._content, self._at)
                self._at += 8
        return found


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
