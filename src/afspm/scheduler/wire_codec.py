"""The wire, as far as the scheduler's decisions need it."""

from __future__ import annotations

from collections.abc import Sequence

from afspm import wire
from afspm.errors import AfspmError
from afspm.model import Parameter


class WireCodec:
    """See `logic.events.Codec`."""

    def encode_action(self, name: str) -> bytes:
        return wire.encode_subject(name)

    def decode_parameter(self, payload: bytes) -> Parameter | None:
        try:
            return wire.decode_parameter(payload)
        except AfspmError:
            return None

    def encode(self, thing: object) -> bytes:
        return wire.encode(thing)[1]

    def encode_orders(self, restart: Sequence[str]) -> bytes:
        return wire.encode_orders(restart)

    def relocated(self, message: str, payload: bytes | memoryview, told: bytes) -> bytes:
        """See `scheduler.drift.places.PlaceCodec`."""
        of = "ProbePosition" if message in ("Spec1d", "ProbePosition") else "ScanParameters2d"
        return wire.relocated(message, payload, wire.place_in(of, told))

    def decode_packet(self, message: str, payload: bytes | memoryview) -> object:
        try:
            return wire.decode(message, payload)
        except AfspmError:
            return None
