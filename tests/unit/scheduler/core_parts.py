"""Frozen parts of the scheduler's state, changed step by step."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

from afspm.model import Feedback, ScopeState
from afspm.model.microscope_status import MicroscopeStatus
from afspm.scheduler.control.arbitration import Cause
from afspm.scheduler.safety.watchdog import SafetyResult, TipDuty, Watchdog, WatchdogSettings

T = TypeVar("T")


class Held(Generic[T]):
    """Calls the methods of a part; a part returned by a method (perhaps with a result) replaces the former one."""

    def __init__(self, part: T) -> None:
        self.part = part

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.part, name)
        return (lambda *args, **kwargs: self._take(found(*args, **kwargs))) if callable(found) else found

    def _take(self, returned: Any) -> Any:
        kind = type(self.part)
        if isinstance(returned, kind):
            self.part = returned
            return None
        if isinstance(returned, tuple) and returned and isinstance(returned[0], kind):
            self.part, *results = returned
            return results[0] if len(results) == 1 else tuple(results)
        return returned


class Dog:
    """A watchdog with its microscope."""

    def __init__(self, settings: WatchdogSettings) -> None:
        self.watchdog = Watchdog(settings)
        self.microscope = MicroscopeStatus(settings.dangerous)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.watchdog, name)

    @property
    def danger(self) -> str | None:
        return self.microscope.danger

    @property
    def states_seen(self) -> int:
        return self.microscope.states_seen

    def untold(self) -> str | None:
        self.microscope, danger = self.microscope.telling()
        return danger

    def state(self, state: ScopeState) -> None:
        self.microscope = self.microscope.with_state(state, 0.0)
        self.watchdog = self.watchdog.state_reported(self.microscope)

    def feedback(self, *, on: bool) -> None:
        self.microscope = self.microscope.with_feedback(Feedback(on=on))

    def feedback_may_be_off(self) -> None:
        self.microscope = self.microscope.feedback_may_be_off()

    def feedback_was_left(self) -> None:
        self.microscope = self.microscope.feedback_was_left()

    def started(self, action: str, states_seen: int, *, certain: bool = True) -> None:
        self.watchdog = self.watchdog.started(action, states_seen, self.microscope)
        is_away = certain and action == self.watchdog.settings.retract
        self.microscope = self.microscope.after_action(action, is_away=is_away)

    def control_taken(self, cause: Cause, in_flight: str | None, **how: bool) -> list[str]:
        before = self.watchdog
        self.watchdog = before.control_taken(cause, in_flight, self.microscope, **how)
        return self.watchdog.newly_wanted(before)

    def next_action(self) -> str | None:
        self.watchdog, action = self.watchdog.next_action(self.microscope)
        return action

    def answered(self, code: int, now_s: float) -> SafetyResult:
        is_retract = self.watchdog.tip.duty is TipDuty.ASKED
        self.watchdog, result = self.watchdog.answered(code, self.microscope, now_s)
        if is_retract and result is SafetyResult.DONE:
            self.microscope = self.microscope.with_tip(away=True)
        return result

    def look_again(self, now_s: float, *, is_seen_to: bool) -> str | None:
        self.watchdog, told = self.watchdog.look_again(self.microscope, now_s, is_seen_to=is_seen_to)
        return told

    def tell(self, name: str, *args: Any) -> None:
        """Call a method of the watchdog that returns the next one."""
        self.watchdog = getattr(self.watchdog, name)(*args)
