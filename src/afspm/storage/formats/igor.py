"""Igor binary waves of version 5 (WaveMetrics, Technical Note 003, "Igor Binary Format").

The translator reads files that Asylum is still writing, so damaged and incomplete files must be refused. The package
igor2 (0.5.15) ignores the checksum and returns other numbers after one wrong bit, takes over 2 GB of memory for a
wrong length of a text, and needs 25 ms instead of 0.05 ms for a scan of 256² pixels with six channels. Its correct
results are the reference of the tests.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np

from afspm.basics.errors import FileError
from afspm.storage.formats.content import text_of

_DATA = 384  # offset of the values, after a header of 64 bytes and one of 320
_LABEL = 32
_KINDS = {2: "f4", 4: "f8", 8: "i1", 16: "i2", 32: "i4", 72: "u1", 80: "u2", 96: "u4"}


@dataclass(frozen=True, eq=False)
class Wave:
    """An Igor wave.

    Attributes:
        name: name of the wave.
        values: with up to four dimensions.
        unit: unit of the values.
        steps, dimension_units: step and unit of each of four dimensions.
        labels: names of the elements of each dimension; empty without names.
        note: text of the wave's note.
    """

    name: str
    values: np.ndarray
    unit: str
    steps: tuple[float, ...]
    dimension_units: tuple[str, ...]
    labels: tuple[list[str], ...]
    note: str


def read_wave(data: bytes) -> Wave:
    """Return the wave in the bytes of a file.

    Raises:
        FileError: the file has another version or no real numbers, is incomplete, or its checksum is wrong.
    """
    if len(data) < 2:
        raise FileError(f"is incomplete: {len(data)} bytes are too few for an Igor wave")
    # the version, a 16-bit number below 256, comes first: its first byte is 0 in a big-endian file
    order = "<" if data[0] else ">"
    (version,) = struct.unpack_from(f"{order}h", data)
    if version != 5:
        raise FileError(f"is an Igor wave of version {version}, not 5", hint="save it again in Igor, as version 5")
    if len(data) < _DATA:
        raise FileError(f"is incomplete: {len(data)} bytes are too few for an Igor wave")
    # the 16-bit words of both headers sum to zero (Technical Note 003)
    if int(np.frombuffer(data, f"{order}i2", _DATA // 2).sum(dtype=np.int64)) & 0xFFFF:
        raise FileError("has a damaged header: the checksum is wrong")
    formula, note = struct.unpack_from(f"{order}2i", data, 8)
    unit, *units = struct.unpack_from(f"{order}5i", data, 16)
    sizes = [formula, note, unit, *units, *struct.unpack_from(f"{order}4i", data, 36)]
    values, after = _values(data, order)
    parts = []
    for size in sizes:  # the texts follow the values in the order of their sizes
        if size < 0 or after + size > len(data):
            raise FileError("is incomplete: its strings are cut off")
        parts.append(data[after : after + size])
        after += size
    labels = tuple(_labels(part, max(n, 1)) for part, n in zip(parts[7:], (*values.shape, 1, 1, 1, 1)[:4], strict=True))
    return Wave(
        name=_text(data[92:124]),
        values=values,
        unit=_text(data[212:216]) or _text(parts[2]),
        steps=struct.unpack_from(f"{order}4d", data, 148),
        dimension_units=tuple(_text(data[216 + 4 * k : 220 + 4 * k]) or _text(parts[3 + k]) for k in range(4)),
        labels=labels,
        note=text_of(parts[1]),
    )


def _values(data: bytes, order: str) -> tuple[np.ndarray, int]:
    # values in their shape, and the offset after them
    (count,) = struct.unpack_from(f"{order}i", data, 76)
    (kind,) = struct.unpack_from(f"{order}h", data, 80)
    if kind not in _KINDS:
        raise FileError(f"an Igor wave of type {kind}, which is not real numbers")
    lengths = struct.unpack_from(f"{order}4i", data, 132)
    used = [n for n in lengths if n]
    # the first length of 0 ends the list of dimensions
    if not used or min(used) < 0 or list(lengths[: len(used)]) != used or math.prod(used) != count:
        raise FileError(f"an Igor wave of {count} values can't have the shape {used}")
    kind_of = np.dtype(f"{order}{_KINDS[kind]}")
    end = _DATA + count * kind_of.itemsize
    if end > len(data):
        raise FileError(f"is incomplete: {len(data) - _DATA} of {end - _DATA} bytes of values")
    return np.frombuffer(data, kind_of, count, _DATA).reshape(used, order="F"), end


def _labels(text: bytes, count: int) -> list[str]:
    # the first label names the dimension itself; a NUL ends a label, and the bytes after it are left from a longer text
    if not text:
        return []
    # the elements after the last one with a label have none
    if len(text) % _LABEL or len(text) > _LABEL * (count + 1):
        raise FileError(f"{len(text)} bytes of labels for a dimension of {count}")
    return [_text(text[k * _LABEL : (k + 1) * _LABEL]) for k in range(1, count + 1)]


def _text(raw: bytes) -> str:
    return text_of(raw.split(b"\0", 1)[0])
