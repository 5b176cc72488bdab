"""The beginning: first, in the order of time, comes what the translator published before the scheduler was there."""

from __future__ import annotations

from collections import deque

from afspm.logic.events import RequestIn

_MOST_KEPT = 1000


class StartupBarrier:
    """Knows for how long that is waited for, before anybody is told who is in control, and keeps what comes too early.

    Attributes:
        until_s: when it is over at the latest, in real monotonic time; None: it is over.

    Args:
        patience_s: how long (real) is waited.
    """

    def __init__(self, patience_s: float) -> None:
        self.until_s: float | None = None
        self._patience_s = patience_s
        self._again = False
        self._over_s = 0.0
        self._kept: deque[RequestIn] = deque()

    def begin(self, now_s: float, *, again: bool) -> None:
        """The scheduler was started.

        Args:
            again: it was there before.
        """
        self.until_s, self._again = now_s + self._patience_s, again

    def put_off(self, until_s: float) -> None:
        """More is to come, until then."""
        if self.until_s is not None:
            self.until_s = max(self.until_s, until_s)

    def over(self, now_s: float) -> None:
        """Who is in control is told: nothing of before is waited for any more."""
        self.until_s, self._over_s = None, now_s

    def keeps(self, event: RequestIn) -> bool:
        """Whether a request that may change control comes too early; then it is kept, to be `let_in` afterwards.

        After a restart, what was published before may still come again: that would get a time after the change, and be
        taken for something new.
        """
        if self.until_s is None or not self._again or len(self._kept) >= _MOST_KEPT:
            return False
        self._kept.append(event)
        return True

    def let_in(self) -> RequestIn | None:
        """The first of what came too early, once it does no more."""
        return self._kept.popleft() if self._kept and self.until_s is None else None

    def due_s(self) -> float | None:
        """When there is something to be done: control is told, or what came too early is let in."""
        if self.until_s is not None:
            return self.until_s
        return self._over_s if self._kept else None
