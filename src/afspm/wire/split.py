"""Extraction of an array from a serialised message as a view of the buffer, without a list of numbers.

A packed `repeated double` is tag, length, then little-endian float64 values. The values go to numpy as they are; the
small rest of the message goes to the Protocol Buffers library.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.errors import WireError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Buffer = bytes | memoryview
Chunks = list[memoryview]

_VARINT, _FIXED64, _LENGTH, _FIXED32 = 0, 1, 2, 5


def split(buffer: bytes | memoryview, field: int) -> tuple[bytes, list[memoryview]]:
    """Return a serialised message without the top-level field number `field`, and the contents of this field.

    Returns:
        The rest of the message in bytes, and the contents as views in their order: usually one.

    Raises:
        WireError: the bytes are no message.
    """
    view = memoryview(buffer)
    if view.format != "B":
        view = view.cast("B")
    rest: list[memoryview] = []
    found: list[memoryview] = []
    end, at, kept_from = len(view), 0, 0
    while at < end:
        start = at
        tag, at = varint(view, at)
        wire_type = tag & 7
        if wire_type == _LENGTH:
            length, at = varint(view, at)
        elif wire_type == _VARINT:
            _, stop = varint(view, at)
            length = stop - at
        elif wire_type == _FIXED64:
            length = 8
        elif wire_type == _FIXED32:
            length = 4
        else:
            raise WireError(f"byte {start} begins a field of the unknown kind {wire_type}")
        if at + length > end:
            raise WireError(f"the message breaks off: the field at byte {start} is longer than the rest")
        # protobuf allows a repeated field in several packed pieces, and unpacked
        if tag >> 3 == field and wire_type in (_LENGTH, _FIXED64):
            found.append(view[at : at + length])
            rest.append(view[kept_from:start])
            kept_from = at + length
        at += length
    if not found:
        return bytes(view), found
    rest.append(view[kept_from:])
    return b"".join(rest), found


def doubles(chunks: list[memoryview]) -> NDArray[np.float64]:
    """Return the contents of a `repeated double` as an array, shape (n,): a view if there is one piece.

    Raises:
        WireError: the length is not a multiple of eight bytes.
    """
    import numpy as np

    if not chunks:
        return np.empty(0)
    # the encoder of a peer may send pieces: only these are copied
    data = chunks[0] if len(chunks) == 1 else b"".join(chunks)
    if len(data) % 8:
        raise WireError(f"values of {len(data)} bytes are no float64 numbers")
    return np.frombuffer(data, "<f8")


def packed(values: NDArray[np.float64], field: int) -> tuple[bytes, memoryview]:
    """Return an array as the field number `field`: its tag and length, and its values (if possible a view)."""
    import numpy as np

    data = np.ascontiguousarray(values, "<f8").reshape(-1).data.cast("B")
    return bytes([field << 3 | _LENGTH]) + as_varint(len(data)), data


def packed_chunks(chunks: Chunks, field: int) -> Chunks:
    """Return the contents of a `repeated double` as the field number `field`, in one piece."""
    length = sum(map(len, chunks))
    return [memoryview(bytes([field << 3 | _LENGTH]) + as_varint(length)), *chunks]


def nested(payload: bytes, field: int) -> bytes:
    """Return a serialised message as the field number `field` of another message."""
    return bytes([field << 3 | _LENGTH]) + as_varint(len(payload)) + payload


def varint(view: memoryview | bytes, at: int) -> tuple[int, int]:
    """Return the number at byte `at`, and the position after it.

    Raises:
        WireError: the bytes are no varint.
    """
    value = shift = 0
    end = len(view)
    # a 64-bit number has at most ten bytes; a longer one is damage
    while at < end and shift < 64:
        byte = view[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise WireError("the message breaks off in a number")


def as_varint(value: int) -> bytes:
    """Return a non-negative number as a varint."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)
