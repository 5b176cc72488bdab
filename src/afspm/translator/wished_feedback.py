"""`WishedFeedback`: whether the z feedback is as the run wishes it. Pure.

| it is wished | from |
| --- | --- |
| as the first reading of a run with the tip at the sample shows it | that reading; off is logged |
| as a request of the run switches it | the request |
| as the next reading shows it | an action that says `switches_feedback` |
| on | a reading that shows it on after any approach, or any action but the start of a scan |
| off | a person's `--feedback-off` |

No other action, and no setting of a parameter, makes off wished: off at the sample is otherwise a person's doing, or an
action's that should say `switches_feedback`. A withdrawn tip says nothing. Many controllers hold the feedback
in a spectrum or an action, and give it back after the reported end: until then, off proves nothing.
"""

from __future__ import annotations

import math
from enum import Enum, auto
from typing import Final

from afspm.model import ScopeState, names
from afspm.translator.state import KeptState

CALM: Final = frozenset({ScopeState.FREE, ScopeState.SCANNING})
"""States in which the controller itself changes neither settings nor the feedback."""
SINCE_BEFORE: Final = "the z feedback has been off since before this run"


_AT_FIRST: Final = {"wished": None, "after": "", "is_away": False, "is_switched": False}


class FeedbackLevel(Enum):
    """The feedback at a reading, compared with the wish of the run."""

    AS_WISHED = auto()
    """Also where the controller does not show it, or the tip is withdrawn."""
    HELD = auto()
    """Off: the controller may hold it still, after a spectrum or an action."""
    OFF = auto()
    """Off, though on is wished; once is no proof yet that a person has switched it off."""
    BY_HAND = auto()
    """Off at two readings, though on is wished."""
    ON = auto()
    """On, though off is wished."""


class WishedFeedback:
    """The feedback as wished, and as the last reading shows it.

    Args:
        kept: JSON values that outlive a kill.
        settles_s: experiment seconds for which the controller may hold the feedback after a spectrum or an action.
        follows: True for a shadow, whose run wishes what the person does.

    Attributes:
        level: of the last reading.
        news: a sentence for the log, until it is taken.
    """

    def __init__(self, kept: KeptState, settles_s: float, *, follows: bool = False) -> None:
        self._kept = kept.setdefault("feedback", dict(_AT_FIRST))
        self._settles_s = settles_s
        self._follows = follows
        self._settled_s = -math.inf
        self.level = FeedbackLevel.AS_WISHED
        self.news = ""

    @property
    def wished(self) -> bool | None:
        """Whether on is wished; None before the first reading with the tip at the sample."""
        found: bool | None = self._kept["wished"]
        return found

    @property
    def is_in_question(self) -> bool:
        """Whether the feedback must be read again soon: the last reading shows it off, and one is no proof."""
        return self.level is FeedbackLevel.HELD or (self.level is FeedbackLevel.OFF and self.wished is True)

    @property
    def after(self) -> str:
        """The last action of the run since the feedback was on, if it does not say `switches_feedback`."""
        return str(self._kept["after"])

    def asked(self, action: str, now_s: float, *, switches: bool = False) -> None:
        """Note that the run changes something.

        Args:
            action: the action that it asks for; empty: none.
            switches: whether the request may switch the feedback, so that the next reading shows the wish.
        """
        self._kept["is_switched"] = self._kept["is_switched"] or switches
        if action and action != names.START_SCAN:
            self._kept["after"] = "" if switches else action
            self._kept["is_away"] = self._kept["is_away"] or action == names.RETRACT
            self.held(now_s)

    def is_set(self, on: bool | None) -> None:
        """Note that a request of the run has switched the feedback; None: it did not."""
        if on is not None:
            self._kept |= {"wished": on, "after": "", "is_switched": False}

    def held(self, now_s: float) -> None:
        """Note that the controller may hold the feedback until now: it gives it back a little later."""
        self._settled_s = now_s + self._settles_s

    def may_be_off(self) -> None:
        """Make off wished: a person says that it is off by intention."""
        self._kept |= {**_AT_FIRST, "wished": False}

    def lost(self) -> None:
        """Note a restart or a lost controller: one reading is no proof again."""
        self.level = FeedbackLevel.AS_WISHED

    def read(self, engaged: bool | None, on: bool | None, state: ScopeState, now_s: float) -> FeedbackLevel:
        """Compare a reading with the wish of the run.

        Args:
            engaged: None: the controller does not show the tip.
            on: None: the controller does not show the feedback.
        """
        is_calm = state in CALM
        if not is_calm and state is not ScopeState.UNDEFINED:
            self.held(now_s)
        self.level = self._level(engaged, on, now_s, is_calm=is_calm)
        return self.level

    def _level(self, engaged: bool | None, on: bool | None, now_s: float, *, is_calm: bool) -> FeedbackLevel:
        kept = self._kept
        if engaged is False:  # an approach may switch it on a little later
            kept["is_away"] = True
            self.held(now_s)
        if on is None or engaged is False:
            return FeedbackLevel.AS_WISHED
        if on:
            self._is_on(now_s)
            return FeedbackLevel.AS_WISHED if kept["wished"] else FeedbackLevel.ON
        if not is_calm:
            return FeedbackLevel.AS_WISHED
        if kept["is_switched"] or kept["wished"] is None:
            self._is_off_by_itself(engaged)
        if kept["wished"] is False:
            return FeedbackLevel.AS_WISHED
        if kept["wished"] and now_s < self._settled_s:
            return FeedbackLevel.HELD
        if engaged is None and (kept["is_away"] or kept["wished"] is None):
            return FeedbackLevel.OFF  # no second reading proves more
        is_second = self.level in (FeedbackLevel.OFF, FeedbackLevel.BY_HAND)
        if is_second and self._follows:
            kept["wished"] = False
        return FeedbackLevel.BY_HAND if is_second else FeedbackLevel.OFF

    def _is_on(self, now_s: float) -> None:
        kept = self._kept
        if kept["wished"] is None or kept["after"] or kept["is_away"] or kept["is_switched"] or self._follows:
            kept["wished"] = True
        kept["is_away"] = False
        if now_s >= self._settled_s:  # an action may switch it a little later
            kept |= {"after": "", "is_switched": False}

    def _is_off_by_itself(self, engaged: bool | None) -> None:
        kept = self._kept
        if kept["is_switched"]:
            kept |= {"wished": False, "after": "", "is_switched": False}
        elif engaged:
            kept["wished"] = False
            self.news = f"{SINCE_BEFORE}: it is taken to be off by intention"

    def why_not(self) -> str:
        """Return why nothing may be begun; empty: it may."""
        if self.level in (FeedbackLevel.AS_WISHED, FeedbackLevel.ON):
            return ""
        if self.level is FeedbackLevel.HELD:
            return "the z feedback is off: the controller may still hold it"
        if self.wished is None:
            return f"{SINCE_BEFORE}: switch it on at the panel, or say --feedback-off"
        if self._kept["is_away"]:
            return "the z feedback is off since the tip was withdrawn: bring it to the sample first"
        return f"the z feedback is off{self.hint}"

    @property
    def hint(self) -> str:
        """What may have switched the feedback off beside a person, as the rest of a sentence."""
        known = self.after in ("", names.START_SPEC)
        return "" if known else f", perhaps by {self.after}, which does not say `switches_feedback`"
