"""Changes of the values or the place in a serialised message, without decoding the rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from google.protobuf.message import Message

from afspm.basics.errors import WireError
from afspm.model import ProbePosition, Region
from afspm.wire import unit_conversion
from afspm.wire.generated import lines_pb2, scan_pb2, spectroscopy_pb2
from afspm.wire.messages import parse
from afspm.wire.split import Buffer, nested, packed, packed_chunks, split

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# numbers of fields in proto/
_VALUES = {"Scan2d": 4, "ScanLines": 4}
_DATA_OF_SPECTRUM, _VALUES_OF_DATA = 4, 5
_NO_VALUES = 1 << 28  # a field number that no message has
_PLACES: dict[str, tuple[type[Message], Callable[[Any], Message], int]] = {
    "Scan2d": (scan_pb2.Scan2d, lambda scan: scan.params.spatial, _VALUES["Scan2d"]),
    "ScanLines": (lines_pb2.ScanLines, lambda lines: lines.params.spatial, _VALUES["ScanLines"]),
    "ScanParameters2d": (scan_pb2.ScanParameters2d, lambda parameters: parameters.spatial, _NO_VALUES),
    "Spec1d": (spectroscopy_pb2.Spec1d, lambda spectrum: spectrum.position, _DATA_OF_SPECTRUM),
}
"""By the name of a message: its class, the field that holds its place, and the field of values, which is not parsed."""


def without_values(message: str, payload: Buffer) -> bytes:
    """Return a serialised message without the values of a scan, lines or a spectrum; other messages unchanged.

    Raises:
        WireError: the bytes are no message.
    """
    if message in _VALUES:
        return split(payload, _VALUES[message])[0]
    if message == "Spec1d":
        rest, inner = split(payload, _DATA_OF_SPECTRUM)
        return rest + nested(split(b"".join(inner), _VALUES_OF_DATA)[0], _DATA_OF_SPECTRUM)
    return bytes(payload)


def with_zeros(message: str, payload: Buffer) -> bytes:
    """Return a scan, lines or a spectrum of the same length with zeros as values; other messages unchanged.

    Raises:
        WireError: the bytes are no message.
    """
    made = bytearray(payload)
    found: list[memoryview] = []
    if message in _VALUES:
        found = split(memoryview(made), _VALUES[message])[1]
    elif message == "Spec1d":
        data = split(memoryview(made), _DATA_OF_SPECTRUM)[1]
        found = [one for part in data for one in split(part, _VALUES_OF_DATA)[1]]
    for one in found:
        one[:] = bytes(len(one))
    return bytes(made)


def with_values(message: str, head: bytes, values: NDArray[np.float64]) -> bytes:
    """Return a message from `without_values` with values: [y, x] of a scan or lines, (points, variables) of a spectrum.

    Raises:
        WireError: the bytes are no message.
    """
    if message in _VALUES:
        return b"".join((head, *packed(values, _VALUES[message])))
    rest, inner = split(head, _DATA_OF_SPECTRUM)
    data = b"".join((*inner, *packed(values, _VALUES_OF_DATA)))
    return rest + nested(data, _DATA_OF_SPECTRUM)


def with_nan(head: bytes) -> bytes:
    """Return a spectrum from `without_values` with NaN for every value.

    Raises:
        WireError: the bytes are no spectrum.
    """
    import numpy as np

    data = parse(spectroscopy_pb2.Spec1d, head).data
    return with_values("Spec1d", head, np.full((data.data_per_variable, data.num_variables), np.nan))


def encode_place(place: Region | ProbePosition) -> bytes:
    """Return a place in bytes as the message field: a SpatialAspects, or a ProbePosition."""
    if isinstance(place, Region):
        return unit_conversion.spatial_to_wire(place).SerializeToString()
    return unit_conversion.position_to_wire(place).SerializeToString()


def place_in(name: str, payload: Buffer) -> bytes:
    """Return the place in a ScanParameters2d or a ProbePosition, unchanged to the bit, in its own unit.

    Raises:
        WireError: the bytes are no such message.
    """
    if name == "ProbePosition":
        return parse(spectroscopy_pb2.ProbePosition, payload).SerializeToString()
    return parse(scan_pb2.ScanParameters2d, payload).spatial.SerializeToString()


def relocated(name: str, payload: Buffer, place: bytes) -> bytes:
    """Return a Scan2d, ScanLines, ScanParameters2d, Spec1d or ProbePosition at another place, otherwise unchanged.

    Raises:
        WireError: the bytes are no such message, or messages of this name have no place.
    """
    if name == "ProbePosition":
        return place
    if name not in _PLACES:
        raise WireError(f"a {name} has no place")
    kind, part_of, values_field = _PLACES[name]
    rest, values = split(payload, values_field)
    message = parse(kind, rest)
    part = part_of(message)
    part.Clear()
    part.ParseFromString(place)
    # a place of default values alone has no bytes, but must be present
    part.SetInParent()
    return b"".join((message.SerializeToString(), *(packed_chunks(values, values_field) if values else [])))
