"""A published packet, and its header, which is known without reading its values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


@dataclass(slots=True)
class Packet:
    """A published message.

    Attributes:
        envelope: the text by which it is subscribed to.
        payload: the serialised message.
        time_ns: when it was first published, ns since the Unix epoch; None from peers that do not say.
    """

    envelope: str
    payload: bytes | memoryview
    time_ns: int | None = None


class LoggedPacket(NamedTuple):
    """A packet as it stands in the packet log.

    Attributes:
        source_ns: the time that the translator gave it; None: it is the scheduler's own.
        history: how many packets of its envelope the scheduler's cache keeps; 0: this one is not cached.
    """

    packet: Packet
    source_ns: int | None
    history: int


@dataclass(frozen=True, slots=True)
class PacketHeader:
    """The header of a packet, on which its envelope may depend.

    Attributes:
        message: the name of the message, e.g. "Scan2d".
        channel: of a scan or a list of places.
        size_m: (x, y) of a scan's region.
        kind: of a spectrum, e.g. "IV".
        time_ns: when it was measured, ns since the Unix epoch, if it says.
    """

    message: str
    channel: str | None = None
    size_m: tuple[float, float] | None = None
    kind: str | None = None
    time_ns: int | None = None
