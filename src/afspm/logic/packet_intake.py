"""What the translator publishes, on its way to everybody."""

from __future__ import annotations

from collections.abc import Callable

from afspm.errors import AfspmError
from afspm.logic.cache import PacketCache
from afspm.logic.coordinate_frame import CoordinateFrame
from afspm.logic.events import Log, Publish
from afspm.logic.scheduler_publisher import CONTROL_STATE
from afspm.model import Packet, PacketHeader

SPECTRUM = "Spec1d"
_MOST_TOLD = 1000
_DOUBT = (
    "the translator is of version 1: those of the published implementation for Nanonis and Asylum send the values of a "
    "spectrum variable after variable; if curves look scrambled, set spectra_by_variable = true in [control]"
)


class PacketIntake:
    """Takes packets in: each is given its envelope, its time and its coordinates, or is dropped.

    Args:
        frame: the coordinates that components speak of, where they are not those of the microscope.
        by_point: puts the values of a spectrum in order; None: they are.
    """

    def __init__(
        self,
        cache: PacketCache,
        frame: CoordinateFrame | None = None,
        by_point: Callable[[bytes | memoryview], bytes] | None = None,
    ) -> None:
        self._cache = cache
        self._frame = frame
        self._by_point = by_point
        self._told: set[str] = set()

    def take(self, packet: Packet, header: PacketHeader, now_ns: int) -> Publish | Log | None:
        """What to publish; or why it is dropped, if that has not been told yet; None: we have had it."""
        if header.message == CONTROL_STATE:
            return self._once("WARNING", "the translator publishes a ControlState, which is the scheduler's: dropped")
        source_ns = packet.time_ns
        try:
            if self._by_point is not None and header.message == SPECTRUM:
                packet = Packet(packet.envelope, self._by_point(packet.payload), packet.time_ns)
            if self._frame is not None:
                packet = self._frame.incoming(packet, header, now_ns)
            taken = self._cache.take(packet, header, now_ns)
        except AfspmError as error:
            return self._once("ERROR", f"{header.message} is not published: {error}")
        return None if taken is None else Publish(taken[0], source_ns, taken[1])

    def doubted(self, header: PacketHeader) -> Log | None:
        """What is to be said, once, of a packet of a translator of version 1."""
        if header.message != SPECTRUM or self._by_point is not None:
            return None
        return self._once("WARNING", _DOUBT)

    def _once(self, level: str, text: str) -> Log | None:
        """What is to be logged, if it was not yet."""
        if text in self._told or len(self._told) >= _MOST_TOLD:
            return None
        self._told.add(text)
        return Log(level, text)
