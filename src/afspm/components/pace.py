"""The pace of a plan, for the estimate of its end."""

from __future__ import annotations

from afspm.client.scope import Scope
from afspm.storage.memory import Memory

_WORKED = "worked_s"


class Pace:
    """The mean duration of a part of a plan, kept over restarts.

    A pause by a person, and the time between a kill and a restart, say nothing about the parts that are left. Repairs
    and waiting for other components do, so they count.
    """

    def __init__(self, scope: Scope, memory: Memory) -> None:
        self._scope, self._memory = scope, memory
        self._before_s = float(memory.get(_WORKED, 0.0)) - scope.worked_s()

    def note(self) -> None:
        """Keep the time worked so far, before the memory is saved."""
        self._memory[_WORKED] = self._before_s + self._scope.worked_s()

    def left_s(self, done: int, total: int, least_s: float = 0.0) -> float:
        """Return the experiment time left.

        Args:
            done, total: number of finished parts, and of all parts.
            least_s: shortest duration of a part.
        """
        return (total - done) * max(float(self._memory[_WORKED]) / done, least_s)
