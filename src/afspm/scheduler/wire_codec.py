"""The wire format, as far as the scheduler's decisions need it."""

from __future__ import annotations

from afspm import wire
from afspm.basics.errors import AfspmError
from afspm.model import Parameter


class WireCodec:
    """The codec of the wire format for `scheduler.events.Codec`."""

    def decode_parameter(self, payload: bytes) -> Parameter | None:
        try:
            return wire.decode_parameter(payload)
        except AfspmError:
            return None

    def encode(self, thing: object) -> bytes:
        return wire.encode(thing)[1]

    def decode_packet(self, message: str, payload: bytes | memoryview) -> object:
        # a malformed payload is published all the same: only decisions ignore it
        try:
            return wire.decode(message, payload)
        except AfspmError:
            return None
