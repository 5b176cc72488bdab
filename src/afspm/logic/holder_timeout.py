"""When the holder loses control for doing nothing (its lease) or for being gone (its grace period)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from afspm.logic.frozen import replace
from afspm.logic.sessions import SessionTable


@dataclass(frozen=True)
class Lease:
    """The idle time of the holder while the microscope is free, in experiment time: a simulated night decides alike.

    Attributes:
        lease_ns: longest idle time; None: no limit.
        token: of the life of the holder that was granted control.
        announced: the last holder that was logged.
    """

    lease_ns: int | None = None
    holder: str | None = None
    token: str | None = None
    announced: str | None = None
    idle_since_ns: int = 0

    def held_by(self, holder: str | None, now_ns: int) -> Lease:
        """Restart the idle time for another holder, or for nobody."""
        return self if holder == self.holder else replace(self, holder=holder, idle_since_ns=now_ns)

    def used(self, now_ns: int) -> Lease:
        """Restart the idle time: a request was accepted, or the microscope began or ended something."""
        return replace(self, idle_since_ns=now_ns)

    def deadline_ns(self, *, is_free: bool) -> int | None:
        """Return when the lease runs out; None while the microscope is busy, or nobody is in control."""
        if self.lease_ns is None or self.holder is None or not is_free:
            return None
        return self.idle_since_ns + self.lease_ns


@dataclass(frozen=True)
class HolderTimeout:
    """The grace period of a holder that is gone: it may only have lost its connection, or be started again.

    Attributes:
        grace_s: real time before control is revoked.
        restart_grace_s: the same for a holder that has not been heard of since the scheduler itself was restarted.
    """

    grace_s: float
    restart_grace_s: float
    started_s: float = 0.0
    told_again_s: float = -math.inf

    def dead_at_s(self, holder: str | None, sessions: SessionTable, over_since_s: float | None) -> float | None:
        """Return when control is revoked unless the holder comes back; None while it is connected.

        Args:
            over_since_s: since when its process is known to be over and not started again; None if it is not.
        """
        if holder is None or sessions.connection_of(holder) is not None:
            return None
        lost_s = sessions.lost_since_s(holder)
        # -inf: known before our restart: whoever was in control then may be another, by hand
        if over_since_s is not None and over_since_s > -math.inf:
            # exit and lost connection come by different ways, so either may be known a little earlier
            is_this_life = sessions.since_s(holder) <= over_since_s
            if is_this_life and (lost_s is None or lost_s <= over_since_s + self.grace_s):
                return over_since_s
        return self.started_s + self.restart_grace_s if lost_s is None else lost_s + self.grace_s

    def told(self, now_s: float) -> HolderTimeout:
        """Log no other loss within the grace period: a connection may come and go."""
        return replace(self, told_again_s=now_s + self.grace_s)
