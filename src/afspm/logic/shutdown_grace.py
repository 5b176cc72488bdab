"""How long the scheduler stays after the end: what is only now started again needs what was measured, too."""

from __future__ import annotations

import math
from collections.abc import Iterable

from afspm.logic.supervisor_registry import OVER
from afspm.model import ProcessState

SHUTDOWN_GRACE_S = 3.0
"""How long (real) after the end whoever comes late, or is started again, is still given what was measured and told that
it is over; and after somebody was last heard to be still at work."""
LONGEST_GRACE_S = 20.0
"""How long (real) after the end at most: to find that a component is silent, to kill it and to start it again takes as
long as the supervisor allows it at the end."""
_OTHERS = ("scheduler", "translator")


class ShutdownGrace:
    """The time between the end of the experiment and that of the scheduler.

    Attributes:
        until_s: when the scheduler leaves, in real monotonic time; inf: the experiment has not ended.
    """

    def __init__(self) -> None:
        self.until_s = math.inf
        self._latest_s = math.inf

    def begin(self, now_s: float) -> None:
        """The experiment has ended, and all are told."""
        self.until_s, self._latest_s = now_s + SHUTDOWN_GRACE_S, now_s + LONGEST_GRACE_S

    def told(self, states: Iterable[ProcessState], now_s: float) -> None:
        """A supervisor says how it is with its processes. It does so again and again while there are any."""
        if self.until_s < math.inf and any(map(_is_at_work, states)):
            self.until_s = max(self.until_s, min(now_s + SHUTDOWN_GRACE_S, self._latest_s))


def _is_at_work(state: ProcessState) -> bool:
    # a translator subscribes to nobody, and the scheduler is not to wait for itself
    return state.role not in _OTHERS and state.condition not in OVER
