"""A quick substitute for the wire format: objects travel as numbers into a table. It hides errors of encoding."""

from __future__ import annotations

from typing import Any

from afspm.model import Parameter


class TableCodec:
    """See `scheduler.events.Codec`; a payload is the number of its object, in ASCII."""

    def __init__(self) -> None:
        self._objects: dict[bytes, Any] = {}
        self._numbers: dict[Any, bytes] = {}

    def encode(self, thing: Any) -> bytes:
        payload = self._numbers.get(thing)
        if payload is None:
            payload = self._numbers[thing] = b"%d" % len(self._objects)
            self._objects[payload] = thing
        return payload

    def decode(self, payload: bytes | memoryview) -> Any:
        return self._objects[bytes(payload)]

    def decode_parameter(self, payload: bytes) -> Parameter | None:
        thing = self.decode(payload)
        return thing if isinstance(thing, Parameter) else None

    def decode_packet(self, message: str, payload: bytes | memoryview) -> Any:
        return self.decode(payload)
