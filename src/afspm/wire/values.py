"""Messages without their values, which are kept elsewhere, and with them again."""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.wire.codec import Buffer
from afspm.wire.split import nested, packed, split

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_VALUES = {"Scan2d": 4, "ScanLines": 4}
_DATA_OF_SPECTRUM, _VALUES_OF_DATA = 4, 5


def without_values(message: str, payload: Buffer) -> bytes:
    """A message as bytes, without the values of a scan, of lines or of a spectrum; any other as it is.

    Raises:
        WireError: the bytes are no message.
    """
    if message in _VALUES:
        return split(payload, _VALUES[message])[0]
    if message == "Spec1d":
        rest, inner = split(payload, _DATA_OF_SPECTRUM)
        return rest + nested(split(b"".join(inner), _VALUES_OF_DATA)[0], _DATA_OF_SPECTRUM)
    return bytes(payload)


def with_values(message: str, head: bytes, values: NDArray[np.float64]) -> bytes:
    """What `without_values` made, with values again: of a scan or of lines [y, x], of a spectrum (points, variables).

    Raises:
        WireError: the bytes are no message.
    """
    if message in _VALUES:
        return b"".join((head, *packed(values, _VALUES[message])))
    rest, inner = split(head, _DATA_OF_SPECTRUM)
    data = b"".join((*inner, *packed(values, _VALUES_OF_DATA)))
    return rest + nested(data, _DATA_OF_SPECTRUM)
