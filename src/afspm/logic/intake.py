"""What the translator publishes, on its way to everybody."""

from __future__ import annotations

from afspm.errors import AfspmError
from afspm.logic.bulletin import CONTROL_STATE
from afspm.logic.cache import Cache
from afspm.logic.events import Log, Publish
from afspm.logic.frame import CoordinateFrame
from afspm.model import Packet, PacketHeader

_MOST_TOLD = 1000


class Intake:
    """Takes packets in: each is given its envelope, its time and its coordinates, or is dropped.

    Args:
        frame: the coordinates that components speak of, where they are not those of the microscope.
    """

    def __init__(self, cache: Cache, frame: CoordinateFrame | None = None) -> None:
        self._cache = cache
        self._frame = frame
        self._told: set[str] = set()

    def take(self, packet: Packet, header: PacketHeader, now_ns: int) -> Publish | Log | None:
        """What to publish; or why it is dropped, if that has not been told yet; None: we have had it."""
        if header.message == CONTROL_STATE:
            return self._once("WARNING", "the translator publishes a ControlState, which is the scheduler's: dropped")
        source_ns = packet.time_ns
        if self._frame is not None:
            packet = self._frame.incoming(packet, header, now_ns)
        try:
            taken = self._cache.take(packet, header, now_ns)
        except AfspmError as error:
            return self._once("ERROR", f"{header.message} is not published: {error}")
        return None if taken is None else Publish(taken[0], source_ns, taken[1])

    def _once(self, level: str, text: str) -> Log | None:
        if text in self._told or len(self._told) >= _MOST_TOLD:
            return None
        self._told.add(text)
        return Log(level, text)
