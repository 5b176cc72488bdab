"""The state that a translator keeps on disk, so that a restarted one tells the same story and does nothing twice."""

from __future__ import annotations

from afspm.basics.clock import Clock
from afspm.basics.plain_data import Plain
from afspm.model import ScopeState, ScopeStatus
from afspm.storage.memory import Memory
from afspm.translator.sequence import StatusSequence

Kept = Plain
"""JSON values by name, kept on disk."""


class TranslatorState:
    """The kept values, with the times and the order of what is published.

    Args:
        result_timeout_s: see `StatusSequence`.

    Attributes:
        kept: JSON values of the translator's parts; the part that changes them calls `save`.
    """

    def __init__(self, memory: Memory, clock: Clock, result_timeout_s: float) -> None:
        self._memory = memory
        self._clock = clock
        self.kept: Kept = memory.setdefault("translator", {"said": 0, "ledger": {}, "outbox": {}})
        self.sequence = StatusSequence(ScopeStatus(ScopeState(self.kept["said"])), result_timeout_s)

    def save(self) -> None:
        """Write everything to disk. On a full disk it is logged, and the tip is looked after all the same."""
        self.kept["said"] = int(self.sequence.said.state)
        self.kept["seen_ns"] = self._clock.now_ns()  # a run that is resumed goes on after it
        self._memory.save()

    def stamp(self, count: int = 1) -> list[int]:
        """Return strictly increasing times for so many packets, ns."""
        first = max(self._clock.now_ns(), int(self.kept.get("last_ns", 0)) + 1)
        self.kept["last_ns"] = first + count - 1
        return list(range(first, first + count))
