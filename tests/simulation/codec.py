"""A quick substitute for the wire format: objects travel as numbers into a table. It hides errors of encoding."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from afspm import wire
from afspm.basics.errors import WireError
from afspm.model import PacketHeader, Parameter, Request


class TableCodec:
    """See `scheduler.events.Codec`; a payload is the number of its object, in ASCII."""

    def __init__(self) -> None:
        self._objects: dict[bytes, Any] = {}
        self._numbers: dict[tuple[type, Any], bytes] = {}

    def encode(self, thing: Any) -> bytes:
        key = (type(thing), thing)  # 1 and 1.0 are equal, and are two subjects
        payload = self._numbers.get(key)
        if payload is None:
            payload = self._numbers[key] = b"%d" % len(self._objects)
            self._objects[payload] = thing
        return payload

    def decode(self, payload: bytes | memoryview) -> Any:
        """Return the object.

        Raises:
            WireError: the payload is the number of none.
        """
        try:
            return self._objects[bytes(payload)]
        except KeyError:
            raise WireError(f"{bytes(payload)!r} is no number of an object") from None

    # --- see `scheduler.shell.Messages` ---

    id_of = staticmethod(wire.id_of)
    encode_response = staticmethod(wire.encode_response)
    decode_response = staticmethod(wire.decode_response)

    def encode_request(self, request: Request) -> list[bytes]:
        return [bytes([request.kind]), self.encode(request.subject), request.id.encode()]

    def decode_request(self, frames: Sequence[bytes]) -> Request:
        if len(frames) != 3 or len(frames[0]) != 1:
            raise WireError(f"{len(frames)} frames are no request")
        return Request(frames[0][0], self.decode(frames[1]), frames[1], frames[2].decode())

    def header(self, envelope: str, payload: bytes | memoryview) -> PacketHeader:
        self.decode(payload)
        return PacketHeader(envelope)

    def decode_parameter(self, payload: bytes) -> Parameter | None:
        thing = self.decode(payload)
        return thing if isinstance(thing, Parameter) else None

    def decode_packet(self, message: str, payload: bytes | memoryview) -> Any:
        return self.decode(payload)
