"""A published packet, and its header, which can be read without the values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


# not frozen, as the events of `transport.port`: frozen dataclasses take twice as long to make
@dataclass(slots=True)
class Packet:
    """A published message.

    Attributes:
        envelope: the topic of the packet, to which receivers subscribe.
        payload: the serialised message.
        time_ns: time of its first publication, ns since the Unix epoch; None for packets of peers without times.
    """

    envelope: str
    payload: bytes | memoryview
    time_ns: int | None = None


class LoggedPacket(NamedTuple):
    """A packet with its fields in the packet log.

    Attributes:
        source_ns: the translator's time of the packet; None for the scheduler's own packets.
        history: number of packets of its envelope that the scheduler's cache keeps; 0: not cached.
    """

    packet: Packet
    source_ns: int | None
    history: int


@dataclass(frozen=True, slots=True)
class PacketHeader:
    """The header of a packet, on which its envelope may depend.

    Attributes:
        message: the name of the message, e.g. "Scan2d".
        channel: channel of a scan or a list of places.
        size_m: (width, height) of a scan's region in m.
        kind: kind of a spectrum, e.g. "IV".
        time_ns: time of measurement, ns since the Unix epoch; None if the message has none.
    """

    message: str
    channel: str | None = None
    size_m: tuple[float, float] | None = None
    kind: str | None = None
    time_ns: int | None = None
