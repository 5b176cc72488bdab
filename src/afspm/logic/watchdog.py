"""The watchdog: what the scheduler itself tells the microscope to do when control is taken from somebody.

It stops the scan or spectrum that is running, and retracts the tip where its holder did not itself give control back
and left it in a dangerous state: it can't put that right any more, and nobody else knows of it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from enum import Enum

from afspm.logic.arbitration import Cause
from afspm.model import ControlResponse, Feedback, Parameter, Request, ScopeState, names

FEEDBACK_OFF = "feedback-off"
"""The name of the dangerous state in which the feedback is known to be switched off."""

_STOP = {ScopeState.SCANNING: names.STOP_SCAN, ScopeState.SPEC: names.STOP_SPEC}
_STARTS = {names.START_SCAN: names.STOP_SCAN, names.START_SPEC: names.STOP_SPEC}
_OFF = names.OFF_WORDS | {"0.0"}  # a translator that is not ours may take a number
_DEFAULT_STOPS = frozenset({Cause.PROBLEM, Cause.MANUAL, Cause.DEAD, Cause.IDLE})


@dataclass(frozen=True)
class WatchdogSettings:
    """When the scheduler acts by itself.

    Attributes:
        stop_when: for which causes of losing control what is running is stopped.
        dangerous: the states in which the tip is retracted when its holder loses control: names of ScopeState, and
            "feedback-off".
        retract: the action that does it; None: never.
        attempts: how often an action that gets no response is tried.
        again_s: after how long (real) a tip that was not retracted is tried to be again; twice as long each time.
        longest_s: but never longer than this.
    """

    stop_when: Collection[Cause] = _DEFAULT_STOPS
    dangerous: Collection[str] = frozenset({ScopeState.COARSE_MOTOR.name, FEEDBACK_OFF})
    retract: str | None = names.RETRACT
    attempts: int = 3
    again_s: float = 10.0
    longest_s: float = 300.0


class Result(Enum):
    """What became of an action of the watchdog's."""

    DONE = "done"
    AGAIN = "to be tried again"
    FAILED = "failed"


class Watchdog:
    """Knows what the microscope is doing, and what the scheduler wants it to do.

    The caller sends `next_action()` before anything else, reports by `answered`, and lets nobody command while it
    `wants_retract`. A tip that the microscope does not retract stays wanted away: others may command, and unless one of
    them sees to it `try_again` is called when it is `due_s`.
    """

    def __init__(self, settings: WatchdogSettings | None = None) -> None:
        self._settings = settings or WatchdogSettings()
        self._state = ScopeState.UNDEFINED
        self._feedback_on: bool | None = None
        self._is_away = False  # the tip: neither the motor that retracts it nor a feedback that is off does harm
        self._starting: str | None = None
        self._states_seen = 0
        self._wanted: list[str] = []
        self._sent = False
        self._attempts = 0
        self._can_retract = True  # as far as we know
        self._danger_told: str | None = None
        self._refused_at = -1  # states seen when the microscope last was not free
        self._left_to_people = False
        self._put_off = False  # the tip is in danger still, and is tried to be retracted later
        self._due_s: float | None = None
        self._again_s = self._settings.again_s
        self._unstoppable = False  # what runs

    @property
    def retract(self) -> str | None:
        """The action that retracts the tip, if it may be used."""
        return self._settings.retract

    @property
    def wanted(self) -> tuple[str, ...]:
        """What is not done yet, to be kept over a restart of the scheduler."""
        return tuple(self._wanted)

    @property
    def left_to_people(self) -> bool:
        """It has retracted the tip, or could not, and nobody was called yet: to go on is for a person to decide."""
        return self._left_to_people

    @property
    def put_off(self) -> bool:
        """The microscope did not retract the tip: others may see to it."""
        return self._put_off

    def restore(self, wanted: Iterable[str], *, left_to_people: bool = False, attended: bool = False) -> None:
        """Want what a scheduler wanted before.

        Args:
            attended: retracting was put off, and somebody sees to the tip.
        """
        self._wanted = [action for action in wanted if not (attended and action == self._settings.retract)]
        self._left_to_people = left_to_people

    def leave_to_people(self) -> None:
        """Nobody can be told any more what to do with a tip in danger: the translator sees to it as it leaves."""
        self._left_to_people |= self._settings.retract is not None and self.danger is not None

    def people_called(self) -> None:
        """The problem was flagged."""
        self._left_to_people = False

    @property
    def wants_retract(self) -> bool:
        """The tip is being retracted."""
        return self.owes_retract and not self._put_off

    @property
    def owes_retract(self) -> bool:
        """The tip is to be retracted, now or later."""
        return self._settings.retract in self._wanted

    @property
    def due_s(self) -> float | None:
        """When, real, `try_again` is to be called; None: not."""
        return self._due_s

    def try_again(self, now_s: float, *, attended: bool) -> str | None:
        """The tip that was not retracted is tried to be, unless it is out of danger, or somebody has `attended` to it.

        Returns:
            what people are to be told, if it is that the microscope is still not free for that.
        """
        if not self._put_off:
            self._retract_later(now_s)
            return f"{self.danger}, and the microscope is not free to retract the tip" if self.danger else None
        self._put_off, self._due_s, self._refused_at = False, None, -1
        if attended or self.danger is None:
            self._forget_retract()
        return None

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
        self._unstoppable = False
        self._see_danger()
        if state is ScopeState.FREE and not self._sent:  # it ended while the translator could not be told to stop it
            self._wanted = [action for action in self._wanted if action not in _STOP.values()]

    def feedback_is(self, feedback: Feedback) -> None:
        if feedback.on is not None:
            self._feedback_on = feedback.on
            self._is_away = self._is_away and not feedback.on
            self._see_danger()

    @property
    def danger(self) -> str | None:
        """What is dangerous now, in words; None: nothing, or it was seen to."""
        dangerous = self._settings.dangerous
        if self._is_away:
            return None
        if self._feedback_on is False and FEEDBACK_OFF in dangerous:
            return "the feedback is off"
        return f"the microscope is in {self._state.name}" if self._state.name in dangerous else None

    def left_in_danger(self) -> str | None:
        """The danger about which nothing is done, to be told: each once."""
        danger = None if self.wants_retract else self.danger
        if danger == self._danger_told:
            return None
        self._danger_told = danger
        return danger

    def _see_danger(self) -> None:
        if self.danger is None:
            self._danger_told = None

    def started(self, action: str, states_seen: int, *, certain: bool = True) -> None:
        """An action succeeded, or may have, that was sent when `states_seen` states were known.

        The answer may overtake the state that the microscope is in by it, or be overtaken.
        """
        if action not in _STARTS and action not in _STOP.values():
            self._is_away = certain and action == self._settings.retract  # what else there is may bring the tip back
        if states_seen == self._states_seen:
            self._starting = _STARTS.get(action, self._starting)

    def cannot(self, action: str) -> None:
        """The microscope has no such action."""
        if action == self._settings.retract:
            self._can_retract = False

    def control_taken(
        self, cause: Cause, in_flight: str | None, *, had_died: bool = False, by_holder: bool = False
    ) -> list[str]:
        """Control was taken for `cause` while the action `in_flight` was with the translator.

        Args:
            had_died: the process that got control has died; who gives it back is the one started in its place.
            by_holder: it is the holder's own doing.

        Returns:
            What is wanted now, in order.
        """
        wanted = []
        stop = _STOP.get(self._state) or self._starting or _STARTS.get(in_flight or "")
        # whoever gives control back knows what it leaves, and so does a person who takes it
        knows = cause in (Cause.RELEASED, Cause.MANUAL) or (cause is Cause.SOLVED and by_holder)
        retract = self._settings.retract if self._can_retract and (had_died or not knows) else None
        if self.danger is None:
            retract = None
        if self._put_off:
            self._forget_retract()
        if stop is not None and (cause in self._settings.stop_when or retract is not None):
            wanted.append(stop)
        if retract is not None:
            wanted.append(retract)
        self._wanted += [action for action in wanted if action not in self._wanted]
        return wanted

    def next_action(self) -> str | None:
        """The action to send now, if one is; it counts as sent."""
        if self._sent or not self._wanted or self._put_off or self._refused_at == self._states_seen:
            return None
        action = self._wanted[0]
        if action == self._settings.retract and self._state in _STOP and not self._unstoppable:
            return None  # it is being stopped
        self._sent, self._due_s = True, None
        return action

    def answered(self, code: int, now_s: float) -> Result:
        """The translator answered what was sent (or NO_RESPONSE)."""
        self._sent = False
        is_retract = self._wanted[0] == self._settings.retract
        if code == ControlResponse.SUCCESS:
            self._starting = None
            if is_retract:
                self._is_away = True
                self._see_danger()
                self._left_to_people = True
            self._forget()
            return Result.DONE
        if code == ControlResponse.NOT_FREE:
            self._refused_at = self._states_seen
            self._due_s = now_s + self._settings.again_s if is_retract else None
            return Result.AGAIN
        self._attempts += 1
        if code == ControlResponse.NO_RESPONSE and self._attempts < self._settings.attempts:
            return Result.AGAIN
        if is_retract and code != ControlResponse.ACTION_NOT_SUPPORTED:
            self._retract_later(now_s)
        else:
            self._unstoppable = not is_retract
            self._left_to_people |= is_retract
            self._forget()
        return Result.FAILED

    def unsent(self) -> None:
        """What `next_action` said could not be sent: the translator is not connected. Again when it is."""
        self._sent = False
        self._attempts = 0
        self._refused_at = -1

    def _forget(self) -> None:
        """What was answered is not wanted any more."""
        if self._wanted.pop(0) == self._settings.retract:
            self._again_s = self._settings.again_s
        self._attempts = 0

    def _retract_later(self, now_s: float) -> None:
        self._put_off, self._left_to_people = True, True
        self._due_s = now_s + self._again_s
        self._again_s = min(2 * self._again_s, self._settings.longest_s)
        self._attempts = 0

    def _forget_retract(self) -> None:
        self._wanted = [action for action in self._wanted if action != self._settings.retract]
        self._put_off, self._due_s = False, None
        self._again_s = self._settings.again_s


def feedback_of(request: Request) -> Feedback | None:
    """What a request sets of the feedback."""
    subject = request.subject
    if isinstance(subject, Parameter) and subject.name == names.FEEDBACK_ON and subject.value is not None:
        return Feedback(on=subject.value.strip().lower() not in _OFF)
    return subject if isinstance(subject, Feedback) else None
