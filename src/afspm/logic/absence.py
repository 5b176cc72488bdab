"""How long a holder that is gone stays in control: it may only have lost its connection, or be started again."""

from __future__ import annotations

import math

from afspm.logic.sessions import Sessions


class Absence:
    """Counts how long the holder has been gone, in real time.

    Args:
        sessions: knows who is connected, and since when somebody is not.
        grace_s: so long it stays in control.
        restart_grace_s: the same for one that has not been heard of since the scheduler itself was restarted.
    """

    def __init__(self, sessions: Sessions, grace_s: float, restart_grace_s: float) -> None:
        self._grace_s = grace_s
        self._restart_grace_s = restart_grace_s
        self._sessions = sessions
        self._started_s = 0.0
        self._told_again_s = -math.inf

    def started(self, now_s: float) -> None:
        """The scheduler was started: from now on somebody can be heard of."""
        self._started_s = now_s

    def dead_at_s(self, holder: str | None) -> float | None:
        """When the holder is given up, if it does not come back; None if it is there, or nobody is in control."""
        if holder is None or self._sessions.connection_of(holder) is not None:
            return None
        lost_s = self._sessions.lost_since_s(holder)
        if lost_s is None:
            return self._started_s + self._restart_grace_s
        return lost_s + self._grace_s

    def is_told(self, now_s: float) -> bool:
        """Whether people are told now that the holder is gone: not each time of a connection that comes and goes."""
        if now_s < self._told_again_s:
            return False
        self._told_again_s = now_s + self._grace_s
        return True
