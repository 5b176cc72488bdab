"""When the holder loses control for doing nothing (its lease) or for being gone (its grace period)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from afspm.basics.frozen import replace
from afspm.model.sessions import SessionTable


@dataclass(frozen=True)
class Lease:
    """The idle time of the holder.

    That of the experiment file counts while the microscope is free, in experiment time: a simulated night decides
    alike. That which a holder asks for itself, as it speaks for somebody who may vanish without a connection to lose,
    counts in real time and whatever the microscope does.

    Attributes:
        lease_ns: longest idle time by the experiment file; None: no limit.
        asked_s: longest idle time that the holder asked for; None: it did not.
        token: of the life of the holder that was granted control.
        announced: the last holder that was logged.
    """

    lease_ns: int | None = None
    holder: str | None = None
    token: str | None = None
    announced: str | None = None
    idle_since_ns: int = 0
    asked_s: float | None = None
    idle_since_s: float = 0.0

    def held_by(self, holder: str | None, now_ns: int) -> Lease:
        """Restart the idle time for another holder, or for nobody."""
        return self if holder == self.holder else replace(self, holder=holder, idle_since_ns=now_ns, asked_s=None)

    def used(self, now_ns: int) -> Lease:
        """Restart the idle time while the microscope is free: it began or ended something."""
        return replace(self, idle_since_ns=now_ns)

    def commanded(self, now_ns: int, now_s: float) -> Lease:
        """Restart the idle time: a request of the holder was accepted."""
        return replace(self, idle_since_ns=now_ns, idle_since_s=now_s)

    def asked(self, lease_s: float | None, now_s: float) -> Lease:
        """Begin the lease that the holder asks for, or begin it anew."""
        return replace(self, asked_s=lease_s, idle_since_s=now_s)

    def asked_until_s(self) -> float | None:
        """Return when (real) the lease that the holder asked for runs out; None: it asked for none."""
        return None if self.asked_s is None or self.holder is None else self.idle_since_s + self.asked_s

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
