"""When to start a crashed process again: at once the first time, later each time it fails soon, and not for ever."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True)
class RestartPolicy:
    """The frequency and delay of restarts; all in real seconds.

    Attributes:
        budget: how many restarts within `window_s`; one more and it is given up.
        first_delay_s: before the second restart in a row; the first is at once.
        factor: each further one waits that much longer,
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
    """The restarts of one child."""

    def __init__(self, policy: RestartPolicy) -> None:
        self._policy = policy
        self._times_s: deque[float] = deque()
        self._row = 0

    def failed(self, now_s: float, lived_s: float) -> float | None:
        """Take in a crash after `lived_s`; return how long to wait before the next start. None: give it up."""
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
