"""Limits of the holder of control: a lease if it is idle, a grace period if disconnected, a number of restarts."""

from __future__ import annotations

import math
from dataclasses import dataclass

from afspm.basics.frozen import replace
from afspm.model.sessions import SessionTable

MOST_RESTARTS = 3
"""Restarts of the holder's process, since it was granted control, after which control is revoked.

Each restart is within the grace period, so nothing else bounds how long a component that freezes in its block each time
keeps the others out. One or two restarts are worth their continuation: the measurement so far is kept."""


@dataclass(frozen=True)
class Lease:
    """The idle time after which the holder loses control.

    The lease of the experiment file counts in experiment time while the microscope is free, so that a simulated night
    gives the same decisions. A lease that the holder requested counts in real time, also while the microscope is busy:
    such a holder acts for a client that may vanish without losing a connection.

    Attributes:
        lease_ns: longest idle time by the experiment file, in experiment time; None: no limit.
        asked_s: longest idle time that the holder requested, real; None: no such request.
        token: the session token of the process that was granted control.
        announced: the holder named last in the log.
        starts: how often the holder's process had been started when its supervisor first reported it in control; None:
            no report yet. Lost at a restart of the scheduler, from which on restarts are then counted.
    """

    lease_ns: int | None = None
    holder: str | None = None
    token: str | None = None
    announced: str | None = None
    idle_since_ns: int = 0
    asked_s: float | None = None
    idle_since_s: float = 0.0
    starts: int | None = None

    def held_by(self, holder: str | None, now_ns: int) -> Lease:
        """Register the holder; a new holder starts without idle time and without a requested lease.

        Args:
            holder: the component in control; None: no component.
        """
        if holder == self.holder:
            return self
        return replace(self, holder=holder, idle_since_ns=now_ns, asked_s=None, starts=None)

    def used(self, now_ns: int) -> Lease:
        """Restart the idle time in experiment time: the microscope began or ended an activity."""
        return replace(self, idle_since_ns=max(self.idle_since_ns, now_ns))

    def waiting(self, until_ns: int) -> Lease:
        """Begin the idle time in experiment time later: a limit lets the holder wait until then."""
        return replace(self, idle_since_ns=until_ns)

    def commanded(self, now_ns: int, now_s: float) -> Lease:
        """Restart both idle times: a command of the holder was sent, or has succeeded."""
        return replace(self, idle_since_ns=now_ns, idle_since_s=now_s)

    def asked(self, lease_s: float | None, now_s: float) -> Lease:
        """Begin or renew the lease that the holder requests; None: end it."""
        return replace(self, asked_s=lease_s, idle_since_s=now_s)

    def reported(self, starts: int | None) -> Lease:
        """Register the number of starts of the holder's process; only the first since it got control counts."""
        return self if self.holder is None or self.starts is not None else replace(self, starts=starts)

    def is_restarted_too_often(self, starts: int | None) -> bool:
        """Return whether the holder's process was restarted `MOST_RESTARTS` times since it got control.

        Args:
            starts: number of starts of the process by now; None: no supervisor reports it.
        """
        return starts is not None and self.starts is not None and starts - self.starts >= MOST_RESTARTS

    def asked_until_s(self) -> float | None:
        """Return the real time at which the lease requested by the holder expires; None without such a lease."""
        return None if self.asked_s is None or self.holder is None else self.idle_since_s + self.asked_s

    def deadline_ns(self, *, is_free: bool) -> int | None:
        """Return when the lease of the experiment file expires; None while busy, or without lease or holder."""
        if self.lease_ns is None or self.holder is None or not is_free:
            return None
        return self.idle_since_ns + self.lease_ns


@dataclass(frozen=True)
class HolderTimeout:
    """The grace period of a disconnected holder, which may reconnect or be restarted.

    Attributes:
        grace_s: real time before control is revoked.
        restart_grace_s: the same for a holder without a connection since the scheduler itself was restarted.
        started_s: real time of the scheduler's start.
        next_loss_log_s: no further loss is logged before this time, real.
    """

    grace_s: float
    restart_grace_s: float
    started_s: float = 0.0
    next_loss_log_s: float = -math.inf

    def dead_at_s(self, holder: str | None, sessions: SessionTable, over_since_s: float | None) -> float | None:
        """Return when control is revoked unless the holder comes back; None if no holder is disconnected.

        Args:
            over_since_s: real time at which the holder's process ended for good; None: no known end.
        """
        if holder is None or sessions.connection_of(holder) is not None:
            return None
        lost_s = sessions.lost_since_s(holder)
        # -inf: ended before the scheduler's restart. The present holder may be another process, started by hand
        if over_since_s is not None and over_since_s > -math.inf:
            # the exit is reported by the supervisor, the loss by the socket: either may arrive first
            is_this_life = sessions.since_s(holder) <= over_since_s
            if is_this_life and (lost_s is None or lost_s <= over_since_s + self.grace_s):
                return over_since_s
        return self.started_s + self.restart_grace_s if lost_s is None else lost_s + self.grace_s

    def loss_logged(self, now_s: float) -> HolderTimeout:
        """Suppress logs of further losses within the grace period: a connection may come and go."""
        return replace(self, next_loss_log_s=now_s + self.grace_s)
