"""The watchdog: what the scheduler itself tells the microscope to do when control is taken from somebody.

It stops the scan or spectrum that is running, and retracts the tip where its holder did not itself give control back
and left it in a dangerous state: it can't put that right any more, and nobody else knows of it.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum
from typing import Any

from afspm.logic.arbitration import Cause
from afspm.logic.microscope_status import FEEDBACK_OFF, TipRisk
from afspm.logic.tip_duty import TipDuties, TipDuty, TipEvent
from afspm.model import ControlResponse, Feedback, Parameter, Request, ScopeState, names

_STOP = {ScopeState.SCANNING: names.STOP_SCAN, ScopeState.SPEC: names.STOP_SPEC}
_STARTS = {names.START_SCAN: names.STOP_SCAN, names.START_SPEC: names.STOP_SPEC}
_OFF = names.OFF_WORDS | {"0.0"}  # a translator that is not ours may take a number
_DEFAULT_STOPS = frozenset({Cause.PROBLEM, Cause.MANUAL, Cause.DEAD, Cause.IDLE})
_SOON_S = 1.0


@dataclass(frozen=True)
class WatchdogSettings:
    """When the scheduler acts by itself.

    Attributes:
        stop_when: for which causes of losing control what is running is stopped.
        dangerous: the states in which the tip is retracted when its holder loses control: names of ScopeState, and
            "feedback-off".
        retract: the action that does it; None: never.
        attempts: how often an action that gets no response is tried.
        again_s: how long (real) something that should happen is waited for: that the microscope is free, has stopped,
            is there. After that time, too, a tip that was not retracted is tried to be again; twice as long each time.
        longest_s: but never longer than this.
    """

    stop_when: Collection[Cause] = _DEFAULT_STOPS
    dangerous: Collection[str] = frozenset({ScopeState.COARSE_MOTOR.name, FEEDBACK_OFF})
    retract: str | None = names.RETRACT
    attempts: int = 3
    again_s: float = 10.0
    longest_s: float = 300.0


class SafetyResult(Enum):
    """What became of an action of the watchdog's."""

    DONE = "done"
    AGAIN = "to be tried again"
    FAILED = "failed"


class Watchdog:
    """Knows what the microscope is doing, and what the scheduler wants it to do.

    The caller sends `next_action()` before anything else, reports by `answered` or `unsent`, and calls `look_again`
    when it is `due_s`. While it `owes_retract` nobody commands; but when that is `put_off`, since the microscope does
    not do it, whoever is there to see to the tip may. What is owed to the tip follows from a table: see `tip_duty`.

    Attributes:
        danger: what is known of it.
    """

    def __init__(self, settings: WatchdogSettings | None = None) -> None:
        self._settings = settings or WatchdogSettings()
        self.danger = TipRisk(self._settings.dangerous)
        self._state = ScopeState.UNDEFINED
        self._starting: str | None = None
        self._states_seen = 0
        self._stops: list[str] = []  # wanted before the tip is retracted
        self._tip = TipDuties()
        self._sent: str | None = None
        self._attempts = 0
        self._can_retract = True  # as far as we know
        self._refused_at = -1  # states seen when the microscope last was not free
        self._told_to_stop = self._unstoppable = False  # what runs
        self._for_feedback = False  # why the tip is to be retracted
        self._due_s: float | None = None
        self._retries = 0
        self._in_haste = False

    def snapshot(self) -> dict[str, Any]:
        """What must survive a kill, as plain JSON."""
        return {
            "stops": list(self._stops),
            "for_feedback": self._for_feedback,
            "tip": self._tip.snapshot(),
            "danger": self.danger.snapshot(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `snapshot` wrote."""
        self._stops = [str(action) for action in state["stops"]]
        self._for_feedback = bool(state["for_feedback"])
        self._tip.restore(state["tip"])
        self.danger.restore(state["danger"])

    def begin(self, now_s: float) -> None:
        """After `restore`: what has happened meanwhile is heard of first, and the translator may not be there."""
        if self.owes_retract:
            self._due_s = now_s + self._settings.again_s

    @property
    def left_to_people(self) -> bool:
        """It has retracted the tip, or could not, and nobody was called yet: to go on is for a person to decide."""
        return self._tip.calls_people

    def leave_to_people(self) -> None:
        """Nobody can be told any more what to do with a tip in danger: the translator sees to it as it leaves."""
        if self._settings.retract is not None and self.danger.now is not None:
            self._tip.see(TipEvent.LEFT)

    def people_called(self) -> None:
        """The problem was flagged."""
        self._tip.calls_people = False

    @property
    def owes_retract(self) -> bool:
        """The tip is to be retracted, now or later."""
        return self._tip.now is not TipDuty.NONE

    @property
    def put_off(self) -> bool:
        """The tip is to be retracted, but that is not done: it is tried again later."""
        return self._tip.now is TipDuty.PUT_OFF

    @property
    def _wanted(self) -> list[str]:
        """The actions wanted, in order."""
        retract = self._settings.retract
        return [*self._stops, retract] if self.owes_retract and retract is not None else list(self._stops)

    @property
    def state(self) -> ScopeState:
        return self._state

    @property
    def states_seen(self) -> int:
        """How many states the microscope has told; see `started`."""
        return self._states_seen

    def scope_is(self, state: ScopeState) -> None:
        self._state = state
        self._states_seen += 1
        self._starting = None
        self.danger.scope_is(state)
        if state not in _STOP:
            self._told_to_stop = self._unstoppable = False
        if (
            state is ScopeState.FREE and self._sent is None
        ):  # it ended while the translator could not be told to stop it
            self._stops = []

    def started(self, action: str, states_seen: int, *, certain: bool = True) -> bool:
        """An action succeeded, or may have, that was sent when `states_seen` states were known.

        The answer may overtake the state that the microscope is in by it, or be overtaken.

        Returns:
            whether what is known of the danger has changed.
        """
        if states_seen == self._states_seen:
            self._starting = _STARTS.get(action, self._starting)
        if action in _STARTS or action in _STOP.values():
            return False
        # what else there is may bring the tip back
        return self.danger.tip_is_away(is_away=certain and action == self._settings.retract)

    def cannot_retract(self) -> None:
        """The microscope has no such action."""
        self._can_retract = False

    @property
    def question(self) -> str:
        """The action of which the translator is asked first whether the microscope has it."""
        return self._settings.retract or names.STOP_SCAN

    # --- what is wanted ---

    def control_taken(
        self,
        cause: Cause,
        in_flight: str | None,
        *,
        had_died: bool = False,
        by_holder: bool = False,
        was_seen_to: bool = False,
    ) -> list[str]:
        """Control was taken for `cause` while the action `in_flight` was with the translator.

        Args:
            had_died: the process that got control has died; who gives it back is the one started in its place.
            by_holder: it is the holder's own doing.
            was_seen_to: the holder was there to see to a tip that was not retracted.

        Returns:
            What is wanted now and was not before, in order.
        """
        # whoever gives control back knows what it leaves, and so does a person who takes it
        knows = cause in (Cause.RELEASED, Cause.MANUAL) or (cause is Cause.SOLVED and by_holder)
        if cause is Cause.MANUAL or (was_seen_to and knows and not had_died):
            self.seen_to()
        before = [] if self.put_off else self._wanted
        if self._can_retract and (had_died or not knows) and self.danger.now is not None:
            self._want_retract()
        stop = _STOP.get(self._state) or self._starting or _STARTS.get(in_flight or "")
        if stop is not None and (cause in self._settings.stop_when or self.owes_retract) and stop not in self._stops:
            self._stops.insert(0, stop)
        return [] if self.put_off else [action for action in self._wanted if action not in before]

    def _want_retract(self) -> None:
        if self._settings.retract is None:
            return
        self._for_feedback = self.danger.by_feedback
        if self.put_off:  # whoever was there to see to it is gone
            self._due_s = None
        self._tip.see(TipEvent.ENDANGERED)

    def seen_to(self) -> None:
        """Somebody sees to the tip: it is not retracted any more, unless it is just being."""
        self._see(TipEvent.SEEN_TO)

    def put_right(self) -> None:
        """Somebody says that the tip is well again: it may be at the surface, where it can be endangered anew."""
        self.seen_to()
        self.danger.tip_is_away(is_away=False)

    def hurry(self, now_s: float) -> None:
        """The experiment ends: nothing is waited for any longer than a moment."""
        self._in_haste = True
        if self._due_s is not None:
            self._due_s = min(self._due_s, now_s + _SOON_S)

    # --- what is sent ---

    def next_action(self) -> str | None:
        """The action to send now, if one is; it counts as sent."""
        if self._for_feedback and self.danger.feedback_is_on:
            self.seen_to()
        if self._sent is not None or self.put_off or self._refused_at == self._states_seen:
            return None
        runs = _STOP.get(self._state)
        if self.owes_retract and runs is not None and not self._told_to_stop and runs not in self._stops:
            self._stops.insert(0, runs)
        if not self._wanted or self._waits_for_stop():
            return None
        self._sent, self._due_s = self._wanted[0], None
        self._told_to_stop |= self._sent == runs
        if not self._stops:
            self._tip.see(TipEvent.SENT)
        return self._sent

    def _waits_for_stop(self) -> bool:
        """It has been told to stop, and the tip is retracted when it has."""
        return not self._stops and self._state in _STOP and not self._unstoppable

    def answered(self, code: int, now_s: float) -> SafetyResult:
        """The translator answered what was sent (or NO_RESPONSE)."""
        action, self._sent = self._sent or "", None
        is_retract = self._tip.now is TipDuty.ASKED
        if code == ControlResponse.SUCCESS:
            self._starting = None
            if is_retract:
                self.danger.tip_is_away(is_away=True)
                self._see(TipEvent.RETRACTED)
            else:
                self._forget_stop(action)
                self._due_s = now_s + self._wait_s if self.owes_retract else None
            return SafetyResult.DONE
        if code == ControlResponse.NOT_FREE:
            self._refused_at = self._states_seen
            self._due_s = now_s + self._wait_s
            self._see(TipEvent.NOT_YET)
            return SafetyResult.AGAIN
        self._attempts += 1
        if code == ControlResponse.NO_RESPONSE and self._attempts < self._settings.attempts:
            self._see(TipEvent.NOT_YET)
            return SafetyResult.AGAIN
        if not is_retract:
            self._unstoppable = True
            self._forget_stop(action)
        elif code == ControlResponse.ACTION_NOT_SUPPORTED:
            self._see(TipEvent.IMPOSSIBLE)
        else:
            self._retract_later(now_s)
        return SafetyResult.FAILED

    def done_late(self, action: str) -> None:
        """The translator did what nobody waited for any more: a tip withdrawn late is left to people, too."""
        if action == self._settings.retract:
            self._see(TipEvent.RETRACTED_LATE)

    def unsent(self, now_s: float) -> None:
        """What `next_action` said could not be sent: the translator is not connected. Again when it is."""
        self._sent = None
        self._attempts = 0
        self._refused_at = -1
        self._told_to_stop = False
        self._see(TipEvent.NOT_YET)
        if self.owes_retract and self._due_s is None:
            self._due_s = now_s + self._wait_s

    def translator_is_there(self, now_s: float) -> None:
        """Another, or again: what was put off is due, once it has told how it is with the microscope."""
        if self.put_off:
            self._due_s = now_s + _SOON_S

    # --- what does not come about ---

    @property
    def due_s(self) -> float | None:
        """When, real, `look_again` is to be called; None: not."""
        return self._due_s

    def look_again(self, now_s: float, *, is_seen_to: bool) -> str | None:
        """What was waited for has not happened, or what was put off is due.

        Args:
            is_seen_to: somebody is there to see to the tip, if it was not retracted.

        Returns:
            what people are to be told, if that is new.
        """
        self._due_s = None
        if self.put_off:
            self._refused_at = -1
            self._see(TipEvent.SEEN_TO if is_seen_to else TipEvent.DUE)
            return None
        if not self._wanted or self._sent is not None:
            return None
        if self._stops:
            action = self._stops[0]
            self._forget_stop(action)
            self._unstoppable, self._refused_at = True, -1
            return f"the microscope is never free to {action}"
        if self._refused_at != self._states_seen and self._waits_for_stop():
            self._unstoppable = True
            return "the microscope was told to stop, and does not"
        is_refused, is_new = self._refused_at == self._states_seen, not self._retries
        self._retract_later(now_s)
        why = "the microscope is never free for that" if is_refused else "its translator is not there"
        return f"the tip was left in danger and can't be retracted: {why}" if is_new else None

    @property
    def _wait_s(self) -> float:
        return _SOON_S if self._in_haste else self._settings.again_s

    def _retract_later(self, now_s: float) -> None:
        self._tip.see(TipEvent.FAILED)
        wait_s = min(self._wait_s * 2**self._retries, self._settings.longest_s)
        self._due_s = now_s + (_SOON_S if self._in_haste else wait_s)
        self._retries = min(self._retries + 1, 32)
        self._attempts = 0

    def _forget_stop(self, action: str) -> None:
        self._stops = [other for other in self._stops if other != action]
        self._attempts = 0

    def _see(self, event: TipEvent) -> None:
        """Go on by the table; what was waited for is forgotten where nothing is owed any more."""
        if self._tip.see(event):
            self._due_s, self._for_feedback = None, False
            self._attempts = self._retries = 0


def feedback_of(request: Request) -> Feedback | None:
    """What a request sets of the feedback."""
    subject = request.subject
    if isinstance(subject, Parameter) and subject.name == names.FEEDBACK_ON and subject.value is not None:
        return Feedback(on=subject.value.strip().lower() not in _OFF)
    return subject if isinstance(subject, Feedback) else None
