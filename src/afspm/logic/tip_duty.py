"""What is owed to a tip that its holder left in danger, as a table of states."""

from __future__ import annotations

from enum import Enum
from typing import Any


class TipDuty(Enum):
    """What the scheduler still has to do for the tip."""

    NONE = "nothing"
    OWED = "it is to be retracted"
    ASKED = "the microscope is asked to retract it"
    PUT_OFF = "it was not retracted, which is tried again later"


class TipEvent(Enum):
    """What changes that."""

    ENDANGERED = "its holder lost control and left it in danger"
    SEEN_TO = "somebody sees to it, or it is out of danger"
    SENT = "the microscope is asked to retract it"
    NOT_YET = "the microscope could not be asked, was not free, or did not answer"
    RETRACTED = "the microscope has retracted it"
    RETRACTED_LATE = "it has, when nobody waited for the answer any more"
    IMPOSSIBLE = "the microscope has no such action"
    FAILED = "the microscope refuses, or was waited for in vain"
    DUE = "it is time to try again"
    LEFT = "the run is stopped with the tip in danger"


_NONE, _OWED, _ASKED, _PUT_OFF = TipDuty
_CALLS = True  # a person is to decide how to go on

# after an event, by what was owed before it: NONE, OWED, ASKED, PUT_OFF; and whether people are called
_TABLE: dict[TipEvent, tuple[TipDuty, TipDuty, TipDuty, TipDuty, bool]] = {
    TipEvent.ENDANGERED: (_OWED, _OWED, _ASKED, _OWED, False),
    TipEvent.SEEN_TO: (_NONE, _NONE, _ASKED, _NONE, False),
    TipEvent.SENT: (_NONE, _ASKED, _ASKED, _PUT_OFF, False),
    TipEvent.NOT_YET: (_NONE, _OWED, _OWED, _PUT_OFF, False),
    TipEvent.RETRACTED: (_NONE, _NONE, _NONE, _NONE, _CALLS),
    TipEvent.RETRACTED_LATE: (_NONE, _NONE, _ASKED, _NONE, _CALLS),
    TipEvent.IMPOSSIBLE: (_NONE, _NONE, _NONE, _NONE, _CALLS),
    TipEvent.FAILED: (_NONE, _PUT_OFF, _PUT_OFF, _PUT_OFF, _CALLS),
    TipEvent.DUE: (_NONE, _OWED, _ASKED, _OWED, False),
    TipEvent.LEFT: (_NONE, _OWED, _ASKED, _PUT_OFF, _CALLS),
}


class TipDuties:
    """The state that the table is in.

    Attributes:
        now: what is owed.
        calls_people: they are to be called, and were not yet.
    """

    def __init__(self) -> None:
        self.now = TipDuty.NONE
        self.calls_people = False

    def see(self, event: TipEvent) -> bool:
        """Go on by the table. Returns whether something was owed and nothing is any more."""
        *after, calls = _TABLE[event]
        before, self.now = self.now, after[list(TipDuty).index(self.now)]
        self.calls_people |= calls
        return before is not TipDuty.NONE and self.now is TipDuty.NONE

    def snapshot(self) -> dict[str, Any]:
        """As plain JSON. Whoever takes it up does not know what the microscope is being asked."""
        now = TipDuty.OWED if self.now is TipDuty.ASKED else self.now
        return {"owed": now.name, "calls_people": self.calls_people}

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `snapshot` wrote."""
        self.now, self.calls_people = TipDuty[state["owed"]], bool(state["calls_people"])
