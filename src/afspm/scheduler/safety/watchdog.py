"""The watchdog: actions that the scheduler itself sends to the microscope when a holder loses control.

It stops the running scan or spectrum after the causes in `stop_when`. It retracts a tip that the holder left in a
dangerous state, unless the holder gave control back or a person took over: no other component knows of the danger.
A z that the holder held without feedback is released first, after any cause: the translator knows the way back, and
once the feedback is on again, nothing is retracted.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from enum import Enum

from afspm.basics.frozen import replace
from afspm.model import ControlResponse, ScopeState, names
from afspm.model.microscope_status import FEEDBACK_OFF, STARTS, STOPS, MicroscopeStatus
from afspm.scheduler.control.arbitration import Cause

_DEFAULT_STOPS = frozenset(set(Cause) - {Cause.RELEASED, Cause.SOLVED, Cause.ENDED, Cause.BY_HAND})
_SOON_S = 1.0  # for the first packets of a new translator, and between attempts at the end


class TipDuty(Enum):
    """The duty of the scheduler towards a tip that its holder left in danger. Its values are part of saved states."""

    NONE = "none"
    OWED = "owed"
    """A retract is due."""
    ASKED = "asked"
    """The retract was sent, and is not answered."""
    PUT_OFF = "put-off"
    """The tip was not retracted; the retract is tried again later."""


class TipEvent(Enum):
    """An event that changes the duty."""

    ENDANGERED = "endangered"
    """The holder lost control and left the tip in danger."""
    SEEN_TO = "seen-to"
    """A person or a solver attends to the tip, or the tip is out of danger."""
    SENT = "sent"
    """The retract is sent to the microscope."""
    NOT_YET = "not-yet"
    """The retract could not be sent, or the microscope was not free or did not answer."""
    RETRACTED = "retracted"
    RETRACTED_LATE = "retracted-late"
    """The microscope has retracted the tip after the deadline."""
    IMPOSSIBLE = "impossible"
    """The microscope has no action to retract the tip."""
    FAILED = "failed"
    """The microscope refuses, is never free, can't be reached, or does not end the retract in time."""
    DUE = "due"
    """A postponed retract is due again."""
    LEFT = "left"
    """The run is stopped with the tip in danger."""


_NONE, _OWED, _ASKED, _PUT_OFF = TipDuty
_CALLS = True  # a person decides how to go on

# the duty after an event, for each duty before it: NONE, OWED, ASKED, PUT_OFF; and whether a person is called
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
    """The conditions under which the scheduler itself stops a measurement or retracts the tip.

    Attributes:
        stop_when: the causes of losing control after which the running measurement is stopped.
        dangerous: the states in which the tip is retracted when its holder loses control: names of ScopeState, and
            "feedback-off".
        retract: the action that retracts the tip; None: never.
        attempts: the number of attempts at an action without a response.
        again_s: the real time to wait for the microscope to be free, to have stopped, or to be connected. A failed
            retract is repeated after this time, then after twice as long each time.
        longest_s: the longest time (real) between two such attempts.
    """

    stop_when: Collection[Cause] = _DEFAULT_STOPS
    dangerous: Collection[str] = frozenset({ScopeState.COARSE_MOTOR.name, FEEDBACK_OFF})
    retract: str | None = names.RETRACT
    attempts: int = 3
    again_s: float = 10.0
    longest_s: float = 300.0


class SafetyResult(Enum):
    """The result of an action sent by the watchdog."""

    DONE = "done"
    AGAIN = "to be tried again"
    FAILED = "failed"


@dataclass(frozen=True)
class RetractState:
    """The part of the watchdog that survives a restart.

    Attributes:
        calls_people: whether a person must still be called: the tip was retracted, could not be retracted, or was in
            danger when the run was stopped.
        stops: the stop actions still to be sent; a retract follows them.
        for_feedback: whether the tip is in danger because the feedback is off.
        may_come: whether a retract sent before a kill of the scheduler may still be in the translator's queue; its
            answer goes to the killed process.
    """

    duty: TipDuty = TipDuty.NONE
    calls_people: bool = False
    stops: tuple[str, ...] = ()
    for_feedback: bool = False
    may_come: bool = False


@dataclass(frozen=True)
class Watchdog:
    """The scheduler's own duties towards the running measurement and the tip.

    The caller sends `next_action()` before anything else, reports by `answered` or `unsent`, and calls `look_again` at
    `due_s`. While the watchdog `owes_retract`, no component commands the microscope. While a failed retract is
    `put_off`, a person or a solver of device-malfunction may. The duty towards the tip follows from a table.

    Attributes:
        starting: the action that stops a measurement just started; None once a newer state is known.
        sent: the action that was sent and is not answered.
        attempts: the number of failed attempts at the present action.
        can_retract: whether the microscope has the action to retract, as far as known.
        refused_at: number of states seen at the last answer NOT_FREE.
        told_to_stop: whether a stop was sent for the running measurement.
        unstoppable: whether the running measurement failed to stop.
        due_s: the real time at which `look_again` is due.
        retries: the number of failed retracts in a row; each doubles the wait.
        in_haste: whether the experiment ends, so that all waits are short.
        returning: whether the way back of a held z has begun: a retract waits for its end.
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
    returning: bool = False

    def restored(self, tip: RetractState) -> Watchdog:
        """Restore the duty from before a restart: an unanswered retract is owed again."""
        # a translator that hung may still carry out the retract after a person has cleared the duty, and the scan that
        # follows would have no tip at the surface; what the controller has already can't be taken back
        was_asked = tip.duty is TipDuty.ASKED
        duty = TipDuty.OWED if was_asked else tip.duty
        return replace(self, tip=replace(tip, duty=duty, may_come=was_asked or tip.may_come))

    def translator_answered(self) -> Watchdog:
        """Process the first answer since the restart: all requests of the killed scheduler are now done or lost.

        If a retract is still owed, the tip is retracted again, which does no harm. If a person has attended to the tip
        meanwhile, the old retract may have come after that: the person is called again.
        """
        if not self.tip.may_come:
            return self
        dog = replace(self, tip=replace(self.tip, may_come=False))
        return dog if dog.owes_retract else dog._after(TipEvent.RETRACTED_LATE)

    def begun(self, now_s: float) -> Watchdog:
        """Start the wait for an owed retract after a restart.

        Missed packets come first, and the translator may not be connected yet.
        """
        return replace(self, due_s=now_s + self.settings.again_s) if self.owes_retract else self

    @property
    def owes_retract(self) -> bool:
        """True while the tip has to be retracted, now or later."""
        return self.tip.duty is not TipDuty.NONE

    @property
    def put_off(self) -> bool:
        """True while the retract has failed, and is tried again later."""
        return self.tip.duty is TipDuty.PUT_OFF

    @property
    def left_to_people(self) -> bool:
        """Whether a person must still be called to decide how to go on."""
        return self.tip.calls_people

    @property
    def wanted(self) -> tuple[str, ...]:
        """The actions still to be sent, in order."""
        retract = self.settings.retract
        return (*self.tip.stops, retract) if self.owes_retract and retract is not None else self.tip.stops

    @property
    def question(self) -> str:
        """The action whose support is checked when a translator connects."""
        return self.settings.retract or names.STOP_SCAN

    def with_retract(self, *, is_supported: bool) -> Watchdog:
        """Register whether the microscope can retract: another translator may have been started."""
        return replace(self, can_retract=is_supported)

    def people_called(self) -> Watchdog:
        return replace(self, tip=replace(self.tip, calls_people=False))

    def leave_to_people(self, microscope: MicroscopeStatus) -> Watchdog:
        """Keep the duty towards a tip in danger when the run is stopped, and call a person.

        The exiting translator retracts the tip.
        """
        return (
            self._after(TipEvent.LEFT) if self.settings.retract is not None and microscope.danger is not None else self
        )

    # --- events of the microscope ---

    def state_reported(self, microscope: MicroscopeStatus) -> Watchdog:
        """Process a new state of the microscope."""
        dog = replace(self, starting=None)
        if microscope.state not in STOPS:
            dog = replace(dog, told_to_stop=False, unstoppable=False)
        # the measurement ended before a stop could be sent
        if microscope.state is not ScopeState.FREE or self.sent is not None:
            return dog
        return dog._with_stops(tuple(one for one in dog.tip.stops if one == names.RELEASE_Z))

    def started(self, action: str, states_seen: int, microscope: MicroscopeStatus) -> Watchdog:
        """Register an action that succeeded, or may have; `states_seen` states were known when it was sent.

        The answer may arrive before or after the state that the action leads to.
        """
        # otherwise a state has overtaken this answer, and shows the running activity
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
        """Process the loss of control for `cause` while the translator executed the action `in_flight` (None: none).

        Args:
            had_died: whether the process that got control has died; its restarted successor gives control back.
            by_holder: whether the holder itself caused the loss.
            was_seen_to: whether the holder was attending to a tip that was not retracted.
        """
        # a holder that gives control back knows the state it leaves, and so does a person who takes control
        knows = cause in (Cause.RELEASED, Cause.MANUAL) or (cause is Cause.SOLVED and by_holder)
        dog = self
        if cause is Cause.BY_HAND:  # see `left_to_person`
            return dog
        if cause is Cause.MANUAL or (was_seen_to and knows and not had_died):
            dog = dog.seen_to()
        if dog.can_retract and (had_died or not knows) and microscope.danger is not None:
            dog = dog._endangered(microscope)
        if microscope.risk.holds_z or in_flight == names.HOLD_Z:
            dog = dog.stopping(names.RELEASE_Z)
        stop = dog.to_stop(in_flight, microscope)
        is_to_stop = cause in dog.settings.stop_when or dog.owes_retract or names.RELEASE_Z in dog.tip.stops
        return dog.stopping(stop) if is_to_stop and stop is not None else dog

    def to_stop(self, in_flight: str | None, microscope: MicroscopeStatus) -> str | None:
        """Return the action that stops the running measurement, or the one about to begin; None: neither is known."""
        return STOPS.get(microscope.state) or self.starting or STARTS.get(in_flight or "")

    def stopping(self, stop: str) -> Watchdog:
        """Require a stop of the running measurement."""
        return self if stop in self.tip.stops else self._with_stops((stop, *self.tip.stops))

    def left_to_person(self, *, is_unsent: bool) -> Watchdog:
        """Drop all duties: a person at the microscope sees to the tip, and may have begun a scan.

        Args:
            is_unsent: whether the action that counts as sent still waited, and was removed.
        """
        dog = replace(self, sent=None)._after(TipEvent.NOT_YET) if is_unsent else self
        return replace(dog.seen_to()._with_stops(()), starting=None)

    def newly_wanted(self, before: Watchdog) -> list[str]:
        """Return the actions wanted now and not before, as far as it is certain that they will be sent."""
        known = () if before.put_off else before.wanted
        # once z is released, nothing is retracted unless that fails
        wanted = self.tip.stops if names.RELEASE_Z in self.tip.stops else self.wanted
        return [] if self.put_off else [action for action in wanted if action not in known]

    def _endangered(self, microscope: MicroscopeStatus) -> Watchdog:
        if self.settings.retract is None:
            return self
        tip = replace(self.tip, for_feedback=microscope.endangered_by_feedback)
        # the solver that attended to the tip has lost control: retry at once
        due_s = None if self.put_off else self.due_s
        return replace(self, tip=tip, due_s=due_s)._after(TipEvent.ENDANGERED)

    def seen_to(self) -> Watchdog:
        """Drop the duty to retract: a person or a solver attends to the tip. A retract in flight goes on."""
        return self._after(TipEvent.SEEN_TO)

    def hurry(self, now_s: float) -> Watchdog:
        """Shorten all waits to a second: the experiment ends."""
        due_s = None if self.due_s is None else min(self.due_s, now_s + _SOON_S)
        return replace(self, in_haste=True, due_s=due_s)

    # --- requests to the translator ---

    def next_action(self, microscope: MicroscopeStatus) -> tuple[Watchdog, str | None]:
        """Return the action to send now, which counts as sent; None: no action."""
        dog = self
        if microscope.risk.feedback_on is True:
            dog = replace(dog.seen_to() if dog.tip.for_feedback else dog, returning=False)
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
        is_running = microscope.state in STOPS or self.returning
        return not self.tip.stops and is_running and not self.unstoppable

    def answered(self, code: int, microscope: MicroscopeStatus, now_s: float) -> tuple[Watchdog, SafetyResult]:
        """Process the translator's answer to the sent action; `code` is NO_RESPONSE if there was no answer."""
        action, dog, is_retract = self.sent or "", replace(self, sent=None), self.tip.duty is TipDuty.ASKED
        if code == ControlResponse.SUCCESS:
            dog = replace(dog, starting=None)
            if is_retract:
                return dog._after(TipEvent.RETRACTED), SafetyResult.DONE
            due_s = now_s + dog._wait_s if dog.owes_retract else None
            returning = action == names.RELEASE_Z
            return replace(dog._without_stop(action), due_s=due_s, returning=returning), SafetyResult.DONE
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
        """Process a success after its deadline: a person is called after a late retract, too."""
        return self._after(TipEvent.RETRACTED_LATE) if action == self.settings.retract else self

    def unsent(self, now_s: float) -> Watchdog:
        """Undo `next_action`: the translator is not connected. The action is sent after the next connection."""
        dog = replace(self, sent=None, attempts=0, refused_at=-1, told_to_stop=False)._after(TipEvent.NOT_YET)
        return replace(dog, due_s=now_s + dog._wait_s) if dog.owes_retract and dog.due_s is None else dog

    def translator_is_there(self, now_s: float) -> Watchdog:
        """Schedule a postponed retract for a second later: a new translator sends its first packets before."""
        return replace(self, due_s=now_s + _SOON_S) if self.put_off else self

    # --- expired waits ---

    def look_again(
        self, microscope: MicroscopeStatus, now_s: float, *, is_seen_to: bool
    ) -> tuple[Watchdog, str | None]:
        """Continue after an expired wait, or when a postponed retract is due.

        Args:
            is_seen_to: a person or a solver attends to the tip.

        Returns:
            The watchdog, and a new message for people or None.
        """
        dog = replace(self, due_s=None)
        if dog.put_off:
            return replace(dog, refused_at=-1)._after(TipEvent.SEEN_TO if is_seen_to else TipEvent.DUE), None
        if not dog.wanted or dog.sent is not None:
            return replace(dog, returning=False), None
        if dog.tip.stops:
            action = dog.tip.stops[0]
            dog = replace(dog._without_stop(action), unstoppable=True, refused_at=-1)
            return dog, f"the microscope is never free to {action}"
        is_refused = dog.refused_at == microscope.states_seen
        if not is_refused and dog._waits_for_stop(microscope):
            what = "is not back from a held z" if dog.returning else "does not stop, although a stop was sent"
            return replace(dog, unstoppable=True, returning=False), f"the microscope {what}"
        why = "the microscope is never free for that" if is_refused else "its translator is not there"
        warning = None if dog.retries else f"the tip was left in danger and can't be retracted: {why}"
        return dog._retract_later(now_s), warning

    @property
    def _wait_s(self) -> float:
        return _SOON_S if self.in_haste else self.settings.again_s

    def _retract_later(self, now_s: float) -> Watchdog:
        wait_s = min(self._wait_s * 2**self.retries, self.settings.longest_s)
        due_s = now_s + (_SOON_S if self.in_haste else wait_s)
        dog = self._after(TipEvent.FAILED)
        # bounded, so that 2**retries stays a usable number in a long run
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
