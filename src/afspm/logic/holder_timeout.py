"""How long a holder that is gone stays in control: it may only have lost its connection, or be started again."""

from __future__ import annotations

import math
from collections.abc import Callable

from afspm.logic.sessions import SessionTable
from afspm.model import component_of


class HolderTimeout:
    """Counts how long the holder has been gone, in real time.

    Args:
        sessions: knows who is connected, and since when somebody is not.
        grace_s: so long it stays in control.
        restart_grace_s: the same for one that has not been heard of since the scheduler itself was restarted.
        over_since_s: since when (real) it is known that a process is over and not started again; None if it is not.
    """

    def __init__(
        self,
        sessions: SessionTable,
        grace_s: float,
        restart_grace_s: float,
        over_since_s: Callable[[str], float | None] = lambda process: None,
    ) -> None:
        self._grace_s = grace_s
        self._restart_grace_s = restart_grace_s
        self._sessions = sessions
        self._over_since_s = over_since_s
        self._started_s = 0.0
        self._told_again_s = -math.inf

    def started(self, now_s: float) -> None:
        """The scheduler was started: from now on somebody can be heard of."""
        self._started_s = now_s

    def dead_at_s(self, holder: str | None) -> float | None:
        """When the holder is given up, if it does not come back; None if it is there, or nobody is in control."""
        if holder is None or self._sessions.connection_of(holder) is not None:
            return None
        over_s = self._over_since_s(component_of(holder))
        if over_s is not None and self._is_of_the_life_before(holder, over_s):
            return over_s
        lost_s = self._sessions.lost_since_s(holder)
        if lost_s is None:
            return self._started_s + self._restart_grace_s
        return lost_s + self._grace_s

    def _is_of_the_life_before(self, holder: str, over_s: float) -> bool:
        """Whether it is the life of the holder that was over then, and none that began anew or goes on beside that.

        The two come by different ways, so that it may be known a little earlier than the connection is lost.
        """
        if over_s == -math.inf:  # known before our restart: whoever was in control then may be another, by hand
            return False
        lost_s = self._sessions.lost_since_s(holder)
        return self._sessions.since_s(holder) <= over_s and (lost_s is None or lost_s <= over_s + self._grace_s)

    def is_told(self, now_s: float) -> bool:
        """Whether people are told now that the holder is gone: not each time of a connection that comes and goes."""
        if now_s < self._told_again_s:
            return False
        self._told_again_s = now_s + self._grace_s
        return True
