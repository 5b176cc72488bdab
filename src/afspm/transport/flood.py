"""When packets come faster than it is worth being woken up for each of them."""

from __future__ import annotations

REST_MS = 2
"""Then what comes within this time is handled in one go. Where many processes share a processor, to wake one of them up
takes several times as long as what it then does with a packet: its code is in no cache."""
FAST_PER_S = 800.0
TOO_FAST_PER_S = 6000.0
"""Beyond it there is always something more once one is handled."""
_LOOKED_AT_S = 0.02


class Flood:
    """Counts packets. A few that belong together, as the channels of a scan, are no flood."""

    def __init__(self) -> None:
        self.is_on = False
        self._count = 0
        self._since_s = 0.0

    def came(self, packets: int, now_s: float) -> None:
        """So many have come, at a real monotonic time."""
        self._count += packets
        lasted_s = now_s - self._since_s
        if lasted_s >= _LOOKED_AT_S:
            self.is_on = FAST_PER_S <= self._count / lasted_s <= TOO_FAST_PER_S
            self._count, self._since_s = 0, now_s
