"""The watchdog: what the scheduler itself tells the microscope to do when control is taken from a holder.

It stops the scan or spectrum that is running, and retracts the tip where its holder did not itself give control back
and left it in a dangerous state: it can't put that right any more, and nobody else knows of it.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from enum import Enum

from afspm.basics.frozen import replace
from afspm.model import ControlResponse, ScopeState, names
from afspm.model.microscope_status import FEEDBACK_OFF, STARTS, STOPS, MicroscopeStatus
from afspm.scheduler.control.arbitration import Cause

_DEFAULT_STOPS = frozenset({Cause.PROBLEM, Cause.MANUAL, Cause.DEAD, Cause.IDLE})
_SOON_S = 1.0


class TipDuty(Enum):
    """The duty of the scheduler towards a tip that its holder left in danger."""

    NONE = "nothing"
    OWED = "it is to be retracted"
    ASKED = "the microscope is asked to retract it"
    PUT_OFF = "it was not retracted, which is tried again later"


class TipEvent(Enum):
    """An event that changes the duty."""

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
    """The result of an action of the watchdog's."""

    DONE = "done"
    AGAIN = "to be tried again"
    FAILED = "failed"


@dataclass(frozen=True)
class RetractState:
    """The part of the watchdog that survives a restart.

    Attributes:
        calls_people: it has retracted the tip, or could not, and nobody was called yet: to go on is for a person.
        stops: actions wanted before the tip is retracted.
        for_feedback: why the tip is to be retracted.
        may_come: the scheduler was killed after it asked for a retract: the translator may still have that in its
            queue, and its answer goes to the life that asked.
    """

    duty: TipDuty = TipDuty.NONE
    calls_people: bool = False
    stops: tuple[str, ...] = ()
    for_feedback: bool = False
    may_come: bool = False


@dataclass(frozen=True)
class Watchdog:
    """The actions that the scheduler itself wants of the microscope.

    The caller sends `next_action()` before anything else, reports by `answered` or `unsent`, and calls `look_again`
    when it is `due_s`. While it `owes_retract` nobody commands; but when that is `put_off`, since the microscope does
    not do it, whoever is there to see to the tip may. The duty towards the tip follows from a table.

    Attributes:
        starting: the action that stops what was just started.
        sent: the action that was sent and is not answered.
        can_retract: as far as we know.
        refused_at: states seen when the microscope last was not free.
        told_to_stop, unstoppable: what runs.
        due_s: when, real, `look_again` is to be called.
    """

    settings: WatchdogSettings = field(default_factory=WatchdogSettings)
    tip: RetractState = RetractState()
    starting: str | None = None
    sent: str | None = None
    attempts: int = 0
    can_retract: bool = True
    refused_at: int = -1
    told_to_stop: bool = False
    unstoppable: bool = False
    due_s: float | None = None
    retries: int = 0
    in_haste: bool = False

    def restored(self, tip: RetractState) -> Watchdog:
        """Take up the duty of before a restart: what the microscope was being asked is not known any more."""
        was_asked = tip.duty is TipDuty.ASKED
        duty = TipDuty.OWED if was_asked else tip.duty
        return replace(self, tip=replace(tip, duty=duty, may_come=was_asked or tip.may_come))

    def translator_answered(self) -> Watchdog:
        """Take an answer to this life of the scheduler: everything that an earlier life asked for is done, or lost.

        A tip that is still to be retracted is retracted again, which does no harm. Where a person has seen to it
        meanwhile, it may have been withdrawn after that: a person looks again.
        """
        if not self.tip.may_come:
            return self
        dog = replace(self, tip=replace(self.tip, may_come=False))
        return dog if dog.owes_retract else dog._after(TipEvent.RETRACTED_LATE)

    def begun(self, now_s: float) -> Watchdog:
        """Wait: what has happened meanwhile is heard of first, and the translator may not be there."""
        return replace(self, due_s=now_s + self.settings.again_s) if self.owes_retract else self

    @property
    def owes_retract(self) -> bool:
        """True while the tip is to be retracted, now or later."""
        return self.tip.duty is not TipDuty.NONE

    @property
    def put_off(self) -> bool:
        """True while the tip is to be retracted, but only later."""
        return self.tip.duty is TipDuty.PUT_OFF

    @property
    def left_to_people(self) -> bool:
        """True until people are called: how to go on is for a person to decide."""
        return self.tip.calls_people

    @property
    def wanted(self) -> tuple[str, ...]:
        """The actions wanted, in order."""
        retract = self.settings.retract
        return (*self.tip.stops, retract) if self.owes_retract and retract is not None else self.tip.stops

    @property
    def question(self) -> str:
        """The action of which the translator is asked first whether the microscope has it."""
        return self.settings.retract or names.STOP_SCAN

    def without_retract(self) -> Watchdog:
        """Take it that the microscope has no action to retract."""
        return replace(self, can_retract=False)

    def people_called(self) -> Watchdog:
        return replace(self, tip=replace(self.tip, calls_people=False))

    def leave_to_people(self, microscope: MicroscopeStatus) -> Watchdog:
        """Leave a tip in danger: the run is stopped, and the translator sees to it as it leaves."""
        return (
            self._after(TipEvent.LEFT) if self.settings.retract is not None and microscope.danger is not None else self
        )

    # --- events of the microscope ---

    def state_told(self, microscope: MicroscopeStatus) -> Watchdog:
        """Take a new state of the microscope."""
        dog = replace(self, starting=None)
        if microscope.state not in STOPS:
            dog = replace(dog, told_to_stop=False, unstoppable=False)
        # it ended while the translator could not be told to stop it
        return dog._with_stops(()) if microscope.state is ScopeState.FREE and self.sent is None else dog

    def started(self, action: str, states_seen: int, microscope: MicroscopeStatus) -> Watchdog:
        """Take an action that succeeded, or may have; it was sent when `states_seen` states were known.

        The answer may overtake the state that the microscope is in by it, or be overtaken.
        """
        is_new = states_seen == microscope.states_seen
        return replace(self, starting=STARTS.get(action, self.starting)) if is_new else self

    # --- events of control ---

    def control_taken(
        self,
        cause: Cause,
        in_flight: str | None,
        microscope: MicroscopeStatus,
        *,
        had_died: bool = False,
        by_holder: bool = False,
        was_seen_to: bool = False,
    ) -> Watchdog:
        """Take the loss of control for `cause` while the action `in_flight` was with the translator.

        Args:
            had_died: the process that got control has died; who gives it back is the one started in its place.
            by_holder: it is the holder's own doing.
            was_seen_to: the holder was there to see to a tip that was not retracted.
        """
        # whoever gives control back knows what it leaves, and so does a person who takes it
        knows = cause in (Cause.RELEASED, Cause.MANUAL) or (cause is Cause.SOLVED and by_holder)
        dog = self
        if cause is Cause.MANUAL or (was_seen_to and knows and not had_died):
            dog = dog.seen_to()
        if dog.can_retract and (had_died or not knows) and microscope.danger is not None:
            dog = dog._endangered(microscope)
        stop = STOPS.get(microscope.state) or dog.starting or STARTS.get(in_flight or "")
        if stop is None or stop in dog.tip.stops:
            return dog
        is_to_stop = cause in dog.settings.stop_when or dog.owes_retract
        return dog._with_stops((stop, *dog.tip.stops)) if is_to_stop else dog

    def newly_wanted(self, before: Watchdog) -> list[str]:
        """Return the actions wanted now that were not before."""
        known = () if before.put_off else before.wanted
        return [] if self.put_off else [action for action in self.wanted if action not in known]

    def _endangered(self, microscope: MicroscopeStatus) -> Watchdog:
        if self.settings.retract is None:
            return self
        tip = replace(self.tip, for_feedback=microscope.endangered_by_feedback)
        # whoever was there to see to a tip that was put off is gone
        due_s = None if self.put_off else self.due_s
        return replace(self, tip=tip, due_s=due_s)._after(TipEvent.ENDANGERED)

    def seen_to(self) -> Watchdog:
        """Leave the tip to whoever sees to it: it is not retracted any more, unless it is just being."""
        return self._after(TipEvent.SEEN_TO)

    def hurry(self, now_s: float) -> Watchdog:
        """Wait for nothing longer than a moment: the experiment ends."""
        due_s = None if self.due_s is None else min(self.due_s, now_s + _SOON_S)
        return replace(self, in_haste=True, due_s=due_s)

    # --- what is sent ---

    def next_action(self, microscope: MicroscopeStatus) -> tuple[Watchdog, str | None]:
        """Return the action to send now, if one is; it counts as sent."""
        dog = self
        if dog.tip.for_feedback and microscope.risk.feedback_on is True:
            dog = dog.seen_to()
        if dog.sent is not None or dog.put_off or dog.refused_at == microscope.states_seen:
            return dog, None
        runs = STOPS.get(microscope.state)
        if dog.owes_retract and runs is not None and not dog.told_to_stop and runs not in dog.tip.stops:
            dog = dog._with_stops((runs, *dog.tip.stops))
        if not dog.wanted or dog._waits_for_stop(microscope):
            return dog, None
        action = dog.wanted[0]
        dog = replace(dog, sent=action, due_s=None, told_to_stop=dog.told_to_stop or action == runs)
        return (dog if dog.tip.stops else dog._after(TipEvent.SENT)), action

    def _waits_for_stop(self, microscope: MicroscopeStatus) -> bool:
        # a retract is sent only once the scan has stopped
        return not self.tip.stops and microscope.state in STOPS and not self.unstoppable

    def answered(self, code: int, microscope: MicroscopeStatus, now_s: float) -> tuple[Watchdog, SafetyResult]:
        """Take the translator's answer to what was sent (or NO_RESPONSE)."""
        action, dog, is_retract = self.sent or "", replace(self, sent=None), self.tip.duty is TipDuty.ASKED
        if code == ControlResponse.SUCCESS:
            dog = replace(dog, starting=None)
            if is_retract:
                return dog._after(TipEvent.RETRACTED), SafetyResult.DONE
            due_s = now_s + dog._wait_s if dog.owes_retract else None
            return replace(dog._without_stop(action), due_s=due_s), SafetyResult.DONE
        if code == ControlResponse.NOT_FREE:
            dog = replace(dog, refused_at=microscope.states_seen, due_s=now_s + dog._wait_s)
            return dog._after(TipEvent.NOT_YET), SafetyResult.AGAIN
        dog = replace(dog, attempts=dog.attempts + 1)
        if code == ControlResponse.NO_RESPONSE and dog.attempts < dog.settings.attempts:
            return dog._after(TipEvent.NOT_YET), SafetyResult.AGAIN
        if not is_retract:
            return replace(dog, unstoppable=True)._without_stop(action), SafetyResult.FAILED
        if code == ControlResponse.ACTION_NOT_SUPPORTED:
            return dog._after(TipEvent.IMPOSSIBLE), SafetyResult.FAILED
        return dog._retract_later(now_s), SafetyResult.FAILED

    def done_late(self, action: str) -> Watchdog:
        """Take what the translator did when nobody waited any more: a tip withdrawn late is left to people, too."""
        return self._after(TipEvent.RETRACTED_LATE) if action == self.settings.retract else self

    def unsent(self, now_s: float) -> Watchdog:
        """Take back what `next_action` gave: the translator is not connected. It is sent when that is."""
        dog = replace(self, sent=None, attempts=0, refused_at=-1, told_to_stop=False)._after(TipEvent.NOT_YET)
        return replace(dog, due_s=now_s + dog._wait_s) if dog.owes_retract and dog.due_s is None else dog

    def translator_is_there(self, now_s: float) -> Watchdog:
        """Try what was put off, once another translator has told how it is with the microscope."""
        return replace(self, due_s=now_s + _SOON_S) if self.put_off else self

    # --- what does not come about ---

    def look_again(
        self, microscope: MicroscopeStatus, now_s: float, *, is_seen_to: bool
    ) -> tuple[Watchdog, str | None]:
        """Go on where something was waited for in vain, or what was put off is due.

        Args:
            is_seen_to: somebody is there to see to the tip, if it was not retracted.

        Returns:
            also what people are to be told, if that is new.
        """
        dog = replace(self, due_s=None)
        if dog.put_off:
            return replace(dog, refused_at=-1)._after(TipEvent.SEEN_TO if is_seen_to else TipEvent.DUE), None
        if not dog.wanted or dog.sent is not None:
            return dog, None
        if dog.tip.stops:
            action = dog.tip.stops[0]
            dog = replace(dog._without_stop(action), unstoppable=True, refused_at=-1)
            return dog, f"the microscope is never free to {action}"
        is_refused = dog.refused_at == microscope.states_seen
        if not is_refused and dog._waits_for_stop(microscope):
            return replace(dog, unstoppable=True), "the microscope was told to stop, and does not"
        why = "the microscope is never free for that" if is_refused else "its translator is not there"
        told = None if dog.retries else f"the tip was left in danger and can't be retracted: {why}"
        return dog._retract_later(now_s), told

    @property
    def _wait_s(self) -> float:
        return _SOON_S if self.in_haste else self.settings.again_s

    def _retract_later(self, now_s: float) -> Watchdog:
        wait_s = min(self._wait_s * 2**self.retries, self.settings.longest_s)
        due_s = now_s + (_SOON_S if self.in_haste else wait_s)
        dog = self._after(TipEvent.FAILED)
        return replace(dog, due_s=due_s, retries=min(self.retries + 1, 32), attempts=0)

    def _with_stops(self, stops: tuple[str, ...]) -> Watchdog:
        return self if stops == self.tip.stops else replace(self, tip=replace(self.tip, stops=stops))

    def _without_stop(self, action: str) -> Watchdog:
        stops = tuple(other for other in self.tip.stops if other != action)
        return replace(self, attempts=0)._with_stops(stops)

    def _after(self, event: TipEvent) -> Watchdog:
        *after, calls = _TABLE[event]
        duty = after[list(TipDuty).index(self.tip.duty)]
        tip = replace(self.tip, duty=duty, calls_people=self.tip.calls_people or calls)
        if duty is TipDuty.NONE and self.owes_retract:
            return replace(self, tip=replace(tip, for_feedback=False), due_s=None, attempts=0, retries=0)
        return replace(self, tip=tip)
