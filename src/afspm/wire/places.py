"""The place that a message speaks of, changed without touching its values."""

from __future__ import annotations

from google.protobuf.message import Message

from afspm.errors import WireError
from afspm.model import ProbePosition, Region
from afspm.wire import convert
from afspm.wire.generated.lines_pb2 import ScanLines
from afspm.wire.generated.scan_pb2 import Scan2d, ScanParameters2d
from afspm.wire.generated.spectroscopy_pb2 import ProbePosition as ProbePositionMessage
from afspm.wire.generated.spectroscopy_pb2 import Spec1d
from afspm.wire.messages import parse
from afspm.wire.split import Chunks, nested, packed_chunks, split

Buffer = bytes | memoryview

_VALUES_OF_SCAN = 4
_DATA_OF_SPECTRUM = 4


def encode_place(place: Region | ProbePosition) -> bytes:
    """A place as the part of a message that says it: a SpatialAspects, or a ProbePosition."""
    if isinstance(place, Region):
        return convert.spatial_to_wire(place).SerializeToString()
    return convert.position_to_wire(place).SerializeToString()


def place_in(name: str, payload: Buffer) -> bytes:
    """The same as it stands in a ScanParameters2d or a ProbePosition, to the last bit and in its own unit.

    Raises:
        WireError: the bytes are no such message.
    """
    if name == "ScanParameters2d":
        return parse(ScanParameters2d, payload).spatial.SerializeToString()
    return parse(ProbePositionMessage, payload).SerializeToString()


def relocated(name: str, payload: Buffer, place: bytes) -> bytes:
    """A Scan2d, ScanLines, ScanParameters2d, Spec1d or ProbePosition with another place; all else is as it was.

    Raises:
        WireError: the bytes are no such message, or messages of this name have no place.
    """
    if name == "Scan2d":
        rest, values = split(payload, _VALUES_OF_SCAN)
        scan = parse(Scan2d, rest)
        _put(scan.params.spatial, place)
        return b"".join((scan.SerializeToString(), *_values(values)))
    if name == "ScanLines":
        rest, values = split(payload, _VALUES_OF_SCAN)
        lines = parse(ScanLines, rest)
        _put(lines.params.spatial, place)
        return b"".join((lines.SerializeToString(), *_values(values)))
    if name == "ScanParameters2d":
        parameters = parse(ScanParameters2d, payload)
        _put(parameters.spatial, place)
        return parameters.SerializeToString()
    if name == "Spec1d":
        rest, data = split(payload, _DATA_OF_SPECTRUM)
        spectrum = parse(Spec1d, rest)
        _put(spectrum.position, place)
        return spectrum.SerializeToString() + (nested(b"".join(data), _DATA_OF_SPECTRUM) if data else b"")
    if name == "ProbePosition":
        return place
    raise WireError(f"a {name} has no place")


def _put(part: Message, place: bytes) -> None:
    part.Clear()
    part.ParseFromString(place)
    part.SetInParent()


def _values(chunks: Chunks) -> Chunks:
    return packed_chunks(chunks, _VALUES_OF_SCAN) if chunks else []
