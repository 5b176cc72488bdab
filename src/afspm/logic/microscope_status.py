"""What is known of the danger that the tip is in."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from afspm.model import Feedback, ScopeState

FEEDBACK_OFF = "feedback-off"
"""The name of the dangerous state in which the feedback is known to be switched off."""


class TipRisk:
    """Knows what the microscope does, as far as that endangers the tip.

    Args:
        dangerous: names of ScopeState, and "feedback-off".
    """

    def __init__(self, dangerous: Collection[str]) -> None:
        self._dangerous = dangerous
        self._state = ScopeState.UNDEFINED
        self._feedback_on: bool | None = None
        self._before: bool | None = None  # what it was before a request of unknown outcome, while there is such a
        self._in_doubt = False
        self._is_away = False  # the tip: neither the motor that retracts it nor a feedback that is off does harm
        self._told: str | None = None

    def snapshot(self) -> dict[str, Any]:
        """As plain JSON."""
        return {"state": int(self._state), "feedback_on": self._feedback_on, "is_away": self._is_away}

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `snapshot` wrote."""
        self._state = ScopeState(state["state"])
        self._feedback_on, self._is_away = state["feedback_on"], bool(state["is_away"])

    def scope_is(self, state: ScopeState) -> None:
        """A microscope that is lost goes on with what it did."""
        if state is not ScopeState.UNDEFINED:
            self._state = state
        self._see()

    def feedback_is(self, feedback: Feedback) -> bool:
        """Returns whether that is new."""
        if feedback.on is None:
            return False
        self._in_doubt = False
        if feedback.on is self._feedback_on:
            return False
        self._feedback_on = feedback.on
        self._is_away = self._is_away and not feedback.on
        self._see()
        return True

    def feedback_may_be_off(self) -> None:
        """A request switches it off, or nobody knows whether one did."""
        before = self._feedback_on
        if self.feedback_is(Feedback(on=False)):
            self._before, self._in_doubt = before, True

    def feedback_was_left(self) -> None:
        """It turns out that the request was refused."""
        if self._in_doubt:
            self._feedback_on, self._in_doubt = self._before, False
            self._see()

    def tip_is_away(self, *, is_away: bool) -> bool:
        """Returns whether that is new."""
        changed, self._is_away = is_away is not self._is_away, is_away
        self._see()
        return changed

    @property
    def by_feedback(self) -> bool:
        """It is that the feedback is off."""
        return self._feedback_on is False and FEEDBACK_OFF in self._dangerous and not self._is_away

    @property
    def feedback_is_on(self) -> bool:
        """It is known to be."""
        return self._feedback_on is True

    @property
    def now(self) -> str | None:
        """What is dangerous now, in words; None: nothing, or it was seen to."""
        if self._is_away:
            return None
        if self.by_feedback:
            return "the feedback is off"
        return f"the microscope is in {self._state.name}" if self._state.name in self._dangerous else None

    def untold(self) -> str | None:
        """The danger now, if people have not been told of it: each once."""
        if self.now == self._told:
            return None
        self._told = self.now
        return self.now

    def _see(self) -> None:
        if self.now is None:
            self._told = None
