"""Restarts of a crashed process: at once the first time, then with back-off, and within a budget."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True)
class RestartPolicy:
    """Budget and back-off of restarts; all in real seconds.

    Attributes:
        budget: number of restarts allowed within `window_s`; at one more the process is given up.
        first_delay_s: before the second restart in a row; the first is at once.
        factor: growth of the delay with each further restart,
        longest_delay_s: up to this.
        healthy_s: a life longer than this ends a row of failures.
    """

    budget: int = 10
    window_s: float = 600.0
    first_delay_s: float = 0.25
    factor: float = 2.0
    longest_delay_s: float = 30.0
    healthy_s: float = 30.0


class RestartBudget:
    """Restarts of one child."""

    def __init__(self, policy: RestartPolicy) -> None:
        self._policy = policy
        self._times_s: deque[float] = deque()
        self._row = 0

    def failed(self, now_s: float, lived_s: float) -> float | None:
        """Process a crash after `lived_s`; return the delay before the next start. None: give the process up."""
        policy = self._policy
        while self._times_s and now_s - self._times_s[0] >= policy.window_s:
            self._times_s.popleft()
        if len(self._times_s) >= policy.budget:
            return None
        self._times_s.append(now_s)
        self._row = 0 if lived_s >= policy.healthy_s else self._row
        delay_s = 0.0
        if self._row:
            delay_s = min(policy.first_delay_s * policy.factor ** min(self._row - 1, 60), policy.longest_delay_s)
        self._row += 1
        return delay_s
