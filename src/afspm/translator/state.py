"""The state that a translator keeps on disk, so that a restart repeats no action and no published state."""

from __future__ import annotations

from typing import TypedDict, cast

from afspm.basics.clock import Clock
from afspm.basics.plain_data import Plain
from afspm.model import ControlRequest, Request, ScopeState, ScopeStatus
from afspm.model.microscope_status import feedback_of
from afspm.storage.memory import Memory
from afspm.translator.sequence import StatusSequence

Kept = Plain
"""JSON values by name, kept on disk."""


class KeptState(TypedDict, total=False):
    """All that a translator keeps on disk; docs/explanation/at-the-panel.md says of each until when it is believed."""

    said: int
    seen_ns: int
    last_ns: int
    ledger: dict[str, str]
    unnumbered: dict[str, str]
    forgotten: dict[str, int]
    outbox: Plain
    claims: Plain
    spoiled: str
    feedback_off: bool
    feedback_was_on: bool | None
    may_have_switched: bool
    feedback: Plain
    feedback_off_by: str
    engaged: bool | None
    was_engaged: bool
    tip_is_moved: bool
    tip_by_hand: str
    temporary: Plain
    treatment: Plain
    unproved_treatment: str
    held_z: Plain
    held_z_ended: str
    held_z_settings: Plain


class FeedbackWatch:
    """A record of whether a request, rather than a person at the panel, has switched the feedback off.

    Args:
        kept: JSON values that outlive a kill.
    """

    def __init__(self, kept: KeptState) -> None:
        self._kept = kept

    @property
    def is_off(self) -> bool:
        """True while the feedback is known to be switched off by a request."""
        return bool(self._kept.get("feedback_off"))

    @property
    def in_danger(self) -> bool:
        """True while the feedback is, or may be, switched off by a request."""
        return self.is_off or bool(self._kept.get("may_have_switched"))

    def saw(self, on: bool | None) -> bool:
        """Store the observed feedback; return True if the feedback went off after a request."""
        kept = self._kept
        # off without a request in between: switched off at the panel, where a person takes care of it (decision 0007)
        switched_off = on is False and bool(kept.get("feedback_was_on") and kept.get("may_have_switched"))
        kept["feedback_off"] = on is False and (switched_off or self.is_off)
        kept["feedback_was_on"], kept["may_have_switched"] = on, False
        return switched_off

    def may_switch(self, request: Request) -> bool:
        """Record that a request will be executed; return True if the record must be saved first."""
        affects = request.kind == ControlRequest.ACTION or feedback_of(request) is not None
        in_doubt = affects and not self._kept.get("may_have_switched")
        self._kept["may_have_switched"] = True
        return in_doubt

    def retracted(self) -> None:
        """Record that the tip is withdrawn, and needs no feedback."""
        self._kept["may_have_switched"] = self._kept["feedback_off"] = False


class TranslatorState:
    """The values on disk, with the times and the order of published packets.

    Args:
        result_timeout_s: see `StatusSequence`.

    Attributes:
        kept: JSON values of the translator's parts; the part that changes them calls `save`.
        feedback: whether a request has switched the feedback off.
    """

    def __init__(self, memory: Memory, clock: Clock, result_timeout_s: float) -> None:
        self._memory = memory
        self._clock = clock
        self.kept = cast(KeptState, memory.setdefault("translator", {"said": 0, "ledger": {}, "outbox": {}}))
        self.feedback = FeedbackWatch(self.kept)
        self.sequence = StatusSequence(ScopeStatus(ScopeState(self.kept["said"])), result_timeout_s)

    def save(self) -> None:
        """Write everything to disk. If the disk is full, log the error and continue, to protect the tip."""
        self.kept["said"] = int(self.sequence.published.state)
        self.kept["seen_ns"] = self._clock.now_ns()  # a resumed run continues after this time
        self._memory.save()

    def stamp(self, count: int = 1) -> list[int]:
        """Return `count` strictly increasing times for packets, ns."""
        # a clock that was set back must not give a time twice: subscribers would drop the packet as a duplicate
        first = max(self._clock.now_ns(), int(self.kept.get("last_ns", 0)) + 1)
        self.kept["last_ns"] = first + count - 1
        return list(range(first, first + count))
